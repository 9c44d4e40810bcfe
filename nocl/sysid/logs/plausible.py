"""Whether logged numbers can be what they are said to be: the unit of time, of states and controls, of angles.

A log without its units still tells them, by the box of its system, by the circle that an angle lies on, and by rows of
xdot that are known or were logged. What cannot be is refused; what is odd is a UserWarning.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from nocl.support.checks import Array

FAR, BEYOND = 8.0, 1000.0  # half widths of its box from the middle: a value to warn of, one to refuse
SMALL, VANISHING = 1e-6, 1e-100  # of the box: the largest value to warn of, to refuse: squares must not vanish
SHORTEST, LONGEST = 1e-12, 1e12  # usual step of time
DIGITS = 1e-3  # of a usual step: what times may be rounded by
SLACK = 1.0  # rad that noise may add to the circle
NEARLY, OFTEN = 0.75, 0.05  # of a half turn in a step; the share of such steps to warn of
ALIKE, RATIO = 0.8, 1.5  # share of a state's motion that a rate explains; how far off its size may then be
CLOSE = 0.1  # of a factor to one that has a usual reason
FACTORS = {  # (d NAME/dt in the log) / (what it should be) -> the usual reason
    1e-3: "is t in ms?", 1e-6: "is t in us?", 1e-9: "is t in ns?", 60: "is t in minutes?", 3600: "is t in hours?",
    86400: "is t in days?", 180 / np.pi: "is {name} in degrees, its rate in radians?",
    np.pi / 180: "is its rate in degrees, {name} in radians?", 1e3: "is {name} in thousandths of its rate's unit?",
    np.pi / 30: "is its rate in rpm, {name} in radians?", 6: "is its rate in rpm, {name} in degrees?",
    -1: "is the sign of one turned?"}


def check_times(t: Array, usual: float, owner: str) -> None:
    """ValueError for a usual step that no arithmetic survives, or that times cannot tell apart."""
    if not SHORTEST <= usual <= LONGEST:
        raise ValueError(f"{owner}: the usual step of time is {usual:.3g}; expected {SHORTEST:g} to {LONGEST:g}: "
                         "choose another unit of time")
    lost = float(np.spacing(np.abs(t).max()))
    if lost > DIGITS * usual:
        raise ValueError(f"{owner}: times around {np.abs(t).max():.6g} are known to {lost:.2g} only, the usual step is "
                         f"{usual:.3g}; expected times of more digits: subtract the first one before rounding")


def check_values(values: Array, lb: float, ub: float, name: str, owner: str) -> None:
    """ValueError for values of a state or control that its box makes impossible, a warning for odd ones."""
    bad = np.flatnonzero(np.abs(values) > 1 / VANISHING)
    if bad.size:
        raise ValueError(f"{owner}: {name} of sample {bad[0]} is {values[bad[0]]:.4g}; expected a number of ordinary "
                         "size, or NaN where it is missing: drop it, or convert the unit")
    if not np.isfinite(values).any():
        return
    box, widest = f"its box [{lb:g}, {ub:g}]", max(abs(lb), abs(ub))
    off = np.abs(values - (lb + ub) / 2) / ((ub - lb) / 2)
    k = int(np.nanargmax(off))
    if off[k] > FAR:
        said = (f"{owner}: {name} of sample {k} is {values[k]:.4g}, {off[k]:.3g} times as far from the middle as {box} "
                "reaches")
        if off[k] > BEYOND:
            raise ValueError(f"{said}; expected values near it: drop that sample (NaN where it is missing), convert "
                             "the unit, or widen the system's box")
        warnings.warn(f"{said}: is it an outlier, or in another unit? Else widen the system's box", UserWarning,
                      stacklevel=4)
    largest = float(np.nanmax(np.abs(values)))
    if 0 < largest < max(SMALL * widest, VANISHING):
        said = f"{owner}: {name} never exceeds {largest:.3g}, beside {box}"
        if largest < VANISHING * max(widest, 1.0):
            raise ValueError(f"{said}; expected values of its size: convert the unit, or write 0")
        warnings.warn(f"{said}: is it in another unit?", UserWarning, stacklevel=4)


def check_rates(rate: Array, t: Array, lb: float, ub: float, name: str, owner: str) -> None:
    """ValueError for logged derivatives [n] that cross the state's box in far less than a step."""
    most = BEYOND * (ub - lb) / float(np.median(np.diff(t)))
    bad = np.flatnonzero(np.isinf(rate) | (np.abs(rate) > most))
    if bad.size:
        raise ValueError(f"{owner}: d{name}/dt at t = {t[bad[0]]:g} is {rate[bad[0]]:.4g}; expected at most "
                         f"{most:.3g}, which crosses the box [{lb:g}, {ub:g}] a thousand times a step: drop that "
                         "sample (NaN where it is missing), convert the unit, or widen the system's box")


def unwrapped(angle: Array, samples: Any, name: str, owner: str) -> Array:
    """A piece's angle [n] without jumps, NaN where it is missing; ValueError where it is neither on a circle nor
    continuous, as degrees are."""
    there = np.isfinite(angle)
    steps, size = np.diff(angle[there]), float(np.ptp(angle[there]))
    if size > 2 * np.pi + SLACK and (np.abs(steps) >= np.pi).any():
        k = int(np.abs(steps).argmax())
        raise ValueError(f"{owner}: the angle {name} goes from {angle[there][k]:.4g} to {angle[there][k + 1]:.4g} at "
                         f"sample {samples[there][k + 1]}, and over {size:.4g} in all; expected radians, within 2 pi, "
                         f"or continuous (steps below pi): is it in degrees? Then pass {name} * pi / 180; else unwrap "
                         "it, or log more often")
    found = angle.copy()
    found[there] = np.unwrap(angle[there])
    wide = np.abs(np.diff(found[there])) > NEARLY * np.pi
    if wide.mean() > OFTEN:
        warnings.warn(f"{owner}: the angle {name} turns by more than {NEARLY:g} pi in {100 * wide.mean():.2g} % of the "
                      "steps: which way is a guess; log more often, or convert the unit", UserWarning, stacklevel=6)
    return found


def check_rate(x: list[Array], rate: list[Array], t: list[Array], name: str, words: str, owner: str) -> None:
    """ValueError where a state moves as a rate's integral says, but by another factor than 1.

    Pieces of x [n], of its rate [n] and of times [n]. The integral is compared, not the derivative, so that noise
    hardly counts.
    """
    moved, meant = (np.concatenate(parts) for parts in zip(*map(_motion, x, rate, t), strict=True))
    both, own, other = float(moved @ meant), float(moved @ moved), float(meant @ meant)
    if not own * other > 0 or both**2 < ALIKE * own * other:
        return
    factor = both / other
    if factor > 0 and 1 / RATIO <= factor <= RATIO:
        return
    near = min((abs(np.log(factor / f)), f) for f in FACTORS if factor / f > 0)
    hint = "are both in the units of one system?"
    if near[0] < CLOSE:
        factor = near[1]
        hint = FACTORS[factor].format(name=name)
    said = f"d {name}/dt in the log is {_three_digits(factor)} times {words}"
    if abs(factor) < 1:
        said = f"{words} is {_three_digits(1 / factor)} times d {name}/dt in the log"
    raise ValueError(f"{owner}: {said}; expected them equal: {hint}")


def _three_digits(value: float) -> str:
    """'1000', not '1e+03'."""
    return f"{float(f'{value:.3g}'):g}"


def _motion(x: Array, rate: Array, t: Array) -> tuple[Array, Array]:
    """A piece's state and its rate's integral, each about its mean, where the state is there."""
    there = np.isfinite(rate)
    if there.sum() < 2:
        return np.zeros(0), np.zeros(0)
    filled = np.interp(t, t[there], rate[there])
    integral = np.r_[0.0, np.cumsum((filled[1:] + filled[:-1]) / 2 * np.diff(t))]
    seen = np.isfinite(x)
    return x[seen] - x[seen].mean(), integral[seen] - integral[seen].mean()
