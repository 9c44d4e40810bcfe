"""An optimal control problem on a System: min of the integral of L(x, u) over [0, T], plus G(x(T))."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from nocl import checks
from nocl.checks import Vector
from nocl.sampling import Distribution, Gaussian, Uniform
from nocl.system import System, equations


@dataclass(frozen=True, eq=False, repr=False)
class OCP:
    """min_u int_0^T L(x, u) dt + G(x(T)), subject to xdot = f(x, u), u in U, h(x) >= 0.

    Parameters
    ----------
    system : System
    horizon : float
        T, in the system's unit of time (seconds for those that come with nocl).
    running, terminal : casadi.SX
        L(x, u) and G(x), scalars in the system's own symbols.
    x_goal, u_goal : [nx], [nu]
        The goal pair (x*, u*): it must lie in the system's boxes. L and G need not vanish there.
    initial_states : Gaussian or Uniform
        Where trajectories start; what a trained controller must cover.
    path_constraints : mapping from names to casadi.SX
        Each h(x), in the unit of a distance, must be >= 0 along the trajectory (an obstacle: distance minus radius).
    penalty, penalty_margin : float
        Where constraints are soft (training, DDP), penalty * max(margin - h, 0)^2 is added to L for each.

    Raises
    ------
    ValueError
        With what was got, what was expected and the remedy.
    """

    system: System
    horizon: float = field(kw_only=True)
    running: ca.SX = field(kw_only=True)
    terminal: ca.SX = field(kw_only=True)
    x_goal: Vector = field(kw_only=True)
    u_goal: Vector = field(kw_only=True)
    initial_states: Distribution = field(kw_only=True)
    path_constraints: Mapping[str, ca.SX] = field(default_factory=dict, kw_only=True)
    penalty: float = field(default=300.0, kw_only=True)
    penalty_margin: float = field(default=0.005, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.system, System):
            raise ValueError(f"OCP: system is a {type(self.system).__name__}; expected a nocl.System")
        s, owner = self.system, f"OCP on {self.system.name!r}"
        for name in ("horizon", "penalty", "penalty_margin"):
            self._check_number(name, owner)
        z = ca.vertcat(s.x, s.u)
        self._set(running=checks.expression(self.running, 1, z, "running", owner),
                  terminal=checks.expression(self.terminal, 1, s.x, "terminal", owner),
                  x_goal=checks.vector(self.x_goal, s.nx, "x_goal", owner),
                  u_goal=checks.vector(self.u_goal, s.nu, "u_goal", owner),
                  path_constraints={name: checks.expression(h, 1, s.x, f"path constraint {name!r}", owner)
                                    for name, h in dict(self.path_constraints).items()})
        self._check_goal(owner)
        self._check_initial_states(owner)
        self._check_finite(owner)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def _check_number(self, name: str, owner: str) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value) or value < 0 \
                or (name == "horizon" and value == 0):
            raise ValueError(f"{owner}: {name} is {value!r}; expected a finite positive number")
        self._set(**{name: float(value)})

    def _check_goal(self, owner: str) -> None:
        s = self.system
        boxes = [(s.state_names, self.x_goal, s.lbx, s.ubx, "x_goal"),
                 (s.control_names, self.u_goal, s.lbu, s.ubu, "u_goal")]
        for names, goal, lb, ub, what in boxes:
            for name, g, low, high in zip(names, goal, lb, ub, strict=True):
                if not low <= g <= high:
                    raise ValueError(f"{owner}: {what} has {name} = {g:g}, outside its box [{low:g}, {high:g}]: "
                                     "move the goal or widen the system's bounds")

    def _check_initial_states(self, owner: str) -> None:
        d = self.initial_states
        if not isinstance(d, (Gaussian, Uniform)):
            raise ValueError(f"{owner}: initial_states is a {type(d).__name__}; expected nocl.Gaussian or nocl.Uniform")
        if d.n != self.system.nx:
            raise ValueError(f"{owner}: initial_states has {d.n} coordinates, expected nx = {self.system.nx}")
        s = self.system
        outside = (d.centre < s.lbx) | (d.centre > s.ubx)
        if outside.any():
            i = int(np.flatnonzero(outside)[0])
            raise ValueError(f"{owner}: initial_states is centred at {s.state_names[i]} = {d.centre[i]:g}, outside the "
                             f"box [{s.lbx[i]:g}, {s.ubx[i]:g}]: move it or widen lbx, ubx")

    def _check_finite(self, owner: str) -> None:
        s = self.system
        x = np.vstack([self.initial_states.sample(64, 0), self.x_goal]).T
        u = np.repeat(self.u_goal[:, None], x.shape[1], axis=1)
        for what, values in (("running", self.L(x, u)), ("terminal", self.G(x)), ("a path constraint", self.h(x))):
            if not np.isfinite(values.full()).all():
                raise ValueError(f"{owner}: {what} gives NaN or inf at an initial state or at the goal; expected "
                                 f"finite values for every state of the problem ({', '.join(s.state_names)})")

    @classmethod
    def quadratic(cls, system: System, *, x_goal: Vector, u_goal: Vector, R: Vector = 0.01, P: Vector = 1.0,
                  **options: Any) -> OCP:
        """L = (u - u*)' R (u - u*), G = (x - x*)' P (x - x*); `options` are OCP's other arguments.

        R and P are numbers (times the identity), diagonals [n] or symmetric positive semidefinite matrices [n, n].
        """
        owner = f"OCP on {system.name!r}"
        du = system.u - ca.DM(checks.vector(u_goal, system.nu, "u_goal", owner))
        dx = system.x - ca.DM(checks.vector(x_goal, system.nx, "x_goal", owner))
        return cls(system, running=ca.bilin(ca.DM(checks.weight(R, system.nu, "R", owner)), du, du),
                   terminal=ca.bilin(ca.DM(checks.weight(P, system.nx, "P", owner)), dx, dx),
                   x_goal=x_goal, u_goal=u_goal, **options)

    @cached_property
    def L(self) -> ca.Function:
        """(x, u) -> running cost, a scalar."""
        return ca.Function("L", [self.system.x, self.system.u], [self.running], ["x", "u"], ["L"])

    @cached_property
    def G(self) -> ca.Function:
        """x -> terminal cost, a scalar."""
        return ca.Function("G", [self.system.x], [self.terminal], ["x"], ["G"])

    @cached_property
    def h(self) -> ca.Function:
        """x -> path constraints [number of them], each >= 0 where it holds."""
        h = ca.vertcat(ca.SX(0, 1), *self.path_constraints.values())
        return ca.Function("h", [self.system.x], [h], ["x"], ["h"])

    @cached_property
    def L_soft(self) -> ca.Function:
        """(x, u) -> running cost plus penalty * sum of max(margin - h(x), 0)^2: L itself without path constraints."""
        soft = self.running
        for h in self.path_constraints.values():
            soft += self.penalty * ca.fmax(self.penalty_margin - h, 0) ** 2
        return ca.Function("L_soft", [self.system.x, self.system.u], [soft], ["x", "u"], ["L"])

    def __repr__(self) -> str:
        lines = [f"OCP on {self.system.name!r}: horizon {self.horizon:g}",
                 f"  L = {equations(self.running)[0]}", f"  G = {equations(self.terminal)[0]}",
                 f"  goal x* = {self.x_goal.tolist()}, u* = {self.u_goal.tolist()}",
                 f"  x0 ~ {self.initial_states}"]
        lines += [f"  {name}: {equations(h)[0]} >= 0" for name, h in self.path_constraints.items()]
        return "\n".join([*lines, repr(self.system)])
