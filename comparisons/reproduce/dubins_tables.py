"""The Dubins table as Markdown, LaTeX and CSV, and the figure of trajectories round the obstacle."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import TYPE_CHECKING

from nocl.comparisons.reproduce.dubins import WAYS, Cell, Entry, table
from nocl.support import store
from nocl.systems import load_ocp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 4  # panels in a row of the figure


def write(folder: str | Path, cells: Sequence[Cell]) -> list[Path]:
    """dubins.md, .tex, .csv and .png in the folder; their paths."""
    from nocl.comparisons.report.style import encode

    entries, folder = table(cells), Path(folder)
    texts = {"md": markdown(entries), "tex": latex(entries), "csv": as_csv(entries)}
    paths = [store.write_text(folder / f"dubins.{kind}", text) for kind, text in texts.items()]
    return [*paths, store.write_bytes(folder / "dubins.png", encode(figure(cells), "png"))]


def markdown(entries: Sequence[Entry]) -> str:
    """A row for each way: ours, the paper's."""
    lines = ["| way | length, mean ± s.d. | success | collisions | ms a state | mean cost | gap: median, 95 % "
             "| length / optimum's | states | made | paper: length, s, success |", f"|{'---|' * 11}"]
    for e in entries:
        paper = WAYS[e.way].paper
        theirs = "" if paper is None else f"{paper[0]:.3f} ± {paper[1]:.3f}, {paper[2]:.3g}, {paper[3]:.3f}"
        row = [WAYS[e.way].title, f"{e.length:.3f} ± {e.length_std:.3f}", f"{e.success:.3f}",
               f"{e.collisions}", f"{e.ms:.3g}", f"{e.cost:.4f}", _or_blank(e.gap, f"{e.gap:.2f}, {e.gap95:.2f} %"),
               _or_blank(e.ratio, "{:.3f}"), f"{e.n}" + (f" x {e.seeds}" if e.seeds > 1 else ""), e.made, theirs]
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def _or_blank(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else ""


def latex(entries: Sequence[Entry]) -> str:
    """In the form of the paper, its own numbers in grey below ours."""
    lines = [r"\begin{tabular}{l | c c c}", r"\toprule",
             r"\textbf{Methods} & Trajectory len. & Compute time (s) & Success rate \\", r"\midrule"]
    for e in entries:
        way = WAYS[e.way]
        lines.append(rf"{way.title.replace('RRT*', 'RRT$^*$')} & {e.length:.4f}\scriptsize{{$\pm${e.length_std:.4f}}} "
                     rf"& {e.ms / 1e3:.4f} & {e.success:.3f} \\")
        if way.paper is not None:
            length, std, seconds, success = way.paper
            lines.append(rf"\quad paper & \color{{gray}}{length:.4f}\scriptsize{{$\pm${std:.4f}}} & "
                         rf"\color{{gray}}{seconds:.4f} & \color{{gray}}{success:.3f} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def as_csv(entries: Sequence[Entry]) -> str:
    """All numbers, a row for each way; the paper's where there are any."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*(f.name for f in fields(Entry)),
                     *(f"paper_{n}" for n in ("length", "length_std", "seconds", "success"))])
    for e in entries:
        writer.writerow([*astuple(e), *(WAYS[e.way].paper or [""] * 4)])
    return file.getvalue()


def figure(cells: Sequence[Cell]) -> Figure:
    """The first states' trajectories of each way, first seed; those that fail dashed."""
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    from nocl.comparisons.report.style import COLOURS, STYLE

    shown = [c for c in cells if c.seed == min(c.seed for c in cells)]
    rows = math.ceil(len(shown) / COLUMNS)
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(2.9 * COLUMNS, 2.9 * rows), layout="constrained")
        panels = drawing.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
        centre, radius = _obstacle()
        for cell, axes in zip(shown, panels, strict=False):
            axes.add_patch(Circle(centre, radius, color="0.8"))
            for path, ok in zip(cell.paths, cell.success, strict=False):
                axes.plot(*zip(*path, strict=True), "-" if ok else "--", color=COLOURS[0 if ok else 1], lw=0.9)
            axes.plot(0, 0, "k+")
            axes.set(title=WAYS[cell.way].title, aspect="equal")
        for axes in panels[len(shown):]:
            axes.set_axis_off()
    return drawing


def _obstacle() -> tuple[tuple[float, float], float]:
    """Centre and radius in m, read off the problem's own constraint."""
    import numpy as np

    h = load_ocp("dubins").h
    axis = np.linspace(-4, 4, 161)
    x, y = np.meshgrid(axis, axis)
    inside = h(np.array([x.ravel(), y.ravel(), 0 * x.ravel()])).full().ravel()
    k = int(np.argmin(inside))
    return (float(x.ravel()[k]), float(y.ravel()[k])), float(-inside[k])
