"""What a trajectory must hold: low <= e(x, u, t, p) <= high along it, low <= e(x, p) <= high at its end.

A user's forms become a `Constraint` each; those of a problem become `Rows` for solvers: c >= 0, or c = 0, one a row.

Their units say nothing: a metre, or its square. So each constraint has a scale, which violations, margins and
tolerances are shares of. Where the user gives none, the scale of an inequality is how deep its forbidden set is in
X x U, max -c, or, where that is less, how large |c| is where the problem takes place, at (x*, u*) and at initial states
under u*: 1 % of a pillar's radius, 1 % of the distance to a wall. Of two sides the smaller one counts, and half their
distance. At the end of a trajectory the problem takes place at x*. The scale of an equation is the largest |c| in
X x U.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.system import System
from nocl.support import checks
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

SAMPLES = 4096  # of X x U
LOWEST = 4  # samples from which a minimum of c is descended to
TOLERANCE = 1e-3  # of a constraint's scale: a run that violates it by more has failed
NEVER = 1e-9  # of the spread of c over X x U: less deep than that is never violated there
TRIED = 512  # samples at which a constraint is tried on construction: whether it can hold at all
PATH, ALONG, BOUND, END = "path constraint", "constraint", "state bound", "terminal constraint"  # in messages
FORM = "an expression, which is held >= 0, or (low, expression, high), None for no bound, low = high for an equation"

Places = dict[str, Array]  # x [n, nx], u [n, nu], t [n], p [n, np]
Measure = Callable[[], tuple[Array, Array]]  # the scales of the rows along a trajectory, and of those at its end


def limit_rates(system: System, rates: Mapping[str, float]) -> System:
    """The system with each named control u as a state, behind the others, and its rate as the control: |du/dt| <= rate.

    u keeps its symbol, so that costs are written as before, and moves in straight lines where its rate is held, in
    discrete time by dt times its rate in a step. Its
    bounds are a constraint of states now: nocl.OCP(..., state_bounds={"u": (low, high)}). Initial states and goals have
    it as a coordinate. Raises ValueError for names of no control, and for rates that are no positive numbers.
    """
    checks.instance(System, system, "system", "limit_rates", "of an OCP, pass ocp.system")
    if not isinstance(rates, Mapping) or not rates or any(name not in system.control_names for name in rates):
        raise ValueError(f"limit_rates: rates is {checks.shown(rates)}; expected a dict from names of controls "
                         f"({', '.join(system.control_names)}) to the largest rate of each")
    most = {name: checks.number(rate, f"the rate of {name}", "limit_rates", positive=True)
            for name, rate in rates.items()}
    parts = {name: (u, low, high) for name, u, low, high in
             zip(system.control_names, ca.vertsplit(system.arguments["u"]), system.lbu, system.ubu, strict=True)}
    slow = [parts[name] for name in most]
    fresh = {name: (ca.SX.sym(f"{name}_rate"), -most[name], most[name]) if name in most else part
             for name, part in parts.items()}
    u, lbu, ubu = zip(*fresh.values(), strict=True)
    at, x = system.arguments, ca.vertcat(system.arguments["x"], *(part[0] for part in slow))
    rate = ca.vertcat(*(fresh[name][0] for name in most))
    if system.dt is None:
        right: dict[str, Any] = {"xdot": ca.vertcat(at.call(system.f), rate)}
    else:
        moved = x[system.nx:, :] + system.dt * rate
        right = {"xdot": None, "x_next": ca.vertcat(at.call(system.F), moved), "dt": system.dt}
    return System(f"{system.name}_rates", x=x, u=ca.vertcat(*u), **right, lbu=lbu, ubu=ubu,
                  lbx=np.r_[system.lbx, [part[1] for part in slow]], ubx=np.r_[system.ubx, [part[2] for part in slow]],
                  p=at.symbols.get("p"), z=system.z, alg=system.alg, z_guess=system.z_guess,
                  angles=system.angles, units=dict(system.units))


@dataclass(frozen=True)
class Free:
    """A horizon to be found, low <= T <= high, in the system's unit of time: nocl.OCP(..., horizon=nocl.Free(0.5, 10)).

    With running=1.0 the cost is T: minimum time.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, checks.number(getattr(self, name), name, "Free", positive=True))
        if not self.low < self.high:
            raise ValueError(f"Free: low is {self.low:g}, high is {self.high:g}; expected low < high: swap or widen "
                             "them, or give a number as horizon")

    def __repr__(self) -> str:
        return f"Free({self.low:g}, {self.high:g})"


@dataclass(frozen=True)
class Infinite:
    """A horizon without an end: what runs for ever, and costs nothing at the goal."""

    def __repr__(self) -> str:
        return "INFINITE"


INFINITE = Infinite()


class Within(NamedTuple):
    """low <= expression <= high, +-inf for no bound; what OCP.constraints holds, and takes again."""

    low: float
    expression: ca.SX
    high: float


@dataclass(frozen=True, eq=False)
class Constraint:
    """One of a problem's."""

    name: str
    kind: str  # PATH, ALONG, BOUND or END
    low: float
    expression: ca.SX
    high: float

    @property
    def title(self) -> str:
        return f"{self.kind} {self.name!r}"

    @property
    def equal(self) -> bool:
        return self.low == self.high

    @property
    def width(self) -> float:
        """Half the distance of two bounds; inf for one, or for an equation."""
        return math.inf if self.equal else (self.high - self.low) / 2

    def sides(self) -> Iterator[tuple[str, ca.SX]]:
        """("low" or "high", c >= 0), or ("equal", c = 0)."""
        low, e, high = self.low, self.expression, self.high
        if self.equal:
            yield "equal", e - low if low else e
            return
        if low > -math.inf:
            yield "low", e - low if low else e  # what is >= 0 stays as it was written
        if high < math.inf:
            yield "high", high - e

    def text(self, shown: str) -> str:
        """In words, the expression being `shown`: -0.5 <= x <= 0.5."""
        if self.equal:
            return f"{shown} = {self.low:g}"
        if self.high == math.inf:
            return f"{shown} >= {self.low:g}"
        return f"{shown} <= {self.high:g}" if self.low == -math.inf else f"{self.low:g} <= {shown} <= {self.high:g}"


@dataclass(frozen=True, eq=False)
class Rows:
    """Constraints as solvers take them: c >= 0, or c = 0 where `equal`, one a row, in the users' own units.

    In this order: inequalities of (x, t, p), which are h; equations of (x, t, p); and rows that hold the control.
    """

    column: ca.SX  # [m]
    of: tuple[Constraint, ...]  # [m], each row's constraint; two rows for one with two sides
    sides: tuple[str, ...]  # [m], "low", "high" or "equal"
    of_u: NDArray[np.bool_]  # [m], whether it depends on the control

    @staticmethod
    def made(constraints: Sequence[Constraint], u: ca.SX) -> Rows:
        found = [(bool(ca.depends_on(c, u)), side, one, c) for one in constraints for side, c in one.sides()]
        found.sort(key=lambda row: (row[0], row[1] == "equal" and not row[0]))  # stable: as they were written
        column = ca.densify(ca.vertcat(ca.SX(0, 1), *(c for *_, c in found)))
        return Rows(column, tuple(one for _, _, one, _ in found), tuple(side for _, side, _, _ in found),
                    np.array([of_u for of_u, *_ in found], dtype=bool))

    def __len__(self) -> int:
        return len(self.of)

    def __getitem__(self, some: slice) -> Rows:
        return Rows(self.column[some, :], self.of[some], self.sides[some], self.of_u[some])

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(one.name for one in self.of)

    @property
    def equal(self) -> NDArray[np.bool_]:
        """[m], which are equations."""
        return np.array([side == "equal" for side in self.sides], dtype=bool)

    @property
    def n_h(self) -> int:
        """How many are inequalities of (x, t, p): the first ones."""
        return int((~self.of_u & ~self.equal).sum())

    @property
    def n_x(self) -> int:
        """How many are of (x, t, p): the first ones."""
        return int((~self.of_u).sum())

    def title(self, i: int) -> str:
        """A row's constraint, as messages name it."""
        return self.of[i].title

    def signed(self, values: Array) -> Array:
        """Values of the rows [m, ...] as what is >= 0 where they hold: -|c| of equations."""
        return np.where(self.equal.reshape(-1, *[1] * (values.ndim - 1)), -np.abs(values), values)


def read(given: Any, field: str, kind: str, owner: str, allowed: ca.SX, controls: ca.SX | None,
         time: ca.SX) -> Mapping[str, Within]:
    """A user's constraints by name, each in the form `FORM`; ValueError otherwise.

    allowed : the symbols that they may hold beside the time; controls: those that a user might well put there although
        they are not allowed
    """
    _check_names(given, field, owner, "expressions, {'wall': 2 - x[0]}, or (low, expression, high)")
    found = {}
    for name, one in given.items():
        what = f"{kind} {name!r}"
        low, e, high = one if isinstance(one, (tuple, list)) and len(one) == 3 else (0.0, one, None)
        if isinstance(one, (tuple, list)) and len(one) != 3:
            raise ValueError(f"{owner}: {what} is {checks.shown(one)}; expected {FORM}")
        expression = checks.expression(e, 1, allowed, what, owner, controls, time=time)
        found[name] = Within(*_bounds(low, high, what, owner, expression))
    return MappingProxyType(found)


def read_paths(given: Any, owner: str, allowed: ca.SX, controls: ca.SX, time: ca.SX) -> Mapping[str, ca.SX]:
    """A user's path constraints by name, expressions of (x, t, p) that are >= 0 where they hold."""
    if not isinstance(given, Mapping) or not all(isinstance(n, str) for n in given):
        raise ValueError(f"{owner}: path_constraints is {given!r}; expected a dict from names to "
                         "expressions that are >= 0 where they hold, {'wall': 2 - p}")
    return MappingProxyType({name: checks.expression(h, 1, allowed, f"{PATH} {name!r}", owner, controls, time=time)
                             for name, h in given.items()})


def read_bounds(given: Any, owner: str, states: Sequence[str]) -> Mapping[str, tuple[float, float]]:
    """A user's bounds of states by name, (low, high); ValueError otherwise."""
    _check_names(given, "state_bounds", owner, "(low, high), {'v': (-2, 2)}, None for no bound")
    found = {}
    for name, pair in given.items():
        what = f"{BOUND} {name!r}"
        if name not in states:
            raise ValueError(f"{owner}: state_bounds has {name!r}; expected names of states ({', '.join(states)}): "
                             "constraints= takes expressions")
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise ValueError(f"{owner}: {what} is {checks.shown(pair)}; expected (low, high), None for no bound")
        low, _, high = _bounds(pair[0], pair[1], what, owner, None)
        if low == high:
            raise ValueError(f"{owner}: {what} is ({low:g}, {high:g}); expected low < high: a state that never moves "
                             "is a parameter")
        found[name] = (low, high)
    return MappingProxyType(found)


def read_scales(given: Any, owner: str, names: Sequence[str]) -> Mapping[str, float]:
    """A user's scales of constraints by name; ValueError otherwise."""
    _check_names(given, "scales", owner, "numbers > 0 in the constraint's own unit, {'track': 0.1}")
    for name in given:
        if name not in names:
            raise ValueError(f"{owner}: scales has {name!r}; expected names of constraints "
                             f"({', '.join(names) or 'there are none'})")
    return MappingProxyType({name: checks.number(size, f"scales[{name!r}]", owner, positive=True)
                             for name, size in given.items()})


def check_unique(constraints: Sequence[Constraint], owner: str) -> None:
    """ValueError where two constraints have one name."""
    seen: dict[str, Constraint] = {}
    for one in constraints:
        if one.name in seen:
            raise ValueError(f"{owner}: {seen[one.name].title} and {one.title} have one name; expected each its own, "
                             "by which scales, soft constraints and messages know it: rename one")
        seen[one.name] = one


def _check_names(given: Any, field: str, owner: str, what: str) -> None:
    if not isinstance(given, Mapping) or not all(isinstance(n, str) and n.strip() for n in given):
        raise ValueError(f"{owner}: {field} is {checks.shown(given)}; expected a dict from names to {what}")


def _bounds(low: Any, high: Any, what: str, owner: str, expression: Any) -> tuple[float, Any, float]:
    """(low, expression, high) as floats, +-inf for no bound."""
    low, high = _bound(low, -math.inf, what, owner), _bound(high, math.inf, what, owner)
    if low == -math.inf and high == math.inf:
        raise ValueError(f"{owner}: {what} has neither a low nor a high bound; expected one at least: leave it out")
    if not low <= high or low == math.inf or high == -math.inf:
        raise ValueError(f"{owner}: {what} is to lie between {low:g} and {high:g}, which nothing does; "
                         "expected low <= high: swap them")
    return low, expression, high


def _bound(value: Any, none: float, what: str, owner: str) -> float:
    if value is None:
        return none
    if isinstance(value, (ca.SX, ca.MX)):
        raise ValueError(f"{owner}: a bound of {what} is the expression {checks.shown(value)}; expected a number: "
                         "write its two sides as constraints of their own, e - low and high - e, each >= 0")
    found = checks.finite(value)
    infinite = isinstance(value, (float, np.floating)) and math.isinf(value)
    if found is None and not infinite:
        raise ValueError(f"{owner}: a bound of {what} is {checks.shown(value)}; expected a number, or None for none")
    return float(value)


def sizes(rows: Rows, at: Arguments, box: Places, place: Places, bounds: tuple[Array, Array]) -> Array:
    """The scale of each row alone [m] > 0.

    at : the arguments of the rows, z the first of them: x, or x and u
    box : points of X x U, with times and parameters; place: points where the problem takes place
    bounds : (lower, upper) of z
    """
    if not len(rows):
        return np.zeros(0)
    column = at.function("h", {"h": rows.column})
    c, near = (_finite(column(*at.columns(**points)).full()) for points in (box, place))
    search = _Search(rows, at, box, bounds)
    return np.array([_equation(c[i]) if rows.sides[i] == "equal" else
                     _size(-search.lowest(i, c[i]), c[i], np.abs(near[i]).max()) for i in range(len(c))])


def _size(depth: float, c: Array, near: float) -> float:
    spread = float(np.ptp(c))
    found = [size for size in (depth if depth > NEVER * spread else spread, near) if size > 0]
    return min(found, default=1.0)


def _equation(c: Array) -> float:
    return float(np.abs(c).max()) or 1.0


def check_possible(rows: Rows, at: Arguments, box: Places, bounds: tuple[Array, Array], owner: str) -> None:
    """ValueError for a row that holds nowhere in the box; arguments as in `sizes`."""
    if not len(rows):
        return
    c = _finite(at.function("h", {"h": rows.column})(*at.columns(**box)).full())
    search = _Search(rows, at, box, bounds)
    for i, side in enumerate(rows.sides):
        for sign in (1, -1) if side == "equal" else (1,):
            if (sign * c[i] >= 0).any():
                continue
            most = -search.lowest(i, -sign * c[i], -sign)
            if most < min(-NEVER * float(np.ptp(c[i])), 0.0):
                one, value = rows.of[i], sign * most
                e = value + one.low if side != "high" else one.high - value
                what = "at the end of a trajectory, x in X" if one.kind == END else "in X x U"
                raise ValueError(f"{owner}: {one.title}, {one.text('e')}, holds nowhere {what}: the nearest e there is "
                                 f"{e:g}; expected one that can be held: move its bounds, or widen lbx, ubx, lbu, ubu")


class _Search:
    """The least values of rows in a box, by descent from the lowest samples: a thin obstacle lies between samples."""

    def __init__(self, rows: Rows, at: Arguments, box: Places, bounds: tuple[Array, Array]) -> None:
        self.at, self.box, self.bounds = at, box, list(zip(*bounds, strict=True))
        self.names = [name for name in ("x", "u") if name in at.names]
        z = ca.vertcat(*(at[name] for name in self.names))
        self.slopes = at.function("slopes", {"h": rows.column, "h_z": ca.jacobian(rows.column, z)})
        self.z = np.hstack([box[name] for name in self.names])
        self.ends = np.cumsum([box[name].shape[1] for name in self.names])[:-1]

    def lowest(self, i: int, c: Array, sign: int = 1) -> float:
        """min of sign * c_i; c: its values at the samples."""
        from scipy.optimize import minimize  # heavy

        def value(z: Array, k: int) -> tuple[float, Array]:
            parts = dict(zip(self.names, np.split(z, self.ends), strict=True))
            moment = {name: self.box[name][k] for name in self.at.names if name not in self.names}
            values, slopes = self.slopes(*self.at.columns(**moment, **parts))
            return sign * float(values[i]), sign * np.asarray(slopes[i, :]).ravel()

        found = [minimize(value, self.z[k], args=(k,), jac=True, method="L-BFGS-B", bounds=self.bounds).fun
                 for k in np.argsort(c)[:LOWEST]]
        return float(np.nanmin([c.min(), *found]))


def joined(rows: Rows, each: Array, given: Mapping[str, float]) -> Array:
    """The scale of each row's constraint [m]: the one that was given, or the smaller one of its rows alone."""
    least: dict[str, float] = {}
    for one, size in zip(rows.of, each, strict=True):
        least[one.name] = min(least.get(one.name, one.width), float(size))
    return np.array([given.get(name, least[name]) for name in rows.names], dtype=np.float64)


def _finite(c: Array) -> Array:
    return np.where(np.isfinite(c), c, 0.0)
