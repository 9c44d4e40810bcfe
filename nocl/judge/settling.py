"""How runs get to their goal, and what they do there: settling time, overshoot, offset, limit cycles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nocl.definition.ocp import OCP
from nocl.judge.runs import Simulation
from nocl.support import checks
from nocl.support.checks import Array

TAIL = 0.25  # of a run: where it is looked at for what stays
FEWEST = 8  # nodes in there
DECAYS = 0.9  # of the swing in the first half of the tail: less in the second half is a motion that dies out


@dataclass(frozen=True, eq=False)
class Response:
    """Of each run. The goal is its nearest image; a band is a share of half of each state's width in X."""

    settling: Array  # [B], s: from when on all states stay within the band about x*; inf: not by the end
    overshoot: Array  # [B, nx], how far beyond x* a state gets, as a share of how far it had to go; 0: it does not get
    # there, or past it; NaN where it begins within the band
    offset: Array  # [B, nx], the mean of x - x* over the last quarter of the run, in the state's own unit
    swing: Array  # [B, nx], half of the way between the extremes there, in the state's own unit
    cycles: NDArray[np.bool_]  # [B], whether a swing is beyond the band and does not die out: a limit cycle
    period: Array  # [B], s: of that cycle; NaN where there is none, or less than one and a half in the last quarter


def response(ocp: OCP, run: Simulation, band: float = 0.01) -> Response:
    """How the runs of a simulation settle at the goal of the problem.

    band : the share of half of each state's width in X that counts as there

    Nodes are what is looked at, with straight lines between them: run with as many as the motion asks for. Runs that
    failed have inf and NaN. Raises ValueError for a problem without a goal, one whose goal depends on parameters, fewer
    than 32 nodes, and a band that is no number in (0, 1).
    """
    ocp.refuse_without_goal("response")
    ocp.refuse_parameters("response")
    checks.instance(Simulation, run, "run", "response", "as nocl.simulate gives it")
    checks.between(band, 1e-12, 1.0, "band", "response")
    if run.x.shape[1] < FEWEST / TAIL:
        raise ValueError(f"response: the run has {run.x.shape[1]} nodes; expected at least {FEWEST / TAIL:.0f}: "
                         "nocl.simulate(..., nodes=401)")
    wide = band * (ocp.system.ubx - ocp.system.lbx) / 2
    d = ocp.from_goal(run.x.reshape(-1, ocp.system.nx)).reshape(run.x.shape)
    d[~run.reached] = np.nan
    tail = d[:, -max(round(TAIL * d.shape[1]), FEWEST):]
    swing = np.ptp(tail, axis=1) / 2
    first, last = (np.ptp(part, axis=1) / 2 for part in np.array_split(tail, 2, axis=1))
    stays = (swing > wide) & (last > DECAYS * first)
    cycles, times = stays.any(axis=1), run.times[:, -tail.shape[1]:]
    period = np.array([_period(t, x[:, np.argmax(s / wide)]) if cycle else np.nan
                       for t, x, s, cycle in zip(times, tail, swing, cycles, strict=True)])
    settling, overshoot = _settling(run.times, np.abs(d) / wide), _overshoot(_unwound(ocp, d), wide)
    return Response(settling, overshoot, tail.mean(axis=1), swing, cycles, period)


def _settling(t: Array, share: Array) -> Array:
    """When each run [B, K+1, nx], in bands, gets into the band for good, on straight lines between nodes."""
    far = share.max(axis=2)
    outside = ~(far <= 1)
    K = far.shape[1]
    last = np.where(outside.any(axis=1), K - 1 - outside[:, ::-1].argmax(axis=1), -1)
    found = np.where(last < 0, t[:, 0], np.inf)
    rows = np.flatnonzero((last >= 0) & (last < K - 1))
    a, b = far[rows, last[rows]], far[rows, last[rows] + 1]
    there = (a - 1) / (a - b)
    start, end = t[rows, last[rows]], t[rows, last[rows] + 1]
    found[rows] = start + there * (end - start)
    return found


def _unwound(ocp: OCP, d: Array) -> Array:
    """The same without the turns at which the nearest image of the goal becomes another: counted from the last node."""
    d = d.copy()
    for i in ocp.periodic:
        d[:, :, i] = np.unwrap(d[:, ::-1, i], axis=1)[:, ::-1]
    return d


def _overshoot(d: Array, wide: Array) -> Array:
    """How far beyond the goal states of d [B, K+1, nx] get, as shares of where they begin."""
    begin = d[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -(d / begin[:, None]).min(axis=1)
    return np.where(np.abs(begin) > wide, np.maximum(share, 0.0), np.nan)


def _period(t: Array, x: Array) -> float:
    """The mean time between upward crossings of the mean; NaN for fewer than two."""
    above = x > x.mean()
    k = np.flatnonzero(~above[:-1] & above[1:])
    if len(k) < 2:
        return float("nan")
    share = (x.mean() - x[k]) / (x[k + 1] - x[k])
    return float(np.diff(t[k] + share * (t[k + 1] - t[k])).mean())
