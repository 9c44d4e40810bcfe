"""Path constraints h(x) >= 0 measured by scales of their own, since their units say nothing: a metre, or its square.

The scale of a constraint is how deep its forbidden set is in X, max -h, or, where that is less, how large |h| is where
the problem takes place, at x* and at initial states: 1 % of a pillar's radius, 1 % of the distance to a wall.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nocl.functions import Functions
from nocl.support.checks import Array

SAMPLES = 4096  # of X
LOWEST = 4  # samples from which a minimum of h is descended to
NEVER = 1e-9  # of the spread of h over X: less deep than that is never violated there


Moments = dict[str, Array]  # times t [n] and parameters p [n, np] of n states


def scales(functions: Functions, place: Array, moments: Callable[[int], Moments], there: Moments) -> Array:
    """The scale of each path constraint [m] > 0.

    place : states [n, nx] where the problem takes place, there: their times and parameters
    moments : random times and parameters of n states
    """
    s, rng = functions.system, np.random.default_rng(0)
    box, at = rng.uniform(s.lbx, s.ubx, (SAMPLES, s.nx)), moments(SAMPLES)
    h, near = (_finite(functions.h(*functions.node.columns(x=x, **when)).full())
               for x, when in ((box, at), (place, there)))
    return np.array([_scale(functions, i, box, at, h[i], np.abs(near[i]).max()) for i in range(len(h))])


def _scale(functions: Functions, i: int, box: Array, at: Moments, h: Array, near: float) -> float:
    depth, spread = -_lowest(functions, i, box, at, h), float(np.ptp(h))
    sizes = [size for size in (depth if depth > NEVER * spread else spread, near) if size > 0]
    return min(sizes, default=1.0)


def _lowest(functions: Functions, i: int, box: Array, at: Moments, h: Array) -> float:
    """min h_i over X, by descent from the lowest samples: a thin obstacle lies between samples."""
    from scipy.optimize import minimize  # heavy

    s, weight = functions.system, np.eye(functions.h.numel_out(0))[i]

    def value(x: Array, k: int) -> tuple[float, Array]:
        here = functions.node.columns(x=x, t=at["t"][k], p=at["p"][k])
        values, slopes, _ = functions.h_derivatives(*here, weight)
        return float(values[i]), np.asarray(slopes[i, :]).ravel()

    bounds = list(zip(s.lbx, s.ubx, strict=True))
    found = [minimize(value, box[k], args=(k,), jac=True, method="L-BFGS-B", bounds=bounds).fun
             for k in np.argsort(h)[:LOWEST]]
    return float(np.nanmin([h.min(), *found]))


def _finite(h: Array) -> Array:
    return np.where(np.isfinite(h), h, 0.0)
