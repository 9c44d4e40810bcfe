"""A dynamical system xdot = f(x, u), written once in CasADi SX: the source of everything else."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl import checks
from nocl.checks import Array, Vector

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
    xdot : casadi.SX
        nx expressions in these symbols and nothing else.
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
    xdot: ca.SX
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
        checks.symbols(self.x, "x", owner), checks.symbols(self.u, "u", owner)
        self._set(x=ca.SX(self.x), u=ca.SX(self.u))  # copies: the caller may go on editing its own
        repeated = sorted({n for n in self.names if self.names.count(n) > 1})
        if repeated:
            raise ValueError(f"{owner}: the name(s) {', '.join(repeated)} stand for several symbols; "
                             "expected a name of its own for each state and control")
        self._set(xdot=checks.expression(self.xdot, self.nx, ca.vertcat(self.x, self.u), "xdot", owner))
        lbu, ubu = checks.bounds(self.lbu, self.ubu, self.nu, ("lbu", "ubu"), owner, self.control_names)
        lbx, ubx = checks.bounds(self.lbx, self.ubx, self.nx, ("lbx", "ubx"), owner, self.state_names)
        self._set(lbu=lbu, ubu=ubu, lbx=lbx, ubx=ubx)
        self._check_names(owner)
        self._check_finite(owner)

    def _set(self, **values: object) -> None:
        for key, value in values.items():
            object.__setattr__(self, key, value)

    def _check_names(self, owner: str) -> None:
        angles = (self.angles,) if isinstance(self.angles, str) else tuple(self.angles)
        unknown = [a for a in angles if a not in self.state_names]
        if unknown:
            raise ValueError(f"{owner}: angles names {unknown}; expected names of states ({', '.join(self.state_names)})")
        unknown = [n for n in self.units if n not in self.names]
        if unknown:
            raise ValueError(f"{owner}: units names {unknown}; expected names of states or controls ({', '.join(self.names)})")
        self._set(angles=angles, units=dict(self.units))

    def _check_finite(self, owner: str) -> None:
        """Try f and its Jacobian at the corners' middle, the bounds and random points of the box."""
        rng = np.random.default_rng(0)
        lb, ub = np.r_[self.lbx, self.lbu], np.r_[self.ubx, self.ubu]
        z = np.vstack([lb, ub, rng.uniform(lb, ub, (N_PROBES, len(lb)))]).T
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

    @cached_property
    def f(self) -> ca.Function:
        """(x [nx], u [nu]) -> xdot [nx]."""
        return ca.Function("f", [self.x, self.u], [self.xdot], ["x", "u"], ["xdot"])

    @cached_property
    def jacobian(self) -> ca.Function:
        """(x, u) -> (A [nx, nx] = df/dx, B [nx, nu] = df/du), dense."""
        A, B = (ca.densify(ca.jacobian(self.xdot, v)) for v in (self.x, self.u))
        return ca.Function("jacobian", [self.x, self.u], [A, B], ["x", "u"], ["A", "B"])

    def linearize(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """(A, B) at (x, u), as numpy arrays [nx, nx] and [nx, nu]."""
        owner = f"{self.name}.linearize"
        A, B = self.jacobian(checks.vector(x, self.nx, "x", owner), checks.vector(u, self.nu, "u", owner))
        return A.full(), B.full()

    def wrap(self, x: ArrayLike) -> Array:
        """States [..., nx] with each declared angle brought to [-pi, pi)."""
        wrapped = np.array(x, dtype=np.float64)
        i = list(self.angle_indices)
        wrapped[..., i] = (wrapped[..., i] + np.pi) % (2 * np.pi) - np.pi
        return wrapped

    def unit(self, name: str) -> str:
        """The unit of a state or control for an axis label, like 'theta [rad]' or just 'theta'."""
        return f"{name} [{self.units[name]}]" if name in self.units else name

    def __repr__(self) -> str:
        def interval(name: str, low: float, high: float) -> str:
            return f"{name} in [{low:g}, {high:g}]" + (" (angle)" if name in self.angles else "")

        lines = [f"System {self.name!r}: {self.nx} states, {self.nu} controls"]
        lines += [f"  d {n}/dt = {e}" for n, e in zip(self.state_names, equations(self.xdot), strict=True)]
        lines.append("  X: " + ", ".join(map(interval, self.state_names, self.lbx, self.ubx)))
        lines.append("  U: " + ", ".join(map(interval, self.control_names, self.lbu, self.ubu)))
        return "\n".join(lines)


def equations(expression: ca.SX) -> list[str]:
    """Each row of an SX column as text; shared subexpressions of long ones are written as CasADi's @1, @2, ..."""
    return [str(row) for row in ca.vertsplit(expression)]


def _stack(matrix: ca.DM, columns: int) -> Array:
    """CasADi's side by side evaluations [r, c * columns] as one column each, [r * c, columns]."""
    blocks = matrix.full()
    return blocks.reshape(blocks.shape[0], columns, -1).transpose(0, 2, 1).reshape(-1, columns)
