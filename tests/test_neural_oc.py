"""NeuralOC: V's gradient, the Hamiltonian's minimiser, the HJB residual, training, CasADi, files."""

import copy
import math

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.hjb import value_gradients
from nocl.judge import simulate
from nocl.solvers import LQR
from nocl.solvers.neural_oc import (
    NeuralOC,
    NeuralOCSettings,
    Trainer,
    ValueNet,
    characteristics,
    minimiser_of,
    train_neural_oc,
)
from nocl.systems import double_integrator, quadrotor
from nocl.translate.fused import FusedFunction
from nocl.translate.torch_functions import to_torch

QUICK = {"width": 8, "steps": 10, "batch": 16, "iterations": 4, "check_every": 2, "drop_every": 3, "resample_every": 2}


def random_net(nx, layers=3, width=7, rank=4, scale=0.3, seed=0):
    """All weights random, none at its start."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = ValueNet(nx, width, layers, rank, scale).double()
        for p in net.parameters():
            p.data = torch.randn_like(p) * 0.5
    return net


def rows(n, B, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(B, n)))


@pytest.mark.parametrize("layers", [2, 3, 4])
def test_the_gradient_in_closed_form_is_that_of_v(layers):
    net, x, t = random_net(3, layers), rows(3, 20), rows(1, 20, 1)
    _, V_x, V_t = value_gradients(net, x, t)
    for closed, auto in zip(net.gradient(x, t), (V_x, V_t), strict=True):
        torch.testing.assert_close(closed, auto, rtol=1e-12, atol=1e-12)
    h = 1e-6
    for i, e in enumerate(torch.eye(4, dtype=torch.float64) * h):
        s = net(x + e[:3], t + e[3:]) - net(x - e[:3], t - e[3:])
        torch.testing.assert_close(s[:, 0] / (2 * h), torch.cat(net.gradient(x, t), 1)[:, i], rtol=1e-7, atol=1e-8)


def test_v_is_the_formula():
    """Written out by numpy, for one state."""
    net, x, t = random_net(2, layers=3), rows(2, 1), rows(1, 1, 1)
    p = {name: value.detach().numpy() for name, value in net.named_parameters()}
    s = np.append(x.numpy(), t.numpy())
    sigma = lambda a: np.log(np.exp(a) + np.exp(-a))  # noqa: E731
    r = sigma(p["opening.weight"] @ s + p["opening.bias"])
    for i in range(2):
        r = r + sigma(p[f"residual.{i}.weight"] @ r + p[f"residual.{i}.bias"]) / 2
    V = p["w"] @ r + s @ p["A"].T @ p["A"] @ s / 2 + p["b"] @ s + p["c"]
    assert net(x, t).item() == pytest.approx(0.3 * V, rel=1e-13)


def test_the_gradient_trains():
    """Its own derivative in the weights, against autograd's second derivative."""
    net, x, t = random_net(3), rows(3, 5), rows(1, 5, 1)
    closed = torch.autograd.grad(torch.cat(net.gradient(x, t), 1).square().sum(), list(net.parameters()),
                                 materialize_grads=True)
    auto = torch.autograd.grad(torch.cat(value_gradients(net, x, t)[1:], 1).square().sum(), list(net.parameters()),
                               materialize_grads=True)
    for a, b in zip(closed, auto, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


def test_large_arguments_do_not_overflow():
    net = random_net(2)
    V_x, _ = net.gradient(1e4 * rows(2, 3), rows(1, 3))
    assert torch.isfinite(net(1e4 * rows(2, 3), rows(1, 3))).all()
    assert torch.isfinite(V_x).all()


def test_the_quadrotors_minimiser_is_the_papers_closed_form():
    """u1 = u* - f7'p / (2 R m), u2..4 = -p / (2 R), clipped: Onken et al.'s, with this L's R and u*."""
    ocp = quadrotor.ocp()
    rng = np.random.default_rng(0)
    x, p = rng.uniform(-2, 2, (500, 12)), rng.normal(size=(500, 12)) * rng.choice([0.01, 1.0, 10.0], (500, 1))
    psi, theta, phi = x[:, 3:6].T
    f7 = np.sin(psi) * np.sin(phi) + np.cos(psi) * np.sin(theta) * np.cos(phi)
    f8 = -np.cos(psi) * np.sin(phi) + np.sin(psi) * np.sin(theta) * np.cos(phi)
    f9 = np.cos(theta) * np.cos(phi)
    u1 = 9.81 - (f7 * p[:, 6] + f8 * p[:, 7] + f9 * p[:, 8]) / (2 * 0.01)
    free = np.column_stack([u1, -p[:, 9:12] / (2 * 0.01)])
    u = to_torch(minimiser_of(ocp))(torch.from_numpy(x), torch.from_numpy(p)).numpy()
    np.testing.assert_allclose(u, np.clip(free, -100, 100), rtol=1e-12, atol=1e-12)
    assert 0.1 < (np.abs(free) > 100).mean() < 0.9


def test_the_hjb_residual_is_zero_on_a_riccati_solution():
    """V = x'Px / 2 of the infinite horizon, in A; w = 0."""
    s = double_integrator.system()
    ocp = nocl.OCP(s, horizon=2.0, running=ca.sumsqr(s.x) + 0.1 * ca.sumsqr(s.u), terminal=ca.sumsqr(s.x),
                   x_goal=[0, 0], u_goal=[0], initial_states=nocl.Gaussian(mean=[0.5, 0.0], std=[0.2, 0.2]))
    trainer = Trainer(ocp, NeuralOCSettings(**QUICK | {"steps": 40}), 0, torch.float64)
    net = trainer.net
    with torch.no_grad():
        for p in net.parameters():
            p.zero_()
        net.A[:2, :2] = torch.from_numpy(np.linalg.cholesky(LQR(ocp, infinite=True).P()).T / math.sqrt(net.scale))
    x0 = trainer.states()
    running, terminal, hjb, *_ = trainer.terms(x0).tolist()
    assert hjb < 1e-12
    V0, end = net(x0, torch.zeros(16, 1)).mean().item(), running + terminal
    controller = NeuralOC(ocp, net)
    sim = simulate(ocp, controller, x0.numpy())
    assert end == pytest.approx(sim.cost.mean(), rel=1e-4)  # RK4 beside CVODES
    left = controller.value(sim.x[:, -1], 2.0).mean()
    assert sim.running_cost.mean() + left == pytest.approx(V0, rel=1e-8)  # V is the cost
    with torch.no_grad():
        net.A[0, 0] += 0.3
    assert trainer.terms(x0)[2] > 1e-3


def test_the_penalties_vanish_where_v_is_g_at_the_end():
    ocp = double_integrator.ocp()
    trainer = Trainer(ocp, NeuralOCSettings(**QUICK), 0, torch.float64)
    with torch.no_grad():
        for p in trainer.net.parameters():
            p.zero_()
        trainer.net.A[0, 0] = trainer.net.A[1, 1] = math.sqrt(2 / trainer.net.scale)  # V = x'x = G
    terms = trainer.terms(trainer.states())
    assert terms[3:].abs().max() < 1e-12
    with torch.no_grad():
        trainer.net.c += 1 / trainer.net.scale
    assert trainer.terms(trainer.states())[3].item() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("ocp", [quadrotor.ocp(), nocl.load_ocp("dubins")], ids=lambda ocp: ocp.system.name)
def test_fused_is_torch(ocp):
    function, n = characteristics(ocp), 2 * ocp.system.nx
    z = [(0.3 * rows(n, 40)).requires_grad_() for _ in range(2)]
    y = [f(v) for f, v in zip((FusedFunction(function), to_torch(function)), z, strict=True)]
    torch.testing.assert_close(*y, rtol=1e-12, atol=1e-12)
    gradients = [torch.autograd.grad((a * torch.arange(1.0, a.shape[1] + 1)).sum(), v)[0]
                 for a, v in zip(y, z, strict=True)]
    torch.testing.assert_close(*gradients, rtol=1e-10, atol=1e-10)


def test_the_gradient_of_the_loss_is_that_of_finite_differences():
    trainer = Trainer(quadrotor.ocp(horizon=0.5), NeuralOCSettings(**QUICK, weights=(0.1, 0.2, 0.3)), 0, torch.float64)
    x0 = trainer.states()
    trainer.loss(trainer.terms(x0)).backward()
    for name, i in (("w", 3), ("b", 0), ("A", (1, 2))):
        p = dict(trainer.net.named_parameters())[name]
        ends = []
        for h in (1e-6, -2e-6):
            with torch.no_grad():
                p[i] += h
                ends.append(trainer.loss(trainer.terms(x0)).item())
        with torch.no_grad():
            p[i] += 1e-6
        assert p.grad[i].item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-6)


def test_path_constraints_enter_as_the_problems_penalty():
    ocp = nocl.load_ocp("dubins")
    x = np.tile(ocp.x_goal, (2, 1))
    x[1, :2] = -1.0, 0.0
    h = ocp.h(x.T).full()
    assert (h[:, 1] < 0).any(), "a state inside the obstacle"
    z = np.hstack([x, np.zeros((2, 3))])
    L = characteristics(ocp)(z.T).full()[3]
    u = minimiser_of(ocp)(x.T, np.zeros((3, 2))).full()
    np.testing.assert_allclose(L, ocp.L_soft(x.T, u).full()[0], rtol=1e-13)
    assert L[1] > ocp.L(x.T, u).full()[0, 1] + 1


@pytest.fixture(scope="module")
def trained():
    return train_neural_oc(quadrotor.ocp(), NeuralOCSettings(**QUICK), seed=3, progress=False)


def test_casadi_is_torch(trained):
    x, t = rows(12, 30).numpy(), np.linspace(0, 4, 30)
    policy, value = trained.to_casadi(), trained.value_to_casadi()
    np.testing.assert_allclose(policy(x.T, t[None]).full().T, trained(x, t), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(value(x.T, t[None]).full()[0], trained.value(x, t), rtol=1e-12, atol=1e-12)


def test_shapes_and_messages(trained):
    x = rows(12, 4).numpy()
    assert trained(x).shape == (4, 4)
    assert trained(x[0]).shape == (4,)
    assert trained.value(x).shape == (4,)
    assert np.ndim(trained.value(x[0])) == 0
    np.testing.assert_allclose(trained.value_gradient(x, 1.0)[2], trained.value_gradient(x[2], 1.0), rtol=1e-9)
    assert "NeuralOC on 'quadrotor'" in repr(trained)
    with pytest.raises(ValueError, match=r"expected one time or 4, each in \[0, 4\]"):
        trained(x, 5.0)
    with pytest.raises(ValueError, match="nx = 12"):
        trained(np.zeros(3))


def test_the_card(trained):
    """nfe: 4 stages of 10 steps for 16 states, in 4 iterations and at 3 looks at the held-out ones."""
    card = trained.card
    assert card["nfe"] == 4 * 10 * 16 * 7
    assert card["seconds"] > 0
    assert card["settings"]["steps"] == 10
    assert [len(v) for v in card["history"].values()] == [4] * 5


def test_the_same_seed_gives_the_same_controller(trained):
    before = torch.get_rng_state()
    again, other = (train_neural_oc(quadrotor.ocp(), NeuralOCSettings(**QUICK), seed=s, progress=False) for s in (3, 4))
    assert torch.equal(before, torch.get_rng_state())
    x = rows(12, 4).numpy()
    np.testing.assert_array_equal(trained(x), again(x))
    assert not np.allclose(trained(x), other(x))


def test_what_is_kept_is_the_best_on_held_out_states():
    trainer = Trainer(double_integrator.ocp(), NeuralOCSettings(**QUICK | {"iterations": 8}), 0)
    trainer.train(progress=False)
    trainer.net.load_state_dict(trainer.best)
    with torch.no_grad():
        assert float(trainer.loss(trainer.terms(trainer.held_out))) == trainer.lowest


@pytest.mark.slow
def test_training_comes_near_the_optimum():
    """What the judged cost is above LQR's, which is least, falls to a tenth or less: 3 to 5 % of it, by the seed."""
    ocp = double_integrator.ocp(R=0.3, horizon=1.5)
    settings = NeuralOCSettings(width=8, steps=8, iterations=120, batch=32, drop_every=40, check_every=10,
                                learning_rate=0.05)
    x0 = ocp.initial_states.sample(20, 1)
    start = train_neural_oc(ocp, NeuralOCSettings(**QUICK | {"iterations": 1}), progress=False)
    end = train_neural_oc(ocp, settings, progress=False)
    before, after = (simulate(ocp, c, x0).cost.mean() / LQR(ocp).value(x0).mean() for c in (start, end))
    assert 0 <= after - 1 < 0.1 * (before - 1)


def test_save_and_load(trained, tmp_path):
    path = trained.save(tmp_path / "new")
    again = NeuralOC.load(tmp_path / "new")
    x = rows(12, 4).numpy()
    np.testing.assert_array_equal(trained(x, 1.0), again(x, 1.0))
    assert again.card == trained.card
    assert [p.name for p in path.parent.iterdir()] == ["neural_oc.safetensors"]
    nocl.support.store.save_checkpoint(path, {"a": torch.zeros(1)})
    with pytest.raises(ValueError, match=r"was not written by NeuralOC\.save"):
        NeuralOC.load(tmp_path / "new")


def test_a_save_that_is_interrupted_leaves_the_former_file(trained, tmp_path, monkeypatch):
    path = trained.save(tmp_path)
    content = path.read_bytes()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("nocl.support.atomic.os.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        NeuralOC(trained.ocp, copy.deepcopy(trained.value_net), {"other": 1}).save(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == content


def test_what_is_refused():
    ocp = double_integrator.ocp()
    with pytest.raises(ValueError, match=r"dynamics is a function; expected None.*nocl\.train"):
        train_neural_oc(ocp, dynamics=lambda x, u: x)
    s = ocp.system
    quartic = nocl.OCP(s, horizon=1.0, running=s.u**4, terminal=ca.sumsqr(s.x), x_goal=[0, 0], u_goal=[0],
                       initial_states=ocp.initial_states)
    with pytest.raises(ValueError, match="no minimiser in closed form"):
        train_neural_oc(quartic, progress=False)
    with pytest.raises(ValueError, match=r"eigenvalues \[0\.0\].*add a cost on each control"):
        train_neural_oc(double_integrator.ocp(R=0.0), progress=False)
    with pytest.raises(ValueError, match=r"expected a nocl\.OCP"):
        train_neural_oc(s)


def test_divergence_is_said():
    settings = NeuralOCSettings(**QUICK | {"iterations": 50}, learning_rate=1e20)
    with pytest.raises(ValueError, match=r"diverged at iteration \d+.*smaller learning_rate \(is 1e\+20\)"):
        train_neural_oc(quadrotor.ocp(), settings, progress=False)


@pytest.mark.parametrize(("options", "message"), [
    ({"layers": 1}, "layers is 1; expected an integer >= 2"), ({"width": 0}, "width is 0"),
    ({"steps": 2.5}, r"steps is 2\.5"), ({"batch": True}, "batch is True"), ({"drop": 1.5}, "at most 1"),
    ({"learning_rate": 0}, "learning_rate is 0; expected a finite number > 0"), ({"weights": (1, 1)}, "3 numbers"),
    ({"weights": (1, -1, 0)}, "3 numbers"), ({"fused": 1}, "fused is 1; expected True or False")])
def test_settings_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        NeuralOCSettings(**options)
