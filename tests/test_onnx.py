"""ONNX out and back: ONNX Runtime computes what torch does, and an imported graph is the graph."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_to_casadi import feature_net, jacobian, rows

from nocl.exports.onnx_reader import from_onnx
from nocl.exports.onnx_writer import Session, to_onnx
from nocl.nets import MLP, FeatureNet

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


@settings(max_examples=12, deadline=None, derandomize=True)
@given(nx=st.integers(1, 12), nu=st.integers(1, 4), angles=st.integers(0, 3), width=st.integers(1, 16),
       activation=st.sampled_from(["sine", "tanh", "relu", "silu"]), skip=st.booleans(), seed=st.integers(0, 99))
def test_out_and_back_equal_torch(tmp_path_factory, nx, nu, angles, width, activation, skip, seed):
    torch.manual_seed(seed)
    net = feature_net(nx, nu, min(angles, nx), width, activation, skip)
    rng = np.random.default_rng(seed)
    x, t = rng.normal(size=(4, nx)), rng.uniform(0, 4, (4, 1))
    expected = net(torch.from_numpy(x), torch.from_numpy(t)).detach().numpy()
    path = to_onnx(net, tmp_path_factory.mktemp("onnx") / "net.onnx")
    np.testing.assert_allclose(Session(path)(x, t), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(rows(from_onnx(path), [x, t]), expected, rtol=1e-5, atol=1e-5)
    path = to_onnx(net, path, dtype="float64", in_names=["state", "time"], out_names=["control"])
    back = from_onnx(path, name="policy")
    assert (back.name_in(), back.name_out()) == (["state", "time"], ["control"])
    np.testing.assert_allclose(rows(back, [x, t]), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("expression", [
    lambda x: ca.if_else(x[0] > 0, x[1] ** 2, ca.sin(x[0])), lambda x: ca.fmin(ca.fmax(x[0], -1), x[1]),
    lambda x: ca.vertcat(2.0, x[0]), lambda x: ca.logic_and(x[0] > 0, ca.logic_not(x[1] != x[0])) + ca.log1p(x[0] ** 2),
    lambda x: ca.expm1(x[0]) + ca.sqrt(1 + x[1] ** 2) + ca.erf(x[0]) + ca.atan(x[1]) + ca.fabs(x[0]) ** 1.5,
    lambda x: ca.SX(ca.DM([1.0, 2.0])), lambda x: ca.hypot(x[0], x[1]) + ca.sign(x[1]) * ca.floor(x[0])])
def test_operations_of_the_maps(tmp_path, expression):
    x, t, y = ca.SX.sym("x", 2), ca.SX.sym("t"), ca.SX.sym("y")
    inputs = ca.Function("inputs", [x, t], [x], ["x", "t"], ["phi"])
    outputs = ca.Function("outputs", [x, t, y], [ca.densify(expression(x)) + 0 * y * t], ["x", "t", "y"], ["u"])
    net = FeatureNet(inputs, [MLP([2, 3, 1])], outputs).double()
    z, times = np.random.default_rng(0).normal(size=(6, 2)), np.zeros((6, 1))
    path = to_onnx(net, tmp_path / "net.onnx", dtype="float64")
    expected = net(torch.from_numpy(z), torch.from_numpy(times)).detach().numpy()
    np.testing.assert_allclose(rows(from_onnx(path), [z, times]), expected, rtol=1e-12, atol=1e-12)
    single = to_onnx(net, tmp_path / "net.onnx")
    np.testing.assert_allclose(Session(single)(z, times), expected, rtol=1e-5, atol=1e-5)


def test_what_onnx_has_not_is_refused(tmp_path):
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    net = FeatureNet(ca.Function("f", [x], [ca.atan2(x[0], x[1])]), [MLP([1, 2, 1])], ca.Function("g", [x, y], [y]))
    with pytest.raises(ValueError, match="f contains OP_ATAN2"):
        to_onnx(net, tmp_path / "net.onnx")
    with pytest.raises(ValueError, match="expected a FeatureNet"):
        to_onnx(MLP([2, 1]), tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


def graph(tmp_path, nodes, constants=None, n=4, out=(1, None), inputs=None):
    """An ONNX file by hand, as other libraries write them."""
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    made = [onnx.numpy_helper.from_array(np.asarray(v), k) for k, v in (constants or {}).items()]
    ends = inputs or [helper.make_tensor_value_info("obs.1", real, ["batch", n])]
    g = helper.make_graph([helper.make_node(*a, **k) for a, k in nodes], "g", ends,
                          [helper.make_tensor_value_info("action", real, list(out))], made)
    model = helper.make_model(g, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "g.onnx")
    return tmp_path / "g.onnx"


def test_a_policy_as_libraries_write_them(tmp_path):
    """Flatten, layers by MatMul and Add, LayerNormalization, Slice, Concat, Split, Clip with an open end."""
    rng = np.random.default_rng(0)
    W, V, b = (rng.normal(size=s).astype(np.float32) for s in ((6, 5), (2, 5), 5))
    nodes = [(("Flatten", ["obs.1"], ["flat"]), {}),
             (("Slice", ["flat", "zero", "two", "one"], ["head"]), {}),
             (("Sin", ["head"], ["sin"]), {}), (("Concat", ["flat", "sin"], ["all"]), {"axis": -1}),
             (("MatMul", ["all", "W"], ["h"]), {}), (("Add", ["b", "h"], ["hb"]), {}),
             (("LayerNormalization", ["hb", "b", "b"], ["ln"]), {}), (("Elu", ["ln"], ["e"]), {"alpha": 0.5}),
             (("Gemm", ["e", "V", "half"], ["raw"]), {"transB": 1, "alpha": 2.0, "beta": 3.0}),
             (("Split", ["raw", "ones"], ["first", "second"]), {"axis": 1}),
             (("Tanh", ["first"], ["tanh"]), {}), (("Clip", ["second", "", "half"], ["clipped"]), {}),
             (("Concat", ["tanh", "clipped"], ["both"]), {"axis": 1}),
             (("Shape", ["obs.1"], ["shape"]), {}), (("Gather", ["shape", "zero0"], ["B"]), {"axis": 0}),
             (("Concat", ["B1", "minus"], ["rows"]), {"axis": 0}), (("Unsqueeze", ["B", "zero"], ["B1"]), {}),
             (("Reshape", ["both", "rows"], ["action"]), {})]
    nodes[-3], nodes[-2] = nodes[-2], nodes[-3]
    constants = {"W": W, "V": V, "b": b, "half": np.float32(0.5), "zero": np.int64([0]), "two": np.int64([2]),
                 "one": np.int64([1]), "ones": np.int64([1, 1]), "zero0": np.int64(0), "minus": np.int64([-1])}
    path = graph(tmp_path, nodes, constants, out=("batch", 2))
    f = from_onnx(path, name="policy")
    assert (f.name_in(), f.name_out()) == (["obs_1"], ["action"])
    x = rng.normal(size=(9, 4))
    np.testing.assert_allclose(rows(f, [x]), Session(path)(x), rtol=1e-5, atol=1e-5)
    for i, step in enumerate(1e-6 * np.eye(4)):
        slope = (rows(f, [x + step]) - rows(f, [x - step])) / 2e-6
        exact = np.array([jacobian(f)(v).full()[:, i] for v in x])
        np.testing.assert_allclose(exact, slope, rtol=1e-5, atol=1e-6)
    assert ca.Function.deserialize(f.serialize())(x[0]).shape == (2, 1)


@pytest.mark.parametrize("op", ["Relu", "Sigmoid", "Softplus", "Softsign", "LeakyRelu", "Elu", "Tanh", "Erf", "Neg",
                                "Abs", "Exp", "Identity"])
def test_activations(tmp_path, op):
    path = graph(tmp_path, [((op, ["obs.1"], ["action"]), {})], out=("batch", 4))
    x = np.array([[-2.0, -0.3, 0.4, 3.0]])
    np.testing.assert_allclose(rows(from_onnx(path), [x]), Session(path)(x), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("nodes", "options", "message"), [
    ([(("RandomNormalLike", ["obs.1"], ["action"]), {})], {},
     r"\(RandomNormalLike\) of .* has no translation .*l4casadi"),
    ([(("MatMul", ["obs.1", "obs.1"], ["action"]), {})], {}, r"\(MatMul\) of .* expected equal inner sizes"),
    ([(("ReduceMean", ["obs.1"], ["action"]), {"axes": [2]})], {}, r"its axes are \[2\]; expected them in \[-2, 1\]"),
])
def test_refusals_name_the_node(tmp_path, nodes, options, message):
    with pytest.raises(ValueError, match=message):
        from_onnx(graph(tmp_path, nodes, **options))


def test_foreign_files_and_shapes_are_refused(tmp_path):
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ValueError, match="cannot be read as ONNX"):
        from_onnx(tmp_path / "text.onnx")
    wide = [onnx.helper.make_tensor_value_info("obs.1", onnx.TensorProto.FLOAT, ["batch", "n"])]
    with pytest.raises(ValueError, match="expected \\[n\\] or \\[batch, n\\]"):
        from_onnx(graph(tmp_path, [(("Tanh", ["obs.1"], ["action"]), {})], inputs=wide))


def test_without_the_package_the_error_says_how_to_install_it(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ValueError, match=r"pip install \"nocl\[onnx\]\""):
        from_onnx(tmp_path / "net.onnx")
