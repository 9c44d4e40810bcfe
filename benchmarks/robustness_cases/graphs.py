"""ONNX graphs: every operation that is read, alone and in chains, against ONNX Runtime; what is not exact is refused.

The cases of single operations are those of tests/test_onnx_operations.py, with other numbers.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
import test_onnx_operations as single
from onnx import TensorProto, helper

from nocl.exports.onnx_reader import RULES

from . import NOTHING

CHAINS, LONGEST = 60, 7
UNARY = ("Abs", "Neg", "Tanh", "Sigmoid", "Relu", "Elu", "Selu", "Celu", "Softplus", "Softsign", "HardSigmoid",
         "HardSwish", "Floor", "Ceil", "Round", "Sign", "Sin", "Cos", "Erf", "LeakyRelu", "Identity", "Exp")
BINARY = ("Add", "Sub", "Mul", "Max", "Min")


def operation(op: str, version: int, kind: str, seed: int, path: Path) -> str:
    graph = single.Graph(True)
    for args, options in single.CASES[op](kind, version, np.random.default_rng(seed)):
        graph.add(op, single.typed(args, kind, single.TYPES[kind][-1]), options)
    model = graph.model(version)
    expected = single.runtime(model, graph.rows)
    return NOTHING if expected is None else compared(path, model, expected, graph.rows, op == "Gelu")


def compared(path: Path, model: Any, expected: list[Any], rows: list[Any], loose: bool = False) -> str:
    """"" where all outputs are ONNX Runtime's, or the graph is refused with a reason."""
    try:
        single.same(path, model, expected, rows, loose)
    except AssertionError as error:
        return " ".join(str(error).split())
    except ValueError as error:
        return "" if "expected" in str(error) or "translat" in str(error) else f"refused without a remedy: {error}"
    return ""


def chain(rng: np.random.Generator, path: Path) -> str:
    """A random graph of up to LONGEST nodes on one row [1, n]."""
    n = int(rng.integers(2, 7))
    graph, names = single.Graph(True), ["x"]
    graph.inputs = [helper.make_tensor_value_info("x", TensorProto.DOUBLE, [1, n])]
    graph.rows = [rng.normal(0, 2, (1, n))]
    for k in range(int(rng.integers(3, LONGEST + 1))):
        names.append(f"v{k}")
        graph.nodes.append(node(rng, graph, str(rng.choice(names[:-1])), str(rng.choice(names[:-1])), f"v{k}", n))
    graph.outputs = [names[-1]]
    model = graph.model(20)
    expected = single.runtime(model, graph.rows)
    return NOTHING if expected is None else compared(path, model, expected, graph.rows)


def node(rng: np.random.Generator, graph: Any, a: str, b: str, out: str, n: int) -> Any:
    """One that keeps [1, n]."""
    form = rng.integers(6)
    if form == 0:
        return helper.make_node("MatMul", [a, graph.constant(rng.normal(0, 0.5, (n, n)))], [out])
    if form == 1:
        return helper.make_node(str(rng.choice(BINARY)), [a, b], [out])
    if form == 2:
        return helper.make_node("Gather", [a, graph.constant(rng.permutation(n))], [out], axis=1)
    if form == 3:
        return helper.make_node("Clip", [a, graph.constant(np.array(-1.5)), graph.constant(np.array(2.5))], [out])
    if form == 4:
        return helper.make_node("Softmax", [a], [out], axis=-1)
    return helper.make_node(str(rng.choice(UNARY)), [a], [out])


def truncated(rng: np.random.Generator, path: Path) -> str:
    """A damaged file is refused, or is a graph that means what it says."""
    from nocl.exports.onnx_reader import from_onnx

    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3])
    graph = helper.make_graph([helper.make_node("Tanh", ["x"], ["y"])], "g", [x], [y])
    content = helper.make_model(graph, ir_version=10).SerializeToString()
    path.write_bytes(content[: int(rng.integers(0, len(content)))])
    try:
        from_onnx(path)
    except ValueError:
        return ""
    return "a cut file was read"


def kinds(rng: np.random.Generator, folder: Path) -> Iterator[tuple[str, list[tuple[str, Callable[[], str]]]]]:
    path, seed = folder / "g.onnx", int(rng.integers(2**31))
    every = [(op, v, k) for op in sorted(RULES) for v in single.versions(op)[-1:] for k in single.kinds(op, v)]
    yield "single operations", [(f"{op} {v} {k}", lambda c=(op, v, k): operation(*c, seed, path)) for op, v, k in every]
    yield "chains", [(f"chain {i}", lambda i=i: chain(np.random.default_rng((seed, i)), path)) for i in range(CHAINS)]
    yield "cut files", [(f"cut {i}", lambda i=i: truncated(np.random.default_rng((seed, i)), path)) for i in range(12)]
