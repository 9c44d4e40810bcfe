"""Runge-Kutta steps that are short enough for a system: what was found, how it is told, and how many are taken.

What is left to nocl (substeps=None) begins with one step in each interval, and takes more where that is too coarse, as
many as what it found first asks for.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

RK4, RADAU = "rk4", "radau"
INTEGRATORS = (RK4, RADAU)
FINEST = 128  # steps in an interval, taken for the truth
TRIED = (1, 2, 4, 8, 16, 32)  # substeps, in this order
COARSE = 1e-2  # a larger error is worth a warning
FINE = 1e-3  # training takes more substeps above it
WANTED = 1e-4  # ... and a smaller one is what substeps are chosen for
REMEDY = "more intervals, or an equation for what settles at once in place of its dynamics"


@dataclass(frozen=True)
class Grid:
    """What was found of solutions, or of logs, on a grid."""

    step: float  # length of an interval
    substeps: int
    error: float  # the largest, of a state after an interval or of a cost, as a share of usual ones
    needed: int | None  # substeps with which it is WANTED; None: of those TRIED none is enough
    then: float  # the error with those, or with the most that were tried
    fastest: float  # time constant of f along them; inf for none
    parts: str = "plan and plant"  # what differs by it

    @property
    def enough(self) -> int:
        """The substeps to go on with."""
        return self.needed or TRIED[-1]

    @property
    def coarse(self) -> bool:
        return not self.error <= COARSE

    def __str__(self) -> str:
        remedy = (f"with substeps={self.needed} {self.parts} agree to {100 * self.then:.2g} %" if self.needed else
                  f"not even with substeps={TRIED[-1]} do {self.parts} agree ({100 * self.then:.2g} %): "
                  f"{REMEDY}")
        mode = f"its fastest time constant is {_time(self.fastest)}, " if math.isfinite(self.fastest) else ""
        return (f"the grid is too coarse for this system: {mode}a step {_time(self.step / self.substeps)}, "
                f"and {self.parts} differ by {100 * self.error:.2g} %; {remedy}")


def grid_of(step: float, substeps: int, error: Callable[[int], float], fastest: float,
            parts: str = "plan and plant") -> Grid:
    """What `error(substeps)` says of intervals of length `step`."""
    now = error(substeps)
    more = (n for n in TRIED if n >= substeps)
    needed = next((n for n in more if error(n) <= WANTED), None) if now > WANTED else substeps
    return Grid(step, substeps, now, needed, error(needed or TRIED[-1]), fastest, parts)


def settled(owner: str, ask: Callable[[int], Grid | None], step: float, fastest: Callable[[], float],
            tolerance: float = COARSE) -> int:
    """The substeps with which solutions are off by `tolerance` at most; a warning says where 1 is far from enough.

    ask : substeps -> the grid of solutions with so many; None where nothing was solved
    step, fastest : length of an interval, and time constant of f where solutions begin; where it is the shorter one
        and nothing was solved, that may be why, and more substeps are tried
    """
    found, substeps = dict[int, Grid | None](), 1
    while substeps not in found:
        grid = found[substeps] = ask(substeps)
        if grid is None and fastest() >= step:
            break
        if grid is not None:
            substeps = substeps if grid.error <= tolerance else grid.enough
        else:
            substeps = min(4 * substeps, TRIED[-1])
    known = [grid for grid in found.values() if grid is not None]
    if not known:
        if len(found) > 1:
            warnings.warn(f"{owner}: nothing was solved, not even with substeps={substeps}: the fastest time constant "
                          f"is {_time(fastest())}, an interval {_time(step)}; {REMEDY}", stacklevel=4)
        return 1  # whoever solves says why nothing can be
    substeps = known[-1].substeps
    if known[-1].coarse:
        warnings.warn(f"{owner}: {known[-1]}", stacklevel=4)
    elif len(found) > 1 and found[1] is None:
        warnings.warn(f"{owner}: with one Runge-Kutta step in an interval nothing was solved; {substeps} are taken, "
                      f"and {known[-1].parts} agree to {100 * known[-1].error:.2g} %", stacklevel=4)
    elif known[0].coarse:
        warnings.warn(f"{owner}: {known[0]}, so they are taken", stacklevel=4)
    return substeps


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if not seconds < 1 else f"{1000 * seconds:.3g} ms"
