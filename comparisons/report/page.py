"""report.html: one self-contained page, drawn by plotly in the browser; it asks for nothing outside itself."""

from __future__ import annotations

import base64
import functools
import json
from collections.abc import Iterator, Mapping
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from nocl.comparisons.report.explain import explained_method, worst
from nocl.comparisons.report.payload import payload, valued
from nocl.comparisons.report.results import REFERENCE, Results, count, percent
from nocl.comparisons.report.tables import Table, facts, tables, x0_text
from nocl.comparisons.report.verdict import verdict

SAID_FIRST = 3  # sentences of the verdict that stand above the table


def page(report: Results, pictures: Mapping[str, Mapping[str, bytes]], run: Mapping[str, Any]) -> str:
    """The whole page; `pictures` by name and form ("svg", "png") are what is printed, or shown without JavaScript."""
    title = f"{report.ocp.system.name}: {', '.join(j.name for j in report.judged)}"
    sections = list(_sections(report, pictures, run))
    links = "".join(f'<a href="#{name}">{escape(heading)}</a>' for name, heading, _ in sections[1:])
    body = [f"<h1>{escape(title)}</h1>", f"<p class=note>{escape(_what(report))}</p>", sections[0][2],
            f"<nav>{links}</nav>",
            *(f"<section id={name}><h2>{escape(heading)}</h2>{content}</section>"
              for name, heading, content in sections[1:])]
    web = files("nocl.comparisons.report") / "web"
    return Template((web / "page.html").read_text(encoding="utf-8")).substitute(
        title=escape(title), body="\n".join(body), style=(web / "page.css").read_text(encoding="utf-8"),
        data=script_json(payload(report)), plotly=plotly_js(), script=(web / "page.js").read_text(encoding="utf-8"))


@functools.cache
def plotly_js() -> str:
    """plotly.js as plotly.py ships it."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs()).replace("</script", "<\\/script")


def script_json(data: Any) -> str:
    """JSON that may stand in a script element: no '<' can end it. NaN and inf become null."""
    return json.dumps(_finite(data), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and (data != data or abs(data) == float("inf")) else data


def _what(report: Results) -> str:
    how = str(report.settings.get("initial states", ""))
    how += f", each at its own {', '.join(report.ocp.parameter_names)}" if report.ocp.np else ""
    return f"{count(len(report.x0), 'initial state')} {how}, {count(len(report.judged), 'method')}."


Section = tuple[str, str, str]  # its anchor, its heading, its content


def _sections(report: Results, pictures: Mapping[str, Mapping[str, bytes]],
              run: Mapping[str, Any]) -> Iterator[Section]:
    """In the order of reading: the verdict first."""
    made, image = tables(report), functools.partial(_static, pictures)
    yield "verdict", "Verdict", _verdict(report, made["summary"])
    yield "explore", "Gap against initial state", EXPLORER + image("map") + image("trajectories")
    yield "gaps", "How near to the best known cost", _plot("ecdf", GAPS) + image("gaps") + _costs(report, image)
    if valued(report) is not None:
        yield "value", "Value function", SLICES + image("value")
    yield "worst", _worst_heading(report), _worst(report) + made["worst"].html() + image("worst")
    if "errors" in made:
        yield "errors", made["errors"].title, made["errors"].html()
    yield "timings", "Timings", _plot("times", TIMES) + image("timings") + made["timings"].html()
    if "audits" in made:
        yield "audits", made["audits"].title, made["audits"].html()
    if report.robustness is not None:
        told = facts((s.name, s.text) for s in report.robustness.scenarios)
        yield "robustness", made["robustness"].title, (_plot("robust", ROBUST, tall=True) + image("robustness")
                                                       + told.html() + made["robustness"].html())
    if "promises" in made:
        said = "".join(f"<li>{escape(str(p))}</li>" for p in report.promises)
        yield "promises", made["promises"].title, f"<ul>{said}</ul>" + made["promises"].html()
    if "stability" in made:
        yield "stability", made["stability"].title, (_plot("poles", POLES) + image("stability")
                                                     + made["stability"].html())
    if "regions" in made:
        yield "regions", made["regions"].title, REGIONS + image("regions") + made["regions"].html()
    for name in ("failures", "impossible"):
        if name in made:
            yield name, made[name].title, made[name].html()
    yield "run", "What was run", _run(report, run)


def _verdict(report: Results, table: Table) -> str:
    said = verdict(report)
    first, more = said[:SAID_FIRST], said[SAID_FIRST:]
    return ("".join(f"<p class=verdict>{escape(s)}</p>" for s in first) + table.html()
            + "".join(f"<p>{escape(s)}</p>" for s in more))


def _plot(name: str, caption: str, tall: bool = False) -> str:
    return (f'<figure><div id={name} class="plot{" tall" if tall else ""}"></div><figcaption>{escape(caption)}'
            "</figcaption></figure>")


def _static(pictures: Mapping[str, Mapping[str, bytes]], name: str) -> str:
    """The picture that stands in for a plot on paper."""
    if name not in pictures:
        return ""
    form, content = min(pictures[name].items(), key=lambda item: len(item[1]))
    source = f"data:image/{'svg+xml' if form == 'svg' else form};base64,{base64.b64encode(content).decode()}"
    return f'<img class=static alt="{escape(name)}" src="{source}">'


def _costs(report: Results, image: Any) -> str:
    return "" if len(report.judged) < 2 else _plot("costs", COSTS) + str(image("costs"))


def _worst_heading(report: Results) -> str:
    return f"The worst states of {report.judged[explained_method(report)].name}, explained"


def _worst(report: Results) -> str:
    """A card for each state; its button shows the state in the explorer."""
    cards, explained = [], worst(report)
    if not explained:
        name = escape(report.judged[explained_method(report)].name)
        return f"<p>{name} has the best known cost at every initial state: nothing was lost.</p>"
    for e in explained:
        gap = f"+{percent(max(e.gap, 0.0))} %" if e.gap != float("inf") else "no gap"
        said = "".join(f"<li>{escape(s)}</li>" for s in e.sentences if s)
        cards.append(f"<article><h3>State {e.state} <small>{escape(gap)}</small></h3>"
                     f"<p class=note>{escape(x0_text(report, e.state))}</p><ul>{said}</ul>"
                     f"<button class=show data-state={e.state}>show its runs</button></article>")
    return "<div class=cards>" + "".join(cards) + "</div>"


def _run(report: Results, run: Mapping[str, Any]) -> str:
    pairs = [(key, value) for part in ("settings", "versions", "machine") for key, value in run[part].items()
             if value is not None]
    pairs += [(key, run[key]) for key in ("commit", "made") if run.get(key)]
    pairs += [("seconds", f"{run['seconds']:g}"), *((f"{j.name}, how it was run", j.how) for j in report.judged
                                                   if j.name != REFERENCE or j.how)]
    return facts(pairs).html() + f"<div class=scroll tabindex=0><pre>{escape(str(run['problem']))}</pre></div>"


EXPLORER = """<div class=controls><label>across <select id=across></select></label>
<label>up <select id=up></select></label><label>colour <select id=colour></select></label></div>
<figure><div id=map class="plot"></div><figcaption>Each point is an initial state. Click one to see its runs below;
a cross failed or violates a constraint, or no plan holds them from there.</figcaption></figure>
<div id=panel><div class=controls><h3 id=which></h3><button id=previous aria-label="previous state">&lsaquo;</button>
<label>state <input id=number type=number min=0 step=1></label><button id=next aria-label="next state">&rsaquo;</button>
</div><div id=outcome class=scroll tabindex=0></div><div id=audit class=scroll tabindex=0></div>
<label><input id=models type=checkbox> the same control on the learned model and under RK4</label>
<figure><div id=runs class="plot"></div><figcaption>States and controls of every method on the exact dynamics. Grey
dots: the goal; grey dashes: the bounds of a control; red dashes: constraints, those of more than one state or control
by their values.</figcaption></figure>
<div class=pair><figure><div id=along class="plot"></div><figcaption id=alongnote></figcaption></figure>
<figure><div class=controls><label>across <select id=phasex></select></label>
<label>up <select id=phasey></select></label></div><div id=phase class="plot"></div><figcaption>Phase portrait: the open
circle is where it starts, the star the goal.</figcaption></figure></div></div>"""
SLICES = """<div class=controls><label>over <select id=slicepair></select></label>
<label>at <select id=slicetime></select></label></div>
<figure><div id=slice class="plot"></div><figcaption id=slicenote></figcaption></figure>"""
REGIONS = """<figure><div id=region class="plot"></div><figcaption>Share of initial states that succeed as the spread of
their distribution grows, with exact bounds; 1 is the problem's own.</figcaption></figure>
<div class=controls><label>method <select id=regionof></select></label>
<label>across <select id=regionx></select></label>
<label>up <select id=regiony></select></label></div>
<figure><div id=regionmap class="plot"></div><figcaption>All states that were tried, at all scales.</figcaption>
</figure>"""
GAPS = ("Share of initial states within a gap: the higher and the further left, the better. A line that ends below "
        "100 % belongs to a method that failed on the rest. Gaps below 0.001 % stand at the left edge.")
COSTS = "Each point is one initial state. Below the line a method is cheaper than the one on the horizontal axis."
TIMES = ("Wall time of the first answer at each initial state, and of each later control (feedback). Boxes: quartiles "
         "and median.")
ROBUST = ("Cost lost against the optimum solved anew under the same disturbance, a box for each scenario and method; "
          "losses below 0.01 % stand at the lower edge, failures are left out here and counted in the table.")
POLES = "Eigenvalues of the closed loop, frozen: left of the line they decay."
