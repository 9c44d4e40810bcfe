"""A dynamical system xdot = f(x, u), written once in CasADi SX: the source of everything else."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl import pretty
from nocl.support import checks
from nocl.support.checks import MALFORMED, Array, Vector
from nocl.translate import instructions
from nocl.translate.arguments import Arguments

N_SAME, SAME = 16, 1e-9  # points, and relative to usual values: equations that agree so far are the same
N_PROBES = 512  # points of the box at which the equations are tried on construction


@dataclass(frozen=True, eq=False, repr=False)
class System:
    """xdot = f(x, u), x in the box [lbx, ubx] of R^nx, u in [lbu, ubu] of R^nu.

    Parameters
    ----------
    name : str
        A plain identifier; it names files and CasADi functions.
    x, u : casadi.SX
        Columns of scalar symbols; their names are the names of the states and controls.
    xdot : casadi.SX or None
        nx expressions in these symbols and nothing else; None where the equations are not known: logs teach them
        (nocl.identify with `data`).
    lbu, ubu : [nu]
        Hard control bounds U, finite.
    lbx, ubx : [nx]
        The box X that samples are drawn from (no constraint on trajectories), finite.
    angles : names
        The 2 pi periodic coordinates, by name.
    units : mapping from names to units, for axes and tables.

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
    angles: Sequence[str] = field(default=(), kw_only=True)
    units: Mapping[str, str] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", self.name):
            raise ValueError(f"System: name is {self.name!r}; expected letters, digits and _, like 'cart_pole'")
        owner = f"System {self.name!r}"
        for name in ("x", "u"):  # copies: the caller may go on editing its own
            parts = checks.symbols(checks.column(getattr(self, name)), name, owner)
            self._set(**{name: checks.FrozenSX(ca.vertcat(*parts))})
        repeated = sorted({n for n in self.names if self.names.count(n) > 1})
        if repeated:
            raise ValueError(f"{owner}: {', '.join(repeated)} occurs more than once in x and u; "
                             "expected a symbol and a name of its own for each state and control")
        if self.xdot is not None:
            z = ca.vertcat(self.x, self.u)
            self._set(xdot=checks.expression(checks.column(self.xdot), self.nx, z, "xdot", owner))
            instructions.check_scalar(ca.Function("xdot", [z], [self.xdot]), f"{owner}: xdot")
        lbu, ubu = checks.bounds(self.lbu, self.ubu, self.nu, ("lbu", "ubu"), owner, self.control_names)
        lbx, ubx = checks.bounds(self.lbx, self.ubx, self.nx, ("lbx", "ubx"), owner, self.state_names)
        self._set(lbu=lbu, ubu=ubu, lbx=lbx, ubx=ubx)
        self._check_names(owner)
        if self.xdot is not None:
            self._check_finite(owner)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def _check_names(self, owner: str) -> None:
        angles = (self.angles,) if isinstance(self.angles, str) else self.angles
        if not isinstance(angles, (list, tuple)) or any(a not in self.state_names for a in angles):
            raise ValueError(f"{owner}: angles is {self.angles!r}; expected a list of names of states "
                             f"({', '.join(self.state_names)})")
        angles = tuple(a for a in self.state_names if a in angles)
        if not isinstance(self.units, Mapping) or any(n not in self.names for n in self.units):
            raise ValueError(f"{owner}: units is {self.units!r}; expected a dict from names of states and controls "
                             f"({', '.join(self.names)}) to units")
        self._set(angles=angles, units=MappingProxyType(dict(self.units)))

    def _check_finite(self, owner: str) -> None:
        """Try f and its Jacobian at the box's middle, its two extreme corners and random points."""
        rng = np.random.default_rng(0)
        lb, ub = np.r_[self.lbx, self.lbu], np.r_[self.ubx, self.ubu]
        z = np.vstack([(lb + ub) / 2, lb, ub, rng.uniform(lb, ub, (N_PROBES, len(lb)))]).T
        x, u = z[: self.nx], z[self.nx:]
        values = np.vstack([self.f(x, u).full(), *(_stack(j, z.shape[1]) for j in self.jacobian(x, u))])
        bad = np.flatnonzero(~np.isfinite(values).all(axis=0))
        if bad.size:
            k = int(bad[0])
            at = ", ".join(f"{n} = {v:.4g}" for n, v in zip(self.names, z[:, k], strict=True))
            f = self.f(x[:, k], u[:, k]).full().ravel()
            rows = [n for n, v in zip(self.state_names, f, strict=True) if not np.isfinite(v)]
            what = f"the equation(s) of {', '.join(rows)}" if rows else "the Jacobian of xdot"
            raise ValueError(f"{owner}: {what} gives NaN or inf inside the box, at {at}; "
                             "expected finite values: change the equation or shrink lbx, ubx")

    @property
    def nx(self) -> int:
        return int(self.x.numel())

    @property
    def nu(self) -> int:
        return int(self.u.numel())

    @property
    def state_names(self) -> tuple[str, ...]:
        return tuple(s.name() for s in ca.vertsplit(self.x))

    @property
    def control_names(self) -> tuple[str, ...]:
        return tuple(s.name() for s in ca.vertsplit(self.u))

    @property
    def names(self) -> tuple[str, ...]:
        return self.state_names + self.control_names

    @property
    def angle_indices(self) -> tuple[int, ...]:
        return tuple(self.state_names.index(a) for a in self.angles)

    @property
    def equations(self) -> ca.SX:
        """xdot; ValueError where it is not known."""
        if self.xdot is None:
            raise ValueError(f"the equations of {self.name!r} are not known (xdot=None), and are needed here: learn "
                             "them from logs, model = nocl.identify(system, data=log), and pass the model, or a "
                             "problem on model.to_system()")
        return self.xdot

    @cached_property
    def arguments(self) -> Arguments:
        """(x, u), the system's own symbols: what xdot is a function of."""
        return Arguments({"x": self.x, "u": self.u})

    @cached_property
    def f(self) -> ca.Function:
        """(x [nx], u [nu]) -> xdot [nx]."""
        return self.arguments.function("f", {"xdot": self.equations})

    @cached_property
    def jacobian(self) -> ca.Function:
        """(x, u) -> (A [nx, nx] = df/dx, B [nx, nu] = df/du), dense."""
        A, B = (ca.densify(ca.jacobian(self.equations, v)) for v in (self.x, self.u))
        return self.arguments.function("jacobian", {"A": A, "B": B})

    def linearize(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """(A, B) at (x, u), as numpy arrays [nx, nx] and [nx, nu]."""
        owner = f"{self.name}.linearize"
        A, B = self.jacobian(checks.vector(x, self.nx, "x", owner), checks.vector(u, self.nu, "u", owner))
        if not (np.isfinite(A.full()).all() and np.isfinite(B.full()).all()):
            raise ValueError(f"{owner}: the Jacobian is NaN or inf at x = {checks.shown(x)}, u = {checks.shown(u)}; "
                             "expected a point where xdot is differentiable")
        return A.full(), B.full()

    def difference(self, other: System, equations: bool = True) -> str:
        """What tells another system from this one, names or (where asked) equations; "" where they are the same."""
        checks.instance(System, other, "other", f"{self.name}.difference", "of an OCP, pass ocp.system")
        for what, own, theirs in (("states", self.state_names, other.state_names),
                                  ("controls", self.control_names, other.control_names)):
            if own != theirs:
                return f"its {what} are {', '.join(theirs)}, not {', '.join(own)}"
        known = self.xdot is not None and other.xdot is not None
        if not checks.flag(equations, "equations", f"{self.name}.difference") or not known or self.xdot is other.xdot:
            return ""
        rng = np.random.default_rng(0)
        x = rng.uniform(self.lbx, self.ubx, (N_SAME, self.nx)).T
        u = rng.uniform(self.lbu, self.ubu, (N_SAME, self.nu)).T
        own, theirs = self.f(x, u).full(), other.f(x, u).full()
        usual = np.abs(own).max(axis=1, keepdims=True)
        rows = np.flatnonzero((~(np.abs(theirs - own) <= SAME * (usual + np.abs(own)))).any(axis=1))
        return "its equation(s) of " + ", ".join(self.state_names[i] for i in rows) + " are others" if rows.size else ""

    def under(self, f: ca.Function) -> System:
        """The system with another f:(x, u) -> xdot for its equations, in its own symbols: f is written out in SX."""
        sizes = [self.nx, self.nu]
        if not isinstance(f, ca.Function) or [f.numel_in(i) for i in range(f.n_in())] != sizes or \
                [f.numel_out(i) for i in range(f.n_out())] != [self.nx]:
            raise ValueError(f"{self.name}.under: f is {checks.shown(f)}; expected a casadi.Function (x [{self.nx}], "
                             f"u [{self.nu}]) -> xdot [{self.nx}]")
        f = f if f.is_a("SXFunction") else instructions.expand(f)
        return replace(self, xdot=f(*self.arguments.inputs))

    def unit(self, name: str) -> str:
        """The unit of a state or control for an axis label, like 'theta [rad]' or just 'theta'."""
        checks.word(name, self.names, "name", f"{self.name}.unit")
        return f"{name} [{self.units[name]}]" if name in self.units else name

    def __repr__(self) -> str:
        def interval(name: str, low: float, high: float) -> str:
            return f"{name} in [{low:g}, {high:g}]" + (" (angle)" if name in self.angles else "")

        lines = [f"System {self.name!r}: {counted(self.nx, 'state')}, {counted(self.nu, 'control')}"]
        if self.xdot is None:
            lines.append("equations not known")
        else:
            rows, shared = pretty.lines(self.xdot, ca.vertcat(self.x, self.u))
            lines += [pretty.wrapped(f"d{n}/dt", e) for n, e in zip(self.state_names, rows, strict=True)]
            lines += [pretty.wrapped(name, e, "    ") for name, e in shared.items()]
        lines.append(pretty.filled("X: " + ", ".join(map(interval, self.state_names, self.lbx, self.ubx))))
        lines.append(pretty.filled("U: " + ", ".join(map(interval, self.control_names, self.lbu, self.ubu))))
        return "\n".join(lines)

    def to_data(self) -> dict[str, Any]:
        """The system as plain JSON data, exact to the last bit."""
        return {"name": self.name, "x": list(self.state_names), "u": list(self.control_names),
                "f": None if self.xdot is None else instructions.to_data(self.f),
                "angles": list(self.angles), "units": dict(self.units),
                **{name: getattr(self, name).tolist() for name in ("lbu", "ubu", "lbx", "ubx")}}

    @staticmethod
    def from_data(data: Mapping[str, Any]) -> System:
        """The system that to_data wrote, with new symbols; ValueError for anything else."""
        checks.instance(Mapping, data, "data", "not a System written by nocl", "what to_data gave")
        try:
            x, u = (ca.vertcat(*map(ca.SX.sym, data[names])) for names in ("x", "u"))
            xdot = None if data["f"] is None else instructions.from_data(data["f"], [x, u])(x, u)
            return System(data["name"], x=x, u=u, xdot=xdot, angles=data["angles"], units=data["units"],
                          **{name: data[name] for name in ("lbu", "ubu", "lbx", "ubx")})
        except MALFORMED as error:
            raise ValueError(f"not a System written by nocl: {type(error).__name__}: {error}; expected what to_data "
                             "gave") from error

    @staticmethod
    def from_casadi(f: ca.Function, *, lbu: Vector, ubu: Vector, lbx: Vector, ubx: Vector, **options: Any) -> System:
        """The system of f:(x [nx], u [nu]) -> xdot [nx]; options: name, states, controls (names), angles, units.

        f is written out in SX: elementary operations only (ValueError for externals, integrators, look-up tables).
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


def counted(n: int, noun: str) -> str:
    """'1 state', '2 states'."""
    return f"{n} {noun}" + ("s" if n != 1 else "")


def _stack(matrix: ca.DM, columns: int) -> Array:
    """CasADi's side by side evaluations [r, c * columns] as one column each, [r * c, columns]."""
    blocks = matrix.full()
    return blocks.reshape(blocks.shape[0], columns, -1).transpose(0, 2, 1).reshape(-1, columns)
