"""Every ONNX operation that is read equals ONNX Runtime: each opset and type, random and special numbers."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nocl.exports.onnx_reader import NEWEST, OLDEST, RULES, from_onnx

onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")
helper, Kind = onnx.helper, onnx.TensorProto
SPECIAL = [0.0, -0.0, 0.5, -0.5, 1.5, 2.5, -1.5, -2.5, 1.0, -1.0, 3.0, -7.0, 2.0**-10, -40.0, 30.0, math.inf, -math.inf,
           math.nan]
WHOLE = [0, 1, -1, 2, -2, 3, -3, 7, -7, 1000, -999]
TYPES = {"f": [np.float32, np.float64], "i": [np.int32, np.int64], "b": [np.bool_]}


class Fixed(np.ndarray):
    """An input that is a constant of the graph, as it is: a shape, an axis."""


class Weight(Fixed):
    """One that has the type of the other inputs."""


def fixed(values: Any, dtype: Any = np.int64) -> Any:
    return np.asarray(values, dtype).view(Fixed)


def weight(values: Any) -> Any:
    return np.asarray(values, np.float32).view(Weight)


def numbers(kind: str, rng: Any, finite: bool = False) -> Any:
    """[1, n], special and random ones."""
    if kind == "b":
        return np.array([[False, True, True, False]])
    if kind == "i":
        return np.array([[*WHOLE, *rng.integers(-50, 50, 8)]])
    special = [v for v in SPECIAL if math.isfinite(v) or not finite]
    return np.array([[*special, *rng.normal(0, 3, 10).astype(np.float32)]])


def pairs(kind: str, rng: Any, **options: bool) -> list[Any]:
    """Each number with each, [1, n^2]."""
    x = numbers(kind, rng, **options)
    return [np.repeat(x, x.size, axis=1), np.tile(x, (1, x.size))]


def block(kind: str, rng: Any) -> Any:
    """[1, 3, 4], finite, some numbers twice."""
    x = rng.normal(0, 2, (1, 3, 4)).astype(np.float32) if kind == "f" else rng.integers(-4, 5, (1, 3, 4))
    x[0, 1, 2] = x[0, 1, 0] = x[0, 2, 2]
    return x > 0 if kind == "b" else x


# What each operation is tried on: (kind, version, random numbers) -> [(arguments, attributes), ...]
Cases = Callable[[str, int, Any], list[tuple[list[Any], dict[str, Any]]]]


def unary(*attributes: dict[str, Any], finite: bool = False) -> Cases:
    return lambda kind, version, rng: [([numbers(kind, rng, finite)], a) for a in attributes or ({},)]


def binary(kind: str, version: int, rng: Any) -> list[Any]:
    x, y, box = numbers(kind, rng), rng.permutation(numbers(kind, rng)[0])[None], block(kind, rng)
    return [(pairs(kind, rng), {}), ([x, y.view(Weight)], {}), ([y.view(Weight), x], {}), ([box, box[:, :1]], {}),
            ([box[0, 0], box[..., :1]], {}), ([box, box[0, 0, 0].reshape(()).view(Weight)], {})]


def divide(kind: str, version: int, rng: Any) -> list[Any]:
    if kind == "f":
        return binary(kind, version, rng)
    x, y = pairs(kind, rng)
    return [([x[y != 0], y[y != 0]], {}), ([x, weight(2)], {}), ([x, weight(-7)], {}), ([weight(-7), weight(2)], {})]


def mod(kind: str, version: int, rng: Any) -> list[Any]:
    x, y = pairs(kind, rng)
    if kind == "f":
        return [([x, y], {"fmod": 1}), ([x, weight(2.5)], {"fmod": 1})]
    return [([x[y != 0], y[y != 0]], {"fmod": f}) for f in (0, 1)]


def power(kind: str, version: int, rng: Any) -> list[Any]:
    x, y = pairs(kind, rng)
    if kind == "i":
        return [([numbers(kind, rng), weight(n)], {}) for n in (0, 1, 2, 3)]
    whole = [([numbers(kind, rng), fixed(n)], {}) for n in (-2, -1, 0, 1, 2, 3)] if version >= 12 else []
    return [([x, y], {}), *whole, *(([numbers(kind, rng), weight(p)], {}) for p in (0.5, 2, -1, 3, 0))]


def several(kind: str, version: int, rng: Any) -> list[Any]:
    x, y = pairs(kind, rng)
    alike = [([x], {}), ([x, y], {}), ([x, y, x[:, ::-1]], {}), ([x, y.view(Weight)], {})]
    return alike + ([([x, y[:, :1].view(Weight)], {}), ([x, y[0, 5]], {})] if version >= 8 else [])


def clip(kind: str, version: int, rng: Any) -> list[Any]:
    x, low, high = numbers(kind, rng), -1, 2
    if version < 11:
        return [([x], {"min": -1.5, "max": 2.25}), ([x], {"max": 0.5}), ([x], {"min": 0.5}), ([x], {})]
    return [([x], {}), *(([x, *(None if b is None else weight(b) for b in ends)], {})
                         for ends in [(low, high), (None, high), (low, None), (high, low)])]


def where(kind: str, version: int, rng: Any) -> list[Any]:
    x, y = pairs(kind, rng)
    condition = rng.random(x.shape) > 0.5
    return [([condition, x, y], {}), ([condition.view(Fixed), x, y[:, :1]], {}), ([condition[:, :1], x, y], {})]


def casts(kind: str, version: int, rng: Any) -> list[Any]:
    x = numbers(kind, rng, finite=True)
    kinds = [Kind.FLOAT, Kind.DOUBLE, Kind.INT32, Kind.INT64, Kind.BOOL]
    return [([x], {"to": to}) for to in kinds] + ([([numbers(kind, rng)], {"to": Kind.BOOL})] if kind == "f" else [])


def casts_like(kind: str, version: int, rng: Any) -> list[Any]:
    return [([numbers(kind, rng, finite=True), fixed([0], t)], {}) for ts in TYPES.values() for t in ts]


def prelu(kind: str, version: int, rng: Any) -> list[Any]:
    x = numbers(kind, rng)
    slopes = [[0.3], rng.normal(size=x.shape[1]), rng.normal(size=x.shape)]
    return [([x, weight(s)], {}) for s in slopes] + [(pairs(kind, rng, finite=True), {})]


def reduction(since: int) -> Cases:
    """since: the opset from which the axes are an input."""

    def cases(kind: str, version: int, rng: Any) -> list[Any]:
        x = block(kind, rng)
        x = np.abs(x) + 1 if kind == "f" and rng.random() < 0.5 else x
        axes = [None, [1], [-1], [2, 1], [-1, 0], [0, 1, 2]]
        found = [[([x], {"keepdims": k} | ({} if a is None else {"axes": a}))] if version < since else
                 [([x, *([] if a is None else [fixed(a)])], {"keepdims": k})] for a in axes for k in (0, 1)]
        if version >= since:
            found += [[([x, *more], {"noop_with_empty_axes": n})] for n in (0, 1) for more in ([], [fixed([])])]
        return [case for cases in found for case in cases]

    return cases


def extreme_index(kind: str, version: int, rng: Any) -> list[Any]:
    x, last = block(kind, rng), [{"select_last_index": 1}] if version >= 12 else []
    return [([x], {"axis": a, "keepdims": k, **more}) for a in (0, 1, 2, -1) for k in (0, 1) for more in ({}, *last)]


def softmax(kind: str, version: int, rng: Any) -> list[Any]:
    x = block(kind, rng)
    masked = np.array([[1.0, -math.inf, 0.5, -80.0, 90.0]])
    return [([x], {}), *(([x], {"axis": a}) for a in (0, 1, 2, -1)), ([masked], {}), ([100 * x], {})]


def gemm(kind: str, version: int, rng: Any) -> list[Any]:
    a, b, c = (rng.normal(size=s).astype(np.float32) for s in ((1, 4), (4, 3), (3,)))
    flips = {"transB": 1, "alpha": 0.5, "beta": -2.0}
    column = {"transA": 1, "transB": 1}
    return [([a, b.view(Weight), c.view(Weight)], {}), ([a, b.T.copy().view(Weight), c.view(Weight)], flips),
            ([b.view(Weight), a, np.ones((3, 1), np.float32).view(Weight)], column), ([a, b, c], {"beta": 0.5}),
            *([([a, b.view(Weight)], {"alpha": 2.0})] if version >= 11 else [])]


def matmul(kind: str, version: int, rng: Any) -> list[Any]:
    shapes = [((1, 4), (4, 3)), ((4,), (4, 3)), ((3, 4), (4,)), ((4,), (4,)), ((1, 3, 4), (4, 2)),
              ((1, 2, 3, 4), (2, 4, 3)), ((3, 4), (1, 4, 1)), ((1, 2, 3), (1, 3, 2))]
    both = [[rng.normal(size=s).astype(np.float32) for s in pair] for pair in shapes]
    return [([a, b], {}) for a, b in both] + [([a, b.view(Weight)], {}) for a, b in both]


def layer_norm(kind: str, version: int, rng: Any) -> list[Any]:
    x, s, b = block(kind, rng), *(weight(rng.normal(size=4)) for _ in range(2))
    wide = [weight(rng.normal(size=(3, 4))) for _ in range(2)]
    return [([x, s, b], {}), ([x, s], {"epsilon": 0.1}), ([x, *wide], {"axis": 1}), ([x, wide[0]], {"axis": -2})]


def rms_norm(kind: str, version: int, rng: Any) -> list[Any]:
    return [(args[:2], options) for args, options in layer_norm(kind, version, rng)]


def batch_norm(kind: str, version: int, rng: Any) -> list[Any]:
    x, more = block(kind, rng), {"epsilon": 0.01}
    weights = [weight(v) for v in (*rng.normal(size=(3, 3)), rng.uniform(0, 2, 3))]
    return [([x, *weights], {}), ([x, *weights], more), ([x[:, :, 0], *weights], {})]


def dropout(kind: str, version: int, rng: Any) -> list[Any]:
    x = numbers(kind, rng)
    if version < 12:
        return [([x], {"ratio": 0.3}), ([x], {})]
    return [([x], {}), ([x, fixed(0.3, np.float32)], {}), ([x, fixed(0.3, np.float32), fixed(False, bool)], {}),
            ([x, fixed(0, np.float32), fixed(True, bool)], {})]


def reshape(kind: str, version: int, rng: Any) -> list[Any]:
    sizes = [[12], [-1], [1, -1], [0, 4, 3], [2, 0, 2], [1, 2, -1, 2], [0, 0, 4]]
    return [([block(kind, rng), fixed(s)], {}) for s in sizes]


def sliced(kind: str, version: int, rng: Any) -> list[Any]:
    x, far = block(kind, rng), 2**63 - 1
    plain = [([1], [3], [2]), ([0, 1], [2, far], [1, 2]), ([-2], [-1], [2]), ([-100], [far], [1]), ([2], [-far], [2])]
    if version < 10:
        short = [([x], {"starts": [0], "ends": [1]})]
        return short + [([x], {"starts": s, "ends": e, "axes": a}) for s, e, a in plain[:4]]
    steps = [([3], [0], [2], [-1]), ([-1], [-far], [2], [-2]), ([0], [far], [2], [3]), ([-100], [-100], [2], [-1]),
             ([far, 0], [-far, 2], [-1, 1], [-1, 1]), ([2], [-4], [2], [-1])]
    return [([x, *(fixed(v) for v in case)], {}) for case in plain[:4] + steps] + [([x, fixed([0]), fixed([1])], {})]


def split(kind: str, version: int, rng: Any) -> list[Any]:
    x = block(kind, rng)
    sizes, whole = [[1, 3], [2, 2], [4]], [([x], {"axis": 1, "outputs": 3}), ([x], {"axis": -1, "outputs": 2})]
    if version >= 18:
        parts = ((2, 3), (2, 2), (-1, 4), (1, 3), (-2, 2))
        whole = [([x], {"axis": a, "num_outputs": n, "outputs": n}) for a, n in parts]
    if version < 13:
        return whole + [([x], {"axis": 2, "split": s, "outputs": len(s)}) for s in sizes]
    return whole + [([x, fixed(s)], {"axis": -1, "outputs": len(s)}) for s in sizes]


def with_axes(shape: tuple[int, ...], *axes: list[int] | None) -> Cases:
    """Squeeze and Unsqueeze: an attribute, from opset 13 on an input."""

    def cases(kind: str, version: int, rng: Any) -> list[Any]:
        x = block(kind, rng).reshape(shape)
        as_input = [([x, *([] if a is None else [fixed(a)])], {}) for a in axes]
        return as_input if version >= 13 else [([x], {} if a is None else {"axes": a}) for a in axes]

    return cases


def sized(*sizes: list[int]) -> Cases:
    return lambda kind, version, rng: [([block(kind, rng), fixed(s)], {}) for s in sizes]


def gather(kind: str, version: int, rng: Any) -> list[Any]:
    x = block(kind, rng)
    return [([x, fixed(i)], {"axis": a}) for i, a in ((0, 2), ([0], 1), ([[1, -1], [3, 0]], -1), ([2, 1, 0, 0], 1))]


def gather_elements(kind: str, version: int, rng: Any) -> list[Any]:
    x = block(kind, rng)
    return [([x, fixed(np.tile([1, -1, 0], (1, 2, 1)))], {"axis": 2}), ([x, fixed(np.tile([2, 0, 1, 1], (1, 1, 1)))],
                                                                        {"axis": 1})]


def concat(kind: str, version: int, rng: Any) -> list[Any]:
    x, y = block(kind, rng), block(kind, rng)
    return [([x, y], {"axis": 1}), ([x, y[..., :2], x], {"axis": -1}), ([x, y.view(Weight)], {"axis": 2}),
            ([x], {"axis": 0})]


def flatten(kind: str, version: int, rng: Any) -> list[Any]:
    axes = [0, 1, 2, 3, *([-1, -2] if version >= 11 else [])]
    return [([block(kind, rng)], options) for options in ({}, *({"axis": a} for a in axes))]


def transpose(kind: str, version: int, rng: Any) -> list[Any]:
    return [([block(kind, rng)], {} if p is None else {"perm": p}) for p in (None, [0, 2, 1], [2, 0, 1])]


def shape(kind: str, version: int, rng: Any) -> list[Any]:
    ends = [{"start": 1}, {"end": -1}, {"start": -2, "end": 100}, {"start": -9}] if version >= 15 else []
    return [([block(kind, rng)], options) for options in ({}, *ends)]


def constant(kind: str, version: int, rng: Any) -> list[Any]:
    value = [([], {"value": onnx.numpy_helper.from_array(block(kind, rng))})]
    if version < 12:
        return value
    more = {"value_float": 0.1, "value_floats": [0.1, 2.0], "value_int": 3, "value_ints": [3, -4]}
    return value + [([], {key: v}) for key, v in more.items()]


def constant_of_shape(kind: str, version: int, rng: Any) -> list[Any]:
    values = [np.float32([1.7]), np.int64([-3]), np.array([True])]
    return [([fixed([2, 3])], o) for o in ({}, *({"value": onnx.numpy_helper.from_array(v)} for v in values))]


def count(kind: str, version: int, rng: Any) -> list[Any]:
    return [([fixed(a), fixed(b), fixed(c)], {}) for a, b, c in ((0, 5, 1), (7, -2, -3), (3, 3, 1))]


ALPHA = ({}, {"alpha": 0.3}, {"alpha": 1.7})
CASES: dict[str, Cases] = {
    **{op: unary() for op in RULES},  # but for
    **dict.fromkeys(("Add", "Sub", "Mul", "Less", "LessOrEqual", "Greater", "GreaterOrEqual"), binary),
    **dict.fromkeys(("Equal", "And", "Or", "Xor"), binary), **dict.fromkeys(("Sum", "Mean", "Max", "Min"), several),
    **dict.fromkeys(("Elu", "LeakyRelu", "ThresholdedRelu", "Celu", "Swish"), unary(*ALPHA)),
    "Div": divide, "Mod": mod, "Pow": power, "Clip": clip, "Where": where, "Cast": casts, "CastLike": casts_like,
    "PRelu": prelu, "Selu": unary({}, {"alpha": 1.2, "gamma": 0.7}),
    "HardSigmoid": unary({}, {"alpha": 0.5, "beta": 0.1}), "Shrink": unary({}, {"lambd": 1.5, "bias": 0.25}),
    "Gelu": unary({}, {"approximate": "tanh"}, {"approximate": "none"}),
    "IsInf": unary({}, {"detect_positive": 0}, {"detect_negative": 0}), "MatMul": matmul, "Gemm": gemm,
    **{op: reduction(18) for op in RULES if op.startswith("Reduce")}, "ReduceSum": reduction(13),
    **dict.fromkeys(("ArgMax", "ArgMin"), extreme_index), **dict.fromkeys(("Softmax", "LogSoftmax"), softmax),
    "LayerNormalization": layer_norm, "RMSNormalization": rms_norm, "BatchNormalization": batch_norm,
    "Dropout": dropout, "Constant": constant, "ConstantOfShape": constant_of_shape, "Range": count, "Shape": shape,
    "Concat": concat, "Transpose": transpose, "Reshape": reshape, "Flatten": flatten, "Slice": sliced, "Split": split,
    "Gather": gather, "GatherElements": gather_elements, "Expand": sized([1, 3, 4], [2, 1, 1, 4], [1], [3, 1]),
    "Tile": sized([1, 2, 3], [1] * 3),
    "Squeeze": with_axes((1, 3, 1, 4), None, [0], [2], [-2], [0, 2]),
    "Unsqueeze": with_axes((3, 4), [0], [-1], [1, 3], [0, -1])}
NO_INPUT_KIND = {"Constant", "ConstantOfShape", "Range"}


HISTORY = [(s.name, s.since_version) for s in onnx.defs.get_all_schemas_with_history() if not s.domain]


def versions(op: str) -> list[int]:
    """The opsets that gave this operation its meanings, of those that are read."""
    began = sorted(version for name, version in HISTORY if name == op)
    ended = [*began[1:], NEWEST + 1]
    return [max(v, OLDEST) for v, end in zip(began, ended, strict=True) if v <= NEWEST and end > OLDEST]


def kinds(op: str, version: int) -> str:
    """The kinds of numbers that are read, of those that the opset's definition has."""
    if op in NO_INPUT_KIND:
        return "f"
    inputs = list(onnx.defs.get_schema(op, version, "").inputs)
    formal = next((i for i in inputs if len(i.types) > 1), inputs[0])  # not a condition or a shape
    spelled = {"f": "tensor(float)", "i": "tensor(int64)", "b": "tensor(bool)"}
    return "".join(k for k in "fib" if (k in RULES[op].kinds or RULES[op].kinds == "*") and spelled[k] in formal.types)


class Graph:
    """A model of one operation, a node for each case. Inputs come in as rows of reals, and are given shape and type."""

    def __init__(self, dynamic: bool) -> None:
        self.dynamic, self.rows = dynamic, []
        self.nodes, self.inputs, self.constants, self.outputs = [], [], [], []

    def add(self, op: str, args: list[Any], options: dict[str, Any]) -> None:
        options = dict(options)
        names = ["" if a is None else self.argument(a) for a in args]
        outputs = [f"y{len(self.outputs) + i}" for i in range(options.pop("outputs", 1))]
        self.outputs += outputs
        self.nodes.append(helper.make_node(op, names, outputs, **options))

    def argument(self, a: Any) -> str:
        if isinstance(a, Fixed) or not self.dynamic:
            return self.constant(np.asarray(a))
        k, element = len(self.inputs), helper.np_dtype_to_tensor_dtype(a.dtype)
        real = element if a.dtype.kind == "f" else Kind.FLOAT
        self.inputs.append(helper.make_tensor_value_info(f"x{k}", real, [a.size]))
        self.rows.append(a.ravel() if a.dtype.kind == "f" else a.ravel().astype(np.float32))
        self.nodes += [helper.make_node("Reshape", [f"x{k}", self.constant(np.array(a.shape, np.int64))], [f"r{k}"]),
                       helper.make_node("Cast", [f"r{k}"], [f"a{k}"], to=element)]
        return f"a{k}"

    def constant(self, value: Any) -> str:
        self.constants.append(onnx.numpy_helper.from_array(value, f"c{len(self.constants)}"))
        return self.constants[-1].name

    def model(self, version: int) -> Any:
        ends = [helper.make_empty_tensor_value_info(o) for o in self.outputs]
        graph = helper.make_graph(self.nodes, "g", self.inputs, ends, self.constants)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", version)], ir_version=10)


def runtime(model: Any, rows: list[Any]) -> list[Any] | None:
    """ONNX Runtime's answers; None where it has not the operation for these types."""
    options = ort.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        session = ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its own types
        if any(text in str(error) for text in ("NOT_IMPLEMENTED", "is invalid")):
            return None
        raise
    return session.run(None, {i.name: row for i, row in zip(session.get_inputs(), rows, strict=True)})


def typed(args: list[Any], kind: str, dtype: Any) -> list[Any]:
    """The numbers of this kind in one of its types, weights too; shapes and axes stay."""
    return [a if a is None or type(a) is Fixed or (a.dtype.kind != kind and not isinstance(a, Weight)) else
            a.astype(dtype) for a in args]


def same(path: Any, model: Any, expected: list[Any], rows: list[Any], single: bool) -> None:
    for info, y in zip(model.graph.output, expected, strict=True):
        info.CopyFrom(helper.make_tensor_value_info(info.name, helper.np_dtype_to_tensor_dtype(y.dtype), y.shape))
    onnx.save(model, path)
    f = from_onnx(path)
    found = f.call([np.asarray(a, np.float64) for a in rows])
    for y, z in zip(found, expected, strict=True):
        tolerance = 0 if z.dtype.kind != "f" else 2e-5 if single else 1e-12
        with np.errstate(over="ignore"):
            rounded = np.asarray(y.full()).ravel().astype(z.dtype)  # infinite beyond what float32 holds
        assert z.dtype.kind == "f" or np.array_equal(rounded, y.full().ravel())
        np.testing.assert_allclose(rounded.astype(np.float64), z.ravel().astype(np.float64), rtol=tolerance,
                                   atol=tolerance)


@pytest.mark.parametrize(("op", "version", "kind"), [
    (op, version, kind) for op in sorted(RULES) for version in versions(op)
    for kind in kinds(op, version)])
def test_each_operation_equals_onnx_runtime(tmp_path, op, version, kind):
    compared, newest = 0, version == versions(op)[-1]
    for dtype in TYPES[kind] if newest else TYPES[kind][-1:] if kind == "i" else TYPES[kind][:1]:
        for dynamic in (True, False) if newest else (True,):
            graph = Graph(dynamic)
            for args, options in CASES[op](kind, version, np.random.default_rng(zlib.crc32(op.encode()))):
                graph.add(op, typed(args, kind, dtype), options)
            model = graph.model(version)
            expected = runtime(model, graph.rows)
            if expected is not None:
                same(tmp_path / "g.onnx", model, expected, graph.rows, dtype is np.float32 or op == "Gelu")
                compared += 1
    assert compared, f"ONNX Runtime has no {op} of opset {version} for {kind}"


def test_the_documentation_names_what_is_read():
    text = (Path(__file__).parents[1] / "docs" / "export.md").read_text()
    table = text[text.index("| kind | operations |"):].split("\n\n")[0]
    assert sorted(op for line in table.splitlines()[2:] for op in line.split("|")[2].split()) == sorted(RULES)
