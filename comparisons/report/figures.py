"""The pictures of a report, by matplotlib's object interface: no global state, no window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from nocl.comparisons.report import limits
from nocl.comparisons.report.explain import explained_method, worst_states
from nocl.comparisons.report.results import Results, percent
from nocl.comparisons.report.study_figures import study_figures
from nocl.comparisons.report.style import COLOURS, LIMIT, SMALL_GAP, STYLE, look, plain
from nocl.support.checks import Array


def draw(report: Results) -> dict[str, Figure]:
    """All figures of a report by name; `costs` only where there are two methods to set side by side."""
    with matplotlib.rc_context(STYLE):
        figures = {"gaps": gaps(report)}
        if len(report.judged) > 1:
            figures["costs"] = costs(report)
        figures |= {name: figure for name, make in study_figures().items() if (figure := make(report)) is not None}
        for figure in figures.values():  # laid out once, not for each file
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
        figures["trajectories"] = trajectories(report, typical_states(report))
        figures["worst"] = trajectories(report, worst_states(report)[:3])
        return figures


# the names that `draw` may use
NAMES = ("gaps", "costs", "map", "value", "timings", "robustness", "stability", "regions", "trajectories", "worst")


def typical_states(report: Results) -> list[int]:
    """Where the explained method's gap is the least, at its median, and the widest."""
    order = worst_states(report)
    return list(dict.fromkeys([order[-1], order[len(order) // 2], order[0]]))


def gaps(report: Results) -> Figure:
    """Share of initial states within a gap; a method's line ends below 100 % where it failed."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    ax = figure.subplots()
    n = max(int(report.counted.sum()), 1)
    right = max(10.0, 2 * float(np.max(report.gap, where=np.isfinite(report.gap), initial=0.0)))
    for m, judged in enumerate(report.judged):
        known = np.sort(report.gap[m][report.feasible[m] & np.isfinite(report.gap[m])])
        share = 100 * np.arange(1, len(known) + 1) / n
        share = np.r_[0, share, 100 * len(known) / n]
        ax.step(np.r_[0, known, right], share, where="post", label=plain(judged.name), **look(m))
    ax.set_xscale("symlog", linthresh=SMALL_GAP)
    for x, text in ((1, "1 %"), (5, "5 %")):
        ax.axvline(x, color="0.6", linewidth=0.8)
        ax.text(x, 2, f" {text}", color="0.4", fontsize=8)
    ax.set(xlabel="gap to the best known cost of the state [%]", ylabel="initial states [%]", ylim=(0, 103))
    ax.set_xlim(-SMALL_GAP / 5, right)
    figure.legend(loc="outside upper center", ncols=min(len(report.judged), 4))
    return figure


def costs(report: Results) -> Figure:
    """Cost of each state, one method against the reference: the last one named."""
    figure = Figure(figsize=(4.8, 4.4), layout="constrained")
    ax = figure.subplots()
    reference = report.cost[-1]
    both = np.isfinite(report.cost).all(axis=0)
    for m, judged in enumerate(report.judged[:-1]):
        ok = np.isfinite(report.cost[m]) & np.isfinite(reference)
        ax.plot(reference[ok], report.cost[m][ok], linestyle="", marker="ox^s"[m % 4], markersize=4, alpha=0.7,
                color=COLOURS[m % len(COLOURS)], label=plain(judged.name))
    if both.any():
        low, high = report.cost[:, both].min(), report.cost[:, both].max()
        ax.plot([low, high], [low, high], color="0.5", linewidth=0.8, label="equal")
        if low > 0 and high > 20 * low:
            ax.set(xscale="log", yscale="log")
    others = plain(report.judged[0].name) if len(report.judged) == 2 else "the others"
    ax.set(xlabel=f"cost of {plain(report.judged[-1].name)}", ylabel=f"cost of {others}")
    ax.legend()
    return figure


def trajectories(report: Results, states: Sequence[int]) -> Figure:
    """States, controls and constraints over time; a column for each initial state, a line for each method."""
    s, bounds, held = report.ocp.system, limits.lines(report.ocp), limits.others(report.ocp)
    names = [*(plain(s.unit(name)) for name in s.names), *(plain(one.name) for one in held)]
    beside = [limits.values(report.ocp, j.simulation, report.parameters) for j in report.judged]
    width, height = 3.1 * len(states) + 0.9, 1.15 * len(names) + 0.9
    figure = Figure(figsize=(width, height))  # laid out in inches: the layout engines take seconds on so many axes
    edges = {"left": 0.75 / width, "right": 1 - 0.1 / width, "bottom": 0.45 / height, "top": 1 - 0.55 / height}
    axes = figure.subplots(len(names), len(states), sharex=True, sharey="row", squeeze=False,
                           gridspec_kw={**edges, "wspace": 0.08, "hspace": 0.15})
    for c, i in enumerate(states):
        axes[0, c].set_title(f"state {i}: " + _gap_title(report, i), fontsize=8)
        axes[-1, c].set_xlabel("t")
        for m, judged in enumerate(report.judged):
            run = np.hstack([judged.simulation.x[i], judged.simulation.u[i], beside[m][i]])
            steps = range(s.nx, s.nx + s.nu) if judged.held else range(0)
            _draw_run(axes[:, c], judged.simulation.times[i], run, m, judged.name, steps)
        goals = np.concatenate(report.ocp.goals(report.parameters[[i]]), axis=1)[0]
        for ax, goal in zip(axes[:, c] if report.ocp.has_goal else [], goals, strict=False):  # constraints have none
            ax.axhline(goal, color="0.6", linewidth=0.7, zorder=0)
        for line in bounds:
            _draw_limit(axes[line.channel, c], line.value, line.at_end)
        for ax, one in zip(axes[len(s.names):, c], held, strict=True):
            for bound in (one.low, one.high):
                _draw_limit(ax, bound, False)
    for ax, name in zip(axes[:, 0], names, strict=True):
        ax.set_ylabel(name)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=min(len(labels), 4))
    figure.align_ylabels(axes[:, 0])
    return figure


def _gap_title(report: Results, i: int) -> str:
    m = explained_method(report)
    gap, name = report.gap[m, i], plain(report.judged[m].name)
    if not report.counted[i]:
        return "no plan holds the constraints"
    return f"{name} +{percent(max(gap, 0.0))} %" if np.isfinite(gap) else f"{name} failed"


def _draw_run(axes: Any, t: Array, run: Array, m: int, name: str, steps: range) -> None:
    """Of run [K+1, rows] each row, those in `steps` held from node to node."""
    for k, ax in enumerate(axes):
        style = {"drawstyle": "steps-post"} if k in steps else {}
        ax.plot(t, run[:, k], linewidth=1.3, label=plain(name), **style, **look(m))


def _draw_limit(ax: Any, value: float, at_end: bool) -> None:
    """A bound, where it is not far from what is drawn."""
    low, high = ax.get_ylim()
    if 2 * low - high <= value <= 2 * high - low:
        ax.axhline(value, xmin=0.94 if at_end else 0.0, color=LIMIT, linewidth=1, linestyle="-" if at_end else "--")
