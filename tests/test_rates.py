"""u(x, t, dt): held controls against the sampled Riccati solution; one network, any rate; a CND like any other."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lq import rk4_lq

import nocl
from nocl.judge import simulate
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.regression.features import at_rate, policy_net
from nocl.solvers.cnd.regression.labels import LONGEST, Labels, at_other_rates, tube
from nocl.solvers.ddp.bank import SolutionBank
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP

SETTINGS = TrainSettings(intervals=40, seeds=4, starts=2, states=60, tails=400, visits=200, rounds=0, iterations=1000,
                         batch=512, hidden=(24, 24), held_out=16, gap_median=1e-9, control_dt=True, value=False)
HELD = 0.05  # s, the horizon of 2 s over 40


@pytest.fixture(scope="module")
def cnd():
    return nocl.train(nocl.load_ocp("double_integrator"), settings=SETTINGS, seed=0, progress=False)


def test_held_controls_are_the_sampled_riccati_feedback(cnd):
    F, G, K, _ = rk4_lq(HELD, 40)
    x0 = cnd.ocp.initial_states.sample(20, 99)
    x, wanted, told, continuous = x0, [], [], []  # continuous: the law of held controls too short to tell
    held = cnd.at_rate(HELD)
    for k, gain in enumerate(K):
        u = -x @ gain.T
        wanted.append(u)
        told.append(held(x, k * HELD))
        continuous.append(-x @ rk4_lq(HELD / 50, 50 * (40 - k))[2][0].T)
        x = x @ F.T + u @ G.T

    def error(laws):
        return np.sqrt(np.mean((np.array(laws) - wanted) ** 2)) / np.std(wanted)

    assert error(told) < error(continuous)  # nearer than what is optimal in continuous time


def test_each_rate_does_best_at_its_own(cnd):
    """What a law loses to the optimum at its own rate is a tenth to a fifth of what the other law loses there."""
    x0 = cnd.ocp.initial_states.sample(20, 99)
    held = cnd.at_rate(HELD)
    assert simulate(cnd.ocp, held, x0, hold=40).cost.mean() < simulate(cnd.ocp, cnd, x0, hold=40).cost.mean()
    assert simulate(cnd.ocp, cnd, x0).cost.mean() < simulate(cnd.ocp, held, x0).cost.mean()


def test_a_rate_is_a_controller_like_any_other(cnd, tmp_path):
    x, t = cnd.ocp.initial_states.sample(5, 3), 0.7
    cnd.save(tmp_path / "all")
    again = nocl.CND.load(tmp_path / "all")
    assert np.array_equal(again(x, t), cnd(x, t))
    assert np.array_equal(cnd.at_rate(0)(x, t), cnd(x, t))
    held = again.at_rate(HELD)
    assert np.array_equal(held(x, t), cnd.at_rate(HELD)(x, t))
    assert not np.array_equal(held(x, t), cnd(x, t))
    u = held.to_casadi()(x.T, t).full().T
    assert u == pytest.approx(held(x, t), rel=1e-12, abs=1e-12)
    held.save(tmp_path / "held")
    one = nocl.CND.load(tmp_path / "held")
    assert np.array_equal(one(x, t), held(x, t))
    assert one.card["dt"] == HELD
    assert {"held_median", "held_p95"} <= set(cnd.card["history"][-1])


@pytest.mark.parametrize("dt", [-0.01, 0.06, np.nan, "0.05"])
def test_rates_beyond_the_trained_ones_are_refused(cnd, dt):
    with pytest.raises(ValueError, match=r"expected a number in \[0, 0\.05\], the horizon over 40"):
        cnd.at_rate(dt)


def test_without_control_dt_there_is_one_rate(cnd):
    with pytest.raises(ValueError, match=r"train with TrainSettings\(control_dt=True\)"):
        cnd.at_rate(HELD).at_rate(HELD)
    with pytest.raises(ValueError, match="control_dt is 1; expected True or False"):
        replace(SETTINGS, control_dt=1)


def test_labels_of_other_rates_are_optimal_held_controls():
    ocp = nocl.load_ocp("double_integrator")
    ddp, rng = DDP(ocp, intervals=40), np.random.default_rng(0)
    bank = SolutionBank.of(ddp, solve_globally(ddp, ocp.initial_states.sample(6, rng), starts=2))
    labels = at_other_rates(ddp, tube(ddp, bank, 60, 0.2, rng), 1.0, rng)
    assert labels.dt.max() <= ocp.horizon / LONGEST * (1 + 1e-6)
    assert len(np.unique(labels.dt.round(9))) > 30
    assert np.isfinite(labels.weight).all()
    for i in range(0, len(labels), len(labels) // 20):
        left = ocp.horizon - labels.t[i]
        n = round(left / labels.dt[i])
        gain = rk4_lq(left / n, n)[2][0]
        assert labels.u[i] == pytest.approx(-gain @ labels.x[i], rel=1e-6, abs=1e-7)


def test_the_same_layers_at_every_rate():
    ocp, rng = nocl.load_ocp("pendulum"), np.random.default_rng(0)
    x, t = rng.standard_normal((50, 2)), rng.uniform(0, 3, 50)
    labels = Labels(x, t, np.zeros((50, 0)), rng.standard_normal((50, 1)), np.ones(50), rng.uniform(0, 0.1, 50))
    net, _ = policy_net(ocp, labels, (8,), control_dt=True)
    X, T = torch.from_numpy(x).float(), torch.from_numpy(t).float()[:, None]
    for dt in (0.0, 0.03):
        torch.testing.assert_close(at_rate(net, dt)(X, T), net(X, T, torch.full_like(T, dt)))
