"""A dynamical system xdot = f(x, u, t, p), or x+ = F(x, u, t, p), written once in CasADi SX: the source of all else."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.definition import algebraic, parameters, pretty
from nocl.support import checks
from nocl.support.asked import answered
from nocl.support.checks import MALFORMED, Array, Vector
from nocl.translate import instructions
from nocl.translate.arguments import Arguments

Generator = np.random.Generator
N_SAME, SAME = 16, 1e-9  # points, and relative to usual values: equations that agree so far are the same
N_PROBES = 512  # points of the box at which the equations are tried on construction
_NONE = checks.FrozenSX(ca.SX(0, 1))


@answered
@dataclass(frozen=True, eq=False, repr=False)
class System:
    """xdot = f(x, u, t, p), x in the box [lbx, ubx] of R^nx, u in [lbu, ubu] of R^nu; t and p where f has them.

    A system in discrete time, x+ = F(x, u, t, p), is made by System.discrete.

    Parameters
    ----------
    name : str
        A plain identifier; it names files and CasADi functions.
    x, u : casadi.SX
        Columns of scalar symbols; their names are the names of the states and controls.
    xdot : casadi.SX or None
        nx expressions in x, u, p and the time nocl.time(), and nothing else; None where the equations are not known:
        logs teach them (nocl.identify with `data`).
    p : casadi.SX, optional
        A column of parameters, nocl.parameter(name, nominal, unit): constant along a trajectory (a mass, a length).
    z, alg : casadi.SX, optional
        Algebraic variables [nz], symbols that xdot may hold, and as many equations 0 = alg(x, z, u, t, p) of index 1.
        They are solved for z once, in the box of x and u (nocl/definition/algebraic.py): `equations` are xdot with the
        solution in place of z, `algebraic` gives it, and costs and constraints of an OCP may hold z too.
    z_guess : [nz], numbers or expressions of x, u and p
        Near which solution z is looked for; default 0.
    lbu, ubu : [nu]
        Hard control bounds U, finite.
    lbx, ubx : [nx]
        The box X that samples are drawn from (no constraint on trajectories), finite.
    angles : names
        The 2 pi periodic coordinates, by name.
    units : mapping from names to units, for axes and tables.
    x_next, dt : of System.discrete

    Raises
    ------
    ValueError
        With what was got, what was expected and the remedy.
    """

    name: str
    x: ca.SX
    u: ca.SX
    xdot: ca.SX | None
    lbu: Vector = field(kw_only=True)
    ubu: Vector = field(kw_only=True)
    lbx: Vector = field(kw_only=True)
    ubx: Vector = field(kw_only=True)
    p: Any = field(default=None, kw_only=True)
    z: Any = field(default=None, kw_only=True)
    alg: Any = field(default=None, kw_only=True)
    z_guess: Any = field(default=None, kw_only=True)
    x_next: Any = field(default=None, kw_only=True)
    dt: float | None = field(default=None, kw_only=True)
    angles: Sequence[str] = field(default=(), kw_only=True)
    units: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    _solution: ca.SX = field(default=_NONE, init=False)  # z

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", self.name):
            raise ValueError(f"System: name is {self.name!r}; expected letters, digits and _, like 'cart_pole'")
        owner = f"System {self.name!r}"
        for name in ("x", "u"):  # copies: the caller may go on editing its own
            parts = checks.symbols(checks.column(getattr(self, name)), name, owner)
            self._set(**{name: checks.FrozenSX(ca.vertcat(*parts))})
        self._set(p=parameters.column(self.p, owner))
        check_unique((*self.names, *self.parameter_names), False, owner)
        lbu, ubu = checks.bounds(self.lbu, self.ubu, self.nu, ("lbu", "ubu"), owner, self.control_names)
        lbx, ubx = checks.bounds(self.lbx, self.ubx, self.nx, ("lbx", "ubx"), owner, self.state_names)
        self._set(lbu=lbu, ubu=ubu, lbx=lbx, ubx=ubx)
        self._read_algebraic(owner)
        if self.is_discrete or self.x_next is not None:
            self._read_step(owner)
        if self.xdot is not None:
            self._set(xdot=self._expression(self.xdot, self.nx, "xdot", owner))
        self._solve_algebraic()
        check_unique((*self.names, *self.parameter_names, *self.algebraic_names), self.uses_time, owner)
        self._check_names(owner)
        if self.xdot is not None:
            self._check_finite(owner)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def _expression(self, value: Any, rows: int, name: str, owner: str, z: bool = True) -> ca.SX:
        """A column in x, u, t, p and, if `z`, the algebraic variables; ValueError for any other."""
        own, t = ca.vertcat(self.x, self.u, self.p, *([self.z] if z else [])), parameters.time()
        value = list(value) if isinstance(value, np.ndarray) else value
        e = checks.expression(checks.column(value), rows, own, name, owner, time=t)
        instructions.check_scalar(ca.Function(name, [own, t], [e]), f"{owner}: {name}")
        return e

    def _read_algebraic(self, owner: str) -> None:
        """z, alg and z_guess as columns, empty where there are none."""
        z, alg, guess = (None if _is_nothing(e) else e for e in (self.z, self.alg, self.z_guess))
        if z is None and (alg is not None or guess is not None):
            raise ValueError(f"{owner}: {'alg' if alg is not None else 'z_guess'} is given and z is not; expected the "
                             "symbols that alg is solved for, z=")
        parts = [] if z is None else checks.symbols(checks.column(z), "z", owner)
        if parts and alg is None:
            raise ValueError(f"{owner}: z is given and alg is not; expected {counted(len(parts), 'equation')} "
                             "0 = alg, expressions of x, z, u and p")
        self._set(z=checks.FrozenSX(ca.vertcat(ca.SX(0, 1), *parts)))
        check_unique((*self.names, *self.parameter_names, *self.algebraic_names), False, owner)
        self._set(alg=self._expression(alg, len(parts), "alg", owner) if parts else _NONE,
                  z_guess=self._expression([0.0] * len(parts) if guess is None else guess, len(parts), "z_guess", owner,
                                           z=False) if parts else None)

    def _read_step(self, owner: str) -> None:
        """x_next and dt, and xdot as what changes by a step in a unit of time."""
        if not self.is_discrete or self.x_next is None:
            given, missing = ("x_next", "dt") if self.x_next is not None else ("dt", "x_next")
            raise ValueError(f"{owner}: {given} is given and {missing} is not; expected both, nocl.System.discrete"
                             "(name, x=, u=, x_next=, dt=), or neither")
        self._set(dt=checks.number(self.dt, "dt, the time between two samples,", owner, positive=True),
                  x_next=self._expression(self.x_next, self.nx, "x_next", owner))
        self._set(xdot=(self.x_next - self.x) / self.dt)

    def _solve_algebraic(self, longest: float = 0.0, low: Array | None = None, high: Array | None = None) -> None:
        """z as expressions of x and u in their boxes, t in [0, longest] and p in [low, high], nominal ones by default.
        """
        if not self.z.numel():
            return self._set(_solution=_NONE)
        low, high = (self.nominal if bound is None else bound for bound in (low, high))
        box = algebraic.Box({"x": self.x, "u": self.u, "t": parameters.time(), "p": self.p},
                            np.r_[self.lbx, self.lbu, 0.0, low], np.r_[self.ubx, self.ubu, longest, high])
        solution = algebraic.solved(self.z, self.alg, self.z_guess, box, f"System {self.name!r}")
        return self._set(_solution=solution)

    def over(self, longest: float, low: Array, high: Array) -> System:
        """The system for times in [0, longest] and parameters [np] in [low, high]: what algebraic variables are solved
        for, where that counts."""
        moving = ca.vertcat(parameters.time(), self.p)
        if not self.z.numel() or not algebraic.changes(self.alg, self.z, moving):
            return self
        other = object.__new__(System)
        other._set(**{one.name: getattr(self, one.name) for one in fields(self)})
        other._solve_algebraic(longest, low, high)
        return other

    def without_z(self, e: Any) -> Any:
        """An expression, or a mapping or a tuple that holds some, with the solution in place of algebraic variables."""
        if isinstance(e, Mapping):
            return {name: self.without_z(one) for name, one in e.items()}
        if isinstance(e, (tuple, list)):
            return type(e)(map(self.without_z, e))
        held = isinstance(e, ca.SX) and self.z.numel() and ca.depends_on(e, self.z)
        return ca.substitute(e, self.z, self._solution) if held else e

    def _check_names(self, owner: str) -> None:
        angles = (self.angles,) if isinstance(self.angles, str) else self.angles
        if not isinstance(angles, (list, tuple)) or any(a not in self.state_names for a in angles):
            raise ValueError(f"{owner}: angles is {self.angles!r}; expected a list of names of states "
                             f"({', '.join(self.state_names)})")
        angles = tuple(a for a in self.state_names if a in angles)
        named = (*self.names, *self.parameter_names, *self.algebraic_names)
        if not isinstance(self.units, Mapping) or any(n not in named for n in self.units):
            raise ValueError(f"{owner}: units is {self.units!r}; expected a dict from names of states and controls "
                             f"({', '.join(named)}) to units")
        units = {**parameters.units_of(self.p), **self.units}
        self._set(angles=angles, units=MappingProxyType(units))

    def _check_finite(self, owner: str) -> None:
        """Try f and its Jacobian at the box's middle, its two extreme corners and random points, at t = 0 and the
        nominal parameters; where these are not all given, the OCP does, which knows their distribution.
        """
        if np.isnan(self.nominal).any():
            return
        moment: dict[str, Any] = {"t": 0.0, "p": self.nominal}
        rng = np.random.default_rng(0)
        lb, ub = np.r_[self.lbx, self.lbu], np.r_[self.ubx, self.ubu]
        z = np.vstack([(lb + ub) / 2, lb, ub, rng.uniform(lb, ub, (N_PROBES, len(lb)))]).T
        x, u = z[: self.nx], z[self.nx:]
        given = self.arguments.columns(x=x.T, u=u.T, **moment)
        values = np.vstack([self.f(*given).full(), *(_stack(j, z.shape[1]) for j in self.jacobian(*given))])
        bad = np.flatnonzero(~np.isfinite(values).all(axis=0))
        if bad.size:
            k = int(bad[0])
            at = ", ".join(f"{n} = {v:.4g}" for n, v in zip(self.names, z[:, k], strict=True))
            f = self.f(*self.arguments.columns(x=x[:, k], u=u[:, k], **moment)).full().ravel()
            rows = [n for n, v in zip(self.state_names, f, strict=True) if not np.isfinite(v)]
            what = f"the equation(s) of {', '.join(rows)}" if rows else "the Jacobian of xdot"
            raise ValueError(f"{owner}: {what} gives NaN or inf inside the box, at {at}; "
                             "expected finite values: change the equation or shrink lbx, ubx")

    @property
    def is_discrete(self) -> bool:
        """Whether time goes in steps, x+ = F(x, u, t, p)."""
        return self.dt is not None

    def refuse_discrete(self, owner: str, remedy: str = "") -> None:
        """ValueError where time goes in steps: for what is about continuous time."""
        if self.is_discrete:
            usual = ("System(..., xdot=...), or what takes steps: NMPC, DDP, LQR, nocl.train, nocl.simulate, "
                     "nocl.comparisons.compare")
            raise ValueError(f"{owner} is for systems in continuous time, and {self.name!r} is one in discrete time "
                             f"(dt = {self.dt:g}); expected {remedy or usual}")

    @property
    def nx(self) -> int:
        return int(self.x.numel())

    @property
    def nu(self) -> int:
        return int(self.u.numel())

    @property
    def np(self) -> int:
        return int(self.p.numel())

    @property
    def state_names(self) -> tuple[str, ...]:
        return tuple(s.name() for s in ca.vertsplit(self.x))

    @property
    def control_names(self) -> tuple[str, ...]:
        return tuple(s.name() for s in ca.vertsplit(self.u))

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the states, then of the controls."""
        return self.state_names + self.control_names

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return parameters.names_of(self.p)

    @property
    def algebraic_names(self) -> tuple[str, ...]:
        """Those of the algebraic variables."""
        return parameters.names_of(self.z)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Those of the controls, then of the parameters: what logs and labels of f have beside states."""
        return self.control_names + self.parameter_names

    @property
    def nominal(self) -> Array:
        """The nominal values of the parameters [np], NaN where none was given."""
        return parameters.nominal_of(self.p)

    @cached_property
    def uses_time(self) -> bool:
        """Whether xdot holds the time."""
        known = self._solution if self.xdot is None else ca.vertcat(self.equations, self._solution)
        return bool(ca.depends_on(known, parameters.time()))

    def refuse_parameters(self, owner: str) -> None:
        """ValueError where f holds parameters or the time: for what has no use of them, or not yet."""
        if self.np or self.uses_time:
            raise ValueError(refusal(owner, f"system {self.name!r}", self.parameter_names, self.uses_time, "system"))

    @property
    def angle_indices(self) -> tuple[int, ...]:
        return tuple(self.state_names.index(a) for a in self.angles)

    @cached_property
    def equations(self) -> ca.SX:
        """xdot, without algebraic variables; ValueError where it is not known."""
        if self.xdot is None:
            raise ValueError(f"the equations of {self.name!r} are not known (xdot=None), and are needed here: learn "
                             "them from logs, model = nocl.identify(system, data=log), and pass the model, or a "
                             "problem on model.to_system()")
        return checks.FrozenSX(self.without_z(self.xdot))

    @cached_property
    def arguments(self) -> Arguments:
        """(x, u[, t][, p]), the system's own symbols: what xdot is a function of."""
        time = {parameters.TIME: parameters.time()} if self.uses_time else {}
        return Arguments({"x": self.x, "u": self.u, **time, **({"p": self.p} if self.np else {})})

    @cached_property
    def f(self) -> ca.Function:
        """(x [nx], u [nu][, t][, p [np]]) -> xdot [nx]."""
        return self.arguments.function("f", {"xdot": self.equations})

    @cached_property
    def F(self) -> ca.Function:
        """(x [nx], u [nu][, t][, p [np]]) -> x+ [nx], the step of a system in discrete time; ValueError for others."""
        if not self.is_discrete:
            raise ValueError(f"system {self.name!r} is one in continuous time, and F is the step of one in discrete "
                             "time; expected nocl.System.discrete(name, x=, u=, x_next=, dt=): take f")
        return self.arguments.function("F", {"x_next": self.without_z(self.x_next)})

    @cached_property
    def algebraic(self) -> ca.Function:
        """(x [nx], u [nu][, t][, p [np]]) -> the algebraic variables z [nz], of a system that has some."""
        if not self.z.numel():
            raise ValueError(f"system {self.name!r} has no algebraic variables; expected System(..., z=, alg=)")
        return self.arguments.function("algebraic", {"z": self._solution})

    @cached_property
    def jacobian(self) -> ca.Function:
        """(x, u[, t][, p]) -> (A [nx, nx] = df/dx, B [nx, nu] = df/du), dense."""
        A, B = (ca.densify(ca.jacobian(self.equations, v)) for v in (self.x, self.u))
        return self.arguments.function("jacobian", {"A": A, "B": B})

    def linearize(self, x: ArrayLike, u: ArrayLike, t: float = 0.0, p: Any = None) -> tuple[Array, Array]:
        """(A, B) at (x, u), as numpy arrays [nx, nx] and [nx, nu]; at time t and parameters p where f has them.

        Of a system in discrete time they are those of a step, x+ = A x + B u.
        """
        owner = f"{self.name}.linearize"
        x, u = checks.vector(x, self.nx, "x", owner), checks.vector(u, self.nu, "u", owner)
        rows = parameters.rows(p, self.parameter_names, 1, owner)
        A, B = self.jacobian(*self.arguments.columns(x=x, u=u, t=t, p=rows))
        if not (np.isfinite(A.full()).all() and np.isfinite(B.full()).all()):
            raise ValueError(f"{owner}: the Jacobian is NaN or inf at x = {checks.shown(x)}, u = {checks.shown(u)}; "
                             "expected a point where xdot is differentiable")
        if self.dt is not None:
            return np.eye(self.nx) + self.dt * A.full(), self.dt * B.full()
        return A.full(), B.full()

    def at(self, p: Any) -> System:
        """The system with its parameters folded in as constants: p as [np], or by name."""
        value = parameters.rows(p, self.parameter_names, 1, f"{self.name}.at")[0]
        units = {n: unit for n, unit in self.units.items() if n not in self.parameter_names}

        def folded(e: Any) -> Any:
            return e if e is None else ca.substitute(e, self.p, ca.DM(value))

        return replace(self, xdot=folded(self.xdot), x_next=folded(self.x_next), alg=folded(self.alg),
                       z_guess=folded(self.z_guess), p=None, units=units)

    def with_inputs(self, low: Array, high: Array) -> System:
        """f(x, u, p) as f(x, (u, p)): the parameters after the controls, between low and high [np]."""
        return replace(self, u=ca.vertcat(self.u, self.p), p=None, lbu=np.r_[self.lbu, low],
                       ubu=np.r_[self.ubu, high])

    def difference(self, other: System, equations: bool = True) -> str:
        """What tells another system from this one, names of states and controls or (where asked) parameters and
        equations; "" where they are the same."""
        checks.instance(System, other, "other", f"{self.name}.difference", "of an OCP, pass ocp.system")
        checks.flag(equations, "equations", f"{self.name}.difference")
        parameters = [("parameters", self.parameter_names, other.parameter_names)] if equations else []
        for what, own, theirs in (("states", self.state_names, other.state_names),
                                  ("controls", self.control_names, other.control_names), *parameters):
            if own != theirs:
                return f"its {what} are {', '.join(theirs) or 'none'}, not {', '.join(own) or 'none'}"
        if self.dt != other.dt:
            mine, its = ("continuous" if s.dt is None else f"in steps of {s.dt:g}" for s in (self, other))
            return f"its time is {its}, not {mine}"
        if not equations or self.xdot is None or other.xdot is None or self.xdot is other.xdot:
            return ""
        rng = np.random.default_rng(0)
        x = rng.uniform(self.lbx, self.ubx, (N_SAME, self.nx)).T
        u = rng.uniform(self.lbu, self.ubu, (N_SAME, self.nu)).T
        at = {"x": x.T, "u": u.T, **self._moments(rng)}
        own, theirs = (s.f(*s.arguments.columns(**at)).full() for s in (self, other))
        usual = np.abs(own).max(axis=1, keepdims=True)
        rows = np.flatnonzero((~(np.abs(theirs - own) <= SAME * (usual + np.abs(own)))).any(axis=1))
        return "its equation(s) of " + ", ".join(self.state_names[i] for i in rows) + " are others" if rows.size else ""

    def _moments(self, rng: Generator) -> dict[str, Array]:
        """N_SAME times and values of the parameters, about their nominal ones or 1."""
        usual = np.where(np.isfinite(self.nominal), self.nominal, 1.0)
        return {"t": rng.random(N_SAME), "p": usual * rng.uniform(0.8, 1.2, (N_SAME, self.np))}

    def under(self, f: ca.Function) -> System:
        """The system with another f:(x, u[, t][, p]) -> xdot for its equations, in its own symbols and SX; of a system
        in discrete time with another F:(x, u[, t][, p]) -> x+."""
        sizes = [v.numel() for v in self.arguments.inputs]
        if not isinstance(f, ca.Function) or [f.numel_in(i) for i in range(f.n_in())] != sizes or \
                [f.numel_out(i) for i in range(f.n_out())] != [self.nx]:
            form = ", ".join(f"{name} [{n}]" for name, n in zip(self.arguments.names, sizes, strict=True))
            raise ValueError(f"{self.name}.under: f is {checks.shown(f)}; expected a casadi.Function ({form}) -> "
                             f"{'x_next' if self.is_discrete else 'xdot'} [{self.nx}]")
        f = f if f.is_a("SXFunction") else instructions.expand(f)
        return replace(self, **{"x_next" if self.is_discrete else "xdot": f(*self.arguments.inputs)})

    def unit(self, name: str) -> str:
        """The unit of a state, control or parameter for an axis label, like 'theta [rad]' or just 'theta'."""
        checks.word(name, (*self.names, *self.parameter_names, *self.algebraic_names), "name", f"{self.name}.unit")
        return f"{name} [{self.units[name]}]" if name in self.units else name

    def __repr__(self) -> str:
        def interval(name: str, low: float, high: float) -> str:
            return f"{name} in [{low:g}, {high:g}]" + (" (angle)" if name in self.angles else "")

        counts = f"{counted(self.nx, 'state')}, {counted(self.nu, 'control')}"
        lines = [f"System {self.name!r}: {counts}" + (f", {counted(self.np, 'parameter')}" if self.np else "")
                 + (f", in steps of {self.dt:g}" if self.is_discrete else "")]
        if self.xdot is None:
            lines.append("equations not known")
        else:
            right = self.x_next if self.is_discrete else self.xdot
            rows, shared = pretty.lines(ca.vertcat(right, self.alg), ca.vertcat(*self.arguments.inputs, self.z))
            names = [*(f"{n}+" if self.is_discrete else f"d{n}/dt" for n in self.state_names), *["0"] * self.z.numel()]
            lines += [pretty.wrapped(n, e) for n, e in zip(names, rows, strict=True)]
            lines += [pretty.wrapped(name, e, "    ") for name, e in shared.items()]
        lines.append(pretty.filled("X: " + ", ".join(map(interval, self.state_names, self.lbx, self.ubx))))
        lines.append(pretty.filled("U: " + ", ".join(map(interval, self.control_names, self.lbu, self.ubu))))
        if self.z.numel():
            lines.append(pretty.filled("z: " + ", ".join(self.algebraic_names)))
        if self.np:
            lines.append(pretty.filled("p: " + parameter_text(self.p)))
        return "\n".join(lines)

    def to_data(self) -> dict[str, Any]:
        """The system as plain JSON data, exact to the last bit."""
        return {"name": self.name, "x": list(self.state_names), "u": list(self.control_names),
                "f": None if self.xdot is None or self.is_discrete else instructions.to_data(self.f),
                **({"F": instructions.to_data(self.F), "dt": self.dt} if self.is_discrete else {}),
                "angles": list(self.angles), "units": dict(self.units),
                **({"p": parameters.to_data(self.p)} if self.np else {}),
                **({"z": list(self.algebraic_names), "z_is": instructions.to_data(self.algebraic)}
                   if self.z.numel() else {}),
                **{name: getattr(self, name).tolist() for name in ("lbu", "ubu", "lbx", "ubx")}}

    @staticmethod
    def from_data(data: Mapping[str, Any]) -> System:
        """The system that to_data wrote, with new symbols; ValueError for anything else."""
        checks.instance(Mapping, data, "data", "not a System written by nocl", "what to_data gave")
        try:
            x, u = (ca.vertcat(*map(ca.SX.sym, data[names])) for names in ("x", "u"))
            p = parameters.from_data(data.get("p", ()))
            at = {"x": x, "u": u, parameters.TIME: parameters.time(), "p": p}
            xdot = None if data["f"] is None else read(data["f"], at)
            z = ca.vertcat(ca.SX(0, 1), *map(ca.SX.sym, data.get("z", ())))
            alg = z - read(data["z_is"], at) if "z_is" in data else None
            step = {"x_next": read(data["F"], at), "dt": data["dt"]} if "F" in data else {}
            return System(data["name"], x=x, u=u, xdot=xdot, **step, p=p, z=z, alg=alg, angles=data["angles"],
                          units=data["units"], **{name: data[name] for name in ("lbu", "ubu", "lbx", "ubx")})
        except MALFORMED as error:
            raise ValueError(f"not a System written by nocl: {type(error).__name__}: {error}; expected what to_data "
                             "gave") from error

    @staticmethod
    def discrete(name: str, x: ca.SX, u: ca.SX, x_next: ca.SX, *, dt: float = 1.0, **options: Any) -> System:
        """A system in discrete time, x+ = F(x, u, t, p): its state is sampled, and its control set, every dt.

        Parameters
        ----------
        name, x, u : as System has them
        x_next : casadi.SX
            F, nx expressions in x, u, p and the time nocl.time(), which is k dt at sample k = 0, 1, ...
        dt : float
            The time between two samples, in the user's unit of time. With the default 1 times are numbers of samples.
        options : lbu, ubu, lbx, ubx, and p, z, alg, z_guess, angles, units, as System has them

        A problem on it costs the sum of dt L(x_k, u_k, k dt, p) over its steps, and G; its horizon is a whole number of
        dt, and solvers have as many intervals. F is taken as it is: `system.F` is (x, u[, t][, p]) -> x+, and `f` and
        xdot are (F - x) / dt, what changes in a unit of time. Constraints hold at the samples. What is about continuous
        time (identification, level sets, implicit steps, nocl.Free, ...) refuses such systems.

        Raises ValueError with what was got, what was expected and the remedy.
        """
        return System(name, x, u, None, x_next=x_next, dt=dt, **options)

    @staticmethod
    def from_casadi(f: ca.Function, *, lbu: Vector, ubu: Vector, lbx: Vector, ubx: Vector, **options: Any) -> System:
        """The system of f:(x [nx], u [nu]) -> xdot [nx]; options: name, states, controls (names), angles, units.

        f is written out in SX: elementary operations only (ValueError for externals, integrators, look-up tables:
        write those by nocl.spline).
        Names of states and controls are x0, x1, ..., u0, ... by default.
        """
        return _from_casadi(f, lbu=lbu, ubu=ubu, lbx=lbx, ubx=ubx, **options)

    def __reduce__(self) -> tuple[Any, ...]:
        return System.from_data, (self.to_data(),)  # bare SX does not pickle


def _from_casadi(f: ca.Function, *, name: str | None = None, states: Sequence[str] | None = None,
                 controls: Sequence[str] | None = None, **options: Any) -> System:
    if not isinstance(f, ca.Function) or f.n_in() != 2 or f.n_out() != 1 or f.size_out(0) != f.size_in(0) or \
            f.size2_in(0) != 1 or f.size2_in(1) != 1:
        raise ValueError(f"System.from_casadi: got {f}; expected a casadi.Function (x [nx], u [nu]) -> xdot [nx] of "
                         "columns")
    x = _named(states, f.size1_in(0), "x", "states", f.name())
    u = _named(controls, f.size1_in(1), "u", "controls", f.name())
    return System(f.name() if name is None else name, x=x, u=u, xdot=instructions.expand(f)(x, u), **options)


def _named(names: Sequence[str] | None, n: int, letter: str, what: str, owner: str) -> ca.SX:
    """A column of n symbols: `names`, or x0, x1, ..."""
    chosen = [f"{letter}{i}" for i in range(n)] if names is None else checks.words(names, what, "System.from_casadi")
    if len(chosen) != n:
        raise ValueError(f"System.from_casadi: {what} has {len(chosen)} names; {owner} has {n}: give each a name")
    return ca.vertcat(*map(ca.SX.sym, chosen))


def _is_nothing(e: Any) -> bool:
    """None, or an empty list or column."""
    return e is None or (isinstance(e, (list, tuple)) and not e) or (isinstance(e, ca.SX) and e.is_empty())


def check_unique(names: Sequence[str], timed: bool, owner: str) -> None:
    """ValueError where a name stands twice among those of states, controls, parameters and, where it is used, t."""
    taken = [*names, *([parameters.TIME] if timed else [])]
    repeated = sorted({n for n in taken if taken.count(n) > 1})
    if repeated:
        also = ", and t is the time" if parameters.TIME in repeated and timed else ""
        raise ValueError(f"{owner}: {', '.join(repeated)} occurs more than once in x and u (or p); "
                         f"expected a symbol and a name of its own for each state, control and parameter{also}")


def read(data: Mapping[str, Any], at: Mapping[str, ca.SX]) -> ca.SX:
    """What a function of data (instructions.to_data) is in symbols, those that its inputs are named by."""
    symbols = [at[name] for name, *_ in data["inputs"]]
    return instructions.from_data(data, symbols)(*symbols)


def parameter_text(p: ca.SX) -> str:
    """A column of parameters in words: 'mass = 1 kg, goal [m]', nominal values where they are given."""
    units = parameters.units_of(p)

    def text(name: str, value: float) -> str:
        unit = units.get(name, "")
        if np.isnan(value):
            return f"{name} [{unit}]" if unit else name
        return f"{name} = {value:g}" + (f" {unit}" if unit else "")

    return ", ".join(map(text, parameters.names_of(p), parameters.nominal_of(p)))


def refusal(owner: str, of: str, names: Sequence[str], time: bool, variable: str) -> str:
    """The message of what takes no problem with parameters or time, or not yet."""
    has = [*([f"the parameter(s) {', '.join(names)}"] if names else []), *(["the time t"] if time else [])]
    remedy = f"one with its parameters folded in, {variable}.at(p=...)" if names else "one without t"
    also = ", and without t" if names and time else ""
    return (f"{owner} is not implemented for {' and for '.join(has)}, which the {of} has; expected one without: "
            f"pass {remedy}{also}")


def counted(n: int, noun: str) -> str:
    """'1 state', '2 states'."""
    return f"{n} {noun}" + ("s" if n != 1 else "")


def _stack(matrix: ca.DM, columns: int) -> Array:
    """CasADi's side by side evaluations [r, c * columns] as one column each, [r * c, columns]."""
    blocks = matrix.full()
    return blocks.reshape(blocks.shape[0], columns, -1).transpose(0, 2, 1).reshape(-1, columns)
