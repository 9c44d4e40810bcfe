"""What users hand over as times, rows and labels of a log, turned into arrays of numbers and plain labels."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import date, datetime, timedelta
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from nocl.support import checks
from nocl.support.checks import Array

MISSING = ("", "nan")  # cells of a CSV file where a sample is missing
NO_LABEL = ("", "nan", "nat", "none", "null", "<na>")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def rows_of(value: Any, n: int, names: Sequence[str], what: str, owner: str) -> Array:
    """[n, len(names)] float64."""
    columns = getattr(value, "columns", None) if hasattr(value, "dtypes") else None
    if columns is not None and list(columns) != list(names):
        raise ValueError(f"{owner}: {what} has the columns {', '.join(map(str, columns))}; expected "
                         f"{', '.join(names)}: pass {what}[[{', '.join(map(repr, names))}]]")
    array = _real(value, what, owner)
    if array.ndim == 1 and len(names) == 1:
        array = array[:, None]
    if array.shape != (n, len(names)):
        raise ValueError(f"{owner}: {what} has shape {array.shape}; expected {(n, len(names))}, a row for each time")
    return array


def _real(value: Any, what: str, owner: str) -> Array:
    try:
        return checks.real(value)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        why = str(error) if str(error).startswith(("is a masked", "holds ")) else f"is a {type(value).__name__}"
        raise ValueError(f"{owner}: {what} {why}; expected an array of numbers, one row for each sample, NaN where one "
                         "is missing: join several runs and tell them apart by `run`") from None


def seconds(t: Any, owner: str) -> Array:
    """Times [N]: numbers as they are, timestamps in seconds from the first, durations in seconds."""
    try:
        array = np.asarray(t)
    except Exception:  # whatever its own conversion raises
        array = np.zeros((0, 0))
    if array.ndim != 1:
        raise ValueError(f"{owner}: t is {checks.shown(t)}; expected one time for each sample, [N]")
    if np.datetime_data(array.dtype)[0] in ("Y", "M") if array.dtype.kind in "mM" else False:
        raise ValueError(f"{owner}: t is {checks.shown(t)}, in whole months or years; expected seconds, or timestamps")
    if array.dtype.kind in "mM":
        return (array - array[:1].astype(array.dtype) if array.dtype.kind == "M" else array) / np.timedelta64(1, "s")
    values = array.tolist()
    first = next((v for v in values if v is not None and v != ""), None)
    if isinstance(first, str) and not NUMBER.fullmatch(first.strip()):
        values = [_timestamp(v, owner) for v in values]
        first = next(v for v in values if v is not None)
    try:
        if isinstance(first, datetime):
            return np.array([np.nan if v is None else (v - first).total_seconds() for v in values])
        if isinstance(first, timedelta):
            return np.array([np.nan if v is None else v.total_seconds() for v in values])
    except (TypeError, AttributeError):
        raise ValueError(f"{owner}: t mixes timestamps of different kinds; expected all with a time zone, or all "
                         "without") from None
    if array.dtype.kind in "US" or array.dtype.kind == "O":
        return numbers(values, "t", owner)
    return _real(t, "t", owner)


def _timestamp(cell: str, owner: str) -> datetime | None:
    if cell.strip().lower() in MISSING:
        return None
    try:
        if len(cell.strip()) < len("2024-01-01T00"):
            raise ValueError
        return datetime.fromisoformat(cell.strip())
    except ValueError:
        raise ValueError(f"{owner}: column 't' holds what is no number and no time ({cell!r}); expected seconds, or "
                         "timestamps like 2024-05-31T12:00:00.25 (ISO 8601): convert the column, and remove lines of "
                         "units and comments") from None


def numbers(column: Sequence[Any], name: str, path: str | Path) -> Array:
    """A column of cells [N], NaN where one is empty."""
    return np.array([_number(cell, i, name, path) for i, cell in enumerate(column)], dtype=np.float64)


def _number(cell: Any, i: int, name: str, path: str | Path) -> float:
    text = cell.strip() if isinstance(cell, str) else None
    if cell is None or (text is not None and text.lower() in MISSING):
        return float("nan")
    try:
        if text is None or NUMBER.fullmatch(text) or text.lower().strip("+-") in ("inf", "infinity"):
            return float(cell)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{path}: column {name!r} holds what is no number ({cell!r}, sample {i}); expected numbers, and "
                     "empty cells where a sample is missing: remove lines of units, and separators of thousands")


def _listed(run: Any) -> Any:
    """A column of another library as a list, or None."""
    try:
        return list(np.asarray(run).tolist())
    except Exception:  # whatever its own conversion raises
        return None


def labels_of(run: Any, n: int, owner: str) -> list[str]:
    """A label for each sample; ValueError for missing ones, and for text among numbers."""
    if run is None:
        return ["0"] * n
    values = run.tolist() if isinstance(run, np.ndarray) else run if isinstance(run, (list, tuple)) else \
        _listed(run)
    values = list(values) if isinstance(values, tuple) else values
    if not isinstance(values, list) or len(values) != n:
        shape = (len(values),) if isinstance(values, list) else ()
        raise ValueError(f"{owner}: run has shape {shape}; expected ({n},), a label for each sample")
    text = [isinstance(v, str) for v in values]
    for i, v in enumerate(values):
        label = isinstance(v, (str, date)) or (isinstance(v, Real) and v == v and v not in (math.inf, -math.inf))
        if not label or str(v).lower() in NO_LABEL or str(v) != str(v).strip():
            raise ValueError(f"{owner}: run of sample {i} is {v!r}; expected a label, like 0 or 'morning': name the "
                             "recording that the sample belongs to, or drop it")
        if text[i] != text[0]:
            raise ValueError(f"{owner}: run of sample 0 is {values[0]!r}, of sample {i} {v!r}; expected text or "
                             "numbers: write all labels in one way")
    if any(isinstance(v, float) for v in values):
        values = [float(v) for v in values]
    return [str(v) for v in values]
