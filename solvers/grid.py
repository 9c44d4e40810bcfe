"""Whether Runge-Kutta steps are short enough: solutions held against the same equations on far shorter steps.

A solver knows its plant on its own grid alone. Where that is too coarse for a fast part of the plant, what it plans,
and says that it costs, has nothing to do with the plant, and a descent even looks for such plans. So a few solutions
are followed again, interval by interval, each from its own nodes: an unstable plant does no harm. What counts is by how
much of X a state is off after an interval, and by how much of J the cost is, to first order: errors of states count by
the costate there, and add up with those of the running cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nocl.data import Solution
from nocl.functions import Functions
from nocl.ocp import OCP
from nocl.scales import usual_sizes
from nocl.support.checks import Array

ROWS = 4  # solutions that are looked at
FINEST = 128  # steps in an interval, taken for the truth
TRIED = (1, 2, 4, 8, 16, 32)  # substeps, in this order
COARSE = 1e-2  # a larger error is worth a warning
FINE = 1e-3  # training takes more substeps above it
WANTED = 1e-4  # ... and a smaller one is what substeps are chosen for
SMALL = 1e-3  # of the usual cost: below it, errors count as shares of that


@dataclass(frozen=True)
class Grid:
    """What was found of solutions on a grid."""

    step: float  # length of an interval
    substeps: int
    error: float  # the largest, of a state after an interval or of a cost, as a share of usual ones
    needed: int | None  # substeps with which it is WANTED; None: of those TRIED none is enough
    then: float  # the error with those, or with the most that were tried
    fastest: float  # time constant of f along the solutions; inf for none

    @property
    def coarse(self) -> bool:
        return not self.error <= COARSE

    def __str__(self) -> str:
        remedy = (f"with substeps={self.needed} plan and plant agree to {100 * self.then:.2g} %" if self.needed else
                  f"not even with substeps={TRIED[-1]} do plan and plant agree ({100 * self.then:.2g} %): more "
                  "intervals, or an equation for what settles at once in place of its dynamics")
        mode = f"its fastest time constant is {_time(self.fastest)}, " if np.isfinite(self.fastest) else ""
        return (f"the grid is too coarse for this system: {mode}a step {_time(self.step / self.substeps)}, "
                f"and plan and plant differ by {100 * self.error:.2g} %; {remedy}")


def measured(ocp: OCP, functions: Functions, solution: Solution, substeps: int) -> Grid | None:
    """The grid of some solutions of an OCP under f, by the first ROWS that were solved; None where none was."""
    solution = solution[np.flatnonzero(solution.success)[:ROWS]]
    if not len(solution):
        return None
    error = _errors(ocp, functions, solution)
    now = error(substeps)
    more = [n for n in TRIED if n >= substeps]
    needed = next((n for n in more if error(n) <= WANTED), None) if now > WANTED else substeps
    step = float(np.diff(solution.t, axis=1).max())
    return Grid(step, substeps, now, needed, error(needed or TRIED[-1]), _fastest(functions, solution))


def _errors(ocp: OCP, functions: Functions, s: Solution) -> Callable[[int], float]:
    """substeps -> the largest error."""
    B, K, nx = len(s), s.u.shape[1], s.x.shape[2]
    x, u, h = s.x[:, :-1].reshape(-1, nx).T, s.u.reshape(B * K, -1).T, np.diff(s.t, axis=1).reshape(1, -1)
    step = functions.step()
    usual = usual_sizes(ocp)
    cost, slope = np.maximum(np.abs(s.cost), SMALL * usual.cost), s.V_x[:, 1:].reshape(-1, nx).T
    known: dict[int, float] = {}

    def after(n: int) -> tuple[Array, Array]:
        z, total = x, np.zeros((1, B * K))
        for _ in range(n):
            z, part = (v.full() for v in step(z, u, h / n))
            total = total + part
        return z, total

    with np.errstate(all="ignore"):
        true, paid = after(FINEST)

    def error(n: int) -> float:
        if n not in known:
            with np.errstate(all="ignore"):
                z, total = after(n)
                off = np.abs(total - paid).ravel() + np.abs((slope * (z - true)).sum(axis=0))
                parted = (np.abs(z - true) / usual.x[:, None]).max()
                worst = max((off.reshape(B, K).sum(axis=1) / cost).max(), parted)
            known[n] = float(worst) if np.isfinite(worst) else np.inf
        return known[n]

    return error


def _fastest(functions: Functions, s: Solution) -> float:
    """The shortest time constant of the linearised f at the solutions' nodes."""
    nx = s.x.shape[2]
    A = functions.jacobian(s.x[:, :-1].reshape(-1, nx).T, s.u.reshape(-1, s.u.shape[2]).T)[0].full()
    A = A.reshape(nx, -1, nx).transpose(1, 0, 2)
    rate = np.abs(np.linalg.eigvals(A[np.isfinite(A).all(axis=(1, 2))]).real).max(initial=0.0)
    return float(1 / rate) if rate > 0 else np.inf


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if not seconds < 1 else f"{1000 * seconds:.3g} ms"
