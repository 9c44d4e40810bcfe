"""method="paper": settings, networks, fused steps, and that training solves problems whose optimum is known."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl import hjb
from nocl.exports.casadi_forms import to_casadi
from nocl.judge import simulate
from nocl.solvers.cnd.paper import PaperSettings, Trainer, controller_net, side_by_side, train_paper, value_net
from nocl.systems import cartpole, double_integrator, dubins, quadrotor
from nocl.translate.fused import FusedStep
from nocl.translate.rk4 import rk4_cost
from nocl.translate.torch_functions import to_torch

TINY = {"iterations": 4, "batch": 4, "race": 2, "race_iterations": 2, "race_batch": 2, "intervals": 5}


@pytest.mark.parametrize(("wrong", "named"), [
    ({"hidden": ()}, "hidden"), ({"hidden": (64, 0)}, "hidden"), ({"value_hidden": (3.5,)}, "value_hidden"),
    ({"activation": "gelu"}, "activation"), ({"step": "dopri5"}, "step"), ({"intervals": 0}, "intervals"),
    ({"iterations": 2.5}, "iterations"), ({"batch": True}, "batch"), ({"race": 0}, "race"),
    ({"learning_rate": 0.0}, "learning_rate"), ({"learning_rate": None}, "learning_rate"), ({"decay": 2.0}, "decay"),
    ({"decay": math.nan}, "decay"), ({"near_goal": 0.0}, "near_goal"), ({"clip": -1.0}, "clip"),
    ({"clip": "no"}, "clip"),
    ({"weights": (1, 1)}, "weights"), ({"weights": (1, -1, 0, 0)}, "weights"), ({"weights": (0, 1, 0, 0)}, "weights"),
    ({"weights": 1.0}, "weights"), ({"step": "euler"}, "step"), ({"hold": 0}, "hold")])
def test_settings_say_what_is_wrong(wrong, named):
    with pytest.raises(ValueError, match=rf"PaperSettings: {named} is .*expected"):
        PaperSettings(**wrong)


def test_the_defaults_are_the_papers_where_it_says():
    s = PaperSettings()
    assert (s.weights, s.learning_rate, s.activation) == ((1.0, 1.0, 0.01, 0.01), 0.01, "tanh")
    assert not s.time_input
    assert PaperSettings(hidden=[3, 4]).hidden == (3, 4)
    assert PaperSettings(clip=None).clip is None


@pytest.mark.parametrize("time_input", [False, True])
def test_the_controller_stays_in_U_and_the_networks_have_the_papers_form(time_input):
    ocp, s = dubins.ocp(), PaperSettings(time_input=time_input)
    torch.manual_seed(0)
    policy, value = controller_net(ocp, s).double(), value_net(ocp, s).double()
    x, t = torch.randn(200, 3, dtype=torch.float64) * 50, torch.rand(200, 1, dtype=torch.float64) * 8
    with torch.no_grad():
        policy.nets[0].body[-1].weight.mul_(100)
        u = policy(x, t)
        assert bool(torch.equal(u, policy(x, t + 1))) is not time_input
        assert (value(x, t) - value(x, t + 1)).abs().min() > 0
    lb, ub = torch.as_tensor(ocp.system.lbu.copy()), torch.as_tensor(ocp.system.ubu.copy())
    assert ((u >= lb) & (u <= ub)).all()
    assert ((u < lb + 1e-3).any(0) & (u > ub - 1e-3).any(0)).all()  # and all of U is within reach
    assert value.nets[0].skip is not None
    assert policy.nets[0].skip is None


@pytest.mark.parametrize("problem", [quadrotor, dubins])  # u* inside U, and at its bound
def test_a_controller_can_start_near_the_goals_control(problem):
    ocp = problem.ocp()
    torch.manual_seed(0)
    policy = controller_net(ocp, PaperSettings(near_goal=1e-6)).double()
    x = torch.as_tensor(ocp.initial_states.sample(20, 0))
    u, width = policy(x, torch.zeros(20, 1).double()).detach().numpy(), ocp.system.ubu - ocp.system.lbu
    near = np.clip(ocp.u_goal, ocp.system.lbu + 0.005 * width, ocp.system.ubu - 0.005 * width)
    np.testing.assert_allclose(u, np.tile(near, (20, 1)), atol=1e-4 * width.max())


@pytest.mark.parametrize("problem", [cartpole, quadrotor, dubins])
def test_fused_steps_are_the_torch_steps_with_the_same_gradients(problem):
    ocp = problem.ocp()
    f, L = to_torch(ocp.system.f), to_torch(ocp.L_soft)
    torch.manual_seed(0)
    policy = controller_net(ocp, PaperSettings(time_input=True)).double()
    x0 = ocp.initial_states.sample(6, 0)
    x0[0, :2] = [-1.0, 0.1]  # inside the obstacle of dubins
    x0 = torch.as_tensor(x0).reshape(3, 2, -1).requires_grad_()
    answers = []
    for step in (rk4_cost, FusedStep(ocp.functions.step())):
        path = hjb.rollout(policy, f, L, x0, 0.5, 4, step=step)
        loss = path.running.sum() + (path.x * torch.arange(1.0, 1 + ocp.system.nx)).sin().sum()
        answers.append([path.x, path.running, *torch.autograd.grad(loss, [x0, *policy.parameters()])])
    for a, b in zip(*answers, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)
    assert path.x.shape == (3, 2, 5, ocp.system.nx)


def train(ocp, dynamics=None, seed=0, **settings):
    return train_paper(ocp, dynamics, PaperSettings(**settings), seed, progress=False)


def test_interrupted_and_resumed_is_the_same_run(tmp_path):
    ocp, path = double_integrator.ocp(), tmp_path / "run" / "training.safetensors"
    settings = PaperSettings(**{**TINY, "iterations": 12})
    *nets, card = train_paper(ocp, None, settings, progress=False)

    def stop(k, terms):
        if k == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_paper(ocp, None, settings, progress=False, callback=stop, checkpoint=path)
    asked = []
    *again, resumed = train_paper(ocp, None, settings, progress=False, checkpoint=path,
                                  callback=lambda k, terms: asked.append(k))
    assert asked == [7, 8, 9, 10, 11]  # the eighth iteration was not kept
    for a, b in zip(outputs(nets, ocp), outputs(again, ocp), strict=True):
        assert torch.equal(a, b)
    for name in ("history", "race", "best_iteration", "held_out_cost", "dynamics_evaluations"):
        assert resumed[name] == card[name], name
    other = train_paper(ocp, None, settings, seed=3, progress=False, checkpoint=path)  # its own run, from the start
    assert torch.equal(outputs(other[:2], ocp)[0], outputs(train_paper(ocp, None, settings, 3, progress=False)[:2],
                                                           ocp)[0])


def test_patience_stops_a_run_that_no_longer_gains():
    ocp = double_integrator.ocp()
    *_, card = train(ocp, **{**TINY, "iterations": 40, "learning_rate": 1e-12, "patience": 3})
    assert card["iterations"] == len(card["history"]["cost"]) <= 40
    assert card["iterations"] - card["best_iteration"] == 3
    with pytest.raises(ValueError, match="patience is 0; expected an integer >= 1, or None"):
        PaperSettings(patience=0)


def test_the_public_call_keeps_checkpoints(tmp_path):
    ocp = double_integrator.ocp()
    cnd = nocl.train(ocp, method="paper", settings=PaperSettings(**TINY), out=tmp_path, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["training.safetensors"]
    again = nocl.train(ocp, method="paper", settings=PaperSettings(**TINY), out=tmp_path, progress=False)
    x = ocp.initial_states.sample(4, 1)
    assert np.array_equal(again(x), cnd(x))
    assert cnd.plot_training(tmp_path / "run.png").stat().st_size > 5000


@pytest.mark.parametrize("device", ["meta", pytest.param("cuda", marks=pytest.mark.skipif(
    not torch.cuda.is_available(), reason="no CUDA device here"))])
@pytest.mark.parametrize("options", [{}, {"hold": True}, {"detach": True, "time_input": True}])
def test_every_tensor_follows_the_device(device, options):
    """One loss and its gradient on another device than the CPU; on "meta" a tensor left behind raises."""
    ocp = double_integrator.ocp()
    trainer = Trainer(ocp, None, PaperSettings(**TINY, **options), 0, False, device, torch.float32)
    policy, value = trainer.starts[0], trainer.value
    terms = trainer.losses(policy, value)
    parameters = [*policy.parameters(), *value.parameters()]
    gradients = torch.autograd.grad(terms.total(trainer.settings.weights), parameters, materialize_grads=True)
    assert {g.device.type for g in gradients} == {device}
    assert trainer.step is rk4_cost  # compiled steps are the CPU's
    many, _ = side_by_side(trainer.starts)
    assert trainer.costs(many, trainer.states(2, 3), hold=True).device.type == device


def outputs(nets, ocp):
    x = torch.as_tensor(ocp.initial_states.sample(5, 1))
    return [net(x, torch.full((5, 1), 0.3, dtype=torch.float64)) for net in nets]


def test_a_seed_is_a_controller_and_the_callers_generators_are_left_alone():
    ocp = double_integrator.ocp()
    torch.manual_seed(5)
    state = torch.get_rng_state()
    first, again, other = (train(ocp, seed=seed, **TINY) for seed in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), state)
    for a, b, c in zip(*(outputs(run[:2], ocp) for run in (first, again, other)), strict=True):
        assert torch.equal(a, b)
        assert not torch.equal(a, c)
    card = first[2]
    assert card["dynamics"] == "exact"
    assert card["dynamics_evaluations"] == 4 * 5 * (2 * 2 * 2 + 4 * 4 + 4 * 128)  # race, training, four checks
    assert [len(v) for v in card["history"].values()] == [4] * 4
    assert len(card["race"]) == 2
    assert {p.dtype for net in first[:2] for p in net.parameters()} == {torch.float64}


def test_fused_and_torch_training_agree():
    ocp = double_integrator.ocp()
    runs = [train_paper(ocp, None, PaperSettings(**TINY, hold=True, fused=fused), progress=False, dtype=torch.float64)
            for fused in (True, False)]
    for a, b in zip(*(outputs(run[:2], ocp) for run in runs), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-8)


def test_learned_dynamics_are_used_as_they_are_and_left_as_they_were():
    ocp = double_integrator.ocp()
    net = torch.nn.Bilinear(2, 1, 2).double()  # any module of (x, u)
    before = [p.clone() for p in net.parameters()]
    *nets, card = train(ocp, net, **TINY)
    assert card["dynamics"] == "learned"
    assert all(torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))
    assert all(p.requires_grad and p.grad is None and p.dtype == torch.float64 for p in net.parameters())
    assert not torch.equal(outputs(nets, ocp)[0], outputs(train(ocp, **TINY)[:2], ocp)[0])
    with pytest.raises(ValueError, match=r"dynamics is a str; expected None \(the exact f\)"):
        train(ocp, "exact", **TINY)


def test_divergence_says_when_and_what_to_try():
    ocp = double_integrator.ocp()
    with pytest.raises(ValueError, match=r"all 2 random controllers .* try a smaller learning_rate \(is 0.01\)"):
        train(ocp, lambda x, u: x * math.nan, **TINY)
    with pytest.raises(ValueError, match=r"diverged at iteration 9: .* cost nan.* try set clip=1.0"):
        train(ocp, lambda x, u: x * math.nan, **{**TINY, "race": 1, "iterations": 30, "clip": None})


def judged(ocp, policy, n=20):
    return simulate(ocp, to_casadi(policy, name="policy", in_names=["x", "t"], out_names=["u"]),
                    ocp.initial_states.sample(n, 77))


@pytest.mark.slow
def test_double_integrator_reaches_the_cost_of_lqr():
    ocp = double_integrator.ocp()
    policy, *_ = train(ocp, time_input=True, hold=True, intervals=20, iterations=300, batch=32, race=1,
                       learning_rate=0.03, decay=0.1)
    run = judged(ocp, policy)
    S = np.linalg.inv(np.eye(2) + np.array([[8 / 3, 2.0], [2.0, 2.0]]) / 0.01)  # (P^-1 + W(T))^-1, T = 2
    Phi = np.array([[1.0, 2.0], [0.0, 1.0]])
    best = np.einsum("bi,ij,bj->b", run.x[:, 0], Phi.T @ S @ Phi, run.x[:, 0])
    assert run.success.all()
    assert (run.cost >= best * (1 - 1e-6)).all()
    assert run.cost.mean() < 1.2 * best.mean()


SHORT = {**TINY, "iterations": 40}


@pytest.fixture(scope="module")
def short():
    return outputs(train(double_integrator.ocp(), **SHORT)[:2], double_integrator.ocp())


@pytest.mark.parametrize("settings", [{"hold": True}, {"step": "euler", "hold": True}, {"detach": True},
                                      {"clip": None, "race": 1}])
def test_each_option_trains(settings, short):
    ocp = double_integrator.ocp()
    *nets, card = train(ocp, **{**SHORT, **settings})
    first, last = np.reshape(card["history"]["cost"], (2, -1)).mean(1)
    assert last < first
    assert not torch.equal(outputs(nets, ocp)[1], short[1])


def test_a_system_of_ones_own_goes_through():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("scalar", x=x, u=u, xdot=-x + u, lbu=[-1.0], ubu=[1.0], lbx=[-2.0], ubx=[2.0])
    ocp = nocl.OCP.quadratic(system, horizon=1.0, x_goal=[0.0], u_goal=[0.0],
                             initial_states=nocl.Uniform(lb=[-1.0], ub=[1.0]))
    policy, _, card = train(ocp, **TINY, weights=(1.0, 0.0, 0.0, 0.0))
    assert judged(ocp, policy, 2).success.all()
    assert card["history"]["hjb"] == [0.0] * 4


@pytest.mark.slow
def test_cartpole_swings_up():
    ocp = cartpole.ocp()
    policy, *_ = train(ocp)
    run = judged(ocp, policy)
    assert run.success.all()
    assert np.linalg.norm(ocp.from_goal(run.x[:, -1]), axis=1).mean() < 0.5  # hanging: 3.1; the optimum: 0.037
    assert run.cost.mean() < 0.5  # hanging: 9.9; the optimum: 0.064
