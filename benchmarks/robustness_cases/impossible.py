"""Problems without a solution: no solver says that it solved them, and each comes back."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import nocl
from nocl.solvers import DDP, NMPC

LIMIT = 60.0  # seconds: what takes longer counts as hanging
PATIENCE = 3.0  # seconds of one solve


def mass(walls: dict[str, Any], horizon: float = 3.0, f: Any = None, L: Any = None, G: Any = None) -> nocl.OCP:
    """p' = v, v' = u, |u| <= 1, or with another acceleration, cost."""
    p, v, u = (ca.SX.sym(name) for name in "pvu")
    a = u if f is None else f(p, v, u)
    s = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, a), lbu=[-1], ubu=[1], lbx=[-5, -5], ubx=[5, 5])
    running = 0.1 * u**2 + p**2 if L is None else L(p, v, u)
    terminal = p**2 + v**2 if G is None else G(p, v)
    return nocl.OCP(s, horizon=horizon, running=running, terminal=terminal, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian([0.5, 0.0], [0.1, 0.1]),
                    path_constraints={n: h(p, v) for n, h in walls.items()})


def problems() -> dict[str, tuple[Callable[[], nocl.OCP], list[float]]]:
    """(the problem, a state from which nothing solves it)."""
    wall = {"wall": lambda p, v: 1 - p}
    return {
        "braking takes longer than the way": (lambda: mass(wall), [0.5, 1.5]),
        "begins inside the wall": (lambda: mass(wall), [1.5, 0.0]),
        "a corridor of no width": (lambda: mass({"low": lambda p, v: p - 1, "high": lambda p, v: 0.5 - p}), [0.7, 0.0]),
        "a wall everywhere": (lambda: mass({"all": lambda p, v: -1 - p**2}), [0.0, 0.0]),
        "too fast for its limit": (lambda: mass({"speed": lambda p, v: 0.5 - v}), [0.0, 3.0]),
        "finite escape": (lambda: mass({}, f=lambda p, v, u: v**3 + 0.01 * u), [0.0, 4.0]),
        "finite escape of a square": (lambda: mass({}, f=lambda p, v, u: 5 * v**2 + u), [0.0, 3.0]),
        "exponential escape": (lambda: mass({}, f=lambda p, v, u: ca.exp(5 * v) + u), [0.0, 2.0]),
        "a cost that is NaN on every way": (lambda: mass({}, L=lambda p, v, u: u**2 + ca.log(4 + p)), [-4.5, -2.0]),
        "a cost that is inf at the start": (lambda: mass({}, L=lambda p, v, u: u**2 + 1 / (4 - p) ** 2), [4.0, 0.0]),
        "a root of what gets negative": (lambda: mass({}, L=lambda p, v, u: u**2 + ca.sqrt(3 + v)), [0.0, -4.9]),
        "an end cost that is NaN": (lambda: mass({}, G=lambda p, v: ca.log(4 - p)), [4.8, 4.8]),
        "a wall that comes too fast": (lambda: mass({"wall": lambda p, v: p + 1 - 2 * nocl.time()}), [0, 0]),
        "a gate that shuts": (lambda: mass({"gate": lambda p, v: 2 * (nocl.time() - 1) ** 2 - p}), [2.0, 0.0]),
        "a pull without end": (lambda: mass({}, f=lambda p, v, u: 1 / (1 - p) + 0.1 * u), [0.9, 1.0]),
        "an end cost that falls without end": (lambda: mass({}, G=lambda p, v: ca.log(p**2 + v**2)), [0.5, 0.0]),
    }


def tried(solver: str, ocp: Callable[[], nocl.OCP], x0: list[float]) -> str:
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem = ocp()
        except ValueError:
            return ""  # refused when it is written down
        made = NMPC(problem, 20, starts=3, passes=1, time_limit=PATIENCE) if solver == "NMPC" else \
            DDP(problem, intervals=20, threads=1)
        found = made.solve([x0, x0], workers=1, progress=False)
    took = time.perf_counter() - begin
    if found.success.any():
        return f"says solved: {found.message[0]}, cost {found.cost[0]:g}"
    if np.isfinite(found.cost).any() or not all(found.message):
        return f"cost {found.cost.tolist()}, message {found.message.tolist()}"
    return f"took {took:.0f} s" if took > LIMIT else ""


def judged(ocp: Callable[[], nocl.OCP], x0: list[float]) -> str:
    """The judge runs no control on it that is feasible and finite."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem = ocp()
        except ValueError:
            return ""
        seen = nocl.simulate(problem, lambda x, t: 0 * x[:, :1], x0)
    fine = seen.success & (seen.violation == 0) & np.isfinite(seen.cost)
    return "the judge finds it feasible" if fine.any() else ""


def kinds(rng: np.random.Generator, folder: Path) -> Iterator[tuple[str, list[tuple[str, Callable[[], str]]]]]:
    every = problems().items()
    for solver in ("NMPC", "DDP"):
        yield solver, [(name, lambda s=solver, a=args: tried(s, *a)) for name, args in every]
    yield "judge", [(name, lambda a=args: judged(*a)) for name, args in every]
