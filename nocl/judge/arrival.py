"""Runs of a problem with a free horizon: each has a horizon of its own.

A plan says when it ends. Feedback ends where it arrives: at the first time, from the least horizon on, at which every
terminal constraint holds within the tolerance. That is looked for at LOOKS times in each interval, and where a run only
passes through, between them, at the least violation there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from nocl.definition import measured
from nocl.judge.runs import MULTISTEP, Ask, Judge, Simulation
from nocl.support.checks import Array

LOOKS = 16  # times in an interval
PRECISE = 1e-6  # of the time between them: how exactly the moment of arrival is found
INSIDE = 0.95  # of the tolerance: a run ends well within it, since one that is run again with nodes differs a little
Follow = Callable[[Array, float, float, int], Array | None]  # (z, a, b, interval) -> z at LOOKS times up to b, or None


def arriving(judge: Judge, policy: ca.Function, x0: Array, nodes: int) -> Simulation:
    """Continuous feedback from x0 [B, nx]; each run has `nodes` nodes from 0 to where it arrives."""
    steps = _steps(judge, judge.feedback_dae(policy))
    runs = []
    for i, x in enumerate(x0):
        alone = judge.of(i)

        def follow(z: Array, a: float, b: float, k: int, p: Array = alone.p[0]) -> Array | None:
            return _followed(judge, steps, z, np.r_[a, b - a, p])

        T, why = _Run(alone, follow, nodes - 1).end(x)
        runs.append(_unless(why, alone.continuous(policy, x[None], np.linspace(0, T, nodes), [])))
    return _stacked(runs)


def arriving_held(judge: Judge, ask: Callable[[Array], Ask], x0: Array, K: int) -> Simulation:
    """Feedback that is asked at K equal parts of the longest horizon, and held. Of what arrives earlier these parts are
    cut into more, of one control each, so that all runs have K.

    ask : p [1, np] -> how it is asked
    """
    grid, runs = np.linspace(0, judge.ocp.longest, K + 1), []
    steps = _steps(judge, judge.held_dae())
    for i, x in enumerate(x0):
        alone = judge.of(i)
        law = _Held(alone, steps, ask(alone.p), K)
        T, why = _Run(alone, law, K).end(x)
        t, of = _cut(grid, T)
        runs.append(_unless(why, alone.held(_Plan(law.u[:, of]), x[None], t, [])))
    return _stacked(runs)


def _cut(grid: Array, T: float) -> tuple[Array, NDArray[np.int64]]:
    """(nodes [K+1] from 0 to T, those of the grid [K+1] before T among them; which of the grid's intervals each of the
    K intervals is in)."""
    K, m = len(grid) - 1, max(int(np.searchsorted(grid, T)), 1)
    place = np.floor(np.linspace(0, K, m + 1) + 1e-9).astype(np.int64)
    return (np.interp(np.arange(K + 1), place, np.minimum(grid[:m + 1], T)),
            np.searchsorted(place, np.arange(K), side="right") - 1)


class _Held:
    """Feedback that is asked once in each interval of a run; `u` [1, K, nu] are its answers."""

    def __init__(self, judge: Judge, steps: list[ca.Function], law: Ask, K: int) -> None:
        self.judge, self.steps, self.law = judge, steps, law
        self.u, self.asked = np.zeros((1, K, judge.ocp.system.nu)), 0

    def __call__(self, z: Array, a: float, b: float, k: int) -> Array | None:
        s = self.judge.ocp.system
        if k == self.asked:
            self.u[:, k] = np.clip(self.law(z[None, :-1].copy(), a, k), s.lbu, s.ubu)
            self.asked += 1
        start = [a] if self.judge.ocp.uses_time else []
        return _followed(self.judge, self.steps, z, np.r_[self.u[0, k], self.judge.p[0], start, b - a])


class _Plan:
    """Controls u [B, K, nu], as what is asked."""

    def __init__(self, u: Array) -> None:
        self.u = u

    def __call__(self, x: Array, t: float, k: int) -> Array:
        return np.asarray(self.u[:, k])


def planned(judge: Judge, u: Array, x0: Array, horizon: Array) -> Simulation:
    """Held controls u [B, K, nu], each over an interval of the plan's own horizon [B]."""
    K, runs = u.shape[1], []
    for i, (x, T) in enumerate(zip(x0, horizon, strict=True)):
        runs.append(judge.of(i).held(_Plan(u[i:i + 1]), x[None], np.linspace(0, T, K + 1), []))
    return _stacked(runs)


def _steps(judge: Judge, dae: dict[str, ca.MX]) -> list[ca.Function]:
    return [judge.integrator(dae, np.arange(1, LOOKS + 1) / LOOKS, method) for method in MULTISTEP]


def _followed(judge: Judge, steps: list[ca.Function], z: Array, p: Array) -> Array | None:
    """z [LOOKS, nx + 1] on the way, by the first integrator that gets there."""
    ends = (judge.integrate(step, z, p)[0] for step in steps)
    return next((np.asarray(end.T) for end in ends if end is not None), None)


@dataclass(frozen=True, eq=False)
class _Run:
    """One run of feedback, interval by interval of K."""

    judge: Judge
    follow: Follow
    K: int

    def end(self, x0: Array) -> tuple[float, str]:
        """(when it arrives, ""), or (when it ended, why it did not arrive)."""
        free, z = self.judge.ocp.horizon, np.r_[x0, 0.0]
        nearest, when = np.inf, 0.0
        for k, (a, b) in enumerate(self._intervals()):
            path = self.follow(z, a, b, k)
            if path is None or not np.isfinite(path).all():
                return a or b, self.judge.blow_up(a, z[:-1], b, "the state blows up or the control is NaN")
            times, off = np.linspace(a, b, LOOKS + 1), self.off(np.vstack([z, path])).max(axis=1)
            off[times < free.low] = np.inf
            T = self._first(times, off, z, k)
            if T is not None:
                return T, ""
            if off.min() < nearest:
                nearest, when, there = off.min(), times[off.argmin()], np.vstack([z, path])[off.argmin()]
            z = path[-1]
        row = int(self.off(there[None])[0].argmax()) + len(self.judge.ocp.functions.rows)
        name, much = measured.excess(self.judge.ocp, row, float(nearest))
        return float(free.high), (f"does not arrive within {free.high:g}: at best {name!r} is off by {much}, at "
                                  f"t = {when:.4g}")

    def _intervals(self) -> list[tuple[float, float]]:
        t = np.linspace(0, self.judge.ocp.longest, self.K + 1)
        return [(float(a), float(b)) for a, b in pairwise(t)]

    def off(self, z: Array) -> Array:
        """[n, m], by which share of its scale each terminal constraint is violated at z [n, nx + 1]."""
        ocp = self.judge.ocp
        at_end = measured.least_at_end(ocp, z[:, :-1], np.repeat(self.judge.p, len(z), axis=0))
        return np.maximum(-at_end / ocp.functions.end_scales, 0)

    def _first(self, times: Array, off: Array, z: Array, k: int) -> float | None:
        """When it is first within the tolerance in interval k, which begins at z; None: not in it."""
        enough = INSIDE * self.judge.tolerance
        if off[0] <= enough:
            return float(times[0])

        def beyond(t: float) -> float:
            path = self.follow(z, float(times[0]), t, k) if t > times[0] else z[None]
            return np.inf if path is None else float(self.off(path[-1:]).max()) - enough

        for j in self._candidates(off, enough):
            low, high = max(times[max(j - 1, 0)], self.judge.ocp.horizon.low), times[min(j + 1, LOOKS)]
            inside = times[j]
            if off[j] > enough:
                tight = {"xatol": PRECISE * (high - low)}
                inside = minimize_scalar(beyond, bounds=(low, high), method="bounded", options=tight).x
            if beyond(inside) <= 0:
                return float(brentq(beyond, low, inside, xtol=PRECISE * (high - low))) if beyond(low) > 0 else low
        return None

    @staticmethod
    def _candidates(off: Array, enough: float) -> list[int]:
        """Looks at or beside which it may be within: those that are, and least ones from which, going on as steeply as
        beside them, it would get there."""
        beside = np.pad(off, 1, mode="edge")
        before, after = beside[:-2], beside[2:]
        least = (off <= before) & (off <= after)
        with np.errstate(invalid="ignore"):
            steep = np.nanmax([np.where(np.isfinite(before), before, off), np.where(np.isfinite(after), after, off)],
                              axis=0) - off
            found = np.isfinite(off) & ((off <= enough) | least & (off - steep <= enough))
        return [int(j) for j in np.flatnonzero(found)]


def _unless(why: str, run: Simulation) -> Simulation:
    """A run that did not arrive has failed, whatever it cost."""
    if not why or not run.reached[0]:
        return run
    lost, none = np.full(1, np.inf), np.zeros(1, dtype=bool)
    return replace(run, cost=lost, running_cost=lost, terminal_cost=lost, success=none, reached=none, message=[why],
                   terminal_error=np.where(np.isnan(run.terminal_error), np.nan, np.inf))


def _stacked(runs: list[Simulation]) -> Simulation:
    """Runs of one row each, with nodes t [B, K+1] of their own."""
    values = {f.name: np.concatenate([getattr(run, f.name) for run in runs]) for f in fields(Simulation)
              if f.name not in ("t", "message")}
    return Simulation(t=np.stack([run.t for run in runs]), message=[m for run in runs for m in run.message], **values)
