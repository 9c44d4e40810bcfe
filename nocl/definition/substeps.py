"""Steps that fit a system: what was found of a grid, how it is told, and which steps are taken, and how many.

What is left to nocl (substeps=None) begins with one Runge-Kutta step in each interval, and takes more where that is too
coarse, as many as what it found first asks for; where these are many, or a mode of the system makes RK4 unstable,
implicit steps (nocl/translate/radau.py), if few of them do. Solutions that are found say nothing of initial states from
which there are none since the state runs away between steps: these are followed under held controls (`enduring`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from nocl.translate import radau

USUAL = 80  # intervals, where nobody says
RK4, RADAU = "rk4", "radau"
MAP = "map"  # the step of a discrete-time system: its own
INTEGRATORS = (RK4, RADAU)
FINEST = 128  # steps in an interval, taken for the truth
TRIED = (1, 2, 4, 8, 16, 32)  # substeps, in this order
FEW = (1, 2, 4, 8)  # implicit steps in an interval that are tried
PRICE = 16  # Runge-Kutta steps that take as long as an implicit one (about, in DDP)
STABLE = 2.7  # |lambda| h up to which RK4 damps what decays
COARSE = 1e-2  # a larger error is worth a warning
FINE = 1e-3  # training takes more substeps above it
WANTED = 1e-4  # ... and a smaller one is what substeps are chosen for
STARTS = 64  # initial states that are followed under held controls
LOST = 0.05  # of those that stay finite with the finest steps, which may blow up: neighbours lead to them
REMEDY = "more intervals, or an equation for what settles at once in place of its dynamics"


class Steps(NamedTuple):
    """The steps of an interval."""

    integrator: str = RK4
    substeps: int = 1


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
    tried: tuple[int, ...] = TRIED
    explicit: bool = False  # whether implicit steps might help

    @property
    def enough(self) -> int:
        """The substeps to go on with."""
        return self.needed or self.tried[-1]

    @property
    def coarse(self) -> bool:
        return not self.error <= COARSE

    def __str__(self) -> str:
        remedy = (f"with substeps={self.needed} {self.parts} agree to {100 * self.then:.2g} %" if self.needed else
                  f"not even with substeps={self.tried[-1]} do {self.parts} agree ({100 * self.then:.2g} %): "
                  + ('integrator="radau", ' if self.explicit else "") + REMEDY)
        mode = f"its fastest time constant is {_time(self.fastest)}, " if math.isfinite(self.fastest) else ""
        return (f"the grid is too coarse for this system: {mode}a step {_time(self.step / self.substeps)}, "
                f"and {self.parts} differ by {100 * self.error:.2g} %; {remedy}")


def grid_of(step: float, substeps: int, error: Callable[[int], float], fastest: float,
            parts: str = "plan and plant", tried: tuple[int, ...] = TRIED, explicit: bool = False) -> Grid:
    """What `error(substeps)` says of intervals of length `step`."""
    now = error(substeps)
    more = (n for n in tried if n >= substeps)
    needed = next((n for n in more if error(n) <= WANTED), None) if now > WANTED else substeps
    return Grid(step, substeps, now, needed, error(needed or tried[-1]), fastest, parts, tried, explicit)


def settled(owner: str, ask: Callable[[Steps], Grid | None], step: float, fastest: Callable[[], float],
            tolerance: float = COARSE, integrator: str | None = None) -> Steps:
    """The steps with which solutions are off by `tolerance` at most; a warning says where one RK4 step is not enough.

    ask : steps -> the grid of solutions with such steps; None where nothing was solved
    step, fastest : length of an interval, and time constant of f where solutions begin; where it is the shorter one
        and nothing was solved, that may be why, and more steps are tried
    integrator : of these steps alone; None: implicit ones where explicit ones are too many
    """
    found, now = dict[Steps, Grid | None](), Steps(integrator or RK4)
    while now not in found:
        found[now] = ask(now)
        now = _following(now, found, step, fastest, tolerance, integrator)
    known = {steps: grid for steps, grid in found.items() if grid is not None}
    if not known:
        if len(found) > 1:
            warnings.warn(f"{owner}: nothing was solved, not even with substeps={now.substeps}: the fastest time "
                          f"constant is {_time(fastest())}, an interval {_time(step)}; {REMEDY}", stacklevel=4)
        return Steps(integrator or RK4)  # whoever solves says why nothing can be
    chosen = now if now in known else list(known)[-1]
    _tell(owner, chosen, known[chosen], found, fastest)
    return chosen


def _following(now: Steps, found: dict[Steps, Grid | None], step: float, fastest: Callable[[], float],
               tolerance: float, integrator: str | None) -> Steps:
    """What is tried next; `now` where that is enough, or nothing else would help."""
    grid, n = found[now], now.substeps
    if grid is not None and grid.error <= (tolerance if now.integrator == RK4 else min(tolerance, FINE)):
        return now
    if now.integrator == RADAU and integrator is None:
        return _explicit_or(now, grid, found)
    if integrator is None and Steps(RADAU) not in found and _too_many(grid, step, fastest):
        return Steps(RADAU)
    if grid is not None:
        return Steps(now.integrator, grid.enough)
    if fastest() >= step:
        return now
    return Steps(now.integrator, min(4 * n, (TRIED if now.integrator == RK4 else FEW)[-1]))


def _too_many(grid: Grid | None, step: float, fastest: Callable[[], float]) -> bool:
    """Whether explicit steps are unstable, or many of them are asked for."""
    if grid is None:
        return step > STABLE * PRICE * fastest()
    return grid.needed is None or grid.needed > PRICE


def _explicit_or(now: Steps, grid: Grid | None, found: dict[Steps, Grid | None]) -> Steps:
    """Implicit steps, as many as are asked for, or where they are no cheaper explicit ones."""
    first = found[Steps()]
    if grid is not None and grid.needed and (first is None or first.needed is None
                                             or PRICE * grid.needed < first.needed):
        return Steps(RADAU, grid.needed)
    return Steps(RK4, TRIED[-1] if first is None else first.enough)


def enduring(owner: str, chosen: Steps, kept: Callable[[Steps], int], stiff: Callable[[], bool],
             ask: Callable[[Steps], Grid | None], tolerance: float = COARSE, integrator: str | None = None) -> Steps:
    """Steps, `chosen` or the next dearer ones, with which initial states stay finite that do so with the finest.

    kept : steps -> how many of STARTS initial states stay finite under held controls
    stiff : whether no explicit steps that are tried can follow f where these begin
    ask, tolerance, integrator : as in `settled`: solutions that there are only now may ask for more
    """
    if kept(chosen) == STARTS:
        return chosen
    dearer = _dearer(chosen, integrator, stiff)
    wanted = (1 - LOST) * kept(dearer[-1])
    best = next(steps for steps in dearer if kept(steps) >= wanted)
    if best != chosen:
        grid = ask(best)
        best = best if grid is None or grid.error <= tolerance else Steps(best.integrator, grid.enough)
        warnings.warn(f"{owner}: of {STARTS} initial states under held controls {kept(chosen)} stay finite with "
                      f"{_words(chosen)} in an interval, {kept(best)} with {_words(best)}; these are taken",
                      stacklevel=4)
    return best


def _dearer(chosen: Steps, integrator: str | None, stiff: Callable[[], bool]) -> list[Steps]:
    """`chosen` and what takes longer, in this order."""
    n = chosen.substeps
    implicit = [Steps(RADAU, few) for few in FEW if chosen.integrator == RK4 or few > n]
    explicit = [Steps(RK4, more) for more in TRIED if more > n]
    if chosen.integrator == RADAU:
        return [chosen, *implicit]
    if integrator == RK4 or n > PRICE:
        return [chosen, *explicit]
    few = [steps for steps in explicit if steps.substeps <= PRICE]
    return [chosen, *few, *implicit] if stiff() else [chosen, *few, implicit[0], *explicit[len(few):]]


def _words(steps: Steps) -> str:
    kind = "Runge-Kutta" if steps.integrator == RK4 else "implicit Radau"
    return f"{steps.substeps} {kind} step" + ("s" if steps.substeps > 1 else "")


def _tell(owner: str, chosen: Steps, grid: Grid, found: dict[Steps, Grid | None], fastest: Callable[[], float]) -> None:
    """Warns where the steps that are taken are not one of Runge and Kutta's, or are too long."""
    first = next(iter(found.values()))
    if grid.coarse:
        warnings.warn(f"{owner}: {grid}", stacklevel=5)
    elif chosen.integrator == RADAU:
        mode = min(fastest(), *(one.fastest for one in found.values() if one is not None))
        more = f", {chosen.substeps} steps in an interval" if chosen.substeps > 1 else ""
        what = f"fastest mode {_time(mode)}" if math.isfinite(mode) else "nothing decays, grows or swings by itself"
        warnings.warn(f"{owner}: {what}, step {_time(grid.step)}: implicit Radau, "
                      f"{radau.STAGES} stages{more}; {grid.parts} agree to {100 * grid.error:.2g} %", stacklevel=5)
    elif len(found) > 1 and first is None:
        warnings.warn(f"{owner}: with one Runge-Kutta step in an interval nothing was solved; {chosen.substeps} are "
                      f"taken, and {grid.parts} agree to {100 * grid.error:.2g} %", stacklevel=5)
    elif first is not None and first.coarse:
        warnings.warn(f"{owner}: {first}, so they are taken", stacklevel=5)


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if not seconds < 1 else f"{1000 * seconds:.3g} ms"
