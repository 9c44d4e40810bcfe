"""Parameters p and time t: what equations may hold besides states and controls, and how values for them are read.

A parameter is constant along a trajectory: a mass, a goal, an obstacle's place. It is a plain SX symbol; what else is
known of it, a nominal value and a unit, is kept here, so that it survives the way through columns and expressions.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nocl.definition.sampling import Distribution, box
from nocl.support import checks
from nocl.support.checks import Array

TIME = "t"
_time = ca.SX.sym(TIME)


class Known(NamedTuple):
    """What is known of a symbol. It is held here, so that no other gets its hash."""

    symbol: ca.SX
    nominal: float | None
    unit: str


_known: dict[int, Known] = {}  # by element_hash


def parameter(name: str, nominal: float | None = None, unit: str = "") -> ca.SX:
    """A new parameter, an SX symbol, for System(..., p=) or OCP(..., p=).

    nominal: the value that is meant where one is needed; default: the centre of the problem's distribution
    """
    owner = f"parameter {name!r}"
    if not isinstance(name, str) or not name.strip():
        raise ValueError(f"parameter: name is {name!r}; expected a text, like 'mass'")
    if not isinstance(unit, str):
        raise ValueError(f"{owner}: unit is {unit!r}; expected a text, like 'kg'")
    if nominal is not None:
        nominal = float(checks.vector([nominal], 1, "nominal", owner)[0])
        if not np.isfinite(nominal):
            raise ValueError(f"{owner}: nominal is {nominal}; expected a finite number, or None")
    symbol = ca.SX.sym(name)
    _known[symbol.element_hash()] = Known(symbol, nominal, unit)
    return symbol


def time() -> ca.SX:
    """The time t, always the same SX symbol: f, L and h may hold it; in G it is the horizon."""
    return ca.SX(_time)


def spline(t: Any, times: Any, values: Any) -> ca.SX:
    """The cubic spline through `values` [n] at `times` [n], n >= 2, as an SX expression in t: a reference from samples.

    values : numbers, or SX expressions such as parameters, which it is linear in; t : nocl.time(), or any expression

    In a state it is a table look-up, C^2; a table of two variables is a spline of splines: spline(x, xs, [spline(y, ys,
    row) for row in values]).

    Its second derivative is continuous, the third one also at the second and the last but one of `times` (not-a-knot);
    before the first and after the last time the outermost cubic goes on. Raises ValueError for times that do not rise.
    """
    from scipy.interpolate import CubicSpline  # which takes longer to import than all of nocl

    nodes, column = checks.numeric(times, "times", "spline", "rising numbers [n]"), checks.column(values)
    if nodes.ndim != 1 or len(nodes) < 2 or not (np.isfinite(nodes).all() and (np.diff(nodes) > 0).all()):
        raise ValueError(f"spline: times is {checks.shown(times)}; expected at least two finite numbers that rise")
    if not isinstance(column, (ca.SX, ca.DM)):
        column = ca.DM(checks.vector(values, len(nodes), "values", "spline"))
    if column.shape != (len(nodes), 1):
        raise ValueError(f"spline: values has shape {column.shape}; expected one for each of the {len(nodes)} times")
    span = nodes[-1] - nodes[0]
    s, knots = (t - nodes[0]) / span, (nodes - nodes[0]) / span
    cubic, square, slope, start = (ca.DM(c) @ column for c in CubicSpline(knots, np.eye(len(nodes))).c)
    value = start[0] + s * (slope[0] + s * (square[0] + s * cubic[0]))
    for i in range(1, len(nodes) - 1):
        value += (cubic[i] - cubic[i - 1]) * ca.fmax(s - knots[i], 0) ** 3
    return ca.SX(value)


def nominal_of(p: ca.SX) -> Array:
    """The nominal values of a column of parameters [np], NaN where none was given."""
    given = [_known.get(s.element_hash()) for s in ca.vertsplit(p)]
    return np.array([np.nan if k is None or k.nominal is None else k.nominal for k in given], dtype=np.float64)


def units_of(p: ca.SX) -> dict[str, str]:
    """The units of a column of parameters by name, of those that have one."""
    given = [_known.get(s.element_hash()) for s in ca.vertsplit(p)]
    return {k.symbol.name(): k.unit for k in given if k is not None and k.unit}


def names_of(p: ca.SX) -> tuple[str, ...]:
    return tuple(s.name() for s in ca.vertsplit(p))


def column(p: Any, owner: str) -> ca.SX:
    """A user's parameters as one frozen SX column, empty for None."""
    p = checks.column(p)
    if p is None or (isinstance(p, ca.SX) and p.is_empty()):
        return checks.FrozenSX(ca.SX(0, 1))
    parts = checks.symbols(p, "p", owner)
    if any(ca.is_equal(part, _time) for part in parts):
        raise ValueError(f"{owner}: p contains the time nocl.time(), expected parameters only: use t in the "
                         "expressions as it is")
    return checks.FrozenSX(ca.vertcat(*parts))


def to_data(p: ca.SX) -> list[dict[str, Any]]:
    """A column of parameters as plain JSON data: names, nominal values as hex floats, units."""
    units = units_of(p)
    return [{"name": name, "nominal": None if np.isnan(value) else float(value).hex(), "unit": units.get(name, "")}
            for name, value in zip(names_of(p), nominal_of(p), strict=True)]


def from_data(data: Sequence[Mapping[str, Any]]) -> ca.SX:
    """New parameters, those that to_data wrote."""
    made = [parameter(one["name"], None if one["nominal"] is None else float.fromhex(one["nominal"]), one["unit"])
            for one in data]
    return ca.vertcat(ca.SX(0, 1), *made)


def rows(p: Any, names: Sequence[str], B: int, owner: str, distribution: Distribution | None = None) -> Array:
    """A user's values of the parameters `names` as rows [B, np].

    p : [np], for all; [B, np], one for each; or a dict from names to numbers or [B]; None where there are none
    distribution : where they are usual; values outside its box are warned of

    Raises ValueError for missing, unknown and non-finite values and wrong shapes.
    """
    wanted = ", ".join(names)
    if not names:
        if p is not None and np.size(list(p.values()) if isinstance(p, Mapping) else p):
            raise ValueError(f"{owner}: got p = {checks.shown(p)}, but the problem has no parameters: leave p out, or "
                             "declare them, System(..., p=) or OCP(..., p=)")
        return np.zeros((B, 0))
    if p is None:
        raise ValueError(f"{owner}: p is missing; expected values of {wanted}: pass p=[...], one row [{len(names)}] "
                         f"for all or one for each state, or p={{{names[0]!r}: ...}}")
    values = _by_name(p, names, B, owner) if isinstance(p, Mapping) else _by_order(p, names, B, owner)
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, i = bad[0]
        raise ValueError(f"{owner}: p has {names[i]} = {values[row, i]} in row {row}; expected finite numbers: repair "
                         "or leave out that row")
    if distribution is not None:
        _warn_outside(values, names, distribution, owner)
    return values


def _numbers(value: Any, what: str, owner: str) -> Array:
    try:
        return checks.real(value)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{owner}: {what} is {checks.shown(value)}; expected numbers: {error}") from None


def _by_name(p: Mapping[str, Any], names: Sequence[str], B: int, owner: str) -> Array:
    missing, unknown = [n for n in names if n not in p], [n for n in p if n not in names]
    if missing or unknown:
        wrong = " and ".join(f"{what} {', '.join(map(str, these))}"
                             for what, these in (("lacks", missing), ("has the unknown", unknown)) if these)
        raise ValueError(f"{owner}: p {wrong}; expected values of {', '.join(names)}: name each of them, and no other")
    columns = [_numbers(p[n], f"p[{n!r}]", owner) for n in names]
    for name, value in zip(names, columns, strict=True):
        if value.shape not in ((), (1,), (B,)):
            raise ValueError(f"{owner}: p[{name!r}] has shape {value.shape}; expected a number, or one for each of the "
                             f"{B} states")
    return np.stack([np.broadcast_to(value, B) for value in columns], axis=1)


def _by_order(p: Any, names: Sequence[str], B: int, owner: str) -> Array:
    array, n = _numbers(p, "p", owner), len(names)
    if array.shape == () and n == 1:
        array = array[None]
    if array.shape not in ((n,), (1, n), (B, n)):
        raise ValueError(f"{owner}: p has shape {array.shape}; expected [{n}] or [{B}, {n}], the values of "
                         f"{', '.join(names)} in this order: one row for all states, or one for each")
    return np.broadcast_to(array, (B, n)).copy()


def _warn_outside(values: Array, names: Sequence[str], distribution: Distribution, owner: str) -> None:
    low, high = box(distribution)
    slack = 1e-9 * np.maximum(np.abs(low), np.abs(high))
    for i in map(int, np.flatnonzero(((values < low - slack) | (values > high + slack)).any(axis=0))):
        outside = np.where(values[:, i] < low[i], low[i] - values[:, i], values[:, i] - high[i])
        warnings.warn(f"{owner}: extrapolation: {names[i]} = {values[np.argmax(outside), i]:.6g} is outside "
                      f"[{low[i]:.6g}, {high[i]:.6g}], where the problem's `parameters` lie", UserWarning, stacklevel=4)
