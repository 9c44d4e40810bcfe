"""Problems in discrete time: their grid is given, one interval a step, and what is asked of another is refused."""

from __future__ import annotations

from typing import Any

import numpy as np

from nocl.definition.substeps import MAP, USUAL, Steps
from nocl.definition.system import System
from nocl.support.checks import Array

WHOLE = 1e-6  # of a step, by which times may be off a sample


def steps_in(system: System, duration: float, what: str, owner: str) -> int:
    """How many steps a time is; ValueError where it is no whole number of them."""
    assert system.dt is not None
    k = round(duration / system.dt)
    if abs(duration / system.dt - k) > WHOLE:
        low = int(duration // system.dt)
        near = " or ".join(f"{n * system.dt:g}" for n in (low, low + 1))
        raise ValueError(f"{owner}: {what} is {duration:g}, and {system.name!r} moves in steps of dt = {system.dt:g}; "
                         f"expected a whole number of steps, like {near}")
    return k


def intervals_of(ocp: Any, given: int | None, owner: str, duration: float | None = None) -> int:
    """How many intervals plans have: what is given, or USUAL; in discrete time one a step of the horizon, or of a
    `duration`."""
    if not ocp.system.is_discrete:
        return USUAL if given is None else int(given)
    steps = ocp.steps if duration is None else steps_in(ocp.system, duration, "horizon", owner)
    if given is not None and int(given) != steps:
        raise ValueError(f"{owner}: intervals is {given}, and {ocp.system.name!r} is a system in discrete time, with "
                         f"{steps} steps of dt = {ocp.system.dt:g} until the end; expected {steps}: leave it out")
    return int(steps)


def check_steps(system: System, substeps: int | None, integrator: str | None, owner: str) -> Steps:
    """The steps of an interval in discrete time: F itself; ValueError where others are asked for."""
    for name, value, usual in (("substeps", substeps, 1), ("integrator", integrator, MAP)):
        if value not in (None, usual):
            raise ValueError(f"{owner}: {name} is {value!r}, and {system.name!r} is a system in discrete time, whose "
                             f"step is F itself; expected none: leave it out")
    return Steps(MAP, 1)


def samples(system: System, first: int, last: int) -> Array:
    """The times of the samples from number `first` to number `last`, inclusive."""
    return np.array((system.dt or 0.0) * np.arange(first, last + 1), dtype=np.float64)


def first_step(ocp: Any, t0: float, owner: str) -> int:
    """The number of the sample at t0, where a run or a plan starts; ValueError where there is none before the end."""
    k = steps_in(ocp.system, t0, "t0", owner)
    if not 0 <= k < ocp.steps:
        raise ValueError(f"{owner}: t0 is {t0:g}, and {ocp.system.name!r} has steps from t = 0 to {ocp.horizon:g}; "
                         "expected a sample before the end")
    return k
