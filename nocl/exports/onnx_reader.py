"""Somebody's ONNX network as a native CasADi Function: what the outputs that are asked for need of it. Needs `onnx`.

So a policy of any library for reinforcement learning can be judged and compared, or a learned model stand in an NLP.
The batch has length 1. An operation is translated exactly, in the meaning of the file's opset, or refused by name; what
is known beforehand (weights, shapes) is worked out beforehand. CasADi's own importer (3.8) is not used: 3.7 has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nocl.exports.onnx_operations import arithmetic, layers, moves
from nocl.exports.onnx_operations.values import Call, Tensor, Value, check_types, known, literal, tensor
from nocl.exports.onnx_writer import package

RULES = arithmetic.RULES | layers.RULES | moves.RULES
OLDEST, NEWEST = 7, 27  # opsets whose meanings are compared with ONNX Runtime; before 7 broadcasting was another


def from_onnx(path: str | Path, *, outputs: Sequence[str] | None = None, name: str = "onnx",
              in_names: Sequence[str] | None = None, out_names: Sequence[str] | None = None) -> ca.Function:
    """The graph of an ONNX file as a ca.Function on columns, float64, twice differentiable.

    Inputs [n] or [batch, n] of reals become columns [n]; the batch is 1. Whole numbers and truths among the outputs are
    columns of floats. Names are the graph's, made plain, unless given.

    outputs: the graph's outputs to translate, in this order; None: all of them. What no output needs is not looked at,
    and an input that none needs is left out if it cannot be a column.
    Raises ValueError for a file that is no ONNX graph, inputs of other or unknown shapes, and a node that is not
    translated exactly (loops, convolutions, random or recurrent or quantised layers), naming it and the outputs that
    can be had without it.
    """
    onnx = package("onnx")
    model = _loaded(onnx, path)
    graph = model.graph
    asked = _asked([o.name for o in graph.output], outputs, path)
    nodes, wanted = _needed(graph, asked)
    fixed = {i.name: i for i in graph.initializer}
    inputs = {i.name: _input(i, path, onnx) for i in graph.input
              if i.name not in fixed and (i.name in wanted or _is_column(i, onnx))}
    values = {n: _weights(i, path, onnx) for n, i in fixed.items() if n in wanted} | inputs | {"": None}
    with literal():
        for node in nodes:
            _run(node, values, model, path)
    results = [tensor(values[o]).column for o in asked]
    return _function(name, [c.column for c in inputs.values()], results, in_names or _plain_names(list(inputs)),
                     out_names or _plain_names(asked))


def _function(name: str, columns: list[ca.MX], results: list[ca.MX], in_names: Sequence[str],
              out_names: Sequence[str]) -> ca.Function:
    ins, outs = list(in_names), list(out_names)
    try:
        return ca.Function(name, columns, [ca.densify(r) for r in results], ins, outs)
    except (RuntimeError, NotImplementedError) as error:
        raise ValueError(f"from_onnx: name={name!r}, in_names={ins}, out_names={outs} do not make a Function of "
                         f"{len(columns)} inputs and {len(results)} outputs: give each a plain name") from error


def _loaded(onnx: Any, path: str | Path) -> Any:
    """The model, its own functions written out in full."""
    try:
        model = onnx.load(str(path))
        onnx.checker.check_model(model)
        model = package("onnx.inliner").inline_local_functions(model) if model.functions else model
    except Exception as error:  # protobuf's, onnx's and the file system's
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"from_onnx: {path} cannot be read as ONNX ({reason}); expected a .onnx file: export it "
                         "again") from error
    opset = _opset(model)
    if opset < OLDEST:
        raise ValueError(f"from_onnx: {path} is of opset {opset}; expected {OLDEST} or later: export it again, or use "
                         "onnx.version_converter")
    return model


def _opset(model: Any) -> int:
    return next((int(o.version) for o in model.opset_import if o.domain in ("", "ai.onnx")), OLDEST)


def _asked(there: list[str], outputs: Sequence[str] | None, path: Any) -> list[str]:
    asked = there if outputs is None else [outputs] if isinstance(outputs, str) else outputs
    asked = list(asked) if isinstance(asked, list | tuple) else []
    if not asked or any(name not in there for name in asked) or len(set(asked)) < len(asked):
        raise ValueError(f"from_onnx: outputs is {outputs!r}; expected names of the outputs of {path}, each once: "
                         f"{', '.join(there)}")
    return asked


def _needed(graph: Any, outputs: Sequence[str]) -> tuple[list[Any], set[str]]:
    """The nodes that these outputs depend on, in order, and the names of all that enters them."""
    wanted, nodes = set(outputs), []
    for node in reversed(graph.node):
        if wanted.intersection(o for o in node.output if o):
            nodes.append(node)
            wanted.update(node.input)
    return nodes[::-1], wanted


def _plain_names(names: Sequence[str]) -> list[str]:
    plain = ["".join(c if c.isalnum() else "_" for c in n).strip("_").replace("__", "_") or "v" for n in names]
    plain = [n if n[0].isalpha() else f"v_{n}" for n in plain]
    return [n if plain.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(plain)]


def _dims(value: Any) -> list[int | None]:
    return [d.dim_value if d.HasField("dim_value") else None for d in value.type.tensor_type.shape.dim]


def _shape(value: Any) -> list[int] | None:
    """[n], [1, n] or [batch, n] with batch 1; None for any other."""
    dims = _dims(value)
    shape = [1 if i == 0 and len(dims) > 1 and n is None else n for i, n in enumerate(dims)]
    sizes = [n for n in shape if n is not None and n >= 1]
    return sizes if sizes == shape and shape and (len(shape) == 1 or shape[0] == 1) else None


def _is_column(value: Any, onnx: Any) -> bool:
    real = (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE)
    return value.type.tensor_type.elem_type in real and _shape(value) is not None


def _input(value: Any, path: Any, onnx: Any) -> Tensor:
    """A symbol for an input [n], [1, n] or [batch, n]."""
    shape, element = _shape(value), value.type.tensor_type.elem_type
    if shape is None:
        raise ValueError(f"from_onnx: the input {value.name!r} of {path} has shape {_dims(value)}; expected [n] or "
                         "[batch, n] with n fixed and the batch free or 1: export it with an example of one row")
    if not _is_column(value, onnx):
        raise ValueError(f"from_onnx: the input {value.name!r} of {path} is {onnx.TensorProto.DataType.Name(element)}; "
                         "expected FLOAT or DOUBLE: export the network with real inputs, and cast inside")
    dtype = onnx.helper.tensor_dtype_to_np_dtype(element)
    return Tensor(ca.MX.sym("x", math.prod(shape)), tuple(shape), dtype)


def _weights(stored: Any, path: Any, onnx: Any) -> Value:
    try:
        return onnx.numpy_helper.to_array(stored)
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"from_onnx: the constant {stored.name!r} of {path} cannot be read ({error}); expected "
                         "numbers of a type and a shape that fit: export the network again") from error


def _run(node: Any, values: dict[str, Value], model: Any, path: Any) -> None:
    """Work out one node; what depends on no input becomes numpy."""
    where = f"the node {node.name or node.output[0]!r} ({node.op_type}) of {path}"
    if node.op_type not in RULES or node.domain not in ("", "ai.onnx"):
        raise ValueError(f"from_onnx: {where} has no translation (docs/export.md lists what has one): "
                         f"{_remedy(node, model)}")
    shapes = [getattr(values.get(name), "shape", None) for name in node.input]
    try:
        results = _results(node, values, _opset(model))
    except (ValueError, LookupError, TypeError, ArithmeticError, NotImplementedError, RuntimeError,
            MemoryError) as error:
        raise ValueError(f"from_onnx: {where} cannot be translated, its inputs have the shapes {shapes}: {error}; or "
                         f"{_remedy(node, model)}") from error
    values |= dict(zip(node.output, results, strict=False))


def _results(node: Any, values: dict[str, Value], opset: int) -> list[Value]:
    import onnx  # stays out of `import nocl`

    missing = [name for name in node.input if name not in values]
    if missing:
        raise ValueError(f"it needs {missing[0]!r}, an output of another node that is not translated")
    args, rule = [values[name] for name in node.input], RULES[node.op_type]
    schema = onnx.defs.get_schema(node.op_type, opset, "")
    if schema.since_version > NEWEST:
        raise ValueError(f"its meaning is that of opset {schema.since_version}; expected {NEWEST} or earlier: export "
                         f"the network with opset_version={NEWEST}")
    check_types(schema, args, rule.kinds)
    options = {key: onnx.helper.get_attribute_value(a.default_value) for key, a in schema.attributes.items()
               if a.default_value.type}
    options |= {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    results = rule.run(Call(args, options, schema.since_version, len(node.output)))
    results = results if isinstance(results, list) else [results]
    if any(isinstance(a, Tensor) for a in args):
        return results
    return [known(r) if isinstance(r, Tensor) else np.asarray(r) for r in results]


def _remedy(node: Any, model: Any) -> str:
    graph = model.graph
    free = [o.name for o in graph.output if node not in _needed(graph, [o.name])[0]]
    if free:
        return f"leave out the outputs that need it, with outputs={free}"
    return "export the network without it, or use nocl.to_casadi(module, backend='l4casadi')"
