"""The pictures of what stands beside the gaps: the map of initial states, V, timings, and what a study found."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from nocl.comparisons.report.explain import explained_method
from nocl.comparisons.report.payload import slices
from nocl.comparisons.report.results import Results
from nocl.comparisons.report.style import COLOURS, SMALL_GAP, look, plain
from nocl.support.checks import Array

LOSS_FLOOR = 1e-2  # per cent: losses below it are drawn there


def study_figures() -> dict[str, Callable[[Results], Figure | None]]:
    """By name; None where there is nothing to draw."""
    return {"map": gap_map, "value": value_slices, "timings": timings, "robustness": robustness,
            "stability": stability, "regions": regions}


def gap_map(report: Results) -> Figure | None:
    """The gap of the explained method over the two coordinates, of x0 and p, that initial states differ most in."""
    starts, names, unit = report.starts, report.start_names, report.ocp.unit
    two, sd = len(names) > 1, starts.std(axis=0)
    i, k = np.sort(np.argsort(-sd, kind="stable")[:2]) if two else (0, 0)
    m = explained_method(report)
    ok = report.feasible[m] & np.isfinite(report.gap[m])
    figure = Figure(figsize=(5.6, 4), layout="constrained")
    ax = figure.subplots()
    y = starts[:, k] if two else np.where(ok, np.maximum(report.gap[m], SMALL_GAP), np.nan)
    if ok.any():
        shade = np.log10(np.maximum(report.gap[m, ok], SMALL_GAP))
        points = ax.scatter(starts[ok, i], y[ok], c=shade, cmap="viridis_r", vmin=-2, vmax=2, s=14)
        bar = figure.colorbar(points, ax=ax, ticks=[-2, -1, 0, 1, 2])
        bar.ax.set_yticklabels(["≤ 0.01 %", "0.1 %", "1 %", "10 %", "≥ 100 %"])
        bar.set_label(f"gap of {plain(report.judged[m].name)}")
    ax.plot(starts[~ok, i], y[~ok], "x", color="k", markersize=5)
    ax.set(xlabel=plain(unit(names[i])), ylabel=plain(unit(names[k])) if two else "gap [%]")
    return figure


def value_slices(report: Results) -> Figure | None:
    """V over its first pair of coordinates at three times, with runs on top."""
    data = slices(report)
    if data is None:
        return None
    s, n = report.ocp.system, data["n"]
    V = np.frombuffer(base64.b64decode(data["V"]), dtype="<f4").reshape(len(data["pairs"]), len(data["t"]), n, n)
    i, k = data["pairs"][0]
    low, high = data["low"], data["high"]
    figure = Figure(figsize=(3.1 * len(data["t"]) + 0.6, 3.1), layout="constrained")
    axes = figure.subplots(1, len(data["t"]), sharey=True, squeeze=False)[0]
    for ax, t, z in zip(axes, data["t"], V[0], strict=True):
        most = max(float(np.nanmax(z)), 1e-12)
        floor = max(1e-4 * most, float(np.nanmin(z)))  # colours go by powers of ten
        drawn = ax.contourf(np.linspace(low[i], high[i], n), np.linspace(low[k], high[k], n), np.maximum(z, floor),
                            levels=np.geomspace(min(floor, 0.999 * most), most, 20), norm=LogNorm(), cmap="Blues")
        bar = figure.colorbar(drawn, ax=ax)
        ticks = np.geomspace(min(floor, 0.999 * most), most, 4)
        bar.set_ticks(list(ticks), labels=[f"{tick:.2g}" for tick in ticks], minor=False)
        bar.ax.minorticks_off()
        for m, j in enumerate(report.judged):
            for run in j.simulation.x[:: max(1, len(report.x0) // 15)]:
                ax.plot(run[:, i], run[:, k], color=COLOURS[m % len(COLOURS)], linewidth=0.6, alpha=0.6)
        ax.set(xlim=(low[i], high[i]), ylim=(low[k], high[k]), xlabel=plain(s.unit(s.state_names[i])))
        ax.set_title(f"V of {plain(data['method'])}, t = {t:.3g}", fontsize=8)
        ax.grid(False)
    axes[0].set_ylabel(plain(s.unit(s.state_names[k])))
    return figure


def timings(report: Results) -> Figure | None:
    """Milliseconds of the first answer and of each later control."""
    rows = [(f"{plain(j.name)}, {what}", values[np.isfinite(values) & (values > 0)], m)
            for m, j in enumerate(report.judged)
            for what, values in (("first", j.ms_first), ("later", j.ms_per_control))]
    rows = [row for row in rows if len(row[1])]
    if not rows:
        return None
    figure = Figure(figsize=(7, 0.9 + 0.35 * len(rows)), layout="constrained")
    ax = figure.subplots()
    _boxes(ax, rows, vertical=False)
    ax.set(xscale="log", xlabel="milliseconds")
    ax.invert_yaxis()
    return figure


def _boxes(ax: Any, rows: list[tuple[str, Array, int]], vertical: bool) -> None:
    drawn = ax.boxplot([values for _, values, _ in rows], orientation="vertical" if vertical else "horizontal",
                       tick_labels=[name for name, _, _ in rows], showfliers=False, widths=0.6, patch_artist=True)
    for box, median, (_, _, m) in zip(drawn["boxes"], drawn["medians"], rows, strict=True):
        box.set(facecolor=COLOURS[m % len(COLOURS)] + "55", edgecolor=COLOURS[m % len(COLOURS)])
        median.set_color("black")


def robustness(report: Results) -> Figure | None:
    """Cost lost in each scenario, a box for each method."""
    if report.robustness is None:
        return None
    names = [j.name for j in report.judged]
    rows = []
    for scenario in report.robustness.scenarios:
        for c, loss in enumerate(scenario.losses):
            lost = loss.lost[np.isfinite(loss.lost)]
            m = names.index(loss.method) if loss.method in names else len(names) + c
            if len(lost):
                rows.append((plain(f"{scenario.name}: {loss.method}"), np.maximum(lost, LOSS_FLOOR), m))
    if not rows:
        return None
    figure = Figure(figsize=(7, 0.9 + 0.3 * len(rows)), layout="constrained")
    ax = figure.subplots()
    _boxes(ax, rows, vertical=False)
    ax.set(xscale="log", xlabel="cost lost against the optimum under the same disturbance [%]")
    ax.invert_yaxis()
    return figure


def stability(report: Results) -> Figure | None:
    """Eigenvalues in the complex plane."""
    if not report.stability:
        return None
    figure = Figure(figsize=(6, 4), layout="constrained")
    ax = figure.subplots()
    for c, s in enumerate(report.stability):
        ax.plot(s.eigenvalues.real.ravel(), s.eigenvalues.imag.ravel(), "x" if s.where == "goal" else ".",
                color=COLOURS[c % len(COLOURS)], label=plain(f"{s.method}, {s.where}"), alpha=0.7)
    ax.axvline(0, color="0.5", linewidth=0.8)
    ax.set(xlabel="real part [1/time]", ylabel="imaginary part")
    ax.legend(fontsize=8)
    return figure


def regions(report: Results) -> Figure | None:
    """Share of successes against the scale of the spread, with bounds."""
    if not report.regions:
        return None
    figure = Figure(figsize=(6, 3.4), layout="constrained")
    ax = figure.subplots()
    for m, r in enumerate(report.regions):
        share = r.successes / r.n
        bounds = np.maximum([share - r.lower, r.upper - share], 0)  # the bounds enclose it, but for rounding
        ax.errorbar(r.scale, 100 * share, yerr=100 * bounds, capsize=2, label=plain(r.method), **look(m))
    ax.set(xlabel="scale of the spread of initial states", ylabel="initial states that succeed [%]", ylim=(0, 104))
    ax.legend()
    return figure
