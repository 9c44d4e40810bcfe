"""A module and its CasADi Function agree in values and derivatives, and the Function is usable as any other."""

from __future__ import annotations

import importlib.util
import pickle

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nocl.exports.casadi_forms import to_casadi
from nocl.nets import ACTIVATIONS, MLP, FeatureNet, Sine
from nocl.translate.rk4 import rk4

LAYERS = [nn.Tanh, nn.ReLU, nn.SiLU, nn.Sigmoid, nn.Softplus, nn.GELU, nn.ELU, nn.LeakyReLU, nn.Identity, Sine,
          lambda: nn.GELU("tanh"), lambda: nn.Softplus(3.0, 5.0), lambda: nn.ELU(0.3), nn.Dropout]
needs_l4casadi = pytest.mark.skipif(importlib.util.find_spec("l4casadi") is None, reason="l4casadi is not installed")


def rows(function: ca.Function, args: list[np.ndarray]) -> np.ndarray:
    """A Function on rows, one call a row."""
    return np.array([function.call([a[k] for a in args])[0].full().ravel() for k in range(len(args[0]))])


def jacobian(function: ca.Function) -> ca.Function:
    """The Jacobian by all inputs, side by side."""
    args = function.mx_in()
    return ca.Function("J", args, [ca.densify(ca.horzcat(*(ca.jacobian(function(*args), a) for a in args)))])


def hessian(function: ca.Function) -> ca.Function:
    """The Hessian of the sum of the outputs by all inputs."""
    sizes = [function.size1_in(i) for i in range(function.n_in())]
    z = ca.MX.sym("z", sum(sizes))
    parts = ca.vertsplit(z, [0, *np.cumsum(sizes).tolist()])
    return ca.Function("H", [z], [ca.densify(ca.hessian(ca.sum1(function(*parts)), z)[0])])


def check_equal(module: nn.Module, function: ca.Function, args: list[np.ndarray], concatenated: bool) -> None:
    """Values, Jacobians and Hessians equal torch's to 1e-12, relative to their size."""
    sizes = [a.shape[1] for a in args]

    def row(z):
        parts = [p[None] for p in torch.split(z, sizes)]
        return module(torch.cat(parts, 1) if concatenated else parts[0], *([] if concatenated else parts[1:]))[0]

    z = torch.from_numpy(np.hstack(args))
    pairs = [(rows(function, args), torch.stack([row(v) for v in z]).detach())]
    for k, v in enumerate(z):
        here = [a[k] for a in args]
        pairs.append((jacobian(function)(*here).full(), torch.func.jacrev(row)(v).detach()))
        pairs.append((hessian(function)(v.numpy()).full(), torch.func.hessian(lambda v: row(v).sum())(v).detach()))
    for got, expected in pairs:
        size = max(1.0, float(expected.abs().max()))
        np.testing.assert_allclose(got, expected.numpy(), rtol=1e-12, atol=1e-12 * size)


def feature_net(nx: int, nu: int, angles: int, width: int, activation: str, skip: bool) -> FeatureNet:
    """(x, t) -> u as controllers have it: sin and cos of angles, scaling, time; limits; two networks that multiply."""
    x, t, y, gain = ca.SX.sym("x", nx), ca.SX.sym("t"), ca.SX.sym("y", nu), ca.SX.sym("gain", nu)
    phi = ca.vertcat(ca.sin(x[:angles]), ca.cos(x[:angles]), x / 3, 2 * t / 5 - 1, ca.log((5 - t) / 5 + 0.02))
    inputs = ca.Function("inputs", [x, t], [phi, x[:1]], ["x", "t"], ["phi", "psi"])
    out = ca.fmin(ca.fmax(3 * ca.tanh(y / 3) * (1 + 0.1 * gain), -2.5), 2.5)
    outputs = ca.Function("outputs", [x, t, y, gain], [out], ["x", "t", "y", "gain"], ["u"])
    nets = [MLP([phi.numel(), width, width, nu], activation, skip), MLP([1, 4, nu], "tanh")]
    return FeatureNet(inputs, nets, outputs).double()


@pytest.mark.parametrize("layer", LAYERS)
def test_each_layer_equals_torch(layer):
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(3, 6), nn.LayerNorm(6), layer(), nn.Linear(6, 2, bias=False)).double().eval()
    check_equal(module, to_casadi(module), [np.random.default_rng(0).normal(size=(3, 3)) * 3], True)


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_stay_finite_far_out_and_agree_at_zero(layer):
    module = layer().double().eval()
    z = np.array([[-800.0, -40.0, 0.0, 40.0, 800.0]])
    function = to_casadi(module, 5)
    x = torch.from_numpy(z).requires_grad_()
    module(x).sum().backward()
    np.testing.assert_allclose(rows(function, [z]), module(x).detach().numpy(), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.diag(jacobian(function)(z[0]).full())[None], x.grad.numpy(), rtol=1e-12, atol=1e-12)
    assert np.isfinite(hessian(function)(z[0]).full()).all()


@settings(max_examples=15, deadline=None, derandomize=True)
@given(sizes=st.lists(st.integers(1, 9), min_size=2, max_size=4), activation=st.sampled_from(sorted(ACTIVATIONS)),
       skip=st.booleans(), seed=st.integers(0, 99))
def test_networks_equal_torch(sizes, activation, skip, seed):
    torch.manual_seed(seed)
    net = MLP(sizes, activation, skip).double()
    check_equal(net, to_casadi(net), [np.random.default_rng(seed).normal(size=(2, sizes[0]))], True)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(nx=st.integers(1, 12), nu=st.integers(1, 4), angles=st.integers(0, 3), width=st.integers(1, 16),
       activation=st.sampled_from(["sine", "tanh", "silu"]), skip=st.booleans(), seed=st.integers(0, 99))
def test_feature_networks_equal_torch(nx, nu, angles, width, activation, skip, seed):
    torch.manual_seed(seed)
    net = feature_net(nx, nu, min(angles, nx), width, activation, skip)
    rng = np.random.default_rng(seed)
    x, t = rng.normal(size=(2, nx)), rng.uniform(0, 4, (2, 1))
    function = to_casadi(net, name="policy")
    assert (function.name(), function.name_in(), function.name_out()) == ("policy", ["x", "t"], ["u"])
    check_equal(net, function, [x, t], False)


def test_a_float32_network_is_exported_at_its_own_weights():
    net = MLP([2, 5, 1])
    before = {key: value.clone() for key, value in net.state_dict().items()}
    function = to_casadi(net)
    double = MLP([2, 5, 1]).double()
    double.load_state_dict(before)
    check_equal(double, function, [np.array([[0.3, -0.7]])], True)
    for key, value in net.state_dict().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, before[key])
    assert all(p.requires_grad for p in net.parameters())


def test_functions_are_usable_as_any_other(tmp_path):
    torch.manual_seed(1)
    net = feature_net(4, 2, 1, 16, "tanh", True)
    function = to_casadi(net, name="policy", in_names=["state", "time"], out_names=["control"])
    assert (function.name_in(), function.name_out()) == (["state", "time"], ["control"])
    x, t = np.random.default_rng(0).normal(size=(5, 4)), np.linspace(0, 4, 5)[:, None]
    expected = rows(function, [x, t])
    function.save(str(tmp_path / "policy.casadi"))
    variants = {"serialize": ca.Function.deserialize(function.serialize()),
                "pickle": pickle.loads(pickle.dumps(function)),
                "save": ca.Function.load(str(tmp_path / "policy.casadi")), "expand": function.expand()}
    for name, variant in variants.items():
        np.testing.assert_allclose(rows(variant, [x, t]), expected, rtol=1e-12, atol=1e-14, err_msg=name)
    for kind in ("serial", "thread", "openmp"):
        np.testing.assert_allclose(function.map(5, kind)(x.T, t.T).full().T, expected, rtol=1e-12, err_msg=kind)


def test_networks_stay_small_graphs():
    """As matrix products, not as thousands of scalar operations."""
    assert to_casadi(MLP([6, 64, 64, 64, 4], "sine")).n_instructions() < 30


def test_several_inputs_are_concatenated():
    net = MLP([3, 4, 1]).double()
    function = to_casadi(net, (2, 1), in_names=["x", "u"], out_names=["xdot"])
    assert function([0.1, 0.2], 0.3) == to_casadi(net)([0.1, 0.2, 0.3])
    assert to_casadi(nn.Tanh(), 3)([0.0, 0.0, 0.0]).shape == (3, 1)


class Doubled(nn.Linear):
    def forward(self, x):
        return 2 * super().forward(x)


def hooked() -> nn.Module:
    layer = nn.Linear(2, 1)
    layer.register_forward_hook(lambda layer, args, result: 2 * result)
    return layer


def with_nan() -> nn.Module:
    layer = nn.Linear(2, 1)
    nn.init.constant_(layer.weight, torch.nan)
    return nn.Sequential(layer)


@pytest.mark.parametrize(("module", "options", "message"), [
    (nn.Sequential(nn.Linear(2, 3), nn.Sequential(nn.Hardtanh())), {}, r"layer '1\.0' is a Hardtanh.*l4casadi"),
    (nn.Sequential(Doubled(2, 2)), {}, "layer '0' is a Doubled"),
    (nn.Conv1d(1, 1, 1), {"n_in": 2}, "the module is a Conv1d"),
    (nn.Sequential(hooked()), {}, "layer '0' has forward hooks"),
    (with_nan(), {}, r"parameter 0\.weight holds NaN"),
    (nn.Sequential(nn.Linear(2, 3), nn.Dropout()), {}, r"'1' \(Dropout\) is in training mode"),
    (nn.Sequential(nn.Linear(2, 3), nn.Linear(2, 1)), {}, r"'1' \(Linear\) takes 2 numbers and gets 3"),
    (nn.Linear(2, 1), {"n_in": 3}, "takes 2 numbers and gets 3"),
    (nn.Linear(2, 1), {"n_in": 0}, "n_in is 0"),
    (nn.Tanh(), {}, "pass n_in"),
    (nn.LayerNorm((2, 3)), {}, "expected one dimension"),
    (MLP([2, 1]), {"backend": "onnx"}, "expected 'native' or 'l4casadi'"),
    (MLP([2, 1]), {"build_dir": "x"}, "leave it out"),
    (MLP([2, 1]), {"in_names": ["x", "t"]}, "in_names has 2 names"),
    (MLP([2, 1]), {"name": "not a name"}, "expected plain identifiers"),
    (feature_net(2, 1, 0, 2, "tanh", False), {"n_in": 2}, r"inputs of lengths \[2, 1\]"),
    (lambda x: x, {}, "expected a torch.nn.Module"),
])
def test_refusals_name_what_is_wrong(module, options, message):
    with pytest.raises(ValueError, match=message):
        to_casadi(module, **options)


def test_without_l4casadi_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "l4casadi", None)
    with pytest.raises(ValueError, match="--no-build-isolation l4casadi"):
        to_casadi(MLP([2, 1]), backend="l4casadi")


@needs_l4casadi
def test_l4casadi_agrees_and_leaves_the_module_and_the_working_folder_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    net = feature_net(4, 2, 1, 16, "tanh", True)
    before = {key: value.clone() for key, value in net.state_dict().items()}
    net.train()
    native = to_casadi(net, name="policy")
    built = [to_casadi(net, name="policy", backend="l4casadi", build_dir=d) for d in (tmp_path / "a folder", None)]
    rng = np.random.default_rng(0)
    x, t = rng.normal(size=(20, 4)), rng.uniform(0, 4, (20, 1))
    for function in built:
        assert str(function) == str(native)
        np.testing.assert_allclose(rows(function, [x, t]), rows(native, [x, t]), rtol=1e-5, atol=1e-5)
        J, exact_J = rows(jacobian(function), [x, t]), rows(jacobian(native), [x, t])
        np.testing.assert_allclose(J, exact_J, rtol=1e-5, atol=1e-5)
        z = np.hstack([x, t])
        np.testing.assert_allclose(rows(hessian(function), [z]), rows(hessian(native), [z]), rtol=1e-3, atol=1e-4)
    assert [p.name for p in tmp_path.iterdir()] == ["a folder"]
    assert net.training
    assert all(p.requires_grad for p in net.parameters())
    for key, value in net.state_dict().items():
        assert value.dtype == torch.float64
        assert torch.equal(value, before[key])


class Gated(nn.Module):
    """A module of a user's own, which only L4CasADi can take."""

    def __init__(self):
        super().__init__()
        self.a, self.b = nn.Linear(3, 8), nn.Linear(8, 2)

    def forward(self, x):
        h = self.a(x)
        return self.b(torch.sigmoid(h) * torch.nn.functional.softplus(h))


class Branch(nn.Module):
    def forward(self, x):
        return 2 * x if x.sum() > 0 else x


@needs_l4casadi
def test_l4casadi_takes_a_users_own_module_and_refuses_branches(tmp_path):
    module = Gated()
    function = to_casadi(module, (2, 1), backend="l4casadi", build_dir=tmp_path, in_names=["x", "t"])
    x = torch.tensor([[0.1, -0.4, 0.7]])
    np.testing.assert_allclose(function([0.1, -0.4], 0.7).full().ravel(), module(x)[0].detach(), rtol=1e-5, atol=1e-6)
    files = sorted(tmp_path.iterdir())
    with pytest.raises(ValueError, match="cannot trace Branch"):
        to_casadi(Branch(), 2, backend="l4casadi", build_dir=tmp_path)
    with pytest.raises(ValueError, match="cannot trace Gated"):
        to_casadi(module, 2, backend="l4casadi", build_dir=tmp_path)
    assert sorted(tmp_path.iterdir()) == files


@needs_l4casadi
def test_l4casadi_dynamics_work_inside_an_rk4_nlp_with_exact_hessians(tmp_path):
    torch.manual_seed(3)
    net = MLP([3, 16, 16, 2]).double()
    solutions = []
    for backend in ("native", "l4casadi"):
        folder = tmp_path if backend == "l4casadi" else None
        f = to_casadi(net, (2, 1), name="f", backend=backend, build_dir=folder, in_names=["x", "u"], out_names=["xdot"])
        x, u = ca.MX.sym("x", 2, 21), ca.MX.sym("u", 1, 20)
        gaps = [x[:, 0] - ca.DM([1.0, 0.5])] + [x[:, k + 1] - rk4(f, x[:, k], u[k], 0.1) for k in range(20)]
        cost = 0.1 * ca.sumsqr(x) + 0.001 * ca.sumsqr(u) + ca.sumsqr(x[:, 20])
        solver = ca.nlpsol("solver", "ipopt", {"x": ca.veccat(x, u), "f": cost, "g": ca.vertcat(*gaps)},
                           {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-5}})
        result = solver(x0=0.1, lbg=0, ubg=0)
        assert solver.stats()["success"]
        assert solver.stats()["n_call_nlp_hess_l"] > 0
        solutions.append((float(result["f"]), result["x"].full().ravel()))
    assert solutions[1][0] == pytest.approx(solutions[0][0], rel=1e-5)
    np.testing.assert_allclose(solutions[1][1], solutions[0][1], atol=1e-3)


@pytest.mark.parametrize("layer", [nn.Sigmoid(), nn.SiLU()])
def test_sigmoids_keep_their_digits_far_below_zero(layer):
    """0.5 (1 + tanh(x / 2)) is 0 below -37; at 0 the branches meet, with all their derivatives."""
    x = np.array([-745.0, -300.0, -50.0, -37.5, -20.0, -1.0, 0.0, 1.0, 37.5, 300.0])
    right = np.exp(np.minimum(x, 0)) / (1 + np.exp(-np.abs(x))) * (x if isinstance(layer, nn.SiLU) else 1)
    f = to_casadi(nn.Sequential(layer), 1, in_names=["x"], out_names=["y"])
    np.testing.assert_allclose([float(f(v)) for v in x], right, rtol=1e-14)
    at = torch.tensor([[0.0]], dtype=torch.float64, requires_grad=True)
    slope = torch.autograd.grad(layer(at).sum(), at)[0].item()
    jacobian = f.factory("slope", ["x"], ["jac:y:x"])
    assert float(jacobian(0.0)) == pytest.approx(slope, rel=1e-14)
    assert np.isfinite([float(jacobian(v)) for v in x]).all()
