"""Whether a log moves as the rows of xdot say that are stated as known: nothing else would tell before a plan fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import casadi as ca
import numpy as np

from nocl.support.checks import Array
from nocl.sysid.logs.log import Log
from nocl.sysid.logs.plausible import check_rate

SIGMAS = 3.0  # times what noise explains
LARGEST = 1e100  # of a rate: squares must not overflow
COARSE = 0.25  # of how far a rate moves in a step: what the trapezoidal rule may miss, and no more than half


def contradictions_of(log: Log, z: ca.SX, known: Mapping[int, ca.SX]) -> list[str]:
    """What the log's own steps say against known rows of xdot, expressions in z = (x, u), in words.

    Raises ValueError where a row is right but for a factor: a unit is wrong then.
    """
    said = []
    for i, row in known.items():
        name, rate = log.states[i], _rows(ca.Function("row", [z], [row]))
        x, t = [r.x[:, i] for r in log], [r.t for r in log]
        last = [np.vstack([r.u, r.u[-1:]]) for r in log]
        rates = [rate(r.x, u) for r, u in zip(log, last, strict=True)]
        _check_finite(log, rates, f"d {name}/dt = {row}")
        check_rate(x, rates, t, name, str(row), "identify: known")
        missed, size, allowed = _misses(log, i, rate)
        if missed > allowed:
            said.append(f"d {name}/dt = {row} misses the log's own steps by {missed:.3g} (rms; their mean rates: "
                        f"{size:.3g}), where noise and sampling explain {allowed:.3g}")
    return said


def _check_finite(log: Log, rates: list[Array], words: str) -> None:
    for r, values in zip(log, rates, strict=True):
        bad = np.flatnonzero(np.isfinite(r.x).all(axis=1) & ~(np.abs(values) < LARGEST))
        if bad.size:
            raise ValueError(f"identify: known: {words} is {values[bad[0]]:.4g} at t = {r.t[bad[0]]:g} of run {r.run}; "
                             "expected numbers of ordinary size wherever the log has been: correct the row")


def _misses(log: Log, i: int, rate: Callable[[Array, Array], Array]) -> tuple[float, float, float]:
    """Root mean squares over all steps: what a row misses of the mean rates, these, what noise and sampling explain.

    A mean rate is (x_{k+1} - x_k) / h, and by the trapezoidal rule half of the row's values at both ends. That misses
    less than half the difference of these values, which is what a simulator's Euler steps miss.
    """
    miss, mean, change, noise = [], [], [], []
    for r in log:
        h, x = np.diff(r.t), r.x[:, i]
        first, last = rate(r.x[:-1], r.u), rate(r.x[1:], r.u)
        rates, smooth = np.diff(x) / h, rate(r.smooth.x[:-1], r.u)
        miss.append(rates - (first + last) / 2)
        mean.append(rates)
        change.append(last - first)
        noise.append(np.hypot(np.hypot(r.smooth.residual[:-1, i], r.smooth.residual[1:, i]) / h,
                              (first - smooth) / 2**0.5))
    missed, size, coarse, random = (_rms(np.concatenate(parts)) for parts in (miss, mean, change, noise))
    tiny = 1e-9 * size  # rounding
    return missed, size, float(np.sqrt((SIGMAS * random) ** 2 + (COARSE * coarse) ** 2)) + tiny


def _rows(row: ca.Function) -> Callable[[Array, Array], Array]:
    """(x [n, nx], u [n, nu]) -> [n]"""
    return lambda x, u: row(np.hstack([x, u]).T).full().ravel()


def _rms(values: Array) -> float:
    there = values[np.isfinite(values)]
    return float(np.sqrt(np.square(there).mean())) if there.size else 0.0
