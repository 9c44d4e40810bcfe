"""ONNX's operations that only move numbers about, or make them from shapes: any type, nothing is computed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nocl.exports.onnx_operations.values import Call, Rule, Tensor, Value, tensor


def _moving(move: Callable[[Any, Call], Any]) -> Callable[[Call], Any]:
    """`move` acts on an array: of the numbers, where they are known, or of their places."""

    def run(call: Call) -> Any:
        first = call.args[0]
        if not isinstance(first, Tensor):
            return move(np.asarray(first), call)
        places = move(first.places, call)
        return [first.at(p) for p in places] if isinstance(places, list) else first.at(places)

    return run


def _needed(values: list[int] | None, what: str) -> list[int]:
    if values is None:
        raise ValueError(f"it has no {what}; expected fixed numbers")
    return values


def _reshape(a: Any, call: Call) -> Any:
    sizes = _needed(call.whole(1, "shape"), "shape")
    if not call.options.get("allowzero", 0):
        sizes = [a.shape[i] if n == 0 else n for i, n in enumerate(sizes)]
    return a.reshape(sizes)


def _flatten(a: Any, call: Call) -> Any:
    axis = call.options["axis"]
    if not -a.ndim <= axis <= a.ndim:
        raise ValueError(f"its axis is {axis}; expected it in [{-a.ndim}, {a.ndim}]")
    return a.reshape(math.prod(a.shape[:axis]), -1)


def _slice(a: Any, call: Call) -> Any:
    starts, ends = (_needed(call.whole(i, name), name) for i, name in ((1, "starts"), (2, "ends")))
    axes, steps = call.whole(3, "axes"), call.whole(4) or [1] * len(starts)
    for axis, start, end, step in zip(axes or range(len(starts)), starts, ends, steps, strict=True):
        a = np.take(a, _range(start, end, step, a.shape[axis]), axis=axis)
    return a


def _range(start: int, end: int, step: int, n: int) -> list[int]:
    """The indices of start:end:step, which ONNX limits to what there is."""
    start, end = (v + n if v < 0 else v for v in (start, end))
    low, high = (0, n) if step > 0 else (-1, n - 1)
    return list(range(min(max(start, 0), high), min(max(end, low), high), step))


def _split(a: Any, call: Call) -> Any:
    axis, sizes = call.options["axis"], call.whole(1, "split")
    if sizes is None:  # equal parts; from opset 18 on the last may be smaller
        n, parts = a.shape[axis], call.options.get("num_outputs", call.outputs)
        step = -(-n // parts) if call.version >= 18 else n // parts
        sizes = [min(step, n - i * step) for i in range(parts)]
    if sum(sizes) != a.shape[axis] or len(sizes) != call.outputs or min(sizes) < 0:
        raise ValueError(f"it splits {a.shape[axis]} numbers into {call.outputs} parts of sizes {sizes}; expected "
                         "sizes that add up, one for each output")
    return np.split(a, np.cumsum(sizes)[:-1], axis=axis)


def _squeeze(a: Any, call: Call) -> Any:
    axes = call.whole(1, "axes")
    if axes == []:  # onnx takes away no axis, ONNX Runtime all of size 1
        raise ValueError("its axes are an empty list, which is read in two ways; expected axes, or none given")
    return np.squeeze(a, None if axes is None else tuple(axes))


def _unsqueeze(a: Any, call: Call) -> Any:
    return np.expand_dims(a, tuple(_needed(call.whole(1, "axes"), "axes")))


def _expand(a: Any, call: Call) -> Any:
    return np.broadcast_to(a, np.broadcast_shapes(a.shape, tuple(_needed(call.whole(1), "shape"))))


def _tile(a: Any, call: Call) -> Any:
    repeats = _needed(call.whole(1), "repeats")
    if len(repeats) != a.ndim:
        raise ValueError(f"its repeats are {repeats} for the shape {a.shape}; expected one for each axis")
    return np.tile(a, repeats)


def _gather(a: Any, call: Call) -> Any:
    return np.take(a, call.fixed(1), axis=call.options["axis"])


def _gather_elements(a: Any, call: Call) -> Any:
    axis, index = call.options["axis"], call.fixed(1)
    sizes = [n for i, n in enumerate(a.shape) if i != axis % a.ndim]
    if index is None or index.ndim != a.ndim or any(
            m > n for m, n in zip(np.delete(index.shape, axis), sizes, strict=True)):
        raise ValueError(f"its indices do not fit the shape {a.shape}; expected no larger size along the other axes")
    trimmed = a[tuple(slice(None) if i == axis % a.ndim else slice(n) for i, n in enumerate(index.shape))]
    return np.take_along_axis(trimmed, index, axis)


def _concat(call: Call) -> Value:
    axis = call.options["axis"]
    if not any(isinstance(a, Tensor) for a in call.args):
        return np.concatenate(call.args, axis=axis)
    parts = [tensor(a) for a in call.args]
    starts = np.cumsum([0, *(math.prod(p.shape) for p in parts)])
    places = np.concatenate([p.places + s for p, s in zip(parts, starts[:-1], strict=True)], axis=axis)
    return Tensor(ca.vertcat(*(p.column for p in parts)), (int(starts[-1]),), parts[0].dtype).at(places)


def _shape(call: Call) -> Any:
    shape = call.args[0].shape
    return np.asarray(shape[call.options.get("start", 0):call.options.get("end", len(shape))], np.int64)


def _constant_of_shape(call: Call) -> Any:
    from onnx.numpy_helper import to_array  # onnx stays out of `import nocl`

    value = np.zeros(1, np.float32) if "value" not in call.options else to_array(call.options["value"])
    return np.full(tuple(_needed(call.whole(0), "shape")), value.item(), value.dtype)


def _from_to(call: Call) -> Any:
    start, limit, delta = (call.fixed(i) for i in range(3))
    if start is None or start.dtype.kind != "i":
        raise ValueError("it is of reals; expected whole numbers, whose count is certain: export it as a constant")
    return np.arange(start, limit, delta, dtype=start.dtype)


def _constant(call: Call) -> Any:
    from onnx.numpy_helper import to_array  # onnx stays out of `import nocl`

    dtypes = {"value_float": np.float32, "value_floats": np.float32, "value_int": np.int64, "value_ints": np.int64}
    (key, value), = call.options.items()
    if key == "value":
        return to_array(value)
    if key not in dtypes:
        raise ValueError(f"it is given as {key}; expected numbers, all of them: export it as a plain tensor")
    return np.asarray(value, dtypes[key])


RULES: dict[str, Rule] = {
    "Constant": Rule("*", _constant), "ConstantOfShape": Rule("*", _constant_of_shape), "Range": Rule("*", _from_to),
    "Shape": Rule("*", _shape), "Size": Rule("*", lambda call: np.asarray(math.prod(call.args[0].shape), np.int64)),
    "Identity": Rule("*", lambda call: call.args[0]), "Concat": Rule("*", _concat),
    "Transpose": Rule("*", _moving(lambda a, call: np.transpose(a, call.options.get("perm")))),
    **{op: Rule("*", _moving(move)) for op, move in {
        "Reshape": _reshape, "Flatten": _flatten, "Slice": _slice, "Split": _split, "Squeeze": _squeeze,
        "Unsqueeze": _unsqueeze, "Expand": _expand, "Tile": _tile, "Gather": _gather,
        "GatherElements": _gather_elements}.items()},
}
