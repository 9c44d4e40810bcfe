"""ONNX's operations across numbers: products of matrices, reductions, normalisations, softmax, the largest of a row."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from nocl.exports.onnx_operations.arithmetic import larger, smaller
from nocl.exports.onnx_operations.values import Call, Rule, Tensor, Value, elementwise, held, if_else, tensor

# Products


def _flipped(value: Value) -> ca.MX:
    """The transpose of [m, n]: what a row-major column is to CasADi, which counts by columns."""
    if not isinstance(value, Tensor):
        return ca.MX(ca.DM(np.asarray(value, np.float64).T))
    m, n = value.shape
    return ca.reshape(value.column, n, m)


def product(a: Value, b: Value) -> Tensor:
    """[m, k] @ [k, n]."""
    if a.shape[1] != b.shape[0]:
        raise ValueError(f"it multiplies {a.shape} by {b.shape}; expected equal inner sizes")
    return Tensor(ca.vec(ca.mtimes(_flipped(b), _flipped(a))), (a.shape[0], b.shape[1]), a.dtype)


def _picked(value: Value, places: Any) -> Value:
    return value.at(places) if isinstance(value, Tensor) else np.asarray(value).ravel()[places]


def _places(value: Value) -> Any:
    return np.arange(math.prod(value.shape)).reshape(value.shape)


def _matmul(call: Call) -> Tensor:
    """numpy's a @ b: matrices in the last two axes, others broadcast; a vector is a row, or a column on the right."""
    a, b = call.args
    if not a.shape or not b.shape:
        raise ValueError(f"it multiplies shapes {a.shape} and {b.shape}; expected at least one axis each")
    left, right = _places(a), _places(b)
    left = left[None] if left.ndim == 1 else left
    right = right[:, None] if right.ndim == 1 else right
    stack = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    left, right = (np.broadcast_to(p, (*stack, *p.shape[-2:])) for p in (left, right))
    parts = [product(_picked(a, left[i]), _picked(b, right[i])) for i in np.ndindex(stack)]
    shape = [*stack, *left.shape[-2:-1] * (len(a.shape) > 1), *right.shape[-1:] * (len(b.shape) > 1)]
    return Tensor(ca.vertcat(*(p.column for p in parts)), tuple(shape), a.dtype)


def _gemm(call: Call) -> Tensor:
    a, b = (_transposed(v) if call.options[key] else v for v, key in zip(call.args, ("transA", "transB"), strict=False))
    if len(a.shape) != 2 or len(b.shape) != 2:
        raise ValueError(f"it multiplies shapes {a.shape} and {b.shape}; expected two axes each")
    y = product(a, b)
    alpha, beta, c = call.options["alpha"], call.options["beta"], call.arg(2)
    if c is None:
        return elementwise(lambda y: alpha * y, y)
    if np.broadcast_shapes(y.shape, c.shape) != y.shape:
        raise ValueError(f"it adds the shape {c.shape} to {y.shape}; expected one that broadcasts to it")
    return elementwise(lambda y, c: alpha * y + beta * c, y, c)


def _transposed(value: Value) -> Value:
    return value.at(value.places.T) if isinstance(value, Tensor) else np.asarray(value).T


# Groups: the numbers over which a reduction goes, a column of a matrix for each group


def _axes(axes: Sequence[int], ndim: int) -> list[int]:
    if any(not -ndim <= a < ndim for a in axes):
        raise ValueError(f"its axes are {list(axes)}; expected them in [{-ndim}, {ndim - 1}]")
    return sorted({a % ndim for a in axes})


def _order(x: Tensor, axes: Sequence[int]) -> Any:
    """The places of x, one row for each group."""
    kept = [i for i in range(len(x.shape)) if i not in axes]
    size = math.prod(x.shape[i] for i in axes)
    return np.transpose(x.places, [*kept, *axes]).reshape(-1, size)


def _groups(x: Tensor, axes: Sequence[int]) -> ca.MX:
    order = _order(x, axes)
    return ca.reshape(x.at(order).column, order.shape[1], order.shape[0])


def _back(matrix: ca.MX, x: Tensor, axes: Sequence[int]) -> Tensor:
    """What has been made of the groups of x, in the shape of x."""
    order = _order(x, axes)
    flat = Tensor(ca.vec(matrix), (order.size,), x.dtype)
    return flat.at(np.argsort(order.ravel()).reshape(x.shape))


def _of_each(row: ca.MX, like: ca.MX) -> ca.MX:
    """One number a group, for each number of the group."""
    return ca.repmat(row, like.size1(), 1)


def _extreme(of_two: Callable[[ca.MX, ca.MX], ca.MX]) -> Callable[[ca.MX], ca.MX]:
    def run(matrix: ca.MX) -> ca.MX:
        while matrix.size1() > 1:  # by halves: the depth of the expression is the logarithm of the size
            half = matrix.size1() // 2
            rest = matrix[2 * half:, :]
            matrix = ca.vertcat(of_two(matrix[:half, :], matrix[half:2 * half, :]), rest)
        return matrix

    return run


largest = _extreme(larger)


def _log_sum(matrix: ca.MX) -> ca.MX:
    top = largest(matrix)
    return top + ca.log(ca.sum1(ca.exp(matrix - _of_each(top, matrix))))


def _reduced_axes(call: Call, ndim: int) -> list[int]:
    axes = call.whole(1, "axes")
    if axes:
        return _axes(axes, ndim)
    return [] if call.options.get("noop_with_empty_axes", 0) else list(range(ndim))


def _shape(x: Tensor, axes: Sequence[int], keep: bool) -> list[int]:
    return [1 if i in axes else n for i, n in enumerate(x.shape) if keep or i not in axes]


def _reduce(of_groups: Callable[[ca.MX], ca.MX]) -> Callable[[Call], Tensor]:
    """of_groups makes one number of each column."""

    def run(call: Call) -> Tensor:
        x = tensor(call.args[0])
        axes = _reduced_axes(call, len(x.shape))
        if not math.prod(x.shape):
            raise ValueError(f"it reduces the shape {x.shape}; expected numbers in it")
        return held(ca.vec(of_groups(_groups(x, axes))), _shape(x, axes, call.options["keepdims"]), x.dtype)

    return run


def _arg(better: Callable[[ca.MX, ca.MX], ca.MX], better_or_equal: Callable[[ca.MX, ca.MX], ca.MX]) -> Callable[
        [Call], Tensor]:
    """The index of the extreme number; of equal ones the first, or the last where select_last_index says so."""

    def run(call: Call) -> Tensor:
        x = tensor(call.args[0])
        axes = _axes([call.options["axis"]], len(x.shape))
        wins = better_or_equal if call.options.get("select_last_index", 0) else better
        matrix = _groups(x, axes)
        best, index = matrix[0, :], ca.MX.zeros(1, matrix.size2())
        for i in range(1, matrix.size1()):
            won = wins(matrix[i, :], best)
            best, index = if_else(won, matrix[i, :], best), if_else(won, i, index)
        return Tensor(ca.vec(index), tuple(_shape(x, axes, call.options["keepdims"])), np.dtype(np.int64))

    return run


def _softmax(of_groups: Callable[[ca.MX], ca.MX]) -> Callable[[Call], Tensor]:
    """Over one axis; before opset 13 over it and all that follow."""

    def run(call: Call) -> Tensor:
        x = tensor(call.args[0])
        first, = _axes([call.options["axis"]], len(x.shape))
        axes = [first] if call.version >= 13 else list(range(first, len(x.shape)))
        return _back(of_groups(_groups(x, axes)), x, axes)

    return run


def _shares(matrix: ca.MX) -> ca.MX:
    weights = ca.exp(matrix - _of_each(largest(matrix), matrix))
    return weights / _of_each(ca.sum1(weights), weights)


# Normalisations


def _normalised(call: Call, centred: bool) -> Tensor:
    x, epsilon = tensor(call.args[0]), call.options["epsilon"]
    first, = _axes([call.options["axis"]], len(x.shape))
    axes = list(range(first, len(x.shape)))
    matrix = _groups(x, axes)
    n = matrix.size1()
    if centred:
        matrix = matrix - _of_each(ca.sum1(matrix) / n, matrix)
    spread = ca.sqrt(ca.sum1(matrix**2) / n + epsilon)
    y = elementwise(ca.times, _back(matrix / _of_each(spread, matrix), x, axes), call.args[1])
    bias = call.arg(2)
    y = y if bias is None else elementwise(ca.plus, y, bias)
    if y.shape != x.shape:
        raise ValueError(f"its scale or bias makes {y.shape} of the shape {x.shape}; expected them to broadcast to it")
    return y


def _batch_norm(call: Call) -> Tensor:
    x = tensor(call.args[0])
    scale, shift, mean, variance = (call.fixed(i) for i in range(1, 5))
    if call.options.get("training_mode", 0) or call.outputs > 1:
        raise ValueError("it is in training mode; expected inference: call .eval() before exporting the network")
    if not call.options.get("spatial", 1) or len(x.shape) < 2:
        raise ValueError(f"it has the shape {x.shape}, spatial={call.options.get('spatial', 1)}; expected "
                         "[batch, channels, ...]: export it with opset 9 or later")
    along = (-1, *[1] * (len(x.shape) - 2))  # the channels are the second axis
    scale, shift, mean, variance = (np.reshape(v, along).astype(np.float64) for v in (scale, shift, mean, variance))
    with np.errstate(invalid="ignore"):  # a negative variance makes NaN, there as here
        gain = scale / np.sqrt(variance + call.options["epsilon"])
    return elementwise(lambda x, mean, gain, shift: (x - mean) * gain + shift, x, mean, gain, shift)


def _dropout(call: Call) -> list[Value]:
    """The input; in training mode it is random. The mask from opset 12 on is true everywhere."""
    training, ratio = call.fixed(2), call.fixed(1)
    if training is not None and training.any() and (ratio is None or ratio.any()):
        raise ValueError("training_mode is true; expected inference: call .eval() before exporting the network")
    return [call.args[0], *([np.ones(call.args[0].shape, bool)] if call.version >= 12 else [])]


RULES: dict[str, Rule] = {
    "MatMul": Rule("f", _matmul), "Gemm": Rule("f", _gemm),
    "ReduceSum": Rule("fi", _reduce(ca.sum1)), "ReduceMax": Rule("fi", _reduce(largest)),
    "ReduceMin": Rule("fi", _reduce(_extreme(smaller))), "ReduceProd": Rule("fi", _reduce(_extreme(ca.times))),
    "ReduceMean": Rule("f", _reduce(lambda m: ca.sum1(m) / m.size1())),
    "ReduceL1": Rule("f", _reduce(lambda m: ca.sum1(ca.fabs(m)))),
    "ReduceL2": Rule("f", _reduce(lambda m: ca.sqrt(ca.sum1(m**2)))),
    "ReduceSumSquare": Rule("f", _reduce(lambda m: ca.sum1(m**2))),
    "ReduceLogSum": Rule("f", _reduce(lambda m: ca.log(ca.sum1(m)))), "ReduceLogSumExp": Rule("f", _reduce(_log_sum)),
    "ArgMax": Rule("fi", _arg(ca.gt, ca.ge)), "ArgMin": Rule("fi", _arg(ca.lt, ca.le)),
    "Softmax": Rule("f", _softmax(_shares)),
    "LogSoftmax": Rule("f", _softmax(lambda m: m - _of_each(_log_sum(m), m))),
    "LayerNormalization": Rule("f", lambda call: _normalised(call, centred=True)),
    "RMSNormalization": Rule("f", lambda call: _normalised(call, centred=False)),
    "BatchNormalization": Rule("f", _batch_norm), "Dropout": Rule("f", _dropout),
}
