"""Path constraints h(x) >= 0 measured by scales of their own, since their units say nothing: a metre, or its square.

The scale of a constraint is how deep its forbidden set is in X, max -h, or, where that is less, how large |h| is where
the problem takes place, at x* and at initial states: 1 % of a pillar's radius, 1 % of the distance to a wall.
"""

from __future__ import annotations

import numpy as np

from nocl.functions import Functions
from nocl.support.checks import Array

SAMPLES = 4096  # of X
LOWEST = 4  # samples from which a minimum of h is descended to
NEVER = 1e-9  # of the spread of h over X: less deep than that is never violated there


def scales(functions: Functions, place: Array) -> Array:
    """The scale of each path constraint [m] > 0; place [n, nx]: states where the problem takes place."""
    s, rng = functions.system, np.random.default_rng(0)
    box = rng.uniform(s.lbx, s.ubx, (SAMPLES, s.nx))
    h, near = (_finite(functions.h(x.T).full()) for x in (box, place))
    return np.array([_scale(functions, i, box, h[i], np.abs(near[i]).max()) for i in range(len(h))])


def _scale(functions: Functions, i: int, box: Array, h: Array, near: float) -> float:
    depth, spread = -_lowest(functions, i, box, h), float(np.ptp(h))
    sizes = [size for size in (depth if depth > NEVER * spread else spread, near) if size > 0]
    return min(sizes, default=1.0)


def _lowest(functions: Functions, i: int, box: Array, h: Array) -> float:
    """min h_i over X, by descent from the lowest samples: a thin obstacle lies between samples."""
    from scipy.optimize import minimize  # heavy

    s, weight = functions.system, np.eye(functions.h.numel_out(0))[i]

    def value(x: Array) -> tuple[float, Array]:
        values, slopes, _ = functions.h_derivatives(x, weight)
        return float(values[i]), np.asarray(slopes[i, :]).ravel()

    found = [minimize(value, box[k], jac=True, method="L-BFGS-B", bounds=list(zip(s.lbx, s.ubx, strict=True))).fun
             for k in np.argsort(h)[:LOWEST]]
    return float(np.nanmin([h.min(), *found]))


def _finite(h: Array) -> Array:
    return np.where(np.isfinite(h), h, 0.0)
