"""The worst states of a method, explained: where the cost is lost, and whether it is a point or a region. B: batch."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nocl.comparisons.report.results import REFERENCE, Results, count, number, percent
from nocl.support.checks import Array

NEIGHBOURS = 5
NODES = 41  # times that two runs are held against each other at
APART = 0.5  # runs from one state go different ways if they are farther apart than this (at the worst time and in the
# worst coordinate, in standard deviations over all runs) and FAR times as far as the method's runs usually are
FAR = 5
PART = 3  # runs from two states part if they get this many times as far apart as they start


@dataclass(frozen=True)
class Explained:
    """One state of a method."""

    state: int
    gap: float  # per cent, inf where the run failed
    sentences: list[str]


def explained_method(report: Results) -> int:
    """The method whose worst states are told: the first that is no reference."""
    return next((m for m, j in enumerate(report.judged) if j.name != REFERENCE), 0)


def worst_states(report: Results, m: int | None = None) -> list[int]:
    """States by the gap of method m (the explained one), the widest first; those that count, or all if none does."""
    m = explained_method(report) if m is None else m
    order = np.argsort(-report.gap[m], kind="stable")
    return order[report.counted[order]].tolist() if report.counted.any() else order.tolist()


def worst(report: Results, k: int = 5, m: int | None = None) -> list[Explained]:
    """The k states with the widest gap of method m, explained; none where it has the best known cost."""
    m = explained_method(report) if m is None else m
    ways = _Ways(report)
    return [Explained(i, float(report.gap[m, i]), list(_sentences(report, ways, m, i)))
            for i in worst_states(report, m)[:k] if report.gap[m, i] > 0]


def _sentences(report: Results, ways: _Ways, m: int, i: int) -> Iterator[str]:
    j, s = report.judged[m], report.judged[m].simulation
    b = report.best_index(i)
    if not s.reached[i]:
        yield f"{j.name} failed: {s.message[i]}."
    elif not s.success[i]:
        yield f"{j.name} failed: it {s.message[i]}, at a cost of {number(s.cost[i])}."
    elif not report.best_method[i]:
        yield f"Cost {number(s.cost[i])}; no method has an answer that counts here, so that there is no gap."
    elif b == m:
        yield f"Cost {number(s.cost[i])}, the best known: no other method did better here."
    else:
        yield (f"Cost {number(s.cost[i])} against {number(report.best[i])} by {report.best_method[i]}: "
               f"{percent(max(report.gap[m, i], 0.0))} % more.")
        if b is not None:
            yield _lost_where(report, m, b, i)
    if s.reached[i]:
        yield from _manners(report, m, b, i)
    if b is not None and b != m and s.reached[i]:
        yield ways.compared(m, b, i)
    if b != m:
        yield from _neighbours(report, ways, m, i)


def _lost_where(report: Results, m: int, b: int, i: int) -> str:
    """Running or terminal cost, and by which coordinate the goal is missed most."""
    ours, best = report.judged[m].simulation, report.judged[b].simulation
    running = float(ours.running_cost[i] - best.running_cost[i])
    terminal = float(ours.terminal_cost[i] - best.terminal_cost[i])
    error = report.ocp.from_goal(ours.x[i, -1], report.parameters[i])
    s = report.ocp.system
    k = int(np.abs(error / (s.ubx - s.lbx)).argmax())
    name = s.state_names[k]
    unit = s.units.get(name, "")
    miss = f"; at the end {name} is off by {number(float(error[k]))}{' ' + unit if unit else ''}" \
        if report.ocp.has_goal else ""
    where = "the terminal cost" if terminal > 2 * running else "the running cost" if running > 2 * terminal else \
        "both"
    return f"Lost in {where} (running {running:+.3g}, terminal {terminal:+.3g}){miss}."


def _manners(report: Results, m: int, b: int | None, i: int) -> Iterator[str]:
    """Saturation."""
    s = report.judged[m].simulation
    if s.saturation[i] > 0.05:
        beside = f", the best run's {100 * report.judged[b].simulation.saturation[i]:.0f} %" if b not in (None, m) \
            else ""
        yield f"Its control is at a bound {100 * s.saturation[i]:.0f} % of the time{beside}."


def _neighbours(report: Results, ways: _Ways, m: int, i: int) -> Iterator[str]:
    """Whether the states about it fare the same, and whether their best runs take its best run's way."""
    near = [n for n in ways.near[i] if report.counted[n]]
    if not near:
        return
    gaps, name = report.gap[m, near], report.judged[m].name
    median = float(np.median(gaps))
    what = "fail too, in the median" if not math.isfinite(median) else f"have a median gap of {percent(median)} %"
    lone = math.isfinite(median) and median < report.gap[m, i] / 3
    yield (f"{name}'s {count(len(near), 'nearest neighbour')} {what}: "
           + ("this state is on its own." if lone else "a region, not a point."))
    b = report.best_index(i)
    if b is None or not ways.another(m, b, i):
        return
    others = [(n, report.best_index(n)) for n in near]
    if away := sum(c is not None and ways.part(b, i, c, n) for n, c in others):
        yield f"The best known runs of {away} of these {len(near)} part from this state's: basins meet here."


class _Ways:
    """How far apart runs are: at the worst time, in the worst coordinate, in standard deviations over all runs.

    At the same time; where the horizon is free, at the same share of each run.
    """

    def __init__(self, report: Results) -> None:
        self.report = report
        runs = [j.simulation for j in report.judged]
        nodes = [np.rint(np.linspace(0, s.x.shape[1] - 1, NODES)).astype(int) for s in runs]
        self.t = [s.times[:, index] for s, index in zip(runs, nodes, strict=True)]  # [methods] of [B, NODES]
        x = [s.x[:, index] for s, index in zip(runs, nodes, strict=True)]
        values = np.concatenate([part.reshape(-1, part.shape[-1]) for part in x])
        known = values[np.isfinite(values).all(axis=1)]
        sd = known.std(axis=0) if len(known) else np.ones(values.shape[1])
        self.sd = np.where(sd > 0, sd, 1.0)
        self.z = [part / self.sd for part in x]  # [methods] of [B, NODES, nx]
        self.near = _nearest(report.starts)

    def part(self, m: int, i: int, n: int, k: int) -> bool:
        """Whether method m's run from state i and method n's from k part."""
        d = np.abs(self.z[m][i] - self.z[n][k]).max(axis=1)
        return bool(np.isfinite(d).all() and d.max() > max(2 * APART, PART * d[0]))

    def usual(self, m: int, b: int) -> float:
        """How far apart the runs of methods m and b from the same state are in the median."""
        d = np.abs(self.z[m] - self.z[b]).max(axis=(1, 2))
        return float(np.median(d[np.isfinite(d)])) if np.isfinite(d).any() else 0.0

    def another(self, m: int, b: int, i: int) -> bool:
        """Whether method m's run from state i goes another way than b's."""
        return bool(np.abs(self.z[m][i] - self.z[b][i]).max() > max(APART, FAR * self.usual(m, b)))

    def compared(self, m: int, b: int, i: int) -> str:
        """Whether m's run goes b's way, and where they are farthest apart."""
        d = np.abs(self.z[m][i] - self.z[b][i])
        if not np.isfinite(d).all():
            return ""
        node, k = np.unravel_index(int(d.argmax()), d.shape)
        system = self.report.ocp.system
        name = system.state_names[k]
        unit = system.units.get(name, "")
        gap, t = float((self.z[m][i] - self.z[b][i])[node, k] * self.sd[k]), self.t[m][i, node]
        where = f"farthest apart in {name} at t = {t:.3g}, by {number(gap)}{' ' + unit if unit else ''}"
        way = "another way than the best run" if self.another(m, b, i) else "the best known way"
        return f"It goes {way} ({where})."


def _nearest(x0: Array) -> list[list[int]]:
    """[B], the NEIGHBOURS nearest other states, coordinates in their standard deviations."""
    sd = x0.std(axis=0)
    z = x0[:, sd > 0] / sd[sd > 0]
    if len(x0) < 2 or not z.shape[1]:
        return [[] for _ in x0]
    from scipy.spatial import cKDTree

    _, index = cKDTree(z).query(z, k=min(NEIGHBOURS + 1, len(x0)))
    return [[int(n) for n in row if n != i][:NEIGHBOURS] for i, row in enumerate(index)]
