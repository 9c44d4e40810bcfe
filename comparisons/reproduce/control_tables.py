"""The tables of control as Markdown, LaTeX and CSV, and their figures: terminal errors, and flights in 3-D."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import TYPE_CHECKING

from nocl.comparisons.reproduce.control import TABLES, Cell, Entry, Published, Way, table
from nocl.support import store
from nocl.systems import load_ocp

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 4  # panels in a row of the flights
HEAD = ("problem", "way", "trained on", "terminal error", "of a seed", "control", "of a seed", "cost", "failed",
        "evaluations", "training: s (CPU s)", "ms a state", "seeds x states", "made", "paper: terminal error",
        "paper: control", "paper: NFE")


def write(folder: str | Path, cells: Sequence[Cell], name: str) -> list[Path]:
    """NAME.md, .tex, .csv and .png in the folder, and of the quadrotor's flights NAME-3d.png; their paths."""
    from nocl.comparisons.report.style import encode

    entries, folder = table(cells, name), Path(folder)
    texts = {"md": markdown(entries, name), "tex": latex(entries, name), "csv": as_csv(entries, name)}
    paths = [store.write_text(folder / f"{name}.{kind}", text) for kind, text in texts.items()]
    paths.append(store.write_bytes(folder / f"{name}.png", encode(figure(entries, name), "png")))
    if any(cell.paths for cell in cells):
        paths.append(store.write_bytes(folder / f"{name}-3d.png", encode(flights(cells, name), "png")))
    return paths


def _way(e: Entry, name: str) -> tuple[Way, Published | None]:
    way = TABLES[name].ways[e.way]
    return way, way.paper.get(e.problem)


def _trained_on(way: Way) -> str:
    """Rivals that have not been run learn models of their own."""
    return "its own model" if way.make is None else "f_theta" if way.learned else "f"


def _number(x: float, digits: int = 3) -> str:
    """So many digits, plain where that is readable; blank for NaN."""
    if not math.isfinite(x):
        return ""
    return f"{x:.{digits}g}" if 1e-4 <= abs(x) < 10**digits or x == 0 else \
        f"{x:,.0f}" if 1 <= abs(x) < 1e7 else f"{x:.1e}".replace("e+0", "e").replace("e-0", "e-")


def _pair(mean: float, spread: float, form: str = "{} ± {}") -> str:
    return form.format(_number(mean), _number(spread)) if math.isfinite(mean) else ""


def markdown(entries: Sequence[Entry], name: str) -> str:
    """A row for each problem and way: ours with the spread over states and over seeds, the paper's."""
    lines = [f"| {' | '.join(HEAD)} |", f"|{'---|' * len(HEAD)}"]
    for e in entries:
        way, paper = _way(e, name)
        took = _number(e.seconds) + (f" ({_number(e.cpu)})" if math.isfinite(e.cpu) else "")
        theirs = ["", "", ""] if paper is None else [
            _pair(paper.error, paper.error_std), _pair(paper.magnitude, paper.magnitude_std),
            "" if paper.evaluations is None else f"{paper.evaluations}"]
        seeds = [_pair(*pair, "{} .. {}") if e.seeds > 1 else "" for pair in
                 ((e.error_low, e.error_high), (e.magnitude_low, e.magnitude_high))]
        row = [e.problem, way.title, _trained_on(way), _pair(e.error, e.error_std), seeds[0],
               _pair(e.magnitude, e.magnitude_std), seeds[1], _number(e.cost), f"{e.failed}" if e.n else "",
               _number(e.evaluations), took, _number(e.ms), f"{e.seeds} x {e.n}" if e.n else "", e.made, *theirs]
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def latex(entries: Sequence[Entry], name: str) -> str:
    """In the form of the paper: ways down, problems across; its own numbers in grey below ours."""
    t = TABLES[name]
    problems = [p for p in t.problems if any(e.problem == p and e.seeds for e in entries)]
    head = " & ".join(rf"\multicolumn{{3}}{{c}}{{{p.capitalize()}}}" for p in problems)
    lines = [rf"\begin{{tabular}}{{l c {'| c c c ' * len(problems)}}}", r"\toprule", rf" & & {head} \\",
             r"\textbf{Methods} & S.T." + r" & Term. error & Control magn. & NFE" * len(problems) + r" \\", r"\midrule"]
    for key, way in t.ways.items():
        row = {e.problem: e for e in entries if e.way == key}
        if not row:
            continue
        ours = [way.title.replace("CND (R = 0)", "CND ($R = 0$)"), _dynamics(way)]
        theirs = [r"\quad paper", ""]
        for problem in problems:
            e, paper = row.get(problem), way.paper.get(problem)
            ours += ["--", "--", "--"] if e is None or not e.n else [
                _tex(e.error, e.error_std), _tex(e.magnitude, e.magnitude_std), _number(e.evaluations)]
            theirs += ["", "", ""] if paper is None else [rf"\color{{gray}}{text}" for text in (
                _tex(paper.error, paper.error_std), _tex(paper.magnitude, paper.magnitude_std),
                "--" if paper.evaluations is None else str(paper.evaluations))]
        lines.append(" & ".join(ours) + r" \\")
        if any(theirs[1:]):
            lines.append(" & ".join(theirs) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _tex(mean: float, spread: float) -> str:
    return rf"{_number(mean, 4)}\scriptsize{{$\pm${_number(spread)}}}"


def as_csv(entries: Sequence[Entry], name: str) -> str:
    """All numbers, a row for each problem and way; the paper's where there are any."""
    file = io.StringIO()
    writer, names = csv.writer(file, lineterminator="\n"), [f.name for f in fields(Published)]
    writer.writerow(["trained_on", *(f.name for f in fields(Entry)), *(f"paper_{n}" for n in names)])
    for e in entries:
        way, paper = _way(e, name)
        theirs = [""] * len(names) if paper is None else ["" if v is None else v for v in astuple(paper)]
        ours = ["" if isinstance(v, float) and math.isnan(v) else v for v in asdict(e).values()]
        writer.writerow([_trained_on(way), *ours, *theirs])
    return file.getvalue()


def figure(entries: Sequence[Entry], name: str) -> Figure:
    """Terminal error of each way, logarithmic, a panel for each problem: dots ours (bars: the seeds), rings theirs."""
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    from nocl.comparisons.report.style import COLOURS, STYLE

    t = TABLES[name]
    problems = [p for p in t.problems if any(e.problem == p for e in entries)]
    labels = [f"{way.title}, {_dynamics(way)}" for way in t.ways.values()]
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(3.4 + 3 * len(problems), 0.8 + 0.3 * len(labels)), layout="constrained")
        panels = drawing.subplots(1, len(problems), sharey=True, squeeze=False)[0]
        for problem, axes in zip(problems, panels, strict=True):
            _dots(axes, {e.way: e for e in entries if e.problem == problem}, t.ways, problem)
            axes.set(xscale="log", title=problem, xlabel="terminal error")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        panels[0].set_yticks(range(len(labels)), labels)
        panels[0].invert_yaxis()
        handles = [axes.plot([], [], "o", ms=4, color=COLOURS[0])[0],
                   axes.plot([], [], "o", mfc="none", color=COLOURS[1])[0]]
        drawing.legend(handles, ["nocl, over the seeds", "the paper"], loc="outside lower center", ncols=2)
        return drawing


def _dynamics(way: Way) -> str:
    return {"f": "$f$", "f_theta": r"$f_\theta$"}.get(trained := _trained_on(way), trained)


def _dots(axes: Axes, entries: dict[str, Entry], ways: dict[str, Way], problem: str) -> None:
    from nocl.comparisons.report.style import COLOURS

    for place, (key, way) in enumerate(ways.items()):
        e, paper = entries.get(key), way.paper.get(problem)
        if paper is not None:
            axes.plot(paper.error, place, "o", mfc="none", color=COLOURS[1])
        if e is not None and math.isfinite(e.error):
            axes.plot([e.error_low, e.error_high], [place, place], "-", color=COLOURS[0])
            axes.plot(e.error, place, "o", ms=4, color=COLOURS[0])


def flights(cells: Sequence[Cell], name: str) -> Figure:
    """The first states' flights of each way in 3-D, first seed, the goal as a cross; a flight far outside is cut."""
    import matplotlib
    import numpy as np
    from matplotlib.figure import Figure

    from nocl.comparisons.report.style import COLOURS, STYLE

    shown = [c for c in cells if c.paths and c.seed == min(c.seed for c in cells if c.paths)]
    rows, ways = math.ceil(len(shown) / COLUMNS), TABLES[name].ways
    goal, margin = load_ocp(shown[0].problem).x_goal[:3], 3.0
    low, high = np.minimum(goal, 0) - margin, np.maximum(goal, 0) + margin
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(2.9 * COLUMNS, 2.9 * rows), layout="constrained")
        for k, cell in enumerate(shown):
            axes = drawing.add_subplot(rows, COLUMNS, k + 1, projection="3d")
            for path in np.array(cell.paths):
                inside = np.where(((path >= low) & (path <= high)).all(1, keepdims=True), path, np.nan)
                axes.plot(*inside.T, color=COLOURS[0], lw=0.9)
                axes.plot(*path[:1].T, ".", color=COLOURS[0], ms=3)
            axes.set_box_aspect(None, zoom=0.85)
            axes.plot(*goal[:, None], "+", color=COLOURS[1], ms=9)
            axes.set(title=f"{ways[cell.way].title}, {_dynamics(ways[cell.way])}", xlim=(low[0], high[0]),
                     ylim=(low[1], high[1]), zlim=(low[2], high[2]), xlabel="x", ylabel="y", zlabel="z")
    return drawing
