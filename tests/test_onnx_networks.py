"""Whole ONNX files: policies as they are exported, types along the way, outputs asked for, refusals."""

from __future__ import annotations

import io
import math
import warnings
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from torch import nn

from nocl.exports.onnx_reader import NEWEST, from_onnx

onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")
helper, Kind = onnx.helper, onnx.TensorProto
Node = tuple[str, str, str] | tuple[str, str, str, dict[str, Any]]  # "op", "inputs", "outputs", attributes


def graph(path: Any, nodes: list[Node], constants: dict[str, Any] | None = None, *, n: Any = (1, 4), opset: int = 18,
          element: int = Kind.FLOAT, outputs: str = "y", functions: Any = (), more: Any = ()) -> Any:
    """A file with the input x [n]; names of inputs and outputs stand in one string, "-" for one that is left out."""
    made = [helper.make_node(op, [i.strip("-") for i in a.split()], y.split(), **(o[0] if o else {}))
            for op, a, y, *o in nodes]
    weights = [onnx.numpy_helper.from_array(np.asarray(v), k) for k, v in (constants or {}).items()]
    inputs = [helper.make_tensor_value_info("x", element, n), *more]
    ends = [helper.make_empty_tensor_value_info(y) for y in outputs.split()]
    opsets = [helper.make_opsetid("", opset), *(helper.make_opsetid(f.domain, 1) for f in functions)]
    model = helper.make_model(helper.make_graph(made, "g", inputs, ends, weights), opset_imports=opsets, ir_version=10,
                              functions=list(functions))
    model = onnx.shape_inference.infer_shapes(model)
    for end in model.graph.output:
        if not end.type.tensor_type.HasField("shape"):
            end.CopyFrom(helper.make_tensor_value_info(end.name, end.type.tensor_type.elem_type or element, None))
            end.type.tensor_type.shape.SetInParent()
    (path / "g.onnx").write_bytes(model.SerializeToString())
    return path / "g.onnx"


def runtime(path: Any, row: Any) -> list[Any]:
    options = ort.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return session.run(None, {session.get_inputs()[0].name: row})


def check(path: Any, rows: Any, tolerance: float = 1e-5, **options: Any) -> ca.Function:
    """One row after the other, all outputs."""
    f = from_onnx(path, **options)
    for row in rows:
        for y, z in zip(f.call([row.ravel().astype(np.float64)]), runtime(path, row), strict=True):
            np.testing.assert_allclose(np.asarray(y.full()).ravel(), z.ravel().astype(np.float64), rtol=tolerance,
                                       atol=tolerance)
    return f


# Policies, as torch exports them


class Squashed(nn.Module):
    """SAC's: mean and logarithm of the deviation from one layer, by chunk."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 4))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, log_std = self.body(x).chunk(2, -1)
        return torch.tanh(mean), log_std.clamp(-20, 2).exp()


class Gaussian(nn.Module):
    """PPO's: action, value, the logarithm of the action's probability."""

    def __init__(self, sampled: bool) -> None:
        super().__init__()
        self.sampled = sampled
        self.actor, self.critic = nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 2)), nn.Linear(4, 1)
        self.log_std = nn.Parameter(torch.tensor([-0.5, 0.3]))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        law = torch.distributions.Normal(self.actor(x), self.log_std.exp().expand(len(x), 2), validate_args=False)
        action = law.rsample() if self.sampled else law.mean.clamp(-0.1, 0.1)
        return law.mean, self.critic(x), law.log_prob(action).sum(-1)


class Gridded(nn.Module):
    """Whole numbers along the way: the action is one of a table, the state is rounded, and divided as integers."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        cell = (3 * x).to(torch.int64)
        best = torch.argmax(x, -1, keepdim=True)
        return torch.cat([cell.float() / 3, torch.round(2 * x), best.float(), (cell % 3).float(),
                          torch.div(cell, 2, rounding_mode="trunc").float(), x / x.norm(dim=-1, keepdim=True)], -1)


def layers(*middle: nn.Module) -> nn.Module:
    net = nn.Sequential(nn.Linear(4, 8), *middle, nn.Linear(8, 2))
    for m in net:
        if isinstance(m, nn.BatchNorm1d):
            m.running_mean, m.running_var = torch.randn(8), torch.rand(8)
    return net


NETS = {"sac": Squashed, "ppo": lambda: Gaussian(sampled=False), "whole numbers": Gridded,
        "norms": lambda: layers(nn.LayerNorm(8), nn.GELU(), nn.Linear(8, 8), nn.BatchNorm1d(8), nn.SiLU(),
                                nn.Dropout()),
        "hard": lambda: layers(nn.Hardswish(), nn.Hardsigmoid(), nn.ReLU6(), nn.Hardtanh(-0.3, 0.4),
                               nn.Hardshrink(0.1)),
        "soft": lambda: layers(nn.SELU(), nn.CELU(0.7), nn.ELU(1.3), nn.PReLU(8), nn.Mish(), nn.Softplus(),
                               nn.LogSigmoid(), nn.LeakyReLU(0.2), nn.Softsign(), nn.Tanhshrink()),
        "shares": lambda: layers(nn.Softmax(-1), nn.LogSoftmax(-1), nn.GLU(), nn.Linear(4, 8))}


def exported(net: nn.Module, path: Any, opset: int, dynamo: bool) -> Any:
    file, names = io.BytesIO(), {"input_names": ["obs"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if dynamo:
            batch = {"dynamic_shapes": ({0: torch.export.Dim("batch")},)}
        else:
            batch = {"dynamic_axes": {"obs": {0: "batch"}}}
        torch.onnx.export(net.eval(), (torch.randn(2 if dynamo else 1, 4),), file, opset_version=opset, dynamo=dynamo,
                          **names, **batch)
    (path / "net.onnx").write_bytes(file.getvalue())
    return path / "net.onnx"


@pytest.mark.parametrize("dynamo", [False, True])
@pytest.mark.parametrize("opset", [13, 18, 20])
@pytest.mark.parametrize("kind", NETS)
def test_policies_from_torch(tmp_path, kind, opset, dynamo):
    if dynamo:
        pytest.importorskip("onnxscript")
        if opset < 18:
            pytest.skip("this exporter writes opset 18 and later")
    torch.manual_seed(0)
    path = exported(NETS[kind](), tmp_path, opset, dynamo)
    f = check(path, np.random.default_rng(0).normal(0, 2, (6, 1, 4)).astype(np.float32), 3e-5)
    assert f.name_in() == ["obs"]


@pytest.mark.parametrize(("size", "parts"), [(4, 2), (5, 2), (6, 4), (3, 3)])
def test_a_chunk_as_the_default_exporter_writes_it(tmp_path, size, parts):
    rng, names = np.random.default_rng(0), " ".join(f"y{i}" for i in range(parts))
    W = rng.normal(size=(4, size)).astype(np.float32)
    nodes: list[Node] = [("MatMul", "x W", "h"), ("Split", "h", names, {"axis": -1, "num_outputs": parts})]
    check(graph(tmp_path, nodes, {"W": W}, n=("batch", 4), outputs=names), rng.normal(size=(3, 1, 4)).astype("f"))


def test_functions_in_the_file_are_written_out(tmp_path):
    opsets = [helper.make_opsetid("", 18)]
    body = [helper.make_node("Sigmoid", ["a"], ["s"]), helper.make_node("Mul", ["a", "s"], ["b"])]
    silu = helper.make_function("torch_lib", "silu", ["a"], ["b"], body, opsets)
    path = graph(tmp_path, [("silu", "x", "y")], functions=[silu])
    model = onnx.load(path)
    model.graph.node[0].domain = "torch_lib"
    model.graph.output[0].CopyFrom(helper.make_tensor_value_info("y", Kind.FLOAT, [1, 4]))
    onnx.save(model, path)
    check(path, np.random.default_rng(0).normal(size=(3, 1, 4)).astype("f"))


# Types, special numbers


@pytest.mark.parametrize(("nodes", "constants", "row", "expected"), [
    ([("Cast", "x", "i", {"to": Kind.INT64}), ("Cast", "i", "y", {"to": Kind.FLOAT})], {}, [1.7, -2.3, 0.4],
     [1, -2, 0]),
    ([("Cast", "x", "i", {"to": Kind.BOOL}), ("Cast", "i", "y", {"to": Kind.FLOAT})], {}, [0.3, -1.7, 0], [1, 1, 0]),
    ([("Cast", "x", "i", {"to": Kind.INT64}), ("Div", "i two", "q"), ("Cast", "q", "y", {"to": Kind.FLOAT})],
     {"two": np.int64(2)}, [-7, 7, 3], [-3, 3, 1]),
    ([("Div", "a two", "q"), ("Cast", "q", "f", {"to": Kind.FLOAT}), ("Add", "x f", "y")],
     {"a": np.int64(-7), "two": np.int64(2)}, [0, 1, 2], [-3, -2, -1]),
    ([("Cast", "c", "i", {"to": Kind.INT64}), ("Cast", "i", "f", {"to": Kind.FLOAT}), ("Add", "x f", "y")],
     {"c": np.float32(1.7)}, [0.3, -1.7, 0], [1.3, -0.7, 1]),
    ([("Mul", "c ten", "t"), ("Floor", "t", "f"), ("Add", "x f", "y")],  # 0.1f * 10f is 1 in float32, more in float64
     {"c": np.float32(0.1), "ten": np.float32(10)}, [0, 1, 2], [1, 2, 3]),
    ([("ReduceSum", "x", "y", {"noop_with_empty_axes": 1})], {}, [1, -2, 4], [1, -2, 4]),
    ([("ReduceSum", "x none", "y", {"noop_with_empty_axes": 0})], {"none": np.int64([])}, [1, -2, 4], [3]),
    ([("Cast", "w", "f", {"to": Kind.FLOAT}), ("Mul", "x f", "y")], {"w": np.float16([0.1, 3])[:1]}, [1, 2, 3],
     np.float16(0.1) * np.array([1.0, 2, 3]))])
def test_types_along_the_way(tmp_path, nodes, constants, row, expected):
    path = graph(tmp_path, nodes, constants, n=[3])
    y = from_onnx(path)(np.array(row, np.float64)).full().ravel()
    np.testing.assert_allclose(y, expected, rtol=1e-7)
    np.testing.assert_allclose(y, runtime(path, np.float32(row))[0], rtol=1e-6)


@pytest.mark.parametrize(("node", "constants"), [
    (("Sub", "x x", "y"), {}), (("Div", "x x", "y"), {}), (("Equal", "x x", "y"), {}),
    (("LessOrEqual", "x x", "y"), {}), (("Mul", "x zero", "y"), {"zero": np.float64(0)}),
    (("Div", "zero x", "y"), {"zero": np.zeros((1, 5))}),
    (("Max", "x x", "y"), {}),
    (("Where", "c x zero", "y"), {"c": np.array([[True, False, False, True, True]]), "zero": np.float64(0)})])
def test_nothing_is_simplified_that_changes_a_value(tmp_path, node, constants):
    path = graph(tmp_path, [node], constants, n=(1, 5), element=Kind.DOUBLE)
    check(path, np.array([[[0.0, math.inf, math.nan, 2.0, -math.inf]]]), 0)
    assert ca.GlobalOptions.getSimplificationOnTheFly()


def test_whole_numbers_that_float64_does_not_hold_are_nan(tmp_path):
    path = graph(tmp_path, [("Cast", "x", "i", {"to": Kind.INT64}), ("Mul", "i i", "y")], n=[4], element=Kind.DOUBLE)
    np.testing.assert_array_equal(from_onnx(path)([1e8, 3, 1e300, -9.9]).full().ravel(), [math.nan, 9, math.nan, 81])


def step(rng: Any, pool: dict[str, list[str]], k: int) -> list[Node]:
    """A random node or two on what there is, by kind: reals f, whole numbers i, truths b. All [1, 6]."""
    f, g, i, j, b = (str(rng.choice(pool[kind])) for kind in "ffiib")
    y = f"v{k}"
    real: list[list[Node]] = [[(op, f"{f} {g}", y)] for op in ("Add", "Sub", "Mul", "Max", "Min")]
    real += [[(op, f, y)] for op in ("Neg", "Abs", "Floor", "Ceil", "Round", "Sign", "Tanh", "Sigmoid", "Relu", "Sqrt")]
    real += [[("Softmax", f, y)], [("Div", f"{f} c", y)], [("Clip", f"{f} low high", y)],
             [("Mod", f"{f} {g}", y, {"fmod": 1})], [("Where", f"{b} {f} {g}", y)],
             [("Cast", i, y, {"to": Kind.DOUBLE})], [("Cast", b, y, {"to": Kind.DOUBLE})],
             [("ReduceSum", f, f"{y}s"), ("Add", f"{f} {y}s", y)],
             [("Transpose", f, f"{y}t"), ("Reshape", f"{y}t row", y)]]
    whole: list[list[Node]] = [[(op, f"{i} {j}", y)] for op in ("Add", "Sub", "Min", "Max")]
    whole += [[("Div", f"{i} three", y)], [("Mod", f"{i} three", y)], [("Where", f"{b} {i} {j}", y)], [("Neg", i, y)],
              [("Clip", f"{f} low high", f"{y}c"), ("IsNaN", f, f"{y}n"), ("Where", f"{y}n low {y}c", f"{y}w"),
               ("Cast", f"{y}w", y, {"to": Kind.INT64})],
              [("Cast", b, y, {"to": Kind.INT64})], [("ArgMax", f, f"{y}a", {"axis": 1}), ("Add", f"{i} {y}a", y)]]
    truth: list[list[Node]] = [[(op, f"{f} {g}", y)] for op in ("Less", "GreaterOrEqual")]
    truth += [[("Equal", f"{i} {j}", y)], [("Cast", f, y, {"to": Kind.BOOL})], [("Not", b, y)], [("IsNaN", f, y)],
              [("Cast", i, y, {"to": Kind.BOOL})], [("Xor", f"{b} true", y)]]
    kind, choices = (("f", real), ("i", whole), ("b", truth))[int(rng.choice(3, p=[0.5, 0.3, 0.2]))]
    pool[kind].append(y)
    return choices[int(rng.integers(len(choices)))]


@pytest.mark.parametrize("seed", range(40))
def test_random_graphs(tmp_path, seed):
    """Thirty random operations in float64, every value on the way compared."""
    rng = np.random.default_rng(seed)
    pool = {"f": ["x", "c"], "i": ["n", "three"], "b": ["true"]}
    nodes = [node for k in range(30) for node in step(rng, pool, k)]
    constants = {"c": np.round(8 * rng.normal(size=(1, 6))) / 8, "n": rng.integers(-9, 9, (1, 6)),
                 "three": np.full((1, 6), -3), "true": np.full((1, 6), True), "low": np.float64(-20),
                 "high": np.float64(30.5), "row": np.int64([1, 6])}
    names = [name for kind in pool.values() for name in kind if name.startswith("v")]
    path = graph(tmp_path, nodes, constants, n=(1, 6), element=Kind.DOUBLE, outputs=" ".join(names))
    eighths = np.round(8 * rng.normal(0, 3, (1, 6))) / 8  # sums are exact, in any order: no ties but true ones
    rows = [eighths, np.array([[0, 0.5, -1.5, 2.5, -7, 1.0]]), np.round(rng.normal(0, 3, (1, 6)))]
    check(path, rows, 1e-10)


@pytest.mark.parametrize(("op", "options"), [
    ("Elu", {}), ("Celu", {"alpha": 0.7}), ("Softplus", {}), ("Sigmoid", {}), ("Gelu", {}),
    ("Gelu", {"approximate": "tanh"}), ("Mish", {}), ("Softmax", {}),
    ("LogSoftmax", {}), ("ReduceL2", {}), ("LayerNormalization", {}), ("Selu", {})])
def test_smooth_operations_have_both_derivatives(tmp_path, op, options):
    inputs, constants = ("x one", {"one": np.ones(4, np.float32)}) if op == "LayerNormalization" else ("x", {})
    f = from_onnx(graph(tmp_path, [(op, inputs, "y", options)], constants, opset=20))
    x = ca.MX.sym("x", 4)
    slope = ca.Function("slope", [x], [ca.vec(ca.jacobian(f(x), x))])
    curve = ca.Function("curve", [x], [ca.jacobian(slope(x), x)])
    h = 1e-6
    for at in (np.array([0.3, -0.8, 1.4, -2.0]), np.array([30.0, -40.0, 2.0, -700.0])):
        for i, d in enumerate(h * np.eye(4)):
            first = (f(at + d) - f(at - d)).full() / (2 * h)
            np.testing.assert_allclose(slope(at).full().reshape(4, -1)[i], first.ravel(), atol=1e-6)
            second = (slope(at + d) - slope(at - d)).full() / (2 * h)
            np.testing.assert_allclose(curve(at).full()[:, i], second.ravel(), atol=1e-6)
    assert np.isfinite(curve(np.zeros(4)).full()).all() or op == "ReduceL2"  # a norm has a kink


# What is asked for, what is refused


def sampled(tmp_path: Any) -> Any:
    torch.manual_seed(0)
    return exported(Gaussian(sampled=True), tmp_path, 17, False)


def test_only_the_outputs_that_are_asked_for(tmp_path):
    path = sampled(tmp_path)
    mean, value, probability = (o.name for o in onnx.load(path).graph.output)
    with pytest.raises(ValueError, match=rf"RandomNormalLike.*outputs=\['{mean}', '{value}'\]"):
        from_onnx(path)
    with pytest.raises(ValueError, match="RandomNormalLike"):
        from_onnx(path, outputs=[probability])
    f = from_onnx(path, outputs=[value, mean], out_names=["V", "u"])
    assert (f.name_in(), f.name_out(), f.size_out("u")) == (["obs"], ["V", "u"], (2, 1))
    row = np.random.default_rng(0).normal(size=(1, 4)).astype(np.float32)
    for y, z in zip(f.call([row.ravel()]), (runtime(path, row)[k] for k in (1, 0)), strict=True):
        np.testing.assert_allclose(y.full().ravel(), z.ravel(), rtol=1e-5, atol=1e-6)
    assert from_onnx(path, outputs=mean).n_out() == 1
    for wrong in ([], ["action"], [mean, mean], 3):
        with pytest.raises(ValueError, match=f"expected names of the outputs of .*: {mean}, {value}, {probability}"):
            from_onnx(path, outputs=wrong)


def test_inputs_that_nothing_asked_for_needs(tmp_path):
    lengths = helper.make_tensor_value_info("lengths", Kind.INT32, ["batch"])
    plain = helper.make_tensor_value_info("t", Kind.FLOAT, ["batch", 1])
    nodes: list[Node] = [("Tanh", "x", "y"), ("Identity", "lengths", "z")]
    path = graph(tmp_path, nodes, outputs="y z", more=[plain, lengths])
    assert from_onnx(path, outputs=["y"]).name_in() == ["x", "t"]
    with pytest.raises(ValueError, match=r"input 'lengths' .* has shape \[None\]"):
        from_onnx(path)


TRUE = {"ratio": np.float32(0.5), "true": np.array(True)}
NORM = {f"w{i}": np.ones(4, np.float32) for i in range(4)}


@pytest.mark.parametrize(("nodes", "constants", "options", "message"), [
    ([("Dropout", "x ratio true", "y")], TRUE, {}, r"\(Dropout\).*training_mode is true.*eval\(\)"),
    ([("BatchNormalization", "x w0 w1 w2 w3", "y m v", {"training_mode": 1})], NORM, {}, "BatchNormalization.*eval"),
    ([("Mod", "x x", "y")], {}, {}, "Mod.*expected fmod = 1"),
    ([("Cast", "x", "y", {"to": Kind.UINT8})], {}, {}, "uint8 of numbers that depend on the inputs.*FLOAT"),
    ([("Cast", "x", "y", {"to": Kind.FLOAT16})], {}, {}, "float16 of numbers that depend"),
    ([("Cast", "x", "y", {"to": Kind.BFLOAT16})], {}, {}, "it makes BFLOAT16; expected one of FLOAT"),
    ([("Cast", "c", "y", {"to": Kind.BFLOAT16})], {"c": np.float32(1.7)}, {}, "it makes BFLOAT16"),
    ([("Cast", "c", "i", {"to": Kind.INT32}), ("Identity", "i", "y")], {"c": np.float32(3e10)}, {},
     "beyond what int32"),
    ([("Cast", "x", "i", {"to": Kind.INT64}), ("Add", "x i", "y")], {}, {},
     r"\(Add\).*float32 and int64; expected one type"),
    ([("Cast", "x", "i", {"to": Kind.INT64}), ("ReduceMean", "i", "y")], {}, {}, "ReduceMean.*expected FLOAT, DOUBLE"),
    ([("Add", "n n", "y")], {"n": np.int64(2**60)}, {}, "which float64 does not hold exactly"),
    ([("Div", "n zero", "y")], {"n": np.int64(3), "zero": np.int64(0)}, {}, "no whole number"),
    ([("ArgMax", "x", "i", {"axis": 1}), ("Gather", "x i", "y")], {}, {}, r"\(Gather\).*depends on the inputs"),
    ([("Squeeze", "x none", "y")], {"none": np.int64([])}, {}, "Squeeze.*read in two ways"),
    ([("RandomNormalLike", "x", "y")], {}, {}, r"\(RandomNormalLike\) of .* has no translation .*l4casadi"),
    ([("Multinomial", "x", "z"), ("Add", "x x", "y")], {}, {"outputs": "y z"}, r"Multinomial.*outputs=\['y'\]"),
    ([("Split", "x", "y z", {"num_outputs": 3, "axis": 1})], {}, {"outputs": "y z"}, "Split.*one for each output"),
    ([("Split", "x", "a b c d e f", {"num_outputs": 6, "axis": 1})], {}, {"outputs": "a f"}, "Split.*that add up"),
    ([("Tanh", "x", "y")], {}, {"opset": 6}, "opset 6; expected 7 or later.*version_converter"),
    ([("Tanh", "x", "y")], {}, {"element": Kind.FLOAT16}, "is FLOAT16; expected FLOAT or DOUBLE"),
    ([("Identity", "x", "y")], {}, {"element": Kind.INT64}, "is INT64; expected FLOAT or DOUBLE"),
    ([("ConstantOfShape", "n", "z"), ("Add", "x z", "y")], {"n": np.int64([2**40, 2**10])}, {}, "ConstantOfShape")])
def test_what_is_not_exact_is_refused(tmp_path, nodes, constants, options, message):
    with pytest.raises(ValueError, match=message):
        from_onnx(graph(tmp_path, nodes, constants, **options))


def test_a_meaning_that_is_newer_than_what_was_compared_is_refused(tmp_path):
    newer = [s for s in onnx.defs.get_all_schemas_with_history() if s.name == "Celu" and s.since_version > NEWEST]
    if not newer:
        pytest.skip("this onnx knows no newer meaning")
    path = graph(tmp_path, [("Celu", "x", "y")], opset=newer[0].since_version)
    with pytest.raises(ValueError, match=f"expected {NEWEST} or earlier"):
        from_onnx(path)
