"""An optimal control problem on a System: min of the integral of L(x, u, t, p) over [0, T], plus G(x(T), p)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from nocl.definition import constraints as limits
from nocl.definition import discrete, pretty, sampling
from nocl.definition import parameters as known
from nocl.definition.constraints import (
    ALONG,
    BOUND,
    END,
    INFINITE,
    PATH,
    Constraint,
    Free,
    Infinite,
    Places,
    Rows,
    Within,
)
from nocl.definition.functions import Functions
from nocl.definition.goals import Goal, Reference, beside, column, joined, text
from nocl.definition.sampling import Distribution, Gaussian, Seed, Uniform, box, short
from nocl.definition.smoothness import kinks, linear_controls
from nocl.definition.system import System, check_unique, counted, parameter_text, read, refusal
from nocl.support import checks
from nocl.support.asked import answered
from nocl.support.checks import MALFORMED, Array, Vector
from nocl.translate import instructions
from nocl.translate.instructions import check_scalar

KINKS = ("solvers that use second derivatives may fail there; smooth it, nocl.smooth_abs(e, width) or "
         "nocl.smooth_max(a, b, width), or split a control, nocl.split_controls(system, names)")
PLACES = 256  # initial states that constraints are measured at
SAMPLES = 64  # initial states, and parameters, that a problem is tried at on construction
ROUNDING = 1e-6  # of a scale: no violation
REST = 1e-9  # of the width of X, and of a usual L: what stands still, and costs nothing
FEW = 5  # parameters, beside the usual ones, that constraints are tried at
HOLD_Z = ("running", "terminal", "constraints", "path_constraints", "terminal_constraints")
N_IMAGES, SAME_IMAGE = 16, 1e-9  # points of the box; relative to usual values, images that agree so far are one


@answered
@dataclass(frozen=True, eq=False, repr=False)
class OCP:
    """min_u int_0^T L(x, u) dt + G(x(T)), subject to xdot = f(x, u), u in U, and constraints along the way and at T.

    f, L and h may hold the time t = nocl.time() and parameters p, G parameters: f(x, u, t, p), L(x, u, t, p), G(x, p),
    h(x, t, p). The order of p is the system's parameters, then the problem's own.

    On a system in discrete time (System.discrete) it is min_u of the sum of dt L(x_k, u_k, k dt, p) over the steps,
    plus G(x_K, p), with K = horizon / dt: a step costs dt L, and constraints hold at the samples.

    Parameters
    ----------
    system : System
    horizon : float, nocl.Free or nocl.INFINITE
        T, in the system's unit of time (seconds for those that come with nocl); nocl.Free(low, high): T is to be found;
        nocl.INFINITE: there is none, the goal pair is an equilibrium that costs nothing, and there is no G.
        In discrete time a whole number of dt, or nocl.INFINITE.
    running, terminal : casadi.SX
        L(x, u) and G(x), scalars in the system's own symbols; t in G is the horizon.
    x_goal, u_goal : [nx], [nu]
        The goal pair (x*, u*): it must lie in the system's boxes. L and G need not vanish there. Either may be a
        casadi.SX column in p, ca.vertcat(goal, 0): the attributes then hold its values at the nominal p, and
        `goals(p)` those at any other. Default: the problem has none, as where a yield is maximised; the attributes
        then hold a point of reference, the centre of initial_states and the middle of U, and terminal errors are NaN.
    initial_states : Gaussian or Uniform
        Where trajectories start; what a trained controller must cover.
    p : casadi.SX, optional
        Parameters of the problem's own, nocl.parameter(name, nominal, unit): a goal, a weight, an obstacle's place.
    parameters : Gaussian or Uniform
        Of all parameters, the system's first, where there are any. Their nominal values are those that the parameters
        were given, or else its centre.
    constraints : mapping from names to casadi.SX, or to (low, casadi.SX, high)
        What holds along the trajectory: e(x, u, t, p) >= 0, or low <= e <= high, where None is no bound and low = high
        an equation: {"track": (-0.5, x[0], 0.5), "wall": x[1] + 2, "thrust": (None, ca.sumsqr(u), 4)}. The box X of the
        system is where samples are drawn from, and holds no trajectory: bounds of states are constraints.
    terminal_constraints : likewise, of (x, p)
        What holds at T.
    state_bounds : mapping from names of states to (low, high)
        Constraints of these names, {"v": (-2, 2)}.
    scales : mapping from names of constraints to numbers > 0
        What violations, margins and tolerances of a constraint are shares of, in its own unit. Default: found from X, U
        and where the problem takes place (nocl/definition/constraints.py).
    path_constraints : mapping from names to casadi.SX
        `constraints` of (x, t, p) alone, each >= 0 (an obstacle: distance minus radius), by their former name.
    penalty, penalty_margin : float
        Where constraints are soft (constraints="soft", method="paper", level sets, NeuralOC), penalty *
        max(margin - c, 0)^2 is added to L for each inequality of (x, t, p), c being a path constraint in its own unit,
        and any other one as a share of its scale.

    Raises
    ------
    ValueError
        With what was got, what was expected and the remedy.
    """

    system: System
    horizon: Any = field(kw_only=True)
    running: ca.SX = field(kw_only=True)
    terminal: Any = field(default=None, kw_only=True)
    initial_states: Distribution = field(kw_only=True)
    x_goal: Any = field(default=None, kw_only=True)
    u_goal: Any = field(default=None, kw_only=True)
    p: Any = field(default=None, kw_only=True)
    parameters: Distribution | None = field(default=None, kw_only=True)
    constraints: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    terminal_constraints: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    state_bounds: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    scales: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    path_constraints: Mapping[str, ca.SX] = field(default_factory=dict, kw_only=True)
    penalty: float = field(default=300.0, kw_only=True)
    penalty_margin: float = field(default=0.005, kw_only=True)

    def __post_init__(self) -> None:
        checks.instance(System, self.system, "system", "OCP")
        s, owner = self.system, f"OCP on {self.system.name!r}"
        for name in ("horizon", "penalty", "penalty_margin"):
            if not isinstance(getattr(self, name), (Free, Infinite)):
                self._set(**{name: checks.number(getattr(self, name), name, owner, positive=name == "horizon")})
        if s.is_discrete:
            self._check_steps(owner)
        self._set(p=known.column(self.p, owner))
        check_unique((*s.names, *self.parameter_names), False, owner)
        if s.z.numel():
            s = self._solve_z(s)
        t, p = known.time(), self._all_p
        self._check_constraints(owner)
        self._set(terminal=self._end(owner))
        self._set(running=checks.expression(self.running, 1, ca.vertcat(s.x, s.u, p), "running", owner, time=t),
                  terminal=checks.expression(self.terminal, 1, ca.vertcat(s.x, p), "terminal", owner, s.u, time=t))
        self._check_parameters(owner)
        self._check_initial_states(owner)
        for name, n, instead in (("x_goal", s.nx, self.initial_states.centre), ("u_goal", s.nu, (s.lbu + s.ubu) / 2)):
            given = getattr(self, name)
            none = given is None or isinstance(given, Reference)
            self._set(**{name: Reference.at(instead) if none else self._goal(given, n, name, owner)})
        self._check_goal(owner)
        if self.is_infinite:
            self._check_for_ever(owner)
        self._check_finite(owner)
        self._check_possible(owner)
        if self.np:
            self._warn_of_goal(owner)
        if self.kinks:
            warnings.warn(f"{owner}: {self.not_smooth}", UserWarning, stacklevel=4)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def _check_steps(self, owner: str) -> None:
        """ValueError for a horizon that is no whole number of steps of a system in discrete time."""
        if self.is_free:
            raise ValueError(f"{owner}: horizon is {self.horizon!r}, and {self.system.name!r} is a system in discrete "
                             f"time; expected a whole number of steps of dt = {self.system.dt:g}: take a long one, "
                             "where to wait at the goal costs nothing")
        if not self.is_infinite:
            discrete.steps_in(self.system, self.horizon, "horizon", owner)

    @property
    def steps(self) -> int | None:
        """K, the number of steps until the end, of a system in discrete time; None in continuous time, or for ever."""
        if not self.system.is_discrete or self.is_infinite:
            return None
        return discrete.steps_in(self.system, self.horizon, "horizon", f"OCP on {self.system.name!r}")

    def _solve_z(self, s: System) -> System:
        """The system, with its algebraic variables solved for all over the problem; its expressions without them."""
        d = self.parameters
        where = box(d) if isinstance(d, (Gaussian, Uniform)) and d.n == self.np else (self.nominal, self.nominal)
        s = s.over(self.longest, *(bound[:s.np] for bound in where))
        self._set(system=s, **{name: s.without_z(getattr(self, name)) for name in HOLD_Z})
        return s

    def _check_constraints(self, owner: str) -> None:
        s, t = self.system, known.time()
        x, z = ca.vertcat(s.x, self._all_p), ca.vertcat(s.x, s.u, self._all_p)
        self._set(constraints=limits.read(self.constraints, "constraints", ALONG, owner, z, None, t),
                  path_constraints=limits.read_paths(self.path_constraints, owner, x, s.u, t),
                  state_bounds=limits.read_bounds(self.state_bounds, owner, s.state_names),
                  terminal_constraints=limits.read(self.terminal_constraints, "terminal_constraints", END, owner, x,
                                                   s.u, t))
        limits.check_unique((*self.held, *self.held_at_end), owner)
        self._set(scales=limits.read_scales(self.scales, owner, self.constraint_names))
        for what, e in (("terminal", self.terminal), *((one.title, one.expression) for one in self.held_at_end)):
            if self.is_free and isinstance(e, ca.SX) and ca.depends_on(e, t):
                raise ValueError(f"{owner}: {what} holds the time, which is the horizon there, and that is free; "
                                 "expected an expression of x and p: give the running cost what T costs, running=1.0")

    @cached_property
    def held(self) -> tuple[Constraint, ...]:
        """What is held along the trajectory."""
        x = dict(zip(self.system.state_names, ca.vertsplit(self.system.x), strict=True))
        return (*(Constraint(name, ALONG, *one) for name, one in self.constraints.items()),
                *(Constraint(name, PATH, 0.0, h, np.inf) for name, h in self.path_constraints.items()),
                *(Constraint(name, BOUND, low, x[name], high) for name, (low, high) in self.state_bounds.items()))

    @cached_property
    def held_at_end(self) -> tuple[Constraint, ...]:
        """What is held at the end of the trajectory."""
        return tuple(Constraint(name, END, *one) for name, one in self.terminal_constraints.items())

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """All that scales and soft constraints may be given for."""
        return tuple(one.name for one in (*self.held, *self.held_at_end))

    @property
    def is_free(self) -> bool:
        """Whether the horizon is to be found."""
        return isinstance(self.horizon, Free)

    @property
    def is_infinite(self) -> bool:
        """Whether there is no end."""
        return isinstance(self.horizon, Infinite)

    @property
    def longest(self) -> float:
        """The horizon, or the longest that it may be; of an infinite one, where time does not count, a unit of it."""
        return 1.0 if self.is_infinite else float(self.horizon.high if self.is_free else self.horizon)

    def lasting(self, duration: float) -> OCP:
        """The problem of an infinite horizon for so long alone, without a cost of where it ends."""
        if not self.is_infinite:
            raise ValueError(f"OCP on {self.system.name!r}: lasting is for nocl.INFINITE, and the horizon is "
                             f"{self.horizon!r}; expected dataclasses.replace(ocp, horizon={duration:g})")
        with warnings.catch_warnings():  # of its kinks the problem itself has warned
            warnings.simplefilter("ignore")
            return replace(self, horizon=duration)

    def _end(self, owner: str) -> Any:
        """The terminal cost; there is none where there is no end."""
        if self.terminal is None and not self.is_infinite:
            raise ValueError(f"{owner}: terminal is missing; expected a cost of where a trajectory ends, an SX "
                             "expression of x (terminal=0.0 for none), or horizon=nocl.INFINITE")
        if not self.is_infinite:
            return self.terminal
        given = ca.SX(0) if self.terminal is None else self.terminal
        if not isinstance(given, (int, float, ca.SX)) or not ca.SX(given).is_zero():
            raise ValueError(f"{owner}: terminal is {checks.shown(given)}, and horizon is nocl.INFINITE, where nothing "
                             "ends; expected none: leave it out, the cost of the last stretch is LQR's")
        if self.terminal_constraints:
            raise ValueError(f"{owner}: terminal_constraints are {', '.join(self.terminal_constraints)}, and horizon "
                             "is nocl.INFINITE, where nothing ends; expected none: a law goes to the goal by itself")
        return ca.SX(0)

    def _check_for_ever(self, owner: str) -> None:
        """What has no end must be an equilibrium that costs nothing, at all parameters."""
        if self.uses_time:
            raise ValueError(f"{owner}: it holds the time, and horizon is nocl.INFINITE; expected neither f nor L to: "
                             "make the phase of what repeats itself two states, its sine and cosine")
        if not self.has_goal:
            raise ValueError(f"{owner}: horizon is nocl.INFINITE and there is no goal pair; expected x_goal and "
                             "u_goal, an equilibrium that costs nothing")
        p = np.vstack([self.nominal, self.sample_parameters(SAMPLES)])
        x, u = self.goals(p)
        of, s = self.functions, self.system
        rows = of.arguments.columns(x=x, u=u, t=np.zeros(len(p)), p=p)
        f = np.abs(of.f(*rows).full()) / (s.ubx - s.lbx)[:, None] if s.xdot is not None else np.zeros((1, 1))
        if (f > REST).any():
            k, i = np.unravel_index(int(f.argmax()), f.shape)
            speed = f[k, i] * (s.ubx - s.lbx)[k]
            raise ValueError(f"{owner}: at the goal pair {s.state_names[k]} moves by {speed:.4g} a unit of time"
                             f"{self.at_p(p[i])}; expected an equilibrium, f(x*, u*) = 0: move the goal pair")
        L = np.abs(of.L(*rows).full()[0])
        if (REST * self._usual_cost() < L).any():
            worst = int(L.argmax())
            raise ValueError(f"{owner}: the goal pair costs {L[worst]:.4g} a unit of time{self.at_p(p[worst])}, for "
                             "ever; expected L = 0 there: subtract it, or move the goal pair")

    def _usual_cost(self) -> float:
        """Of L in X x U."""
        places = self._samples(SAMPLES)
        L = np.abs(self.functions.L(*self.functions.arguments.columns(**places)).full())
        return float(np.median(L[np.isfinite(L)]))

    def _check_parameters(self, owner: str) -> None:
        d, names = self.parameters, self.parameter_names
        check_unique((*self.system.names, *names), self.uses_time, owner)
        if d is None and not self.np:
            return
        words = f"the {counted(self.np, 'parameter')} {', '.join(names)}" if names else "no parameters"
        if not isinstance(d, (Gaussian, Uniform)):
            raise ValueError(f"{owner}: parameters is {d!r}; expected nocl.Gaussian or nocl.Uniform of {words}, in "
                             "this order: say where they lie")
        if d.n != self.np:
            raise ValueError(f"{owner}: parameters has {counted(d.n, 'coordinate')}, but the problem has {words}: "
                             "expected one for each, the system's first; declare others by p=")

    def _goal(self, value: Any, n: int, name: str, owner: str) -> Array:
        """The goal's numbers, at the nominal p where it depends on p."""
        value = joined(getattr(value, "expression", value))
        if isinstance(value, ca.SX) and value.is_constant() and value.numel() == n:
            value = ca.DM(value).full().ravel()
        if not isinstance(value, ca.SX):
            return checks.vector(value, n, name, owner)
        return Goal.at(checks.expression(value, n, self._all_p, name, owner), self._all_p, self.nominal)

    @property
    def has_goal(self) -> bool:
        """Whether the problem was given a goal pair."""
        return not (isinstance(self.x_goal, Reference) or isinstance(self.u_goal, Reference))

    def refuse_without_goal(self, owner: str) -> None:
        """ValueError where the problem has no goal pair: for what is nothing without one."""
        if not self.has_goal:
            missing = " and ".join(name for name in ("x_goal", "u_goal") if isinstance(getattr(self, name), Reference))
            raise ValueError(f"{owner} needs a goal pair, but the problem on {self.system.name!r} has no {missing}: "
                             "give it one, OCP(..., x_goal=, u_goal=), or solve it by NMPC or DDP")

    def _check_goal(self, owner: str) -> None:
        s = self.system
        p = np.vstack([self.nominal, self.sample_parameters(SAMPLES)])
        x, u = self.goals(p)
        boxes = [(s.state_names, x, s.lbx, s.ubx, "x_goal"), (s.control_names, u, s.lbu, s.ubu, "u_goal")]
        for names, goals, lb, ub, what in boxes:
            bad = np.argwhere(~((goals >= lb) & (goals <= ub)))
            if len(bad):
                row, i = bad[0]
                raise ValueError(f"{owner}: {what} has {names[i]} = {goals[row, i]:g}{self.at_p(p[row])}, outside its "
                                 f"box [{lb[i]:g}, {ub[i]:g}]: move the goal or widen the system's bounds")

    def sample_parameters(self, n: int, seed: Seed = 0) -> Array:
        """n parameters of their distribution [n, np]; nothing is drawn where there are none."""
        return np.zeros((n, 0)) if self.parameters is None else self.parameters.sample(n, seed)

    @property
    def parameter_box(self) -> tuple[Array, Array]:
        """Where parameters lie, [np] and [np]: of a Gaussian the usual range."""
        return (np.zeros(0), np.zeros(0)) if self.parameters is None else box(self.parameters)

    @property
    def plant_parameters(self) -> Distribution | None:
        """Where the system's own parameters lie, the first ones of all; None where it has none."""
        low, high = (bound[:self.system.np] for bound in self.parameter_box)
        return Uniform(low, high) if self.system.np else None

    def at_p(self, p: Array | None) -> str:
        """Which parameters are meant, in words; "" where there are none."""
        if p is None or not self.np:
            return ""
        return f" at {', '.join(f'{name} = {v:.4g}' for name, v in zip(self.parameter_names, p, strict=True))}"

    def moments(self, n: int, seed: int = 0) -> dict[str, Array]:
        """n random times in [0, T] and parameters, as {"t": [n], "p": [n, np]}: for what is found out by trying."""
        return {"t": sampling.own_numbers(seed, 1).uniform(0, self.longest, n),
                "p": self.sample_parameters(n, sampling.own_numbers(seed, 2))}

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
        """Try the costs, the constraints and their derivatives at the goal and at initial states, with u = u*; and f,
        where it holds parameters or the time, in the box.
        """
        z, t = ca.vertcat(self.system.x, self.system.u), known.time()
        x, at = np.vstack([self.x_goal, self.initial_states.sample(SAMPLES, 0)]).T, self.moments(SAMPLES + 1)
        at["p"][0], inputs = self.nominal, [z, t, self._all_p]
        values_of = [np.vstack([x, self.goals(at["p"])[1].T]), at["t"][None], at["p"].T]
        for what, value in [("running", self.running), ("terminal", self.terminal),
                            *((one.title, one.expression) for one in (*self.held, *self.held_at_end)
                              if one.kind != BOUND)]:
            check_scalar(ca.Function("e", inputs, [value]), f"{owner}: {what}")
            hessian, gradient = ca.hessian(value, z)
            for order, e in (("", value), ("the gradient of ", gradient), ("the second derivative of ", hessian)):
                values = ca.Function("e", inputs, [ca.vec(ca.densify(e))])(*values_of).full()
                bad = np.flatnonzero(~np.isfinite(values).all(axis=0))
                if bad.size:
                    where = "the goal" if bad[0] == 0 else "an initial state"
                    raise ValueError(f"{owner}: {order}{what} gives NaN or inf at {where}, x = {short(x[:, bad[0]])}"
                                     f"{self.at_p(at['p'][bad[0]])}; expected finite values: square a norm, or smooth "
                                     "it as sqrt(d^2 + 1e-6)")
        if self.system.np or self.system.uses_time:
            self._check_equations(owner)

    def _check_possible(self, owner: str) -> None:
        """Try whether each constraint can be held somewhere in X x U, those of parameters at several of them; path
        constraints without parameters were never asked."""
        at_end = [replace(one, expression=self._at_end(one.expression)) for one in self.held_at_end]
        asked, samples = [one for one in self.held if one.kind != PATH], self._samples(limits.TRIED)
        self._check_held(asked, at_end, samples, owner)
        along, at_end = ([one for one in those if self._hangs_on_p(one)] for those in (self.held, at_end))
        for p in self._several_parameters() if along or at_end else ():
            samples["p"] = np.tile(p, (limits.TRIED, 1))
            self._check_held(along, at_end, samples, owner + self.at_p(p))

    def _check_held(self, along: Sequence[Constraint], at_end: Sequence[Constraint], samples: Places,
                    owner: str) -> None:
        for these, at, bounds in ((along, self.functions.arguments, self._box),
                                  (at_end, self.functions.end, self._box_of_x)):
            limits.check_possible(Rows.made(these, self.system.u), at, samples, bounds, owner)

    def _hangs_on_p(self, one: Constraint) -> bool:
        return any(ca.depends_on(c, self._all_p) for _, c in one.sides())

    def _several_parameters(self) -> Array:
        """[n, np], the nominal ones, of a box the least and the largest, and a few of their distribution."""
        ends = self.parameter_box if isinstance(self.parameters, Uniform) else ()
        return np.vstack([self.nominal, *ends, self.sample_parameters(FEW)])

    def _warn_of_goal(self, owner: str) -> None:
        """Of constraints that the goal itself does not hold at some parameters."""
        p = np.vstack([self.nominal, self.sample_parameters(SAMPLES)])
        moments = {"t": np.full(len(p), self.longest), "p": p}
        rows = self.functions.rows[:self.functions.rows.n_h]
        h = self.h(*self.functions.node.columns(x=self.goals(p)[0], **moments)).full()
        h = np.where(h < -ROUNDING * self.constraint_scales[:, None], h, 0.0)
        for i in map(int, np.flatnonzero((h < 0).any(axis=1))):
            worst = int(h[i].argmin())
            warnings.warn(f"{owner}: the goal itself does not hold {rows.of[i].title} at {(h[i] < 0).sum()} of "
                          f"{len(p)} parameters tried, worst{self.at_p(p[worst])}, by {-h[i, worst]:.3g}: what ends "
                          "there cannot reach it; move the goal, or where `parameters` lie", UserWarning, stacklevel=5)

    @property
    def _box_of_x(self) -> tuple[Array, Array]:
        return self.system.lbx, self.system.ubx

    @property
    def _box(self) -> tuple[Array, Array]:
        """(lower, upper) of (x, u)."""
        s = self.system
        return np.r_[s.lbx, s.lbu], np.r_[s.ubx, s.ubu]

    def _samples(self, n: int) -> Places:
        """n points of X x U, with times and parameters."""
        s, rng = self.system, np.random.default_rng(0)
        return {"x": rng.uniform(s.lbx, s.ubx, (n, s.nx)), "u": rng.uniform(s.lbu, s.ubu, (n, s.nu)), **self.moments(n)}

    def _at_end(self, e: ca.SX) -> ca.SX:
        """An expression at the end, where the time is the horizon."""
        return ca.substitute(e, known.time(), self.horizon) if ca.depends_on(e, known.time()) else e

    def _check_equations(self, owner: str) -> None:
        """Try f and its Jacobian at random states, controls, times and parameters."""
        s, rng, at = self.system, np.random.default_rng(0), self.moments(PLACES)
        if s.xdot is None:
            return
        x, u = rng.uniform(s.lbx, s.ubx, (PLACES, s.nx)), rng.uniform(s.lbu, s.ubu, (PLACES, s.nu))
        of, z = self.functions, ca.vertcat(s.x, s.u)
        both = of.arguments.function("both", {"f": s.equations, "slopes": ca.vec(ca.jacobian(s.equations, z))})
        values = np.vstack([v.full() for v in both(*of.arguments.columns(x=x, u=u, **at))])
        bad = np.flatnonzero(~np.isfinite(values).all(axis=0))
        if bad.size:
            i = int(bad[0])
            raise ValueError(f"{owner}: the equations of {s.name!r} or their Jacobian give NaN or inf inside the box, "
                             f"at x = {short(x[i])}, u = {short(u[i])}, t = {at['t'][i]:.4g}{self.at_p(at['p'][i])}; "
                             "expected finite values: change the equation, or shrink lbx, ubx or `parameters`")

    @cached_property
    def kinks(self) -> tuple[str, ...]:
        """Where L, G or a constraint is not smooth, in words."""
        z, every = ca.vertcat(self.system.x, self.system.u), ca.vertcat(*self.functions.arguments.inputs)
        parts = {"the running cost": self.running, "the terminal cost": self.functions.terminal,
                 **{one.title: self._at_end(one.expression) if one.kind == END else one.expression
                    for one in (*self.held, *self.held_at_end)}}
        return tuple(f"{what} has {kink}" for what, e in parts.items() for kink in kinks(e, every, *self.stage_box, z))

    @property
    def not_smooth(self) -> str:
        """The kinks and what to do about them, as one sentence; "" where there are none."""
        return f"{'; '.join(self.kinks)}: {KINKS}" if self.kinks else ""

    @cached_property
    def periodic(self) -> tuple[int, ...]:
        """The declared angles, by index, in which f, L, G and the constraints are 2 pi periodic: images are one state.

        Found out by trying; none where the equations are not known.
        """
        return tuple(i for i in self.system.angle_indices if self._same_after_a_turn[i])

    @cached_property
    def periodic_controls(self) -> tuple[int, ...]:
        """The controls, by index, in which all of that is 2 pi periodic and U is wider: directions, with images in U.
        """
        s = self.system
        wide = s.ubu - s.lbu > 2 * np.pi * (1 + SAME_IMAGE)
        return tuple(np.flatnonzero(wide & self._same_after_a_turn[s.nx:]).tolist())

    @cached_property
    def _same_after_a_turn(self) -> Array:
        """[nx + nu], in which variables all functions are 2 pi periodic."""
        s = self.system
        if s.xdot is None:
            return np.zeros(s.nx + s.nu, dtype=bool)
        rng = np.random.default_rng(0)
        x, u = rng.uniform(s.lbx, s.ubx, (N_IMAGES, s.nx)).T, rng.uniform(s.lbu, s.ubu, (N_IMAGES, s.nu)).T
        of, at = self.functions, self.moments(N_IMAGES)

        def values(x: Array, u: Array) -> Array:
            stage, node, end = (a.columns(x=x.T, u=u.T, **at) for a in (of.arguments, of.node, of.end))
            held = [of.h(*node)] if self.states_only else [of.c(*stage), of.c_end(*end)]
            return np.vstack([v.full() for v in (of.f(*stage), of.L(*stage), of.G(*end), *held)])

        here = values(x, u)
        usual = np.abs(here).max(axis=1, keepdims=True)
        turns = np.split(2 * np.pi * np.eye(s.nx + s.nu), [s.nx])
        there = (values(x + turns[0][:, [i]], u + turns[1][:, [i]]) for i in range(s.nx + s.nu))
        return np.array([(np.abs(z - here) <= SAME_IMAGE * usual).all() for z in there], dtype=bool)

    @property
    def _all_p(self) -> ca.SX:
        """All parameters, the system's first."""
        return ca.vertcat(self.system.p, self.p)

    @property
    def np(self) -> int:
        """How many parameters the problem has, the system's and its own."""
        return self.system.np + int(self.p.numel())

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The system's, then the problem's own."""
        return self.system.parameter_names + known.names_of(self.p)

    @cached_property
    def nominal(self) -> Array:
        """The nominal parameters [np]: as they were declared, or the centre of their distribution."""
        if self.parameters is None:
            return np.zeros(0)
        given = known.nominal_of(self._all_p)
        return np.where(np.isnan(given), self.parameters.centre, given)

    @property
    def stage_box(self) -> tuple[Array, Array]:
        """(lower, upper) of (x, u[, t][, p]): X, U, [0, T] and where `parameters` lie."""
        s = self.system
        time = ([0.0], [self.longest]) if self.uses_time else ([], [])
        p = self.parameter_box
        return np.r_[s.lbx, s.lbu, time[0], p[0]], np.r_[s.ubx, s.ubu, time[1], p[1]]

    @cached_property
    def uses_time(self) -> bool:
        """Whether f, L or a constraint holds the time."""
        parts = ca.vertcat(self.running, *(one.expression for one in self.held))
        return self.system.uses_time or bool(ca.depends_on(parts, known.time()))

    def unit(self, name: str) -> str:
        """The unit of a state, control or parameter for an axis label, like 'goal [m]'."""
        if name not in known.names_of(self.p):
            return self.system.unit(name)
        unit = known.units_of(self.p).get(name)
        return f"{name} [{unit}]" if unit else name

    def parameters_of(self, p: Any, B: int, owner: str) -> Array:
        """A user's parameters as rows [B, np]: p is [np] for all, [B, np], or a dict from names to numbers or [B].

        None where the problem has none. Raises ValueError for what is missing, unknown, not finite or of another
        shape; warns of extrapolation, values outside the box of `parameters`.
        """
        return known.rows(p, self.parameter_names, B, owner, self.parameters)

    def refuse_parameters(self, owner: str) -> None:
        """ValueError where the problem has parameters or holds the time: for what has no use of them, or not yet."""
        if self.np or self.uses_time:
            of = f"problem on {self.system.name!r}"
            raise ValueError(refusal(owner, of, self.parameter_names, self.uses_time, "ocp"))

    @property
    def states_only(self) -> bool:
        """Whether all constraints are inequalities of (x, t, p) along the trajectory: those that `h` has."""
        return len(self.functions.rows) == self.functions.rows.n_h and not self.held_at_end

    def refuse_constraints(self, owner: str, remedy: str = "solve it by NMPC or DDP") -> None:
        """ValueError for constraints that hold a control, equations, terminal constraints and a free horizon: for what
        has no use of them, or not yet.
        """
        self.refuse_free(owner)
        rows, beyond = self.functions.rows, dict[str, str]()  # name: what it is
        for i in range(rows.n_h, len(rows)):
            what = " of the control" if rows.of_u[i] else ", an equation"
            beyond[rows.names[i]] = f"the {rows.title(i)}{what}"
        beyond |= {one.name: f"the {one.title}" for one in self.held_at_end}
        if beyond:
            raise ValueError(f"{owner} takes inequalities of (x, t, p) alone as constraints, but the problem on "
                             f"{self.system.name!r} has {', '.join(beyond.values())}: {remedy}, or leave them out, "
                             f"ocp.without({', '.join(map(repr, beyond))})")

    def refuse_free(self, owner: str) -> None:
        """ValueError for a free or an infinite horizon."""
        checks.problem(self, owner, discrete=True)
        if self.is_free:
            raise ValueError(f"{owner} takes a number as horizon, but that of the problem on {self.system.name!r} is "
                             f"{self.horizon!r}: solve it by NMPC or DDP, or give it one, dataclasses.replace(ocp, "
                             f"horizon={self.horizon.high:g})")

    def without(self, *names: str) -> OCP:
        """The problem without the constraints of these names; ValueError for names of none."""
        unknown = [name for name in names if name not in self.constraint_names]
        if unknown:
            raise ValueError(f"OCP on {self.system.name!r}: without({', '.join(map(repr, unknown))}); expected names "
                             f"of constraints ({', '.join(self.constraint_names) or 'there are none'})")
        given: dict[str, Any] = {
            field: {name: one for name, one in getattr(self, field).items() if name not in names}
            for field in ("constraints", "terminal_constraints", "state_bounds", "path_constraints", "scales")}
        return replace(self, **given)

    @property
    def unconstrained(self) -> OCP:
        """The problem without its constraints; U stays."""
        return self.without(*self.constraint_names)

    def with_constraints(self, made: Callable[[ca.SX], ca.SX], **changed: Any) -> OCP:
        """dataclasses.replace(self, **changed), the expressions of constraints as `made` has them."""
        def each(given: Mapping[str, Any]) -> dict[str, Any]:
            return {name: Within(one.low, made(one.expression), one.high) for name, one in given.items()}

        paths = {name: made(h) for name, h in self.path_constraints.items()}
        return replace(self, constraints=each(self.constraints), path_constraints=paths,
                       terminal_constraints=each(self.terminal_constraints), **changed)

    def loosened(self, share: float) -> OCP:
        """The problem of ending within a share of each terminal constraint's scale of where it holds."""
        rows, sizes = self.functions.end_rows, self.functions.end_scales
        scale = {name: float(size) for name, size in zip(rows.names, sizes, strict=True)}
        wider = {name: (one.low - share * scale[name], one.expression, one.high + share * scale[name])
                 for name, one in self.terminal_constraints.items()}
        with warnings.catch_warnings():  # of its kinks the problem itself has warned
            warnings.simplefilter("ignore")
            return replace(self, terminal_constraints=wider, scales={**self.scales, **scale})

    def tightened(self, share: float) -> OCP:
        """The problem of holding all inequalities along the way by a share of their scales more than is asked for."""
        rows, sizes = self.functions.rows, self.functions.scales
        room = {name: share * float(size) for name, size in zip(rows.names, sizes, strict=True)} if self.held else {}
        along = {name: one if one.low == one.high else (one.low + room[name], one.expression, one.high - room[name])
                 for name, one in self.constraints.items()}
        bounds = {name: (low + room[name], high - room[name]) for name, (low, high) in self.state_bounds.items()}
        paths = {name: h - room[name] for name, h in self.path_constraints.items()}
        with warnings.catch_warnings():  # of its kinks the problem itself has warned
            warnings.simplefilter("ignore")
            return replace(self, constraints=along, state_bounds=bounds, path_constraints=paths)

    def at(self, p: Any = None) -> OCP:
        """The problem with its parameters folded in as constants: p as [np] or by name, each of them."""
        return self.folded(self.parameters_of(p, 1, f"OCP on {self.system.name!r}, at")[0])

    def folded(self, value: Array) -> OCP:
        """`at` parameters [np] that were checked."""
        if not self.np:
            return self
        x_goal, u_goal = (own if isinstance(own, Reference) else goal[0]
                          for own, goal in zip((self.x_goal, self.u_goal), self.goals(value[None]), strict=True))

        def folded(e: ca.SX) -> ca.SX:
            return ca.substitute(e, self._all_p, ca.DM(value))

        with warnings.catch_warnings():  # of its kinks the problem itself has warned
            warnings.simplefilter("ignore")
            return self.with_constraints(
                folded, system=self.system.at(value[:self.system.np]), running=folded(self.running),
                terminal=folded(self.terminal), x_goal=x_goal, u_goal=u_goal, p=None, parameters=None)

    @cached_property
    def goal(self) -> ca.Function:
        """p -> (x_goal, u_goal); where they are constant, of any p."""
        pair = {name: ca.SX(getattr(value, "expression", ca.DM(value)))
                for name, value in (("x_goal", self.x_goal), ("u_goal", self.u_goal))}
        return ca.Function("goal", [self._all_p], list(pair.values()), ["p"], list(pair))

    @property
    def goal_varies(self) -> bool:
        """Whether the goal pair depends on p."""
        return hasattr(self.x_goal, "expression") or hasattr(self.u_goal, "expression")

    def goals(self, p: Array) -> tuple[Array, Array]:
        """The goal pairs (x_goal [B, nx], u_goal [B, nu]) at parameters p [B, np]."""
        if not self.goal_varies or not len(p):
            x, u = (np.tile(np.asarray(goal), (len(p), 1)) for goal in (self.x_goal, self.u_goal))
        else:
            x, u = (goal.full().T for goal in self.goal(p.T))
        return x, u

    def from_goal(self, x: Any, p: Any = None) -> Any:
        """x - x*, from the nearest image of the goal: numpy rows [..., nx], or a CasADi column [nx].

        p : where the goal depends on it, [np] or a row for each of x's first axis [B, np], or a CasADi column
        """
        if self.goal_varies and p is None:
            raise ValueError(f"OCP on {self.system.name!r}: the goal depends on {', '.join(self.parameter_names)}: "
                             "pass p to from_goal")
        if not isinstance(x, (ca.SX, ca.MX)):
            given = checks.numeric(x, "x", "from_goal", f"numbers [..., {self.system.nx}]")
            if given.shape[-1:] != (self.system.nx,):
                raise ValueError(f"from_goal: x has shape {given.shape}; expected [..., {self.system.nx}]")
            rows = given - self._goal_beside(given.ndim, p)
            for i in self.periodic:
                rows[..., i] -= 2 * np.pi * np.round(rows[..., i] / (2 * np.pi))
            return rows
        if x.shape != (self.system.nx, 1):
            raise ValueError(f"from_goal: x has shape {x.shape}; expected a column ({self.system.nx}, 1)")
        d: Any = x - (self.goal(p)[0] if self.goal_varies else ca.DM(self.x_goal))
        for i in self.periodic:
            d[i] = ca.remainder(d[i], 2 * np.pi)
        return d

    def _goal_beside(self, axes: int, p: Any) -> Array:
        """x* as it is subtracted from states [..., nx] with that many axes."""
        if not self.goal_varies:
            return self.x_goal
        rows = np.asarray(p, dtype=np.float64)
        goal = self.goals(np.atleast_2d(rows))[0]
        return goal[0] if rows.ndim == 1 else beside(goal, axes)

    @cached_property
    def flat_controls(self) -> tuple[str, ...]:
        """The controls that the Hamiltonian is linear in, piece by piece where L has kinks: their optimum jumps between
        bounds (bang-bang), or is singular. Where f is not known, those that L is linear in.
        """
        s = self.system
        return tuple(linear_controls(self.running, ca.SX(0, 1) if s.xdot is None else s.equations, s.u))

    @classmethod
    def quadratic(cls, system: System, *, x_goal: Vector, u_goal: Vector, R: Vector = 0.01, P: Vector = 1.0,
                  **options: Any) -> OCP:
        """L = (u - u*)' R (u - u*), G = (x - x*)' P (x - x*); `options` are OCP's other arguments.

        R and P are numbers (times the identity), diagonals [n] or symmetric positive semidefinite matrices [n, n]. The
        goal may be expressions of p, and follows it.
        """
        owner = f"OCP on {checks.instance(System, system, 'system', 'OCP.quadratic').name!r}"
        du = system.u - column(u_goal, system.nu, "u_goal", owner)
        dx = system.x - column(x_goal, system.nx, "x_goal", owner)
        return cls(system, running=_quadratic(checks.weight(R, system.nu, "R", owner), du),
                   terminal=_quadratic(checks.weight(P, system.nx, "P", owner), dx),
                   x_goal=x_goal, u_goal=u_goal, **options)

    @cached_property
    def functions(self) -> Functions:
        """f, L, L_soft, h, G, all constraints, derivatives, and symbols to build more of them on: the one door to them.
        """
        u, at_end = self.system.u, (replace(one, expression=self._at_end(one.expression)) for one in self.held_at_end)
        return Functions(self.system, self.running, Rows.made(self.held, u), Rows.made(list(at_end), u),
                         self._at_end(self.terminal), self._measured, self.penalty, self.penalty_margin, p=self.p)

    @property
    def L(self) -> ca.Function:
        """(x, u[, t][, p]) -> running cost, a scalar."""
        return self.functions.L

    @property
    def G(self) -> ca.Function:
        """(x[, p]) -> terminal cost, a scalar."""
        return self.functions.G

    @property
    def h(self) -> ca.Function:
        """(x[, t][, p]) -> inequalities of these alone [number of them], each >= 0 where it holds, in its own unit."""
        return self.functions.h

    @property
    def h_titles(self) -> tuple[str, ...]:
        """Whose each row of h is, in words: "path constraint 'wall'"."""
        rows = self.functions.rows
        return tuple(rows.title(i) for i in range(rows.n_h))

    @property
    def constraint_scales(self) -> Array:
        """What violations of each row of h are measured by [number of them]: see nocl/definition/constraints.py."""
        return self.functions.scales[:self.functions.rows.n_h]

    def _measured(self) -> tuple[Array, Array]:
        """The scales of the rows along a trajectory, and at its end."""
        of, rows, end, given = self.functions, self.functions.rows, self.functions.end_rows, self.scales
        there = self.moments(PLACES + 1)
        there["p"][-1] = self.nominal
        x = np.vstack([self.initial_states.sample(PLACES, sampling.own_numbers(0)), self.x_goal])
        place: Places = {"x": x, "u": self.goals(there["p"])[1], **there}
        box, at_goal = self._samples(limits.SAMPLES), {"x": self.goals(there["p"])[0], "p": there["p"]}
        n = rows.n_x
        along = [*limits.sizes(rows[:n], of.node, box, place, self._box_of_x),
                 *limits.sizes(rows[n:], of.arguments, box, place, self._box)]
        at_end = limits.sizes(end, of.end, box, at_goal, self._box_of_x)
        return limits.joined(rows, np.array(along), given), limits.joined(end, at_end, given)

    @property
    def is_held(self) -> bool:
        """Whether there are constraints."""
        return bool(self.held or self.held_at_end)

    @property
    def in_scales(self) -> bool:
        """Whether clearances are in units of the constraints' scales: where there are any beside path constraints."""
        return bool(self.held_at_end) or any(one.kind != PATH for one in self.held)

    @property
    def L_soft(self) -> ca.Function:
        """(x, u[, t][, p]) -> running cost plus penalty * sum of max(margin - h, 0)^2: L itself without any h."""
        return self.functions.L_soft

    def __repr__(self) -> str:
        z = ca.vertcat(*self.functions.arguments.inputs)
        held = (*self.held, *self.held_at_end)
        values = ca.vertcat(self.functions.running, self.functions.terminal,
                            *(self._at_end(one.expression) if one.kind == END else one.expression for one in held))
        (L, G, *constraints), shared = pretty.lines(values, z, prefix="c")
        horizon = "infinite" if self.is_infinite else f"{self.longest:g}" if not self.is_free else \
            f"free in [{self.horizon.low:g}, {self.horizon.high:g}]"
        lines = [f"OCP on {self.system.name!r}: horizon {horizon}"]
        lines += [pretty.wrapped("L", L), pretty.wrapped("G", G)]
        lines += [pretty.filled(f"{one.name}{' at the end' * (one.kind == END)}: {one.text(e)}")
                  for one, e in zip(held, constraints, strict=True)]
        lines += [pretty.wrapped(name, e, "    ") for name, e in shared.items()]
        goal = f"x* = {text(self.x_goal)}, u* = {text(self.u_goal)}" if self.has_goal else "none"
        lines += [pretty.filled(f"goal: {goal}"), pretty.filled(f"x0 ~ {self.initial_states!r}")]
        if self.np:
            own = f", the problem's own: {parameter_text(self.p)}" if self.p.numel() else ""
            lines.append(pretty.filled(f"p = ({', '.join(self.parameter_names)}) ~ {self.parameters!r}{own}"))
        return "\n".join([*lines, repr(self.system)])

    def to_data(self) -> dict[str, Any]:
        """The problem with its system as plain JSON data, exact to the last bit."""
        horizon = "infinite" if self.is_infinite else \
            {"free": [self.horizon.low, self.horizon.high]} if self.is_free else self.horizon
        x_goal, u_goal = (None if isinstance(goal, Reference) else goal.tolist() for goal in (self.x_goal, self.u_goal))
        return {"system": self.system.to_data(), "horizon": horizon, "x_goal": x_goal, "u_goal": u_goal,
                "initial_states": sampling.to_data(self.initial_states),
                "L": instructions.to_data(self.L), "G": instructions.to_data(self.G),
                "h": instructions.to_data(self._paths), "path_constraints": list(self.path_constraints),
                "penalty": self.penalty, "penalty_margin": self.penalty_margin, **self._parameter_data(),
                **self._constraint_data()}

    @property
    def _paths(self) -> ca.Function:
        """(x[, t][, p]) -> path constraints."""
        return self.functions.node.function("h", {"h": ca.vertcat(ca.SX(0, 1), *self.path_constraints.values())})

    def _constraint_data(self) -> dict[str, Any]:
        """What to_data adds where there are constraints beside path constraints."""
        of, found = self.functions, dict[str, Any]()
        for kind, at, given in (("constraints", of.arguments, self.constraints),
                                ("terminal_constraints", of.arguments.but("u"), self.terminal_constraints)):
            if given:
                column = ca.vertcat(*(one.expression for one in given.values()))
                found[kind] = {"e": instructions.to_data(at.function("e", {"e": column})), "names": list(given),
                               "bounds": [_bounds_data(one.low, one.high) for one in given.values()]}
        if self.state_bounds:
            found["state_bounds"] = {name: _bounds_data(*pair) for name, pair in self.state_bounds.items()}
        return found | ({"scales": dict(self.scales)} if self.scales else {})

    def _parameter_data(self) -> dict[str, Any]:
        """What to_data adds where there are parameters."""
        if self.parameters is None:
            return {}
        varies = {"goal": instructions.to_data(self.goal)} if self.goal_varies else {}
        return {"p": known.to_data(self.p), "parameters": sampling.to_data(self.parameters), **varies}

    @staticmethod
    def from_data(data: Mapping[str, Any]) -> OCP:
        """The problem that to_data wrote, with new symbols; ValueError for anything else."""
        checks.instance(Mapping, data, "data", "not an OCP written by nocl", "what to_data gave")
        try:
            system = System.from_data(data["system"])
            p = known.from_data(data.get("p", ()))
            every = ca.vertcat(system.p, p)
            at = {"x": system.x, "u": system.u, known.TIME: known.time(), "p": every}
            constraints = ca.vertsplit(read(data["h"], at)) if data["path_constraints"] else []
            goal = instructions.from_data(data["goal"], [every])(every) if "goal" in data else \
                (data["x_goal"], data["u_goal"])
            x_goal, u_goal = (None if data[name] is None else value
                              for name, value in zip(("x_goal", "u_goal"), goal, strict=True))
            horizon = data["horizon"]
            more = {kind: _constraints_from(data[kind], at) for kind in ("constraints", "terminal_constraints")
                    if kind in data}
            horizon = Free(*horizon["free"]) if isinstance(horizon, Mapping) else \
                INFINITE if horizon == "infinite" else horizon
            return OCP(system, horizon=horizon, x_goal=x_goal, u_goal=u_goal,
                       running=read(data["L"], at), terminal=read(data["G"], at), p=p,
                       parameters=sampling.from_data(data["parameters"]) if "parameters" in data else None,
                       initial_states=sampling.from_data(data["initial_states"]),
                       path_constraints=dict(zip(data["path_constraints"], constraints, strict=True)),
                       penalty=data["penalty"], penalty_margin=data["penalty_margin"], **more,
                       state_bounds=data.get("state_bounds", {}), scales=data.get("scales", {}))
        except MALFORMED as error:
            raise ValueError(f"not an OCP written by nocl: {type(error).__name__}: {error}; expected what to_data "
                             "gave") from error

    def __reduce__(self) -> tuple[Any, ...]:
        return OCP.from_data, (self.to_data(),)  # bare SX does not pickle


def _bounds_data(low: float, high: float) -> list[float | None]:
    return [bound if np.isfinite(bound) else None for bound in (low, high)]


def _constraints_from(data: Mapping[str, Any], at: Mapping[str, ca.SX]) -> dict[str, Any]:
    """The constraints that to_data wrote, by name."""
    expressions = ca.vertsplit(read(data["e"], at))
    return {name: (low, e, high) for name, e, (low, high) in zip(data["names"], expressions, data["bounds"],
                                                                strict=True)}


def _quadratic(W: Array, e: ca.SX) -> ca.SX:
    """e' W e, W symmetric."""
    off = W - np.diag(np.diag(W))
    squares = ca.dot(ca.DM(np.diag(W)), e**2)
    return squares + ca.bilin(ca.DM(off), e, e) if off.any() else squares

