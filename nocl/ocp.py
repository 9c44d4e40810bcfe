"""An optimal control problem on a System: min of the integral of L(x, u) over [0, T], plus G(x(T))."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from nocl import pretty, sampling
from nocl.clearance import scales
from nocl.functions import Functions
from nocl.sampling import Distribution, Gaussian, Uniform, short
from nocl.smoothness import kinks, linear_controls
from nocl.support import checks
from nocl.support.checks import MALFORMED, Array, Vector
from nocl.system import System
from nocl.translate import instructions
from nocl.translate.instructions import check_scalar

KINKS = ("solvers that use second derivatives may fail there; smooth it, nocl.smooth_abs(e, width) or "
         "nocl.smooth_max(a, b, width), or split a control, nocl.split_controls(system, names)")
PLACES = 256  # initial states that constraints are measured at
N_IMAGES, SAME_IMAGE = 16, 1e-9  # points of the box; relative to usual values, images that agree so far are one


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
        checks.instance(System, self.system, "system", "OCP")
        s, owner = self.system, f"OCP on {self.system.name!r}"
        for name in ("horizon", "penalty", "penalty_margin"):
            self._set(**{name: checks.number(getattr(self, name), name, owner, positive=name == "horizon")})
        z = ca.vertcat(s.x, s.u)
        self._check_constraints(owner)
        self._set(running=checks.expression(self.running, 1, z, "running", owner),
                  terminal=checks.expression(self.terminal, 1, s.x, "terminal", owner, s.u),
                  x_goal=checks.vector(self.x_goal, s.nx, "x_goal", owner),
                  u_goal=checks.vector(self.u_goal, s.nu, "u_goal", owner))
        self._check_goal(owner)
        self._check_initial_states(owner)
        self._check_finite(owner)
        if self.kinks:
            warnings.warn(f"{owner}: {self.not_smooth}", UserWarning, stacklevel=3)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def _check_constraints(self, owner: str) -> None:
        if not isinstance(self.path_constraints, Mapping) or not all(isinstance(n, str) for n in self.path_constraints):
            raise ValueError(f"{owner}: path_constraints is {self.path_constraints!r}; expected a dict from names to "
                             "expressions that are >= 0 where they hold, {'wall': 2 - p}")
        x, u = self.system.x, self.system.u
        self._set(path_constraints=MappingProxyType(
            {name: checks.expression(h, 1, x, f"path constraint {name!r}", owner, u)
             for name, h in self.path_constraints.items()}))

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
        """Try the costs, the constraints and their derivatives at the goal and at initial states, with u = u*."""
        s = self.system
        z = ca.vertcat(s.x, s.u)
        x = np.vstack([self.x_goal, self.initial_states.sample(64, 0)]).T
        at = np.vstack([x, np.repeat(self.u_goal[:, None], x.shape[1], axis=1)])
        for what, value in [("running", self.running), ("terminal", self.terminal),
                            *((f"path constraint {name!r}", h) for name, h in self.path_constraints.items())]:
            check_scalar(ca.Function("e", [z], [value]), f"{owner}: {what}")
            hessian, gradient = ca.hessian(value, z)
            for order, e in (("", value), ("the gradient of ", gradient), ("the second derivative of ", hessian)):
                values = ca.Function("e", [z], [ca.vec(ca.densify(e))])(at).full()
                bad = np.flatnonzero(~np.isfinite(values).all(axis=0))
                if bad.size:
                    where = "the goal" if bad[0] == 0 else "an initial state"
                    raise ValueError(f"{owner}: {order}{what} gives NaN or inf at {where}, x = {short(x[:, bad[0]])}; "
                                     "expected finite values: square a norm, or smooth it as sqrt(d^2 + 1e-6)")

    @cached_property
    def kinks(self) -> tuple[str, ...]:
        """Where L, G or a path constraint is not smooth, in words."""
        s, z = self.system, ca.vertcat(self.system.x, self.system.u)
        lower, upper = np.r_[s.lbx, s.lbu], np.r_[s.ubx, s.ubu]
        parts = {"the running cost": self.running, "the terminal cost": self.terminal,
                 **{f"path constraint {name!r}": h for name, h in self.path_constraints.items()}}
        return tuple(f"{what} has {kink}" for what, e in parts.items() for kink in kinks(e, z, lower, upper))

    @property
    def not_smooth(self) -> str:
        """The kinks and what to do about them, as one sentence; "" where there are none."""
        return f"{'; '.join(self.kinks)}: {KINKS}" if self.kinks else ""

    @cached_property
    def periodic(self) -> tuple[int, ...]:
        """The declared angles, by index, in which f, L, G and the constraints are 2 pi periodic: images are one state.

        Found out by trying; none where the equations are not known.
        """
        s = self.system
        if s.xdot is None:
            return ()
        rng = np.random.default_rng(0)
        x, u = rng.uniform(s.lbx, s.ubx, (N_IMAGES, s.nx)).T, rng.uniform(s.lbu, s.ubu, (N_IMAGES, s.nu)).T
        of = self.functions

        def values(x: Array) -> Array:
            return np.vstack([v.full() for v in (of.f(x, u), of.L(x, u), of.G(x), of.h(x))])

        here = values(x)
        usual = np.abs(here).max(axis=1, keepdims=True)
        turn = 2 * np.pi * np.eye(s.nx)
        return tuple(i for i in s.angle_indices
                     if (np.abs(values(x + turn[:, [i]]) - here) <= SAME_IMAGE * usual).all())

    def from_goal(self, x: Any) -> Any:
        """x - x*, from the nearest image of the goal: numpy rows [..., nx], or a CasADi column [nx]."""
        if not isinstance(x, (ca.SX, ca.MX)):
            given = checks.numeric(x, "x", "from_goal", f"numbers [..., {self.system.nx}]")
            if given.shape[-1:] != (self.system.nx,):
                raise ValueError(f"from_goal: x has shape {given.shape}; expected [..., {self.system.nx}]")
            rows = given - self.x_goal
            for i in self.periodic:
                rows[..., i] -= 2 * np.pi * np.round(rows[..., i] / (2 * np.pi))
            return rows
        if x.shape != (self.system.nx, 1):
            raise ValueError(f"from_goal: x has shape {x.shape}; expected a column ({self.system.nx}, 1)")
        d: Any = x - ca.DM(self.x_goal)
        for i in self.periodic:
            d[i] = ca.remainder(d[i], 2 * np.pi)
        return d

    def check_strict(self, owner: str) -> None:
        """ValueError where the Hamiltonian is linear in a control, so that second derivatives say nothing of it."""
        if self.system.xdot is None:
            return  # the equations are learned: nothing is known of them yet
        names = linear_controls(self.running, self.system.xdot, self.system.u)
        if names:
            raise ValueError(f"{owner}: cost and dynamics are linear in {', '.join(names)}: the optimum jumps between "
                             "bounds (bang-bang), which no smooth controller has; expected a cost that curves in each "
                             "control: add a small quadratic term, a thousandth of the usual running cost times "
                             f"(({names[0]} - its goal) / its range)**2, or solve state by state with NMPC")

    @classmethod
    def quadratic(cls, system: System, *, x_goal: Vector, u_goal: Vector, R: Vector = 0.01, P: Vector = 1.0,
                  **options: Any) -> OCP:
        """L = (u - u*)' R (u - u*), G = (x - x*)' P (x - x*); `options` are OCP's other arguments.

        R and P are numbers (times the identity), diagonals [n] or symmetric positive semidefinite matrices [n, n].
        """
        owner = f"OCP on {checks.instance(System, system, 'system', 'OCP.quadratic').name!r}"
        du = system.u - ca.DM(checks.vector(u_goal, system.nu, "u_goal", owner))
        dx = system.x - ca.DM(checks.vector(x_goal, system.nx, "x_goal", owner))
        return cls(system, running=_quadratic(checks.weight(R, system.nu, "R", owner), du),
                   terminal=_quadratic(checks.weight(P, system.nx, "P", owner), dx),
                   x_goal=x_goal, u_goal=u_goal, **options)

    @cached_property
    def functions(self) -> Functions:
        """f, L, L_soft, h, G, their derivatives, and symbols to build more of them on: the one door to them all."""
        soft = self.running
        for h in self.path_constraints.values():
            soft = soft + self.penalty * ca.fmax(self.penalty_margin - h, 0) ** 2
        h = ca.vertcat(ca.SX(0, 1), *self.path_constraints.values())
        return Functions(self.system, self.running, soft, h, self.terminal)

    @property
    def L(self) -> ca.Function:
        """(x, u) -> running cost, a scalar."""
        return self.functions.L

    @property
    def G(self) -> ca.Function:
        """x -> terminal cost, a scalar."""
        return self.functions.G

    @property
    def h(self) -> ca.Function:
        """x -> path constraints [number of them], each >= 0 where it holds."""
        return self.functions.h

    @cached_property
    def constraint_scales(self) -> Array:
        """What violations of each path constraint are measured by [number of them]: see nocl/clearance.py."""
        if not self.path_constraints:
            return np.zeros(0)
        places = self.initial_states.sample(PLACES, sampling.own_numbers(0))
        return scales(self.functions, np.vstack([places, self.x_goal]))

    def least(self, x: Array) -> Array:
        """The least value [B, number of them] of each path constraint along states x [B, n, nx]; inf for NaN."""
        n = self.system.nx
        x = checks.numeric(x, "x", "OCP.least", f"states [B, n, {n}]")
        if x.ndim != 3 or x.shape[2] != n or not x.shape[1]:
            raise ValueError(f"OCP.least: x has shape {x.shape}; expected [B, n, {n}]")
        if not self.path_constraints:
            return np.full((len(x), 0), np.inf)
        h = self.h(x.reshape(-1, n).T).full().reshape(len(self.path_constraints), *x.shape[:2])
        return np.where(np.isfinite(h), h, np.inf).min(axis=2, initial=np.inf).T

    def violation(self, least: Array) -> Array:
        """The largest violation of a path constraint as a share of its scale [B], of least values [B, m]; 0: none."""
        m = len(self.path_constraints)
        least = checks.numeric(least, "least", "OCP.violation", f"least values [B, {m}]")
        if least.ndim != 2 or least.shape[1] != m or np.isnan(least).any():
            raise ValueError(f"OCP.violation: least is {checks.shown(least)}; expected [B, {m}], as OCP.least gives it")
        return np.asarray((-least / self.constraint_scales).max(axis=1, initial=0.0)) + 0.0

    @property
    def L_soft(self) -> ca.Function:
        """(x, u) -> running cost plus penalty * sum of max(margin - h(x), 0)^2: L itself without path constraints."""
        return self.functions.L_soft

    def __repr__(self) -> str:
        z = ca.vertcat(self.system.x, self.system.u)
        values = ca.vertcat(self.running, self.terminal, *self.path_constraints.values())
        (L, G, *constraints), shared = pretty.lines(values, z, prefix="c")
        lines = [f"OCP on {self.system.name!r}: horizon {self.horizon:g}"]
        lines += [pretty.wrapped("L", L), pretty.wrapped("G", G)]
        lines += [pretty.filled(f"{name}: {h} >= 0")
                  for name, h in zip(self.path_constraints, constraints, strict=True)]
        lines += [pretty.wrapped(name, e, "    ") for name, e in shared.items()]
        lines += [pretty.filled(f"goal: x* = {short(self.x_goal)}, u* = {short(self.u_goal)}"),
                  pretty.filled(f"x0 ~ {self.initial_states!r}")]
        return "\n".join([*lines, repr(self.system)])

    def to_data(self) -> dict[str, Any]:
        """The problem with its system as plain JSON data, exact to the last bit."""
        return {"system": self.system.to_data(), "horizon": self.horizon, "x_goal": self.x_goal.tolist(),
                "u_goal": self.u_goal.tolist(), "initial_states": sampling.to_data(self.initial_states),
                "L": instructions.to_data(self.L), "G": instructions.to_data(self.G), "h": instructions.to_data(self.h),
                "path_constraints": list(self.path_constraints),
                "penalty": self.penalty, "penalty_margin": self.penalty_margin}

    @staticmethod
    def from_data(data: Mapping[str, Any]) -> OCP:
        """The problem that to_data wrote, with new symbols; ValueError for anything else."""
        checks.instance(Mapping, data, "data", "not an OCP written by nocl", "what to_data gave")
        try:
            system = System.from_data(data["system"])
            x, u = system.x, system.u
            constraints = ca.vertsplit(instructions.from_data(data["h"], [x])(x)) if data["path_constraints"] else []
            return OCP(system, horizon=data["horizon"], x_goal=data["x_goal"], u_goal=data["u_goal"],
                       running=instructions.from_data(data["L"], [x, u])(x, u),
                       terminal=instructions.from_data(data["G"], [x])(x),
                       initial_states=sampling.from_data(data["initial_states"]),
                       path_constraints=dict(zip(data["path_constraints"], constraints, strict=True)),
                       penalty=data["penalty"], penalty_margin=data["penalty_margin"])
        except MALFORMED as error:
            raise ValueError(f"not an OCP written by nocl: {type(error).__name__}: {error}; expected what to_data "
                             "gave") from error

    def __reduce__(self) -> tuple[Any, ...]:
        return OCP.from_data, (self.to_data(),)  # bare SX does not pickle


def _quadratic(W: Array, e: ca.SX) -> ca.SX:
    """e' W e, W symmetric."""
    off = W - np.diag(np.diag(W))
    squares = ca.dot(ca.DM(np.diag(W)), e**2)
    return squares + ca.bilin(ca.DM(off), e, e) if off.any() else squares

