"""Checks shared by everything that takes a user's input: each error says got, expected, remedy."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
MALFORMED = (KeyError, IndexError, TypeError, AttributeError, NotImplementedError, RuntimeError, RecursionError,
             OverflowError, MemoryError)  # what data of another form than expected raises on its way through a reader
Vector = Any  # a field that takes what a user writes (a list, an array) and holds a read-only Array


def real(value: ArrayLike) -> Array:
    """`value` as a new float64 array; ValueError, saying why, for what numpy would turn into numbers without a word."""
    array = value if isinstance(value, np.ndarray) else np.asarray(value)
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError("is a masked array, whose masked entries would count: fill or drop them")
    if array.dtype.kind not in "iuf" and not (array.dtype.kind == "O" and all(map(_is_real, array.flat))):
        raise ValueError(f"holds {_kind(array)}, not numbers: convert it")
    return np.array(array, dtype=np.float64)


def _is_real(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _kind(array: Any) -> str:
    if array.dtype.kind == "O":
        return ", ".join(sorted({type(v).__name__ for v in array.flat if not _is_real(v)}))
    return {"b": "True and False", "c": "complex numbers", "U": "text", "S": "bytes", "M": "dates",
            "m": "spans of time"}.get(array.dtype.kind, str(array.dtype))


def shown(value: Any, most: int = 120) -> str:
    """repr, cut off where it is long: errors are to be read."""
    text = " ".join(repr(value).split())
    return text if len(text) <= most else f"{text[:most]} ..."


def vector(value: ArrayLike, n: int, name: str, owner: str) -> Array:
    """A read-only float64 vector of length n without NaN; raises ValueError otherwise."""
    try:
        array = real(value)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{owner}: {name} is {shown(value)}, which {_why(error)}; expected {n} numbers: pass a list "
                         "of floats") from None
    if array.shape != (n,):
        raise ValueError(f"{owner}: {name} has shape {array.shape}, expected ({n},): pass one number per coordinate")
    if np.isnan(array).any():
        raise ValueError(f"{owner}: {name} is {array.tolist()}; expected numbers, got NaN: check how it was computed")
    array.setflags(write=False)
    return array


def weight(value: ArrayLike, n: int, name: str, owner: str) -> Array:
    """A weight of a quadratic cost as a symmetric positive semidefinite [n, n], from a number, diagonal or matrix."""
    try:
        array = real(value)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{owner}: the weight {name} is {shown(value)}, which {_why(error)}; expected a number, "
                         f"[{n}] or [{n}, {n}]") from None
    matrix = array * np.eye(n) if array.shape in ((), (n,)) else array
    if matrix.shape != (n, n):
        raise ValueError(f"{owner}: the weight {name} has shape {array.shape}; expected a number, [{n}] or [{n}, {n}]")
    if not np.isfinite(matrix).all() or not np.array_equal(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] < -1e-12:
        raise ValueError(f"{owner}: the weight {name} is {array.tolist()}; expected a symmetric positive semidefinite "
                         "matrix of finite numbers, so that the cost has a minimum at the goal")
    return matrix


def bounds(lower: ArrayLike, upper: ArrayLike, n: int, names: tuple[str, str], owner: str,
           coordinates: Sequence[str]) -> tuple[Array, Array]:
    """Finite bounds with lower < upper in each coordinate; raises ValueError naming the first coordinate that fails."""
    lb, ub = vector(lower, n, names[0], owner), vector(upper, n, names[1], owner)
    for i, coordinate in enumerate(coordinates):
        if not (np.isfinite(lb[i]) and np.isfinite(ub[i])):
            raise ValueError(f"{owner}: {coordinate} is in [{lb[i]}, {ub[i]}]; expected finite bounds: "
                             f"give {names[0]} and {names[1]} the largest values that make sense")
        if not lb[i] < ub[i]:
            raise ValueError(f"{owner}: {coordinate} is in [{lb[i]}, {ub[i]}], an empty interval; "
                             f"expected {names[0]} < {names[1]}: swap or widen them")
    return lb, ub


class FrozenSX(ca.SX):
    """An SX that cannot be edited in place; what is computed from it is plain SX."""

    def _refuse(self, *_: Any) -> Any:
        raise TypeError("this expression belongs to a nocl.System or nocl.OCP and cannot be changed: "
                        "edit a copy, ca.SX(...), and build a new one")

    __setitem__: Any = _refuse
    set: Any = _refuse
    set_nz: Any = _refuse
    clear: Any = _refuse
    enlarge: Any = _refuse
    erase: Any = _refuse
    remove: Any = _refuse
    resize: Any = _refuse


def column(value: Any) -> Any:
    """A list or tuple of SX as one SX column, other things as they are."""
    if isinstance(value, (list, tuple)) and value and all(isinstance(v, (ca.SX, int, float)) for v in value):
        return ca.vertcat(*value)
    return value


def number(value: Any, name: str, owner: str, positive: bool = False) -> float:
    """A finite number >= 0 (> 0 where `positive`) as a float; raises ValueError otherwise."""
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not real or not np.isfinite(value) or value < 0 or (positive and value == 0):
        expected = "positive number" if positive else "number >= 0"
        raise ValueError(f"{owner}: {name} is {value!r}; expected a finite {expected}")
    return float(value)


def symbols(value: Any, name: str, owner: str) -> list[ca.SX]:
    """The scalar symbols of a column of SX symbols; raises ValueError for anything else."""
    if not isinstance(value, ca.SX):
        raise ValueError(f"{owner}: {name} is a {type(value).__name__}; expected casadi.SX symbols: "
                         f"use ca.SX.sym(...) (MX is not accepted)")
    if value.is_empty() or not value.is_column():
        raise ValueError(f"{owner}: {name} has shape {value.shape}, expected a column of symbols: use ca.vertcat(...)")
    parts = ca.vertsplit(ca.densify(value))
    for i, part in enumerate(parts):
        if not part.is_symbolic():
            raise ValueError(f"{owner}: {name}[{i}] is the expression {part}; expected a plain symbol ca.SX.sym(...)")
        if not part.name().strip():
            raise ValueError(f"{owner}: {name}[{i}] is a symbol without a name; expected one, ca.SX.sym('theta')")
    return parts


def expression(value: Any, rows: int, allowed: ca.SX, name: str, owner: str, controls: ca.SX | None = None,
               time: ca.SX | None = None) -> ca.SX:
    """A dense SX column of `rows` entries in the allowed symbols only; raises ValueError otherwise.

    `controls` are symbols that a user might well put there although they are not allowed: the error explains it.
    `time` is the symbol of time, which is allowed where it is given.
    """
    if isinstance(value, (numbers.Real, ca.DM)):
        value = ca.SX(value if isinstance(value, ca.DM) else float(value))
    if not isinstance(value, ca.SX):
        raise ValueError(f"{owner}: {name} is a {type(value).__name__}; expected a casadi.SX expression: "
                         f"build it from the system's SX symbols (MX is not accepted)")
    if value.shape != (rows, 1):
        raise ValueError(f"{owner}: {name} has shape {value.shape}, expected ({rows}, 1): "
                         f"{'one row per state, by ca.vertcat(...)' if rows > 1 else 'a scalar expression'}")
    own = allowed if time is None else ca.vertcat(allowed, time)
    free = [s for s in ca.symvar(value) if not ca.depends_on(s, own)]
    used = [s.name() for s in free if controls is not None and ca.depends_on(s, controls)]
    if used:
        raise ValueError(f"{owner}: {name} contains the control(s) {', '.join(used)}, expected the states only: bound "
                         f"controls by the system's lbu and ubu, and weigh them in the running cost")
    if free:
        names = ", ".join(sorted(s.name() for s in free))
        known = ", ".join(s.name() for s in ca.symvar(allowed))
        raise ValueError(f"{owner}: {name} contains the symbol(s) {names}, expected only the system's own ({known}): "
                         f"put a number in their place, or use the very symbols given to the System, not new "
                         f"ones of the same name; a parameter is declared, System(..., p=) or OCP(..., p=), and time "
                         f"is nocl.time()")
    return FrozenSX(ca.densify(value))


def problem(ocp: Any, owner: str) -> None:
    """Raises ValueError for what is no nocl.OCP."""
    if not (hasattr(ocp, "system") and hasattr(ocp, "initial_states")):
        raise ValueError(f"{owner}: the problem is a {type(ocp).__name__}; expected a nocl.OCP: "
                         "nocl.OCP(system, ...) or nocl.load_ocp(name)")


def _why(error: Exception) -> str:
    """What `real` said, or that numpy could make no array of it."""
    text = str(error)
    return text if text.startswith(("is a masked", "holds ")) else "makes no array of numbers"


def states(x: ArrayLike, nx: int, owner: str, name: str = "x0") -> tuple[Array, bool]:
    """States as float64 rows [B, nx], and whether a single [nx] was given; NaN and other shapes raise ValueError."""
    if hasattr(x, "columns") and hasattr(x, "dtypes"):  # a table: which column is which is not for numpy to guess
        raise ValueError(f"{name} is a {type(x).__name__} with columns {shown(list(x.columns))}; expected an array "
                         f"[{nx}] or [B, {nx}]: pick the columns in {owner}'s order, table[[...]].to_numpy()")
    try:
        array = real(x)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{name} is {shown(x)}, which {_why(error)}; {owner} has nx = {nx}: pass numbers [nx] or "
                         "[B, nx]") from None
    single = array.ndim == 1
    rows = array[None, :] if single else array
    if rows.ndim != 2 or rows.shape[1] != nx:
        raise ValueError(f"{name} has shape {array.shape}; {owner} has nx = {nx}: pass [{nx}] or [B, {nx}]")
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise ValueError(f"{name}[{bad}] is {rows[bad].tolist()}; expected finite numbers: remove or repair that state")
    return rows, single
