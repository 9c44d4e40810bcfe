"""Whether Runge-Kutta steps are short enough: solutions held against the same equations on far shorter steps.

A solver knows its plant on its own grid alone. Where that is too coarse for a fast part of the plant, what it plans,
and says that it costs, has nothing to do with the plant, and a descent even looks for such plans. So a few solutions
are followed again, interval by interval, each from its own nodes: an unstable plant does no harm. What counts is by how
much of X a state is off after an interval, and by how much of J the cost is, to first order: errors of states count by
the costate there, and add up with those of the running cost.

Where it is left to a solver (substeps=None) it takes one Runge-Kutta step in each interval, and more where that is too
coarse, as many as its first solutions ask for.
"""

from __future__ import annotations

import warnings
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
    def enough(self) -> int:
        """The substeps to go on with."""
        return self.needed or TRIED[-1]

    @property
    def coarse(self) -> bool:
        return not self.error <= COARSE

    def __str__(self) -> str:
        remedy = (f"with substeps={self.needed} plan and plant agree to {100 * self.then:.2g} %" if self.needed else
                  f"not even with substeps={TRIED[-1]} do plan and plant agree ({100 * self.then:.2g} %): more "
                  "intervals, or an equation for what settles at once in place of its dynamics")
        return (f"the grid is too coarse for this system: its fastest time constant is {_time(self.fastest)}, a step "
                f"{_time(self.step / self.substeps)}, and plan and plant differ by {100 * self.error:.2g} %; {remedy}")


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
    x, u = solution.x[:, :-1].reshape(-1, ocp.system.nx), solution.u.reshape(-1, ocp.system.nu)
    return Grid(step, substeps, now, needed, error(needed or TRIED[-1]), fastest(functions, x, u))


def settled(owner: str, ask: Callable[[int], Grid | None], stiff: Callable[[], bool],
            tolerance: float = COARSE) -> int:
    """The substeps with which solutions are off by `tolerance` at most; a warning says where 1 is far from enough.

    ask : substeps -> the grid of solutions with so many; None where nothing was solved
    stiff : whether f is fast beside a step: then more are tried where nothing was solved, since that may be why
    """
    found, substeps = dict[int, Grid | None](), 1
    while substeps not in found:
        grid = found[substeps] = ask(substeps)
        if grid is None and not stiff():
            break
        if grid is not None:
            substeps = substeps if grid.error <= tolerance else grid.enough
        else:
            substeps = min(4 * substeps, TRIED[-1])
    known = [grid for grid in found.values() if grid is not None]
    if not known:
        return 1  # whoever solves says why nothing can be
    substeps = known[-1].substeps
    if known[-1].coarse:
        warnings.warn(f"{owner}: {known[-1]}", stacklevel=4)
    elif len(found) > 1 and found[1] is None:
        warnings.warn(f"{owner}: with one Runge-Kutta step in an interval nothing was solved; {substeps} are taken, "
                      f"and plan and plant agree to {100 * known[-1].error:.2g} %", stacklevel=4)
    elif known[0].coarse:
        warnings.warn(f"{owner}: {known[0]}, so they are taken", stacklevel=4)
    return substeps


def stiff(ocp: OCP, functions: Functions, step: float) -> bool:
    """Whether f at initial states under u* is faster than explicit steps of this length follow well."""
    x = ocp.initial_states.sample(ROWS, 0)
    return bool(step > fastest(functions, x, np.tile(ocp.u_goal, (ROWS, 1))))


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


def fastest(functions: Functions, x: Array, u: Array) -> float:
    """The shortest time constant of the linearised f at states x [n, nx] under controls u [n, nu]; inf for none."""
    nx = x.shape[1]
    A = functions.jacobian(x.T, u.T)[0].full()
    A = A.reshape(nx, -1, nx).transpose(1, 0, 2)
    rate = np.abs(np.linalg.eigvals(A[np.isfinite(A).all(axis=(1, 2))]).real).max(initial=0.0)
    return float(1 / rate) if rate > 0 else np.inf


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if not seconds < 1 else f"{1000 * seconds:.3g} ms"
