"""A figure of errors: a panel for each problem, a line for each way, the paper's beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from nocl.comparisons.report.style import COLOURS, STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Dot:
    """What is drawn for a way on a problem."""

    ours: tuple[float, float, float] | None = None  # mean, and the least and the greatest mean of a seed
    paper: float | None = None


def dots(panels: Mapping[str, Sequence[Dot]], labels: Sequence[str], what: str) -> Figure:
    """Logarithmic: dots are ours (bars: the seeds), rings the paper's; a panel has a Dot for each label."""
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(3.4 + 2.6 * len(panels), 0.8 + 0.3 * len(labels)), layout="constrained")
        row = drawing.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for (problem, shown), axes in zip(panels.items(), row, strict=True):
            _panel(axes, shown)
            axes.set(title=problem, xlabel=what)
        row[0].set_yticks(range(len(labels)), labels)
        row[0].set_ylim(len(labels) - 0.5, -0.5)  # the first at the top
        handles = [row[0].plot([], [], "o", ms=4, color=COLOURS[0])[0],
                   row[0].plot([], [], "o", mfc="none", color=COLOURS[1])[0]]
        drawing.legend(handles, ["nocl, over the seeds", "the paper"], loc="outside lower center", ncols=2)
        return drawing


def _panel(axes: Axes, shown: Sequence[Dot]) -> None:
    for place, dot in enumerate(shown):
        if dot.paper is not None:
            axes.plot(dot.paper, place, "o", mfc="none", color=COLOURS[1])
        if dot.ours is not None:
            mean, low, high = dot.ours
            axes.plot([low, high], [place, place], "-", color=COLOURS[0])
            axes.plot(mean, place, "o", ms=4, color=COLOURS[0])
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    if high < 1e3 * low:  # few powers of ten: their thirds too, as plain numbers
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
