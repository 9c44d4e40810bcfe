"""Implicit steps for stiff systems: Radau IIA with controls held, for CasADi.

    X_i = x + h sum_j a_ij f(X_j, u, t + c_j h),  x+ = X_s,  int L dt = h sum_j b_j L(X_j, u, t + c_j h),  b = a_s

of order 2 s - 1; L-stable: what is far faster than a step is at rest at its end. csrc/radau.h has the same in C.

Source: Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.5 (coefficients) and IV.8 (z = X - x).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from nocl.support.checks import Array

STAGES = 3
ITERATIONS = 30  # of Newton's method at most
SETTLED = 1e-9  # its correction, as a share of a usual state, after which it has converged: what is left is its square
LEFT = 1e-6  # of a usual state, by which the equations may be off: CasADi's root finder calls anything a success
S6 = np.sqrt(6.0)
TABLES = {  # stages -> (c, a)
    2: ([1 / 3, 1], [[5 / 12, -1 / 12], [3 / 4, 1 / 4]]),
    3: ([(4 - S6) / 10, (4 + S6) / 10, 1],
        [[(88 - 7 * S6) / 360, (296 - 169 * S6) / 1800, (-2 + 3 * S6) / 225],
         [(296 + 169 * S6) / 1800, (88 + 7 * S6) / 360, (-2 - 3 * S6) / 225],
         [(16 - S6) / 36, (16 + S6) / 36, 1 / 9]]),
}
REACH, WEIGHT = (np.array(part) for part in TABLES[STAGES])
Moment = Callable[..., Any]  # (x, u[, t]) -> f, L or z


def residual(f: Moment, z: Any, x: Any, u: Any, h: Any, t: Any = None) -> Any:
    """z_i - h sum_j a_ij f(x + z_j) [s nx]."""
    parts = ca.vertsplit(z, x.numel())
    slopes = [f(x + part, u, *_later(t, c * h)) for part, c in zip(parts, REACH, strict=True)]
    return ca.vertcat(*(part - h * sum(float(a) * slope for a, slope in zip(row, slopes, strict=True))
                        for part, row in zip(parts, WEIGHT, strict=True)))


def stages(equations: ca.Function, unit: Array, inputs: Sequence[ca.MX]) -> ca.MX:
    """z where equations(z, *inputs) = 0, an MX; NaN where Newton's method finds none. unit [nx]: usual states."""
    size = np.tile(unit, STAGES)
    z, given = ca.MX.sym("z", size.size), [ca.MX.sym("given", i.numel()) for i in inputs]
    scaled = {"x": z, "p": ca.vertcat(*given), "g": equations(z * size, *given) / size}
    solver = ca.rootfinder("radau", "newton", scaled, {
        "error_on_fail": False, "show_eval_warnings": False, "max_iter": ITERATIONS, "abstol": 1e-13,
        "abstolStep": SETTLED**1.5, "line_search": False})
    found = solver(0, ca.vertcat(*inputs)) * size
    left = ca.norm_inf(equations(found, *inputs) / size)
    return found + ca.if_else(left <= LEFT, 0, np.nan)


def radau_cost(z: Moment, L: Moment, x: Any, u: Any, h: Any, substeps: int = 1, t: Any = None) -> tuple[Any, Any]:
    """(the state after an interval, the integral of L over it) by `substeps` steps.

    z : (x, u[, t]) -> the stages less x of a step of length h / substeps
    t : the time at its start, where f and L are functions of (x, u, t)
    """
    cost, h = 0, h / substeps
    for part in range(substeps):
        now = None if t is None else t + part * h
        states = [x + one for one in ca.vertsplit(z(x, u, *_later(now, 0)), x.numel())]
        for state, b, c in zip(states, WEIGHT[-1], REACH, strict=True):
            cost = cost + h * float(b) * L(state, u, *_later(now, c * h))
        x = states[-1]
    return x, cost


def _later(t: Any, time: Any) -> list[Any]:
    return [] if t is None else [t + time]
