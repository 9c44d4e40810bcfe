"""The numbers of an ONNX graph: columns with a shape and a type where they depend on the inputs, else numpy.

A tensor that depends on the inputs is an MX column of its numbers, row-major. Its type is kept beside it, since ONNX
divides, compares and rounds by type: truths are 0 and 1, whole numbers are exact floats, and a whole number that its
type or a float64 cannot hold is NaN, for ONNX leaves those undefined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

RANGES = {np.dtype(np.int32): (-(2**31), 2**31 - 1), np.dtype(np.int64): (-(2**53) + 1, 2**53 - 1)}
TYPES = {np.dtype(t): name for t, name in ((np.float32, "FLOAT"), (np.float64, "DOUBLE"), (np.int32, "INT32"),
                                           (np.int64, "INT64"), (np.bool_, "BOOL"))}


@dataclass(frozen=True)
class Tensor:
    """Numbers that depend on the inputs: an MX column, row-major, the shape, and ONNX's type of them."""

    column: ca.MX
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def places(self) -> Any:
        """Where in the column each number stands, an array of the tensor's shape."""
        return np.arange(math.prod(self.shape)).reshape(self.shape)

    def at(self, places: Any) -> Tensor:
        """The numbers at these places, in this shape."""
        places = np.asarray(places)
        order = places.ravel()
        if np.array_equal(order, np.arange(math.prod(self.shape))):  # only the shape is another
            return Tensor(self.column, places.shape, self.dtype)
        picked = ca.vec(self.column[order.tolist()])  # of a scalar CasADi makes a row
        return Tensor(picked, places.shape, self.dtype)


Value = Any  # a Tensor, or a numpy array
_SIMPLIFICATION = Lock()  # CasADi has one switch for all threads


@contextmanager
def literal() -> Iterator[None]:
    """Expressions stay as they are written: CasADi makes 1 of x / x and 0 of 0 x, where ONNX has NaN for some x."""
    with _SIMPLIFICATION:
        before = ca.GlobalOptions.getSimplificationOnTheFly()
        ca.GlobalOptions.setSimplificationOnTheFly(False)
        try:
            yield
        finally:
            ca.GlobalOptions.setSimplificationOnTheFly(before)


@dataclass(frozen=True)
class Call:
    """One node: what it is given (None: left out), its attributes with the defaults of its opset, its outputs."""

    args: list[Value]
    options: Mapping[str, Any]
    version: int  # the opset in which this meaning of the operation began
    outputs: int

    def arg(self, i: int) -> Value | None:
        return self.args[i] if i < len(self.args) else None

    def fixed(self, i: int, attribute: str = "") -> Any:
        """An input that says how (a shape, an axis), which earlier opsets had as an attribute; None if left out."""
        value = self.arg(i)
        if isinstance(value, Tensor):
            raise ValueError(f"its input {i} depends on the inputs of the network; expected it fixed: export the "
                             "network with shapes, axes and indices that are constants")
        value = self.options.get(attribute) if value is None else value
        return None if value is None else np.asarray(value)

    def whole(self, i: int, attribute: str = "") -> list[int] | None:
        value = self.fixed(i, attribute)
        return None if value is None else [int(v) for v in value.ravel()]


class Rule(NamedTuple):
    """What an operation does, and the kinds of numbers for which it is exact: f real, i whole, b truths, * any."""

    kinds: str
    run: Callable[[Call], Any]


def constant(value: Any) -> Tensor:
    """Numbers that are known, as a tensor."""
    array = np.asarray(value)
    if array.dtype not in TYPES:
        raise ValueError(f"numbers of type {array.dtype} are computed with; expected {', '.join(TYPES.values())}")
    low, high = RANGES.get(array.dtype, (None, None))
    if low is not None and array.size and not low <= array.min() <= array.max() <= high:
        raise ValueError(f"a whole number of {array.dtype} is beyond {high}, which float64 does not hold exactly; "
                         "expected smaller ones: export the network without them")
    return Tensor(ca.MX(ca.DM(array.ravel().astype(np.float64))), array.shape, array.dtype)


def tensor(value: Value) -> Tensor:
    return value if isinstance(value, Tensor) else constant(value)


def known(value: Tensor) -> Any:
    """The numbers of a tensor that depends on no input, rounded to its type as ONNX does."""
    numbers = np.asarray(ca.evalf(value.column).full()).reshape(value.shape)
    if value.dtype.kind == "i" and np.isnan(numbers).any():
        raise ValueError(f"a constant is no whole number that {value.dtype} holds: check how it is computed")
    with np.errstate(over="ignore"):  # float32 has no larger number than 3.4e38
        return numbers.astype(value.dtype)


def if_else(condition: ca.MX, yes: Any, no: Any) -> ca.MX:
    """Number by number; NaN and infinity of the branch that is not taken do not come through."""
    return ca.if_else(condition, yes, no)


def held(column: ca.MX, shape: Sequence[int], dtype: np.dtype[Any]) -> Tensor:
    """A result: whole numbers outside what their type holds exactly become NaN."""
    if dtype in RANGES:
        low, high = RANGES[dtype]
        column = if_else(ca.logic_and(column >= low, column <= high), column, math.nan)
    return Tensor(column, tuple(shape), dtype)


def elementwise(of_mx: Callable[..., Any], *values: Value, dtype: Any = None) -> Tensor:
    """of_mx on columns of one shape (or single numbers), the first value's type unless given."""
    shape = np.broadcast_shapes(*(v.shape for v in values))
    columns = [_spread(v, shape) for v in values]
    return held(of_mx(*columns), shape, values[0].dtype if dtype is None else np.dtype(dtype))


def _spread(value: Value, shape: tuple[int, ...]) -> ca.MX:
    if not isinstance(value, Tensor) and np.size(value) != 1:
        value = np.broadcast_to(value, shape)
    value = tensor(value)
    if math.prod(value.shape) == 1 or value.shape == shape:  # CasADi repeats a single number
        return value.column
    return value.at(np.broadcast_to(value.places, shape)).column


def each(of_mx: Callable[..., Any], dtype: Any = None) -> Callable[[Call], Tensor]:
    """The rule of an operation on single numbers."""
    return lambda call: elementwise(of_mx, *call.args, dtype=dtype)


def cast(value: Value, dtype: np.dtype[Any]) -> Value:
    """In another type: towards zero for whole numbers, x != 0 for truths. Reals stay float64, whatever their name."""
    if not isinstance(value, Tensor):
        return _cast_constant(np.asarray(value), dtype)
    if dtype not in TYPES:
        raise ValueError(f"it makes {dtype} of numbers that depend on the inputs; expected one of "
                         f"{', '.join(TYPES.values())}: export the network in float32, not quantised")
    if dtype.kind == "b" and value.dtype.kind != "b":
        return Tensor(ca.ne(value.column, 0), value.shape, dtype)
    if dtype.kind == "i" and value.dtype.kind != "b":
        return held(truncated(value.column), value.shape, dtype)
    return Tensor(value.column, value.shape, dtype)


def _cast_constant(array: Any, dtype: np.dtype[Any]) -> Any:
    if array.dtype.kind == "V":  # bfloat16, float8 and their like: float32 holds all of them
        array = array.astype(np.float32)
    if array.dtype.kind not in "fiub" or dtype.kind not in "fiub":
        raise ValueError(f"it makes {dtype} of a constant of {array.dtype}; expected numbers of usual types")
    if dtype.kind in "iu" and array.size:
        limits, numbers = np.iinfo(dtype), np.trunc(array.astype(np.float64))
        if not (np.isfinite(numbers).all() and limits.min <= numbers.min() and numbers.max() <= limits.max):
            raise ValueError(f"a constant is beyond what {dtype} holds, where ONNX leaves the result open")
    with np.errstate(over="ignore"):
        return array.astype(dtype)


def truncated(x: ca.MX) -> ca.MX:
    return if_else(x < 0, ca.ceil(x), ca.floor(x))


def check_types(schema: Any, args: Sequence[Value | None], kinds: str) -> None:
    """Refuse inputs of types that the operation's definition, or this translation of it, does not take."""
    bound: dict[str, Any] = {}
    for i, value in enumerate(args):
        if i >= len(schema.inputs) and schema.inputs[-1].option != schema.inputs[-1].option.Variadic:
            raise ValueError(f"it has {len(args)} inputs; expected at most {len(schema.inputs)}")
        if value is not None:
            formal = schema.inputs[min(i, len(schema.inputs) - 1)]
            _check_type(formal, value.dtype, kinds)
            if bound.setdefault(formal.type_str, value.dtype) != value.dtype:
                raise ValueError(f"its inputs are {bound[formal.type_str]} and {value.dtype}; expected one type")


def _check_type(formal: Any, dtype: np.dtype[Any], kinds: str) -> None:
    spelled = {"float32": "float", "float64": "double"}.get(dtype.name, dtype.name)
    if f"tensor({spelled})" not in formal.types:
        raise ValueError(f"its input {formal.name} is {dtype}; expected one of {', '.join(sorted(formal.types))}")
    if "*" in kinds or len(formal.types) == 1:  # shapes and axes have the one type that is theirs
        return
    if dtype not in TYPES or dtype.kind not in kinds:
        exact = [name for t, name in TYPES.items() if t.kind in kinds]
        raise ValueError(f"its input {formal.name} is {dtype}; expected {', '.join(exact)}, for which it is exact "
                         "here: cast it in the network")
