"""Checks shared by everything that takes a user's input: each error says got, expected, remedy."""

from __future__ import annotations

import math
import numbers
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
MALFORMED = (KeyError, IndexError, TypeError, AttributeError, NotImplementedError, RuntimeError, RecursionError,
             OverflowError, MemoryError)  # what data of another form than expected raises on its way through a reader
LARGEST = 10**9  # whole number that counts something: more is a mistake, and does not fit into memory
ORDINARY = 1e150  # squares of larger numbers overflow
PUBLIC = ("System", "OCP", "Dataset", "Log")  # kinds that are known by nocl's name
Vector = Any  # a field that takes what a user writes (a list, an array) and holds a read-only Array


def real(value: ArrayLike, copy: bool = True) -> Array:
    """`value` as a float64 array, a new one where `copy`.

    Raises ValueError, saying why, for what numpy would turn into numbers without a word.
    """
    if isinstance(value, (bytes, bytearray, memoryview)):  # of a bytearray numpy takes the codes of its letters
        raise ValueError("holds bytes, not numbers: convert it")
    array = value if isinstance(value, np.ndarray) else np.asarray(value)
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError("is a masked array, whose masked entries would count: fill or drop them")
    if array.dtype.kind not in "iuf" and not (array.dtype.kind == "O" and all(map(_is_real, array.flat))):
        raise ValueError(f"holds {_kind(array)}, not numbers: convert it")
    return np.array(array, dtype=np.float64, copy=copy or None)


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


def numeric(value: ArrayLike, name: str, owner: str, expected: str, copy: bool = True) -> Array:
    """`value` as a float64 array of any shape; ValueError, with what was expected, where it is none."""
    if hasattr(value, "columns") and hasattr(value, "dtypes"):  # which column is which is not for numpy to guess
        raise ValueError(f"{owner}: {name} is a {type(value).__name__} with columns {shown(list(value.columns))}; "
                         f"expected {expected}: pick the columns in order, table[[...]].to_numpy()")
    try:
        return real(value, copy)
    except Exception as error:  # whatever its own conversion raises
        raise ValueError(f"{owner}: {name} is {shown(value)}, which {_why(error)}; expected {expected}") from None


def array(value: ArrayLike, shape: Sequence[int | None], name: str, owner: str) -> Array:
    """Finite numbers of a shape, float64, not copied where they are; None: any length. ValueError otherwise."""
    text = "[" + ", ".join("N" if n is None else str(n) for n in shape) + "]" if shape else "a number"
    found = numeric(value, name, owner, f"finite numbers {text}" if shape else text, copy=False)
    if len(found.shape) != len(shape) or any(n not in (None, m) for n, m in zip(shape, found.shape, strict=True)):
        raise ValueError(f"{owner}: {name} has shape {found.shape}; expected {text}")
    if not np.isfinite(found).all():
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(found))[0])
        raise ValueError(f"{owner}: {name}{list(at) if at else ''} is {found[at]}; expected finite numbers: check how "
                         "it was computed")
    return found


def vector(value: ArrayLike, n: int, name: str, owner: str) -> Array:
    """A read-only float64 vector of length n without NaN; raises ValueError otherwise."""
    array = numeric(value, name, owner, f"{n} numbers: pass a list of floats")
    if array.shape != (n,):
        raise ValueError(f"{owner}: {name} has shape {array.shape}, expected ({n},): pass one number per coordinate")
    if np.isnan(array).any():
        raise ValueError(f"{owner}: {name} is {array.tolist()}; expected numbers, got NaN: check how it was computed")
    array.setflags(write=False)
    return array


def weight(value: ArrayLike, n: int, name: str, owner: str) -> Array:
    """A weight of a quadratic cost as a symmetric positive semidefinite [n, n], from a number, diagonal or matrix."""
    array = numeric(value, f"the weight {name}", owner, f"a number, [{n}] or [{n}, {n}]")
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
    found = finite(value)
    if found is None or found < 0 or (positive and found == 0):
        expected = "positive number" if positive else "number >= 0"
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected a finite {expected}")
    return found


def finite(value: Any) -> float | None:
    """A finite real number, also as a numpy scalar, as a float; None for anything else."""
    if not _is_real(value):
        return None
    try:
        found = float(value)
    except (OverflowError, ValueError):
        return None
    return found if math.isfinite(found) else None


def between(value: Any, low: float, high: float, name: str, owner: str, what: str = "") -> float:
    """A number in [low, high] as a float; ValueError otherwise, where `what` says what the range is."""
    found = finite(value)
    if found is None or not low <= found <= high:
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected a number in [{low:g}, {high:g}]{what}")
    return found


def start_time(t0: Any, horizon: float, owner: str = "") -> float:
    """A time at which a problem can start; ValueError otherwise."""
    found = finite(t0)
    if found is None or not 0 <= found < horizon:
        raise ValueError(f"{owner}{': ' * bool(owner)}t0 is {shown(t0)}; expected 0 <= t0 < {horizon:g}, the horizon")
    return found


def whole(value: Any, name: str, owner: str, least: int = 0, most: int = LARGEST) -> int:
    """A whole number from `least` to `most` as an int; ValueError otherwise."""
    found = int(value) if isinstance(value, (int, np.integer)) and not isinstance(value, bool) else None
    if found is None or not least <= found <= most:
        limit = f", at most {most:g}" if found is not None and found > most else ""
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected an integer >= {least}{limit}")
    return found


def flag(value: Any, name: str, owner: str) -> bool:
    """True or False; ValueError otherwise."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected True or False")
    return bool(value)


def word(value: Any, among: Sequence[str], name: str, owner: str) -> str:
    """One of some words; ValueError otherwise."""
    if not isinstance(value, str) or value not in among:
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected {_alternatives(among)}")
    return value


def _alternatives(among: Sequence[str]) -> str:
    """'a', 'b' or 'c'."""
    return " or ".join(filter(None, [", ".join(map(repr, among[:-1])), repr(among[-1])]))


def words(value: Any, name: str, owner: str, n: int | None = None) -> list[str]:
    """A list of texts, n of them where it is given; ValueError otherwise."""
    listed = isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value)
    if not listed or n not in (None, len(value)):
        many = "names" if n is None else f"{n} names"
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected a list of {many}")
    return list(value)


def folder(value: Any, name: str, owner: str) -> Path:
    """A path; ValueError for what names no file or folder."""
    if not isinstance(value, (str, os.PathLike)) or not os.fspath(value) or "\0" in os.fsdecode(value):
        raise ValueError(f"{owner}: {name} is {shown(value)}; expected a path: pass a str or a pathlib.Path")
    try:
        Path(os.fsdecode(value)).exists()
    except OSError as error:
        raise ValueError(f"{owner}: {name} is {shown(value)}, {error.strerror}; expected a path of this machine"
                         ) from None
    return Path(os.fsdecode(value))


def instance(kind: type, value: Any, name: str, owner: str, remedy: str = "") -> Any:
    """`value`, where it is a `kind`; ValueError otherwise."""
    if not isinstance(value, kind):
        called = f"nocl.{kind.__name__}" if kind.__name__ in PUBLIC else kind.__name__
        raise ValueError(f"{owner}: {name} is a {type(value).__name__}; expected a {called}"
                         f"{': ' * bool(remedy)}{remedy}")
    return value


def generator(seed: Any, owner: str) -> np.random.Generator:
    """The random numbers of a seed, an integer >= 0; a Generator goes on where it is."""
    if isinstance(seed, np.random.Generator):
        return seed
    return np.random.default_rng(whole(seed, "seed", owner, most=2**128))


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


def problem(ocp: Any, owner: str, infinite: bool = False, discrete: bool = False) -> None:
    """Raises ValueError for what is no nocl.OCP, and for one whose horizon is infinite, or whose system has discrete
    time, unless `infinite` and `discrete` say that these are taken."""
    if not (hasattr(ocp, "system") and hasattr(ocp, "initial_states")):
        raise ValueError(f"{owner}: the problem is a {type(ocp).__name__}; expected a nocl.OCP: "
                         "nocl.OCP(system, ...) or nocl.load_ocp(name)")
    if ocp.is_infinite and not infinite:
        raise ValueError(f"{owner} takes a horizon that ends, and that of the problem on {ocp.system.name!r} is "
                         "INFINITE; expected a number: train a law, nocl.train(ocp), or let it last for a while, "
                         "ocp.lasting(10)")
    if not discrete:
        ocp.system.refuse_discrete(owner)


def _why(error: Exception) -> str:
    """What `real` said, or that numpy could make no array of it."""
    text = str(error)
    return text if text.startswith(("is a masked", "holds ")) else "makes no array of numbers"


def states(x: ArrayLike, nx: int, owner: str, name: str = "x0") -> tuple[Array, bool]:
    """States as float64 rows [B, nx], and whether a single [nx] was given; NaN and other shapes raise ValueError."""
    array = numeric(x, name, owner, f"an array of nx = {nx} columns: pass numbers [{nx}] or [B, {nx}]")
    single = array.ndim == 1
    rows = array[None, :] if single else array
    if rows.ndim != 2 or rows.shape[1] != nx:
        raise ValueError(f"{name} has shape {array.shape}; {owner} has nx = {nx}: pass [{nx}] or [B, {nx}]")
    if not (np.abs(rows) < ORDINARY).all():
        bad = int(np.flatnonzero(~(np.abs(rows) < ORDINARY).all(axis=1))[0])
        why = "numbers below 1e150, whose squares are finite" if np.isfinite(rows[bad]).all() else "finite numbers"
        raise ValueError(f"{name}[{bad}] is {rows[bad].tolist()}; expected {why}: remove or repair that state")
    return rows, single
