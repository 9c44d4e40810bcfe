"""A report as files: report.html (one self-contained page), rows.csv, summary.json, figures/ as SVG and PNG."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from importlib import metadata
from pathlib import Path
from string import Template
from typing import Any

from nocl import store
from nocl.comparisons import figures as pictures
from nocl.comparisons.report import COLUMNS, NOTE, Report, cells, csv_text, flat_rows, number, percent

WORST = 5
PACKAGES = ("nocl", "casadi", "numpy", "scipy", "torch", "matplotlib")
CAPTIONS = {
    "gaps": ("How near to the best known cost", "Share of initial states within a gap: the higher and the further "
             "left, the better. A line that ends below 100 % belongs to a method that failed on the rest."),
    "costs": ("Cost, state by state", "Each point is one initial state. Below the grey line the method is cheaper than "
              "the one on the horizontal axis."),
    "trajectories": ("Trajectories", "States and controls over time, on the exact dynamics, from three initial states: "
                     "where the first method's gap is the least, at its median, and the widest. Grey: the goal."),
    "worst": ("The worst three, as trajectories", "The initial states of the table above with the widest gap."),
}


def write_report(report: Report, folder: Path) -> Path:
    """Write all files into the folder, each atomically; everything is made before the first is written."""
    _check_folder(folder)
    drawn = pictures.draw(report)
    files: dict[Path, bytes] = {}
    for name, figure in drawn.items():
        for form in ("svg", "png"):
            files[folder / "figures" / f"{name}.{form}"] = pictures.encode(figure, form)
    svgs = {name: files[folder / "figures" / f"{name}.svg"] for name in drawn}
    run = what_was_run(report)
    files[folder / "rows.csv"] = csv_text(flat_rows(report)).encode()
    files[folder / "report.html"] = page(report, svgs, run).encode()
    for path, content in files.items():
        store.write_bytes(path, content)
    store.write_json(folder / "summary.json", summary_data(report) | run)
    for name in set(pictures.NAMES) - set(drawn):  # of the report that this one replaces
        for form in ("svg", "png"):
            (folder / "figures" / f"{name}.{form}").unlink(missing_ok=True)
    return folder / "report.html"


def summary_data(report: Report) -> dict[str, Any]:
    """Verdict, summary and what a study found, without arrays over the states, as plain data."""
    return {"verdict": report.verdict(), "summary": list(report.summary()),
            "audits": [audit.summary() for audit in report.audits],
            "robustness": [] if report.robustness is None else report.robustness.summary(),
            "promises": [vars(promise) | {"text": str(promise)} for promise in report.promises],
            "stability": [s.summary() for s in report.stability], "regions": [r.summary() for r in report.regions]}


def _check_folder(folder: Path) -> None:
    for path in (folder, folder / "figures", *folder.parents):
        if path.exists() and not path.is_dir():
            raise ValueError(f"{path} is a file; expected a folder to write the report to: name another one")


def what_was_run(report: Report) -> dict[str, Any]:
    """Versions, machine, settings and equations: what it takes to run it again."""
    return {"settings": dict(report.settings), "seconds": round(report.seconds, 3),
            "made": datetime.now(UTC).isoformat(timespec="seconds"), "versions": _versions(),
            "machine": {"python": platform.python_version(), "system": platform.platform(), "cores": os.cpu_count()},
            "problem": repr(report.ocp)}


def _versions() -> dict[str, str]:
    """The versions of the packages that this process has loaded."""
    return {name: metadata.version(name) for name in PACKAGES if name in sys.modules}


def page(report: Report, svgs: dict[str, bytes], run: dict[str, Any]) -> str:
    """report.html: verdict, table, pictures, worst states, what was run."""
    title = f"{report.ocp.system.name}: {', '.join(j.name for j in report.judged)}"
    figure = {name: _figure(name, svg, report) for name, svg in svgs.items()}
    sections = [
        f"<h1>{escape(title)}</h1>", *(f"<p class=verdict>{escape(s)}</p>" for s in report.verdict()),
        _table([label for label, _, _ in COLUMNS], map(cells, report.summary())),
        f"<p class=note>{escape(' '.join(NOTE))}</p>",
        _table(["method", "how its control was run"], ([j.name, j.how] for j in report.judged), text=True),
        figure["gaps"], figure.get("costs", ""), figure["trajectories"],
        f"<h2>The worst {min(WORST, len(report.x0))} initial states of {escape(report.judged[0].name)}</h2>",
        _table(*_worst_table(report), text=True), figure["worst"], _failures(report), _run_section(run)]
    return PAGE.substitute(title=escape(title), body="\n".join(sections))


def _figure(name: str, svg: bytes, report: Report) -> str:
    title, caption = CAPTIONS[name]
    wide = " class=wide" if name in ("trajectories", "worst") else ""
    return (f'<h2>{escape(title)}</h2><figure><div class=scroll><img{wide} src="{pictures.data_uri(svg)}" '
            f'alt="{escape(title)}"></div><figcaption>{escape(caption)}</figcaption></figure>')


def _table(head: Sequence[str], body: Iterable[Sequence[str]], text: bool = False) -> str:
    """An HTML table that scrolls within itself on a narrow screen."""
    lines = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in line) + "</tr>" for line in body)
    heads = "".join(f"<th>{escape(h)}</th>" for h in head)
    return f"<div class=scroll><table{' class=text' if text else ''}><tr>{heads}</tr>{lines}</table></div>"


def _worst_table(report: Report) -> tuple[list[str], list[list[str]]]:
    names = report.ocp.system.state_names
    head = ["state", "x0", *(f"{j.name}: cost (gap)" for j in report.judged), "best known by"]
    body = []
    for i in pictures.worst_states(report)[:WORST]:
        x0 = ", ".join(f"{name} {number(v)}" for name, v in zip(names, report.x0[i], strict=True))
        runs = [_run_cell(report, m, i) for m in range(len(report.judged))]
        body.append([str(i), x0, *runs, report.best_method[i] or "nobody"])
    return head, body


def _run_cell(report: Report, m: int, i: int) -> str:
    s = report.judged[m].simulation
    if not s.success[i]:
        return f"failed: {s.message[i]}"
    if not report.feasible[m, i]:
        return f"{number(report.cost[m, i])}, violates a path constraint by {number(-s.clearance[i])}"
    return f"{number(report.cost[m, i])} ({percent(report.gap[m, i])} %)"


def _failures(report: Report) -> str:
    """All failures with their messages."""
    rows = [[j.name, str(i), str(j.simulation.message[i])] for j in report.judged for i in range(len(report.x0))
            if not j.simulation.success[i]]
    return "" if not rows else "<h2>What failed</h2>" + _table(["method", "state", "message"], rows, text=True)


def _run_section(run: dict[str, Any]) -> str:
    facts = [[key, str(value)] for part in ("settings", "versions", "machine") for key, value in run[part].items()]
    facts += [["made", run["made"]], ["seconds", f"{run['seconds']:g}"]]
    return ("<h2>What was run</h2>" + _table(["", ""], facts, text=True)
            + f"<div class=scroll><pre>{escape(run['problem'])}</pre></div>")


PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>$title</title>
<style>
:root { --text: #1b1f24; --back: #ffffff; --soft: #f3f5f7; --line: #d4d9de; --quiet: #59636e; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e3e7eb; --back: #14171a; --soft: #1f2428; --line: #3a4148; --quiet: #9aa4ae; }
  img { filter: invert(0.92) hue-rotate(180deg); }
}
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--back); max-width: 62rem;
       margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.verdict { font-size: 1.08rem; margin: 0.4rem 0; }
.note, figcaption { color: var(--quiet); font-size: 0.9rem; }
.scroll { overflow-x: auto; margin: 0.8rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.92rem; }
th, td { padding: 0.3rem 0.7rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--quiet); font-weight: 600; }
th:first-child, td:first-child, .text th, .text td { text-align: left; }
.text td { white-space: normal; vertical-align: top; }
figure { margin: 0; } img { max-width: 100%; height: auto; background: #ffffff; }
pre { background: var(--soft); padding: 0.8rem; font-size: 0.82rem; overflow-x: auto; margin: 0; }
@media (max-width: 40rem) { body { font-size: 15px; } img.wide { max-width: none; width: 48rem; } }
@media print { body { max-width: none; } img { filter: none; } h2, figure, table { break-inside: avoid; } }
</style>
</head>
<body>
$body
</body>
</html>
""")
