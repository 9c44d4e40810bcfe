"""The one discretisation: RK4 steps under controls held over each interval, for torch and CasADi alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Field = Callable[[Any, Any], Any]  # (x, u) -> xdot, torch or CasADi
Moment = Callable[..., Any]  # ... or (x, u, t) -> xdot


def rk4(f: Field, x: Any, u: Any, h: Any) -> Any:
    """One classical Runge-Kutta step of length h, u held."""
    k1 = f(x, u)
    k2 = f(x + h / 2 * k1, u)
    k3 = f(x + h / 2 * k2, u)
    k4 = f(x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def rk4_interval(f: Field, x: Any, u: Any, h: Any, substeps: int = 1) -> Any:
    """The state after an interval of length h with u held, by `substeps` RK4 steps."""
    for _ in range(substeps):
        x = rk4(f, x, u, h / substeps)
    return x


def map_cost(f: Moment, L: Moment, x: Any, u: Any, h: Any, t: Any = None) -> tuple[Any, Any]:
    """(the next state, the cost) of a step of a discrete-time system: f is (x+ - x) / dt there, and h is dt, or 0 where
    nothing moves.

    t : the time at its start, where f and L are functions of (x, u, t)
    """
    now = [] if t is None else [t]
    return x + h * f(x, u, *now), h * L(x, u, *now)


def rk4_cost(f: Moment, L: Moment, x: Any, u: Any, h: Any, substeps: int = 1, t: Any = None) -> tuple[Any, Any]:
    """(the state after an interval, the integral of L over it): the same RK4 stages quadrate the cost.

    t : the time at its start, where f and L are functions of (x, u, t)
    """
    cost = 0
    h = h / substeps
    for part in range(substeps):
        begin, middle, end = ([] if t is None else [t + (part + share) * h] for share in (0, 0.5, 1))
        k1 = f(x, u, *begin)
        x2 = x + h / 2 * k1
        k2 = f(x2, u, *middle)
        x3 = x + h / 2 * k2
        k3 = f(x3, u, *middle)
        x4 = x + h * k3
        L1, L2, L3, L4 = L(x, u, *begin), L(x2, u, *middle), L(x3, u, *middle), L(x4, u, *end)
        cost = cost + h / 6 * (L1 + 2 * L2 + 2 * L3 + L4)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x4, u, *end))
    return x, cost
