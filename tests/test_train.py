"""The default method against what is known: the Riccati solution, fine integration, problems solved again."""

import importlib
import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from lq import lq_symbols, lq_value

import nocl
from nocl.hjb import hjb_residual
from nocl.judge import simulate
from nocl.nets import MLP, FeatureNet
from nocl.solvers import LQR, NMPC
from nocl.solvers.cnd import TrainSettings, validate
from nocl.solvers.cnd.regression.features import policy_net
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import (
    SMALL,
    Labels,
    Problems,
    answered,
    continuous_cost,
    folded_into,
    kicked_rollout,
    kicked_states,
    policy_controls,
    tube,
    tube_states,
)
from nocl.solvers.cnd.regression.regress import fit_net, policy_loss
from nocl.solvers.cnd.validate import advice, gap, held_out, refined, summary, value_scores
from nocl.solvers.cnd.value import ROUND, ValueLabels, on_fine_grid, value_loss, value_net, value_tails
from nocl.solvers.ddp.bank import SolutionBank, extend
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.translate.rk4 import rk4_interval

module = importlib.import_module("nocl.solvers.cnd.training")  # the package has a function of that name

QUICK = TrainSettings(intervals=40, seeds=4, starts=2, states=60, tails=400, visits=200, rounds=0, iterations=800,
                      batch=512, hidden=(24, 24), value_initial=100, value_tails=800,
                      value_visits=200, value_iterations=800, held_out=16, gap_median=1e-9)
TINY = replace(QUICK, intervals=20, batch=64, states=10, tails=40, visits=20, rounds=2, iterations=30, hidden=(8,),
               value_initial=10, value_tails=40, value_visits=10, value_iterations=20, value_rounds=1, held_out=4)


@pytest.fixture(scope="module")
def integrator():
    ocp = nocl.load_ocp("double_integrator")
    return ocp, nocl.train(ocp, settings=QUICK, seed=0, progress=False)


def test_an_export_that_would_differ_is_told_before_training(monkeypatch):
    monkeypatch.setitem(module.parity.LIMITS, "float64", 1e-20)
    with pytest.warns(UserWarning, match=r"policy: native CasADi \(float64\) differs .*, before it is trained"):
        nocl.train(nocl.load_ocp("double_integrator"), settings=replace(TINY, rounds=0, value=False), progress=False)


@pytest.fixture(scope="module")
def pendulum():
    """(ocp, ddp, bank of solutions, f): no training."""
    ocp = nocl.load_ocp("pendulum")
    ddp, rng = DDP(ocp, intervals=40), np.random.default_rng(0)
    seeds = solve_globally(ddp, ocp.initial_states.sample(6, rng), starts=4, seed=rng)
    bank = SolutionBank.of(ddp, seeds)
    more = extend(ddp, bank, ocp.initial_states.sample(40, rng))
    return ocp, ddp, SolutionBank.of(ddp, more), nocl.to_torch(ocp.system.f)


def paths(ocp, x0, nodes=21):
    """Optimal paths of the double integrator (t [n], x [n, 2]) from x0: LQR is tested by itself."""
    run = simulate(ocp, LQR(ocp), x0, nodes=nodes)
    return np.tile(run.t, len(x0)), run.x.reshape(-1, 2), run


def test_linear_quadratic_policy_is_the_riccati_feedback(integrator):
    ocp, cnd = integrator
    t, x, _ = paths(ocp, ocp.initial_states.sample(20, 99))
    _, K = lq_value(t)
    u = -np.einsum("nij,nj->ni", K, x)
    early = t < 0.98 * ocp.horizon  # labels end half an interval before T
    assert np.sqrt(np.mean((cnd(x, t) - u)[early] ** 2)) < 0.06 * u.std()


def test_linear_quadratic_value_is_the_riccati_value(integrator):
    ocp, cnd = integrator
    t, x, _ = paths(ocp, ocp.initial_states.sample(20, 99))
    S, _ = lq_value(t)
    V, V_x = np.einsum("ni,nij,nj->n", x, S, x), 2 * np.einsum("nij,nj->ni", S, x)
    error = np.abs(cnd.value(x, t) - V) / V
    assert np.median(error) < 0.005
    assert np.mean(error[t == 0]) < 0.015
    gradient = cnd.value_gradient(x, t)
    off = np.linalg.norm(gradient - V_x, axis=1) / np.linalg.norm(V_x, axis=1)
    assert np.median(off) < 0.04


def test_linear_quadratic_cost_in_continuous_time(integrator):
    ocp, cnd = integrator
    x0 = ocp.initial_states.sample(20, 99)
    S, _ = lq_value([0.0])
    best = np.einsum("ni,ij,nj->n", x0, S[0], x0)
    gap = simulate(ocp, cnd, x0).cost / best - 1
    assert (gap > -1e-6).all()
    assert np.median(gap) < 0.001
    assert gap.max() < 0.04  # at the edge of the labelled tube
    assert cnd.card["gap_median"] == pytest.approx(np.median(gap), abs=1e-3)


def test_hjb_residual_is_small(integrator):
    """V_t + L + V_x' f, at the trained u: small beside the running cost's mean rate J* / T."""
    ocp, cnd = integrator
    t, x, run = paths(ocp, ocp.initial_states.sample(20, 99))
    inside = t < 0.95 * ocp.horizon
    X, T = torch.from_numpy(x[inside]), torch.from_numpy(t[inside])[:, None]
    residual = hjb_residual(cnd.value_net, nocl.to_torch(ocp.system.f), nocl.to_torch(ocp.L), X, cnd.policy(X, T), T)
    assert residual.abs().median() < 0.05 * run.cost.mean() / ocp.horizon


def test_a_trained_controller_exports_and_comes_back(integrator, tmp_path):
    ocp, cnd = integrator
    x, t = ocp.initial_states.sample(10, 3), np.linspace(0, ocp.horizon, 10)
    policy, value = cnd.to_casadi(), cnd.value_to_casadi()
    assert pytest.approx(cnd(x, t), rel=1e-12, abs=1e-12) == policy(x.T, t[None]).full().T
    assert value(x.T, t[None]).full()[0] == pytest.approx(cnd.value(x, t), rel=1e-12, abs=1e-12)
    cnd.save(tmp_path)
    again = nocl.CND.load(tmp_path)
    assert np.array_equal(again(x, t), cnd(x, t))
    assert again.card == json.loads(json.dumps(cnd.card))


@pytest.mark.slow
def test_pendulum_swings_up():
    ocp = nocl.load_ocp("pendulum")
    settings = replace(QUICK, intervals=80, states=150, tails=1000, visits=600, rounds=1, iterations=1500,
                       hidden=(48, 48), value_iterations=2000)
    cnd = nocl.train(ocp, settings=settings, seed=0, progress=False)
    x0 = ocp.initial_states.sample(20, 99)
    ddp = DDP(ocp, intervals=320)
    best = solve_globally(ddp, x0, starts=6)
    gap = simulate(ocp, cnd, x0).cost / best.cost - 1
    assert np.median(gap) < 0.015
    assert np.quantile(gap, 0.95) < 0.06
    assert np.mean(np.abs(cnd.value(x0) / best.cost - 1)) < 0.03


@pytest.mark.slow
def test_same_seed_same_controller_and_others_differ():
    ocp = nocl.load_ocp("pendulum")
    runs = [nocl.train(ocp, settings=replace(TINY, rounds=1), seed=seed, progress=False) for seed in (3, 3, 4)]
    x = ocp.initial_states.sample(8, 1)
    assert np.array_equal(runs[0](x, 0.7), runs[1](x, 0.7))
    assert np.array_equal(runs[0].value(x, 0.7), runs[1].value(x, 0.7))
    assert runs[0].card["history"] == runs[1].card["history"]
    assert not np.array_equal(runs[0](x, 0.7), runs[2](x, 0.7))


@pytest.mark.filterwarnings("ignore:mayer")
def test_a_cost_at_the_end_alone_has_a_residual_in_its_own_units():
    """L = 0: there is no running cost to measure the HJB residual by."""
    p, v, u = (ca.SX.sym(name) for name in "pvu")
    system = nocl.System("mayer", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u - 0.2 * u**2), lbu=[-1], ubu=[1],
                         lbx=[-2, -2], ubx=[2, 2])
    ocp = nocl.OCP(system, horizon=1.0, running=0.0, terminal=1 + p**2 + v**2, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([0.5, -0.1], [1, 0.1]))
    card = nocl.train(ocp, settings=replace(TINY, rounds=0), progress=False).card["value"]
    assert np.isfinite([card["hjb_median"], card["hjb_mean"]]).all()


def test_training_leaves_torch_as_it_was():
    torch.manual_seed(5)
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    nocl.train(nocl.load_ocp("double_integrator"), settings=replace(TINY, rounds=0), progress=False)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.get_num_threads() == threads


@pytest.fixture(scope="module")
def whole():
    return nocl.train(nocl.load_ocp("pendulum"), settings=TINY, seed=1, progress=False)


def test_the_card_tells_how_training_went(whole, tmp_path):
    rows, value = whole.card["history"], whole.card["value"]
    assert 0 < whole.card["fitting_seconds"] < whole.card["seconds"]
    assert [row["round"] for row in rows] == [0, 1, 2]
    for row in rows:
        assert {"labels", "loss", "gap_median", "gap_p95", "kicked_median", "kicked_p95"} <= set(row)
        assert len(row["loss"]) == TINY.iterations * (2 if row["round"] == 2 else 1)
    assert {f"{name}_error" for name in ("initial", "tube", "tails")} <= set(value)
    assert {"tails_degrees", "tails_slope_error", "hjb_mean"} <= set(value)
    assert np.isfinite([v for v in value.values() if isinstance(v, float)]).all()
    assert json.loads(json.dumps(whole.card))["history"] == rows
    picture = whole.plot_training(tmp_path / "run" / "training.png")
    assert picture.read_bytes()[:8] == bytes([137]) + b"PNG\r\n" + bytes([26, 10])
    with pytest.raises(ValueError, match="has no history; expected one of nocl"):
        nocl.CND(whole.ocp, whole.policy).plot_training(tmp_path / "none.png")


def test_v_is_fitted_again_until_the_held_out_states_are_met():
    ocp, tiny = nocl.load_ocp("double_integrator"), replace(TINY, rounds=0, value_rounds=2)
    met, missed = (nocl.train(ocp, settings=replace(tiny, value_error=e), seed=1, progress=False).card["value"]
                   for e in (1e3, 1e-9))
    assert missed["labels"] > met["labels"]
    assert len(missed["loss"]) > len(met["loss"]) == TINY.value_iterations
    assert [len(card["tried"]) for card in (met, missed)] == [1, 2]
    assert max(missed[f"{name}_error"] for name in ("initial", "tube", "tails")) == min(missed["tried"])


def test_the_papers_run_is_drawn_too(whole, tmp_path):
    card = {"method": "paper", "history": {name: [1.0, 0.5, 0.2] for name in ("cost", "hjb", "final", "hamil")}}
    assert nocl.CND(whole.ocp, whole.policy, None, card).plot_training(tmp_path / "paper.png").stat().st_size > 5000


def test_a_large_gap_is_told_with_what_to_try():
    with pytest.warns(UserWarning, match=r"costs .* % more than the optimum .* expected less than 1 %: .* lower"):
        nocl.train(nocl.load_ocp("double_integrator"), settings=replace(TINY, rounds=0, value=False), progress=False)
    near = {"gap_median": 1e-4, "gap_p95": 1e-3, "unsolved": 0}
    assert advice(near, 2, 64) is None
    assert "more seeds" in advice({**near, "gap_p95": 0.5}, 2, 64)
    assert "7 of 64" in advice({**near, "unsolved": 7}, 2, 64)


def test_the_gap_counts_from_any_time_and_a_policy_that_blows_up_is_infinitely_bad(pendulum):
    ocp, ddp, bank, _ = pendulum
    fine = DDP(ocp, intervals=160)
    tails = refined(fine, tube(ddp, bank, 8, 0.1, np.random.default_rng(2)))
    own = fine.solve(tails.x[:, 0], tails.t[:, 0], u=tails.u)
    for i in range(3):  # the optimum's own feedback, as a policy of one row
        K, t0, h = fine.intervals, tails.t[i, 0], (ocp.horizon - tails.t[i, 0]) / fine.intervals

        def feedback(x, t, i=i, t0=t0, h=h, K=K):
            k = np.clip(((t.numpy()[:, 0] - t0) / h + 1e-9).astype(int), 0, K - 1)
            part = ((t.numpy()[:, 0] - t0) / h - k)[:, None]
            near = (1 - part) * own.x[i, k] + part * own.x[i, k + 1]
            u = own.u[i, k] + np.einsum("nij,nj->ni", own.gain[i, k], x.numpy() - near)
            return torch.from_numpy(u.clip(ocp.system.lbu, ocp.system.ubu))

        assert gap(feedback, InTorch(ocp), own[i:i + 1]) == pytest.approx(0.0, abs=2e-3)
    assert summary(np.array([np.nan, np.nan, 0.0]), "gap") == {"gap_median": np.inf, "gap_p95": np.inf}


def test_held_out_states_that_no_neighbour_leads_to_are_solved_from_cold_starts(monkeypatch):
    ocp = nocl.load_ocp("pendulum")
    ddp, fine = DDP(ocp, intervals=20), DDP(ocp, intervals=80)
    fresh = Problems.initial(ocp, 4, np.random.default_rng(0))
    bank = SolutionBank.of(ddp, ddp.solve(ocp.initial_states.sample(6, 1)))
    whole = held_out(ddp, fine, bank, fresh)

    def failing(*args, **options):
        found = extend(*args, **options)
        found.success[2], found.cost[2] = False, np.inf
        return found

    monkeypatch.setattr(validate, "extend", failing)
    again = held_out(ddp, fine, bank, fresh)
    assert again.success.all()
    assert again.cost[2] <= whole.cost[2] * (1 + 1e-6)
    np.testing.assert_array_equal(np.delete(again.cost, 2), np.delete(whole.cost, 2))


def test_value_scores_are_zero_for_the_exact_value():
    """The double integrator's V = x' S(t) x from its own DDP solutions: errors of the label grid only."""
    ocp = nocl.load_ocp("double_integrator")
    fine, x0 = DDP(ocp, intervals=320), ocp.initial_states.sample(10, 5)
    starts = fine.solve(x0)
    x, (t, S, K) = ca.SX.sym("x", 2), lq_symbols()

    def value(X, T):
        return nocl.to_torch(ca.Function("V", [x, t], [x.T @ S @ x]))(X, T)

    policy = nocl.to_torch(ca.Function("u", [x, t], [-K @ x]))
    optima = {"initial": starts, "tails": starts}
    row = value_scores(value, policy, InTorch(ocp), optima)
    assert row["tails_error"] < 1e-4
    assert row["tails_degrees"] < 0.1
    assert row["tails_slope_error"] < 1e-4
    assert row["hjb_mean"] < 1e-10
    twice = value_scores(lambda X, T: 2 * value(X, T), policy, InTorch(ocp), optima)
    of_usual = starts.cost / (starts.cost + 0.1 * starts.cost.mean())  # what costs next to nothing is no measure
    assert twice["initial_error"] == pytest.approx(of_usual.mean(), abs=1e-3)
    assert twice["initial_slope_error"] == pytest.approx(1.0, abs=1e-3)
    assert twice["hjb_mean"] > 0.1


def test_value_scores_do_not_depend_on_units():
    """A speed in m/s and in mm/s, and a V that is not the true one."""
    found = []
    for unit in (1.0, 1e3):
        p, w, u = (ca.SX.sym(name) for name in "pwu")
        system = nocl.System("mass", x=ca.vertcat(p, w), u=u, xdot=ca.vertcat(w / unit, unit * u), lbu=[-1], ubu=[1],
                             lbx=[-2, -2 * unit], ubx=[2, 2 * unit])
        ocp = nocl.OCP(system, horizon=1.0, running=u**2, terminal=p**2 + (w / unit)**2,
                       initial_states=nocl.Gaussian([1.0, 0.0], [0.5, 0.5 * unit]))
        best = DDP(ocp, intervals=20).solve([[1.0, 0.5 * unit], [0.5, -0.2 * unit]])
        x, t = ca.SX.sym("x", 2), ca.SX.sym("t")
        wrong = nocl.to_torch(ca.Function("V", [x, t], [x[0]**2 + 0.9 * x[0] * x[1] / unit + 0.2 * (x[1] / unit)**2]))
        policy = nocl.to_torch(ca.Function("u", [x, t], [-0.3 * x[0] - 0.4 * x[1] / unit]))
        found.append(value_scores(wrong, policy, InTorch(ocp), {"tails": best}))
    assert found[0]["tails_degrees"] > 1
    assert found[0] == pytest.approx(found[1], rel=1e-6)


@pytest.mark.parametrize("stage", ["_regress", "_value"])
def test_interrupted_and_resumed_is_the_same_run(stage, whole, tmp_path, monkeypatch):
    ocp = whole.ocp
    original = getattr(module.Training, stage)

    def interrupted(self, *args):
        if self.round >= 2:
            raise KeyboardInterrupt
        return original(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(module.Training, stage, interrupted)
        with pytest.raises(KeyboardInterrupt):
            nocl.train(ocp, settings=TINY, seed=1, out=tmp_path, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == [module.CHECKPOINT]
    monkeypatch.setattr(module.Training, "_first_labels", lambda self: pytest.fail("labels were made again"))
    resumed = nocl.train(ocp, settings=TINY, seed=1, out=tmp_path, progress=False)
    x = ocp.initial_states.sample(8, 1)
    assert np.array_equal(resumed(x, 0.4), whole(x, 0.4))
    assert np.array_equal(resumed.value(x, 0.4), whole.value(x, 0.4))
    assert resumed.card["history"] == whole.card["history"]


def test_a_checkpoint_of_another_run_is_left_aside(tmp_path):
    ocp, settings = nocl.load_ocp("double_integrator"), replace(TINY, rounds=0)
    nocl.train(ocp, settings=settings, seed=1, out=tmp_path, progress=False)
    fresh = nocl.train(ocp, settings=settings, seed=2, progress=False)
    again = nocl.train(ocp, settings=settings, seed=2, out=tmp_path, progress=False)
    x = ocp.initial_states.sample(8, 1)
    assert np.array_equal(again(x), fresh(x))


def test_nothing_is_written_without_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    nocl.train(nocl.load_ocp("double_integrator"), settings=replace(TINY, rounds=0, value=False), progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("change", "message"), [
    ({"seeds": 0}, "seeds is 0; expected an integer >= 1"),
    ({"iterations": 2.5}, "iterations is 2.5"), ({"batch": True}, "batch is True"),
    ({"lr": 0.0}, "lr is 0.0; expected a finite number > 0"), ({"width": -1.0}, "width is -1.0"),
    ({"kick": float("nan")}, "kick is nan"), ({"gap_p95": float("inf")}, "gap_p95 is inf"),
    ({"rounds": -1}, ">= 0"), ({"hidden": ()}, r"hidden is \(\)"), ({"hidden": (64, 0)}, "expected widths")])
def test_settings_are_checked(change, message):
    with pytest.raises(ValueError, match=message):
        TrainSettings(**change)


def test_what_cannot_be_trained_is_refused():
    ocp = nocl.load_ocp("pendulum")
    with pytest.raises(ValueError, match="method is 'magic'; expected 'default' or 'paper'"):
        nocl.train(ocp, method="magic")
    with pytest.raises(ValueError, match=r"ocp is a System; expected a nocl\.OCP"):
        nocl.train(ocp.system)
    with pytest.raises(ValueError, match="settings is a dict; this method takes TrainSettings"):
        nocl.train(ocp, settings={"seeds": 3})
    with pytest.raises(ValueError, match="this method takes PaperSettings"):
        nocl.train(ocp, method="paper", settings=QUICK)


def test_dynamics_of_another_system_are_refused():
    class Other:
        system = nocl.load_ocp("cartpole").system

    with pytest.raises(ValueError, match="dynamics has 4 states and 1 controls, pendulum has 2 and 1"):
        nocl.train(nocl.load_ocp("pendulum"), Other())


def test_labels_stand_at_the_middle_of_each_interval(pendulum):
    ocp, ddp, bank, f = pendulum
    solution = bank.solution[:3]
    unit = 0.3
    labels, K = Labels.of(solution, InTorch(ddp.ocp), unit), ddp.intervals
    assert len(labels) == 3 * K
    h = ocp.horizon / K
    assert labels.t.reshape(3, K) == pytest.approx(np.tile((np.arange(K) + 0.5) * h, (3, 1)))
    cost = np.repeat(np.abs(solution.cost) + SMALL * unit, K)
    assert labels.weight == pytest.approx(h / cost)
    assert not labels.dt.any()
    assert np.array_equal(labels.u.reshape(3, K, 1), solution.u)
    nodes, u = (torch.from_numpy(z.reshape(3 * K, -1)) for z in (solution.x[:, :-1], solution.u))
    middle = rk4_interval(f, nodes, u, h / 2, substeps=50)
    assert labels.x == pytest.approx(middle.numpy(), abs=1e-5)


def test_labels_of_what_failed_are_dropped(pendulum):
    _, ddp, bank, _ = pendulum
    failed = replace(bank.solution[:3], success=np.array([True, False, True]))
    assert len(Labels.of(failed, InTorch(ddp.ocp), 1.0)) == 2 * ddp.intervals
    assert len(ValueLabels.of([failed, bank.solution[:1]])) * 2 == len(ValueLabels.of([bank.solution[:6]]))


def test_tube_labels_are_optimal(pendulum):
    """Tails that DDP solved from their parents, solved again by NMPC from many starts."""
    ocp, ddp, bank, _ = pendulum
    solved = tube(ddp, bank, 6, 0.25, np.random.default_rng(4))
    assert solved.success.all()
    assert solved.V[:, 0] == pytest.approx(solved.cost, rel=1e-12)
    for i in range(len(solved)):
        tail = replace(ocp, horizon=ocp.horizon - solved.t[i, 0])  # neither f nor L depends on time
        again = NMPC(tail, ddp.intervals, starts=8).solve(solved.x[i, 0])
        assert solved.cost[i] == pytest.approx(again.cost[0], rel=1e-5)
        assert solved.V_x[i, 0] == pytest.approx(again.costate[0, 0], rel=1e-3, abs=1e-5)


def test_the_better_of_two_starts_is_kept(pendulum):
    """A policy that does nothing gives a poor start; the bank's nearest solution saves the label."""
    ocp, ddp, bank, _ = pendulum

    def idle(x, t):
        return torch.zeros(len(x), 1, dtype=x.dtype)

    x, t0 = bank.solution.x[:5, 10].copy(), bank.solution.t[:5, 10].copy()
    best = answered(ddp, bank, idle, InTorch(ocp), Problems(x, t0, np.zeros((5, 0))))
    near = ddp.solve(x, t0, **bank.guess(np.arange(5), t0))
    assert (best.cost <= near.cost * (1 + 1e-4)).all()
    u = policy_controls(idle, InTorch(ocp), Problems(x, t0, np.zeros((5, 0))), ddp.intervals)
    assert u.shape == (5, ddp.intervals, 1)
    assert not u.any()


def feedback(ocp, K=(20.0, 6.0)):
    """u = clip(-K x - t / 10), a policy with nothing to learn, as a network."""
    x, t, y = ca.SX.sym("x", 2), ca.SX.sym("t"), ca.SX.sym("y")
    inputs = ca.Function("phi", [x, t], [ca.vertcat(x, t)], ["x", "t"], ["phi"])
    clip = ca.fmin(ca.fmax(y, ocp.system.lbu[0]), ocp.system.ubu[0])
    net = FeatureNet(inputs, [MLP([3, 1])], ca.Function("u", [x, t, y], [clip], ["x", "t", "y"], ["u"]))
    with torch.no_grad():
        net.nets[0].body[0].weight[:] = torch.tensor([[-K[0], -K[1], -0.1]])
        net.nets[0].body[0].bias[:] = 0
    return net.double().requires_grad_(False)


def test_kicked_rollout(pendulum):
    ocp = pendulum[0]
    policy, x0 = feedback(ocp), np.array([[0.3, 0.0], [0.1, -0.2]])
    acting = (InTorch(ocp), policy, Problems(x0, np.zeros(2), np.zeros((2, 0))))
    t, x = kicked_rollout(*acting, np.zeros(2), np.random.default_rng(0), steps=320)
    run = simulate(ocp, nocl.CND(ocp, policy), x0, nodes=321)
    assert t == pytest.approx(run.t)
    assert x == pytest.approx(run.x, abs=0.01)  # held over 320 intervals, half an interval late
    _, kicked = kicked_rollout(*acting, np.array([0.0, 0.1]), np.random.default_rng(0), steps=320)
    _, again = kicked_rollout(*acting, np.array([0.0, 0.1]), np.random.default_rng(0), steps=320)
    assert np.array_equal(kicked, again)
    assert np.array_equal(kicked[:, 0], x0)
    assert np.abs(kicked - x).max() > 0.01


def grown(lowest: float) -> tuple[nocl.OCP, SolutionBank]:
    """n' = u n - n / (1 + n), which means nothing beyond n = -1, in a box [lowest, 100]; and two solutions."""
    n, u = ca.SX.sym("n"), ca.SX.sym("u")
    system = nocl.System("cells", x=n, u=u, xdot=u * n - n / (1 + n), lbu=[0], ubu=[1], lbx=[lowest], ubx=[100])
    ocp = nocl.OCP(system, horizon=2.0, running=u**2, terminal=-n, initial_states=nocl.Uniform([0.5], [1.0]))
    ddp = DDP(ocp, intervals=10)
    return ocp, SolutionBank.of(ddp, ddp.solve(ocp.initial_states.sample(2, 0)))


@pytest.mark.parametrize("lowest", [0.0, 0.7])
def test_states_are_drawn_within_bounds_that_no_solution_leaves(lowest):
    """Cells are never fewer than none; a box that solutions leave is no bound."""
    ocp, bank = grown(lowest)
    acting = (bank, lambda x, t: 0 * x, InTorch(ocp))
    _, near = tube_states(ocp, bank, 200, 1.0, np.random.default_rng(0))
    kicked = kicked_states(*acting, 200, 1.0, np.random.default_rng(0))
    assert (bank.solution.x.min() >= lowest) == (lowest == 0)
    for found in (near, kicked):
        assert (found.x.min() >= 0) == (lowest == 0)
        assert found.x.std() > 0.5  # they are moved


def test_a_state_is_mirrored_at_its_bound():
    x = np.array([[-0.2, 5.0], [1.3, -7.0], [9.0, 0.5]])
    np.testing.assert_allclose(folded_into(x, np.array([0.0, -np.inf]), np.array([1.0, 2.0])),
                               [[0.2, -1.0], [0.7, -7.0], [0.0, 0.5]])


def test_continuous_cost_is_the_judges(pendulum):
    ocp = pendulum[0]
    policy, x0 = feedback(ocp), np.array([[0.2, 0.0], [0.1, -0.2], [-0.15, 0.3]])  # U is not reached: smooth
    run = simulate(ocp, nocl.CND(ocp, policy), x0)
    assert run.saturation.max() == 0
    cost = continuous_cost(policy, InTorch(ocp), Problems(x0, np.zeros(3), np.zeros((3, 0))), 400)
    assert cost == pytest.approx(run.cost, rel=1e-6)


def loss_parts(u_label):
    """u -> (policy loss where the network answers u, its slope, one unit of u in the network's); U = [-5, 5]."""
    ocp = nocl.load_ocp("pendulum")
    rng = np.random.default_rng(0)
    n = len(u_label)
    labels = Labels(rng.standard_normal((n, 2)), rng.uniform(0, 3, n), np.zeros((n, 0)), np.array(u_label)[:, None],
                    np.ones(n), np.zeros(n))
    net, inverse = policy_net(ocp, labels, (4,))
    answer = torch.nn.Linear(1, 1)  # stands for the network: whatever the features, it answers `y`
    answer.y = None
    answer.forward = lambda phi: answer.y
    net.nets[0] = answer
    net.float()
    loss = policy_loss(ocp, net, inverse, labels)
    to_y_and_label = nocl.to_torch(inverse)

    def to_y(u):
        return to_y_and_label(u)[0]

    def of(u):
        y = to_y(torch.tensor(u, dtype=torch.float64)[:, None]).float().requires_grad_(True)
        answer.y = y
        value = loss(torch.arange(n))
        (slope,) = torch.autograd.grad(value, y)
        return value.item(), slope[:, 0].numpy(), float((to_y(torch.ones(1, 1)) - to_y(torch.zeros(1, 1))).item())

    return of


def test_policy_loss_counts_what_costs():
    wanted = [-5.0, 5.0, 1.0, -2.0]
    of = loss_parts(wanted)
    value, slope, _ = of(wanted)
    assert value == pytest.approx(0, abs=1e-10)
    assert slope == pytest.approx(np.zeros(4), abs=1e-5)
    value, slope, _ = of([-9.0, 7.0, 1.0, -2.0])  # beyond bounds that are active in the labels
    assert value == pytest.approx(0, abs=1e-10)
    assert slope == pytest.approx(np.zeros(4), abs=1e-5)
    value, slope, unit = of([-4.0, 4.0, 1.5, -2.5])
    off = unit * np.array([1.0, -1.0, 0.5, -0.5])  # in the network's units
    assert value == pytest.approx((off**2).mean(), rel=1e-4)
    assert slope == pytest.approx(2 * off / 4, rel=1e-4)


def test_value_labels_are_costs_to_go_on_the_fine_grid(pendulum):
    ocp, ddp, bank, _ = pendulum
    fine = DDP(ocp, intervals=160)
    (whole,) = on_fine_grid(fine, bank.solution)
    found = value_tails(ddp, bank, feedback(ocp), InTorch(ocp), initial=3, tails=12, visits=8, width=0.25, kick=0.1,
                        rng=np.random.default_rng(0))
    assert (found.t[:3, 0] == 0).all()  # initial states first
    (tails,) = on_fine_grid(fine, found)
    assert len(whole) == len(bank)
    assert (whole.cost <= bank.solution.cost).all()  # what is held for shorter costs less
    labels = ValueLabels.of([whole, tails])
    end = labels.t > ocp.horizon - 1e-9
    assert end.sum() == whole.success.sum() + tails.success.sum()
    G = ocp.G(labels.x[end].T).full()[0]
    assert labels.V[end] == pytest.approx(G, rel=1e-9)
    assert labels.V_x[end] == pytest.approx(2 * labels.x[end], rel=1e-9)


def riccati_labels(n=4000, shift=0.0):
    rng = np.random.default_rng(0)
    t, x = rng.uniform(0, 2, n), rng.standard_normal((n, 2))
    S, _ = lq_value(t)
    V, V_x = np.einsum("ni,nij,nj->n", x, S, x) + shift, 2 * np.einsum("nij,nj->ni", S, x)
    return ValueLabels(x, t, np.zeros((n, 0)), V, V_x)


@pytest.mark.parametrize("shift", [0.0, -3.0])
def test_value_regression_on_exact_labels(shift):
    """Positive costs and costs of both signs alike."""
    ocp, labels = nocl.load_ocp("double_integrator"), riccati_labels(shift=shift)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = value_net(ocp, labels, (24, 24))
    fit_net(net, value_loss(net, labels, np.ones(2)), len(labels), iterations=600, batch=512, lr=4e-3, seed=0)
    cnd = nocl.CND(ocp, feedback(ocp), net)
    size = labels.V - min(0.0, labels.V.min())
    error = np.abs(cnd.value(labels.x, labels.t) - labels.V) / (size + 0.1 * np.median(size))
    assert np.median(error) < (0.03 if shift else 0.01)
    if shift == 0:
        assert cnd.value(labels.x, labels.t).min() >= 0


def test_value_loss_has_the_right_gradients():
    """The gradient that the loss sees, assembled from those of the features, is autograd's own dV/dx."""
    ocp, labels = nocl.load_ocp("pendulum"), riccati_labels(50)
    torch.manual_seed(0)
    net = value_net(ocp, labels, (8,)).float()
    exact = nocl.CND(ocp, feedback(ocp), value_net(ocp, labels, (8,)))
    exact.value_net.load_state_dict({k: v.double() for k, v in net.state_dict().items()})
    at = (labels.x, labels.t)
    own = ValueLabels(*at, labels.p, exact.value(*at), exact.value_gradient(*at))
    rows = torch.arange(50)
    at_own = value_loss(net, own, np.array([0.5, 2.0]))(rows).item()
    assert at_own == pytest.approx(ROUND, rel=1e-3)  # its least value
    for wrong in (replace(own, V_x=own.V_x * [1.0, 1.2]), replace(own, V=own.V * 1.1)):
        assert value_loss(net, wrong, np.array([0.5, 2.0]))(rows).item() > 2 * at_own


@pytest.mark.parametrize(("name", "sizes"), [("pendulum", (8, 8)), ("cartpole", (13, 9, 5)), ("quadrotor", (24,))])
def test_the_compiled_value_loss_is_that_of_autograd(name, sizes):
    """In float64, over more rows than fill the lanes, one of them twice, a floor below zero."""
    ocp, rng = nocl.load_ocp(name), np.random.default_rng(3)
    x, t = rng.standard_normal((50, ocp.system.nx)), rng.uniform(0, ocp.horizon, 50)
    labels = ValueLabels(x, t, np.zeros((50, 0)), rng.standard_normal(50), rng.standard_normal(x.shape))
    torch.manual_seed(0)
    net, rows = value_net(ocp, labels, sizes).double(), torch.tensor([*range(0, 50, 2), 3, 3, *range(1, 20, 3)])
    answers = []
    for compiled in (True, False):
        net.zero_grad()
        value = value_loss(net, labels, np.linspace(0.5, 2, ocp.system.nx), compiled=compiled)(rows)
        value.backward()
        answers.append(torch.cat([value.detach()[None], *(p.grad.flatten() for p in net.parameters())]))
    torch.testing.assert_close(answers[0], answers[1], rtol=1e-10, atol=1e-12)


def test_the_compiled_value_loss_refuses_what_it_was_not_made_for():
    ocp, labels = nocl.load_ocp("double_integrator"), riccati_labels(50)
    net = value_net(ocp, labels, (8,)).float()
    loss = value_loss(net, labels, np.ones(2))
    for rows in ([50], [-1], []):
        with pytest.raises(IndexError, match="the loss of V has 50 labels; got"):
            loss(torch.tensor(rows, dtype=torch.int64))
    net.double()
    with pytest.raises(ValueError, match="made for weights in float32; got float64: make it again after"):
        loss(torch.arange(5))


def test_without_a_compiler_v_is_fitted_in_torch_and_that_is_told(monkeypatch):
    ocp, labels = nocl.load_ocp("double_integrator"), riccati_labels(50)
    net, rows = value_net(ocp, labels, (8,)), torch.arange(50)
    compiled = value_loss(net, labels, np.ones(2))(rows)
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.warns(UserWarning, match="V is fitted in torch, several times slower: no C compiler found"):
        plain = value_loss(net, labels, np.ones(2))(rows)
    assert plain.item() == pytest.approx(compiled.item(), rel=1e-5)


def test_a_loss_that_is_not_finite_stops_the_fit():
    ocp = nocl.load_ocp("double_integrator")
    labels = riccati_labels(10)
    net = value_net(ocp, labels, (4,))
    with pytest.raises(ValueError, match="the loss is nan at iteration 0: lower the learning rate"):
        fit_net(net, lambda rows: net.nets[0].body[0].weight.sum() * torch.nan, 10, iterations=3, batch=2, lr=1e-3,
                seed=0)


def test_training_never_draws_the_states_of_a_sample_with_a_seed(monkeypatch):
    """numpy pads seeds with zeros: default_rng([s, 0]) is default_rng(s), which draws the states of comparisons."""
    ocp = nocl.load_ocp("double_integrator")
    drawn, sample = [], nocl.Gaussian.sample
    def spy(self, n, seed=0):
        drawn.append(sample(self, n, seed))
        return drawn[-1]

    monkeypatch.setattr(nocl.Gaussian, "sample", spy)
    nocl.train(ocp, settings=replace(TINY, rounds=0, value=False), seed=1, progress=False)
    monkeypatch.undo()
    used = {row.tobytes() for rows in drawn for row in rows}
    assert used
    for seed in range(4):
        assert not used & {row.tobytes() for row in ocp.initial_states.sample(200, seed)}


def test_a_checkpoint_of_another_model_is_not_taken_up(tmp_path):
    """Models in closed form have no weights: their maps tell them apart."""
    ocp = nocl.load_ocp("double_integrator")
    x, u = ocp.system.x, ocp.system.u
    other = nocl.System("other", x=x, u=u, xdot=ca.vertcat(x[1], 2 * u - x[0]), lbx=ocp.system.lbx, ubx=ocp.system.ubx,
                        lbu=ocp.system.lbu, ubu=ocp.system.ubu)
    settings = replace(TINY, rounds=0, value=False)
    models = [nocl.identify(s, progress=False) for s in (ocp.system, other)]
    kept = [nocl.train(ocp, m, settings=settings, out=tmp_path, progress=False) for m in models]
    alone = nocl.train(ocp, models[1], settings=settings, progress=False)
    x0 = ocp.initial_states.sample(5, 0)
    assert np.array_equal(kept[1](x0), alone(x0))
    assert not np.array_equal(kept[0](x0), alone(x0))


@pytest.mark.parametrize(("arguments", "message"), [
    ({"dynamics": 3}, "dynamics is a int; expected what nocl.identify returns"), ({"seed": 1.5}, "seed is 1.5"),
    ({"seed": 2**62}, "seed is 4611686018427387904"), ({"seed": -1}, "seed is -1")])
def test_what_train_refuses_before_any_work(arguments, message):
    with pytest.raises(ValueError, match=message):
        nocl.train(nocl.load_ocp("double_integrator"), **arguments)


def test_a_file_is_no_folder_for_checkpoints(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match="expected a folder for checkpoints"):
        nocl.train(nocl.load_ocp("double_integrator"), out=tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_visited_states_are_kept_in_a_box_that_ends_at_zero(pendulum):
    """Far out is measured by the larger bound; where every state is, it is said."""
    from nocl.solvers.cnd.regression.labels import visited

    ocp, _, _, _ = pendulum
    s = ocp.system
    shifted = nocl.System("shifted", x=s.x, u=s.u, xdot=s.xdot, lbu=s.lbu, ubu=s.ubu, lbx=s.lbx, ubx=[6.3, 0.0])
    start = nocl.Gaussian(mean=[3.14, -0.1], std=[0.1, 0.1])
    problem = nocl.OCP(shifted, horizon=1.0, running=ocp.running, terminal=ocp.terminal, x_goal=[0, 0], u_goal=[0],
                       initial_states=start)
    ddp = DDP(problem, intervals=10)
    bank = SolutionBank.of(ddp, ddp.solve(start.sample(4, 0)))
    rng = np.random.default_rng(0)
    policy = FeatureNet(ca.Function("phi", [s.x, ca.SX.sym("t")], []), [],
                        ca.Function("u", [s.x, ca.SX.sym("t")], [ca.SX(0.0)]))
    assert len(visited(ddp, bank, policy, InTorch(problem), 8, 0.1, rng)) == 8

    def far_out(seed):
        """Two states under a torque of 1e9; where a run starts is not far out."""
        try:
            kicked_states(bank, lambda x, _: x[:, :1] + 1e9, InTorch(problem), 2, 0.1, np.random.default_rng(seed))
        except ValueError as error:
            return "drives every state far out of the box" in str(error)
        return False

    assert any(map(far_out, range(20)))
