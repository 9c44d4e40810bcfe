"""Odd arguments: what users, notebooks and data frames hand over by mistake, and what refuses them well."""

from __future__ import annotations

import datetime
import linecache
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import casadi as ca
import numpy as np
import torch
from documents import ROOT
from hypothesis import strategies as st

HUGE = 10**30  # a whole number that no 64-bit one holds
SAYS = re.compile(r"expected|outside its box|\b(take|pass|give|needs?|takes?)\b|there (are|is)|no file|has nx")


class Table:
    """What a DataFrame looks like to numpy, with columns of other names than the states."""

    columns = ("pressure", "torque")
    dtypes = None

    def __init__(self, values: Any = ((0.0, 0.0), (0.0, 0.0))) -> None:
        self.values = np.asarray(values, dtype=np.float64)

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return self.values


class Hostile:
    """An object whose every conversion fails."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        raise RuntimeError("no array")

    def __float__(self) -> float:
        raise OverflowError("no float")

    def __len__(self) -> int:
        raise IndexError("no length")


def things() -> list[Any]:
    """Of every kind that has nothing to do with the argument."""
    x = ca.SX.sym("x")
    ragged = np.empty(2, dtype=object)
    ragged[:] = [1, [2, 3]]
    nothing: list[Any] = [None, "", [], (), {}, set(), range(0), ..., NotImplemented]
    text = ["abc", "1", "1.5", "theta", "../..", "\0", "é\n", "x" * 300, b"1", b"\xff", bytearray(b"12"),
            memoryview(b"12"), Path("nowhere"), Path("/dev/null/x")]
    numbers = [True, False, np.True_, 0, -1, 2.5, -0.0, HUGE, -HUGE, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324,
               1j, complex(1, 0), np.complex64(1), Decimal("0.5"), Decimal("nan"), Fraction(1, 3)]
    lists = [[[]], [None], ["a", "b"], [1, "2"], [1j, 2], [[1, 2], [3]], [[[1]]], [True, False], [[True, False]],
             [0.1] * 7, [[0.1, 0.2]] * 3, range(2), iter([1, 2]), {1, 2}, frozenset({1}), {"a": 1}, {0: 1.0, 1: 2.0}]
    objects = [lambda: 1, lambda *a: None, object(), Hostile(), Table(), type, int, np.float64, ValueError("x"),
               slice(1, 2), np.random.default_rng(0)]
    times = [datetime.datetime(2024, 5, 1), datetime.date(2024, 5, 1), datetime.timedelta(1), datetime.time(1),
             np.datetime64("2024-05-01"), np.array(["2024", "NaT"], "M8[Y]"), np.array([1, 2], "m8[s]")]
    arrays = [np.array(3.0), np.zeros(0), np.zeros((0, 2)), np.zeros((2, 0)), np.zeros((2, 2, 2)), np.full(2, np.nan),
              np.full((1, 2), np.inf), np.array(["a", "b"]), np.array([b"a"]), np.array([1, None], dtype=object),
              ragged, np.ma.array([1.0, 2.0], mask=[0, 1]), np.ma.masked, np.ma.array([1.0, 2.0]),
              np.zeros(2, dtype=[("a", float)]), np.array([1, 2], np.float16), np.array([2**63], np.uint64)]
    tensors = [torch.zeros(2), torch.zeros(2, requires_grad=True), torch.zeros(2, dtype=torch.complex64),
               torch.zeros(2, dtype=torch.bfloat16), torch.nn.Linear(2, 1)]
    symbols = [x, ca.SX(2, 2), ca.SX.nan(2, 1), ca.MX.sym("m"), ca.DM([1, 2]), ca.DM(2, 1), ca.DM.nan(2),
               ca.Function("g", [x], [x])]
    return [*nothing, *text, *numbers, *lists, *objects, *times, *arrays, *tensors, *symbols]


def deformed(good: Any) -> list[Any]:
    """A good value of the same size with one thing wrong, where it is made of numbers."""
    try:
        a = np.asarray(good, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):
        return []
    if not a.size or a.ndim == 0:
        return []
    at = np.zeros(a.shape, dtype=bool)
    at.flat[-1] = True
    wrong = [np.where(at, v, a) for v in (np.nan, np.inf, -np.inf, 1e308, -1e300, 1e30)]
    words = a.astype(str)
    return [*wrong, a[None], a[..., None], a.ravel()[:-1], np.r_[a.ravel(), 0.0], np.ma.array(a, mask=at), a + 0j,
            a + 1j, words, words.tolist(), a.astype(bytes), a.astype(bool), np.zeros(a.shape, "M8[s]"),
            np.zeros(a.shape, "m8[s]"), a.astype(object), np.where(at, None, a), Table(a), a.T, a[:0], a * 1e300, a * 0,
            -a, dict(enumerate(a.ravel())), set(a.ravel()), [a.tolist()] * 2, torch.tensor(a),
            ca.DM(a) if a.ndim < 3 else a]


@dataclass(frozen=True, eq=False)
class Call:
    """A public function, arguments that it takes, and what its answers must be."""

    name: str
    run: Callable[..., Any]
    good: Mapping[str, Any]
    holds: Callable[[Any], bool] = lambda answer: True
    odd: Mapping[str, list[Any]] | None = None  # further odd values of single arguments

    def values(self, argument: str) -> list[Any]:
        return [*things(), *deformed(self.good[argument]), *(self.odd or {}).get(argument, [])]


def strange(call: Call, most: int = 2) -> st.SearchStrategy[dict[str, Any]]:
    """Good arguments but for one or two."""

    @st.composite
    def draw(pick: Any) -> dict[str, Any]:
        names = pick(st.lists(st.sampled_from(sorted(call.good)), min_size=1, max_size=most, unique=True))
        changed = {}
        for name in names:
            values = call.values(name)  # made anew for each call: some can be used up or changed
            changed[name] = values[pick(st.integers(0, len(values) - 1))]
        return changed

    return draw()


def fault(call: Call, changed: Mapping[str, Any]) -> str:
    """What is wrong with how a call answers, or ""."""
    try:
        answer = call.run(**{**call.good, **changed})
    except (ValueError, TypeError) as error:
        return _of_error(error, changed)
    except BaseException as error:
        return f"raised {type(error).__name__}: {error}"
    try:
        held = call.holds(answer)
    except Exception as error:
        return f"answered {answer!r:.300}, of which {type(error).__name__}: {error}"
    return "" if held else f"answered {answer!r:.300}"


def _of_error(error: Exception, changed: Mapping[str, Any]) -> str:
    frame = last_frame(error.__traceback__)
    file = frame.tb_frame.f_code.co_filename
    line = linecache.getline(file, frame.tb_lineno)
    text = f"{type(error).__name__}: {error}"
    if not _ours(file) or not line.strip().startswith("raise"):
        return f"a raw message, {Path(file).name}:{frame.tb_lineno}: {text}"
    if not SAYS.search(text):
        return f"no remedy and nothing expected ({Path(file).name}:{frame.tb_lineno}): {text}"
    return ""


def last_frame(trace: TracebackType | None) -> TracebackType:
    assert trace is not None
    while trace.tb_next is not None:
        trace = trace.tb_next
    return trace


def _ours(file: str) -> bool:
    path = Path(file)
    return path.is_relative_to(ROOT) and not any(part in ("tests", ".venv") for part in path.relative_to(ROOT).parts)
