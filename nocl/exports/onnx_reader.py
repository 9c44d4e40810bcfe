"""Somebody's ONNX network as a native CasADi Function: layers, activations, what moves numbers about. Needs `onnx`.

So a policy of any library for reinforcement learning can be judged and compared, or a learned model stand in an NLP.
Every tensor is a CasADi column of its numbers, row by row, with its shape; the batch has length 1. What is known
beforehand (weights, shapes) stays numpy. CasADi's own importer (3.8) is not used: 3.7 has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nocl.exports.casadi_forms import sigmoid
from nocl.exports.onnx_writer import package
from nocl.support.checks import Array


@dataclass(frozen=True)
class _Tensor:
    """Numbers that depend on the inputs: an MX column, row-major, and the shape."""

    column: ca.MX
    shape: tuple[int, ...]

    @property
    def places(self) -> Any:
        return np.arange(self.column.numel()).reshape(self.shape)

    def at(self, places: Any) -> _Tensor:
        """The numbers at these places, in this shape."""
        places = np.asarray(places)
        picked = ca.vec(self.column[places.ravel().tolist()])  # of a scalar CasADi makes a row
        return _Tensor(picked, places.shape)


Value = Any  # a _Tensor, or a numpy array


def from_onnx(path: str | Path, *, name: str = "onnx", in_names: Sequence[str] | None = None,
              out_names: Sequence[str] | None = None) -> ca.Function:
    """The graph of an ONNX file as a ca.Function on columns, float64, twice differentiable.

    Inputs [n] or [batch, n] become columns [n]; the batch is 1. Names are the graph's, made plain, unless given.
    Raises ValueError for a file that is no ONNX graph, inputs of other or unknown shapes, and an operation that has no
    translation, naming its node (loops, convolutions, recurrent and quantised layers).
    """
    onnx = package("onnx")
    try:
        model = onnx.load(str(path))
        onnx.checker.check_model(model)
    except Exception as error:  # protobuf's, onnx's and the file system's
        raise ValueError(f"from_onnx: {path} cannot be read as ONNX ({str(error).splitlines()[0]}); expected a .onnx "
                         "file: export it again") from error
    graph = model.graph
    known: dict[str, Value] = {i.name: onnx.numpy_helper.to_array(i) for i in graph.initializer}
    inputs = [i for i in graph.input if i.name not in known]
    columns = [_input(i, path) for i in inputs]
    known |= {i.name: v for i, v in zip(inputs, columns, strict=True)} | {"": None}
    for node in graph.node:
        _run(node, known, onnx, path)
    ins = list(in_names or _plain_names([i.name for i in inputs]))
    outs = list(out_names or _plain_names([o.name for o in graph.output]))
    results = [_tensor(known[o.name]).column for o in graph.output]
    try:
        return ca.Function(name, [c.column for c in columns], [ca.densify(r) for r in results], ins, outs)
    except (RuntimeError, NotImplementedError) as error:
        raise ValueError(f"from_onnx: name={name!r}, in_names={ins}, out_names={outs} do not make a Function of "
                         f"{len(columns)} inputs and {len(results)} outputs: give each a plain name") from error


def _plain_names(names: Sequence[str]) -> list[str]:
    plain = ["".join(c if c.isalnum() else "_" for c in n).strip("_").replace("__", "_") or "v" for n in names]
    plain = [n if n[0].isalpha() else f"v_{n}" for n in plain]
    return [n if plain.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(plain)]


def _input(value: Any, path: Any) -> _Tensor:
    """A symbol for an input [n], [1, n] or [batch, n]."""
    dims = [d.dim_value if d.HasField("dim_value") else None for d in value.type.tensor_type.shape.dim]
    shape = [1 if i == 0 and len(dims) > 1 and n is None else n for i, n in enumerate(dims)]
    if not shape or any(n is None or n < 1 for n in shape) or (len(shape) > 1 and shape[0] != 1):
        raise ValueError(f"from_onnx: the input {value.name!r} of {path} has shape {dims}; expected [n] or [batch, n] "
                         "with n fixed and the batch free or 1: export it with an example of one row")
    n = math.prod(s for s in shape if s is not None)
    return _Tensor(ca.MX.sym("x", n), tuple(s for s in shape if s is not None))


def _run(node: Any, known: dict[str, Value], onnx: Any, path: Any) -> None:
    rule = RULES.get(node.op_type) if node.domain in ("", "ai.onnx") else None
    where = f"the node {node.name or node.output[0]!r} ({node.op_type}) of {path}"
    if rule is None:
        raise ValueError(f"from_onnx: {where} has no translation (there is one for {', '.join(sorted(RULES))}): "
                         "export the network without it, or use nocl.to_casadi(module, backend='l4casadi')")
    options = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    if node.op_type == "Constant":
        options = {"value": _constant(options, onnx)}
    args = [known[name] for name in node.input]
    try:
        results = rule(args, options)
    except (ValueError, IndexError, KeyError, TypeError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"from_onnx: {where} does not fit its inputs of shapes "
                         f"{[getattr(a, 'shape', None) for a in args]}: {error}") from error
    known |= dict(zip(node.output, results if isinstance(results, list) else [results], strict=False))


def _constant(options: Mapping[str, Any], onnx: Any) -> Array:
    (key, value), = options.items()
    if key not in ("value", "value_float", "value_floats", "value_int", "value_ints"):
        raise ValueError(f"from_onnx: a constant is given as {key}; expected numbers")
    return np.asarray(onnx.numpy_helper.to_array(value) if key == "value" else value)


def _tensor(value: Value) -> _Tensor:
    if isinstance(value, _Tensor):
        return value
    array = np.asarray(value, dtype=np.float64)
    return _Tensor(ca.MX(ca.DM(array.ravel().tolist())), array.shape)


# Operations, (arguments, attributes) -> value(s)

Rule = Callable[[list[Value], Mapping[str, Any]], Any]


def _elementwise(of_mx: Callable[..., Any], of_numpy: Callable[..., Any] | None = None) -> Rule:
    """One number at a time, shapes broadcast; numpy stays numpy."""

    def rule(args: list[Value], options: Mapping[str, Any]) -> Value:
        if of_numpy is not None and not any(isinstance(a, _Tensor) for a in args):
            return of_numpy(*args)
        tensors = [_tensor(a) for a in args]
        shape = np.broadcast_shapes(*(t.shape for t in tensors))
        parts = [t if t.shape == shape else t.at(np.broadcast_to(t.places, shape)) for t in tensors]
        return _Tensor(of_mx(*(p.column for p in parts)), shape)

    return rule


def _moving(move: Callable[..., Any]) -> Rule:
    """What only moves numbers about: `move` acts on an array, of the numbers or of their places."""

    def rule(args: list[Value], options: Mapping[str, Any]) -> Value:
        first, others = args[0], args[1:]
        if not isinstance(first, _Tensor):
            return move(np.asarray(first), others, options)
        places = move(first.places, others, options)
        return [first.at(p) for p in places] if isinstance(places, list) else first.at(places)

    return rule


def _ints(value: Any) -> list[int]:
    if isinstance(value, _Tensor):
        raise ValueError("a shape, axis or index depends on the inputs; expected it fixed")
    return [int(v) for v in np.atleast_1d(value)]


def _reshape(a: Any, others: list[Value], options: Mapping[str, Any]) -> Any:
    sizes = _ints(others[0])
    return a.reshape([a.shape[i] if n == 0 else n for i, n in enumerate(sizes)])


def _flatten(a: Any, others: list[Value], options: Mapping[str, Any]) -> Any:
    return a.reshape(math.prod(a.shape[:options.get("axis", 1)]), -1)


def _axes(others: list[Value], options: Mapping[str, Any]) -> tuple[int, ...] | None:
    axes = others[0] if others and others[0] is not None else options.get("axes")
    return None if axes is None else tuple(_ints(axes))


def _slice(a: Any, others: list[Value], options: Mapping[str, Any]) -> Any:
    if not others:
        others = [options["starts"], options["ends"], options.get("axes")]
    starts, ends = _ints(others[0]), _ints(others[1])
    axes = _ints(others[2]) if len(others) > 2 and others[2] is not None else list(range(len(starts)))
    steps = _ints(others[3]) if len(others) > 3 else [1] * len(starts)
    where = [slice(None)] * a.ndim
    for axis, start, end, step in zip(axes, starts, ends, steps, strict=True):
        where[axis] = slice(start, None if step < 0 and end < -a.shape[axis] else end, step)
    return a[tuple(where)]


def _gather(a: Any, others: list[Value], options: Mapping[str, Any]) -> Any:
    index = others[0]
    if isinstance(index, _Tensor):
        raise ValueError("its indices depend on the inputs; expected them fixed")
    return np.take(a, np.asarray(index), axis=options.get("axis", 0))


def _split(a: Any, others: list[Value], options: Mapping[str, Any]) -> Any:
    sizes = others[0] if others and others[0] is not None else options.get("split")
    axis = options.get("axis", 0)
    if sizes is None:
        raise ValueError("it has no sizes; expected them given")
    return np.split(a, np.cumsum(_ints(sizes))[:-1], axis=axis)


def _concat(args: list[Value], options: Mapping[str, Any]) -> Value:
    if not any(isinstance(a, _Tensor) for a in args):
        return np.concatenate(args, axis=options["axis"])
    tensors = [_tensor(a) for a in args]
    starts = np.cumsum([0, *(t.column.numel() for t in tensors)])
    places = np.concatenate([t.places + s for t, s in zip(tensors, starts[:-1], strict=True)], axis=options["axis"])
    return _Tensor(ca.vertcat(*(t.column for t in tensors)), (int(starts[-1]),)).at(places)


def _product(a: Value, b: Value) -> _Tensor:
    """a @ b, one of them a vector (or a matrix of one row or column) that depends on the inputs."""
    if isinstance(a, _Tensor) and not isinstance(b, _Tensor) and b.ndim == 2 and math.prod(a.shape[:-1]) == 1:
        return _Tensor(ca.mtimes(ca.MX(ca.DM(np.asarray(b.T, np.float64))), a.column), (*a.shape[:-1], b.shape[1]))
    if isinstance(b, _Tensor) and not isinstance(a, _Tensor) and a.ndim == 2 and math.prod(b.shape[1:]) == 1:
        return _Tensor(ca.mtimes(ca.MX(ca.DM(np.asarray(a, np.float64))), b.column), (a.shape[0], *b.shape[1:]))
    raise ValueError("expected one row times a fixed matrix")


def _matmul(args: list[Value], options: Mapping[str, Any]) -> Value:
    a, b = args
    if not any(isinstance(v, _Tensor) for v in args):
        return a @ b
    return _product(a, b)


def _gemm(args: list[Value], options: Mapping[str, Any]) -> Value:
    a, b = (_transposed(v) if options.get(key) else v for v, key in zip(args, ("transA", "transB"), strict=False))
    y = _product(a, b)
    y = _Tensor(options.get("alpha", 1.0) * y.column, y.shape)
    if len(args) < 3 or args[2] is None:
        return y
    c = _tensor(args[2])
    return _elementwise(ca.plus)([y, _Tensor(options.get("beta", 1.0) * c.column, c.shape)], {})


def _transposed(value: Value) -> Value:
    return value.at(value.places.T) if isinstance(value, _Tensor) else np.asarray(value).T


def _clip(args: list[Value], options: Mapping[str, Any]) -> Value:
    low = args[1] if len(args) > 1 else options.get("min")
    high = args[2] if len(args) > 2 else options.get("max")
    y = args[0]
    y = y if low is None else _elementwise(ca.fmax, np.maximum)([y, np.asarray(low)], {})
    return y if high is None else _elementwise(ca.fmin, np.minimum)([y, np.asarray(high)], {})


def _fold(of_mx: Callable[..., Any], of_numpy: Callable[..., Any]) -> Rule:
    """Min, Max and Sum of any number of tensors."""
    pair = _elementwise(of_mx, of_numpy)

    def rule(args: list[Value], options: Mapping[str, Any]) -> Value:
        result = args[0]
        for a in args[1:]:
            result = pair([result, a], options)
        return result

    return rule


def _reduce(of_column: Callable[[ca.MX], ca.MX]) -> Rule:
    """Over all numbers of the row."""

    def rule(args: list[Value], options: Mapping[str, Any]) -> Value:
        x, axes = _tensor(args[0]), _axes(args[1:], options)
        over = range(len(x.shape)) if axes is None else [a % len(x.shape) for a in axes]
        if math.prod(x.shape[a] for a in over) != x.column.numel():
            raise ValueError("it reduces over a part of the row; expected all of it")
        keep = options.get("keepdims", 1)
        shape = tuple(1 if i in over else n for i, n in enumerate(x.shape) if keep or i not in over)
        return _Tensor(of_column(x.column), shape)

    return rule


def _layer_norm(args: list[Value], options: Mapping[str, Any]) -> Value:
    x = _tensor(args[0])
    if math.prod(x.shape[options.get("axis", -1):]) != x.column.numel():
        raise ValueError("it normalises over a part of the row; expected all of it")
    n = x.column.numel()
    d = x.column - ca.sum1(x.column) / n
    y = _Tensor(d / ca.sqrt(ca.sumsqr(d) / n + options.get("epsilon", 1e-5)), x.shape)
    y = _elementwise(ca.times)([y, args[1]], {})
    return y if len(args) < 3 else _elementwise(ca.plus)([y, args[2]], {})


def _softplus(x: ca.MX) -> ca.MX:
    return ca.fmax(x, 0) + ca.log1p(ca.exp(-ca.fabs(x)))


def _choose(condition: ca.MX, yes: ca.MX, no: ca.MX) -> ca.MX:
    return ca.if_else(condition, yes, no)


def _elu(args: list[Value], options: Mapping[str, Any]) -> Value:
    alpha = options.get("alpha", 1.0)
    return _elementwise(lambda x: ca.if_else(x > 0, x, alpha * ca.expm1(ca.fmin(x, 0))))(args, options)


def _leaky(args: list[Value], options: Mapping[str, Any]) -> Value:
    alpha = options.get("alpha", 0.01)
    return _elementwise(lambda x: ca.if_else(x > 0, x, alpha * x))(args, options)


def _gelu(args: list[Value], options: Mapping[str, Any]) -> Value:
    if options.get("approximate", b"none") == b"tanh":
        return _elementwise(lambda x: x / 2 * (1 + ca.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3))))(args, {})
    return _elementwise(lambda x: x / 2 * (1 + ca.erf(x / math.sqrt(2))))(args, {})


def _same(args: list[Value], options: Mapping[str, Any]) -> Value:
    return args[0]


def _unsqueeze(a: Any, others: list[Value], options: Mapping[str, Any]) -> Any:
    return np.expand_dims(a, _axes(others, options) or 0)


RULES: dict[str, Rule] = {
    "Gemm": _gemm, "MatMul": _matmul, "Constant": lambda args, options: options["value"],
    "Identity": _same, "Cast": _same, "Dropout": _same,
    "Add": _elementwise(ca.plus, np.add), "Sub": _elementwise(ca.minus, np.subtract),
    "Mul": _elementwise(ca.times, np.multiply), "Pow": _elementwise(ca.power, np.power),
    "Div": _elementwise(ca.rdivide, lambda a, b: a // b if np.asarray(a).dtype.kind == "i" else a / b),
    "Min": _fold(ca.fmin, np.minimum), "Max": _fold(ca.fmax, np.maximum), "Sum": _fold(ca.plus, np.add),
    **{op: _elementwise(getattr(ca, f)) for op, f in {
        "Exp": "exp", "Log": "log", "Sqrt": "sqrt", "Sin": "sin", "Cos": "cos", "Tan": "tan", "Asin": "asin",
        "Acos": "acos", "Atan": "atan", "Sinh": "sinh", "Cosh": "cosh", "Tanh": "tanh", "Asinh": "asinh",
        "Acosh": "acosh", "Atanh": "atanh", "Erf": "erf", "Abs": "fabs", "Sign": "sign", "Floor": "floor",
        "Ceil": "ceil"}.items()},
    "Neg": _elementwise(lambda x: -x, np.negative), "Reciprocal": _elementwise(lambda x: 1 / x),
    "Relu": _elementwise(lambda x: ca.if_else(x > 0, x, 0)), "Sigmoid": _elementwise(sigmoid),
    "Softplus": _elementwise(_softplus), "Softsign": _elementwise(lambda x: x / (1 + ca.fabs(x))),
    "Elu": _elu, "LeakyRelu": _leaky, "Gelu": _gelu, "Clip": _clip, "LayerNormalization": _layer_norm,
    "Less": _elementwise(ca.lt), "LessOrEqual": _elementwise(ca.le), "Greater": _elementwise(ca.gt),
    "GreaterOrEqual": _elementwise(ca.ge), "Equal": _elementwise(ca.eq, np.equal), "Not": _elementwise(ca.logic_not),
    "And": _elementwise(ca.logic_and), "Or": _elementwise(ca.logic_or), "Where": _elementwise(_choose, np.where),
    "ReduceSum": _reduce(ca.sum1), "ReduceMean": _reduce(lambda x: ca.sum1(x) / x.numel()), "Concat": _concat,
    "Shape": lambda args, options: np.asarray(args[0].shape, np.int64),
    "Reshape": _moving(_reshape), "Flatten": _moving(_flatten), "Slice": _moving(_slice), "Gather": _moving(_gather),
    "Split": _moving(_split), "Transpose": _moving(lambda a, others, options: np.transpose(a, options.get("perm"))),
    "Squeeze": _moving(lambda a, others, options: np.squeeze(a, _axes(others, options))),
    "Unsqueeze": _moving(_unsqueeze),
    "Expand": _moving(lambda a, others, options: a * np.ones(_ints(others[0]), dtype=a.dtype)),
}
