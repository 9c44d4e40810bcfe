"""Controllers with branches: answers that jump where optima of different kinds are equally good."""

import dataclasses
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.exports.bundle import export
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.regression.features import SHARP, _blended, policy_net
from nocl.solvers.cnd.regression.labels import Labels
from nocl.solvers.cnd.regression.regress import SAME, fit_net, policy_loss


def signs(n: int = 4000, seed: int = 0) -> Labels:
    """u = 2 where x0 > 0.3 x1, else -2, of the double integrator."""
    rng = np.random.default_rng(seed)
    x, t = rng.uniform(-1, 1, (n, 2)), rng.uniform(0, 2, n)
    u = np.where(x[:, :1] > 0.3 * x[:, 1:], 2.0, -2.0) + 0.2 * x[:, 1:]
    return Labels(x, t, np.zeros((n, 0)), u, np.ones(n), np.zeros(n))


def fitted(branches: int) -> tuple[nocl.CND, float]:
    """A controller fitted to such labels, and the share of fresh states where it is off by more than 0.2."""
    ocp, labels = nocl.load_ocp("double_integrator"), signs()
    torch.manual_seed(0)
    net, inverse = policy_net(ocp, labels, (16, 16), branches=branches)
    fit_net(net, policy_loss(ocp, net, inverse, labels), len(labels), iterations=600, batch=256, lr=4e-3, seed=0)
    law, fresh = nocl.CND(ocp, net), signs(2000, 1)
    return law, float((np.abs(law(fresh.x, fresh.t) - fresh.u) > 0.2).mean())


@pytest.fixture(scope="module")
def two() -> tuple[nocl.CND, float]:
    return fitted(2)


def test_two_branches_jump_where_one_blurs(two: tuple[nocl.CND, float]) -> None:
    law, wrong = two
    assert wrong < 0.02
    assert wrong < fitted(1)[1] / 2
    x = np.stack([np.linspace(-0.5, 0.5, 2001), np.zeros(2001)], axis=1)
    u = law(x, 1.0)[:, 0]
    assert np.abs(u[100:] - u[:-100]).max() > 3.5  # within 0.05


def test_a_run_that_stays_where_branches_meet_gets_through() -> None:
    """u = -2 sign(x0) is two constant branches, and a run of v' = u from there stays at v = 0: chattering."""
    ocp = nocl.load_ocp("double_integrator")
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (4000, 2))
    u = -2.0 * np.sign(x[:, 1:])
    labels = Labels(x, rng.uniform(0, 2, 4000), np.zeros((4000, 0)), u, np.ones(4000), np.zeros(4000))
    torch.manual_seed(0)
    net, inverse = policy_net(ocp, labels, (16, 16), branches=2)
    fit_net(net, policy_loss(ocp, net, inverse, labels), len(labels), iterations=300, batch=256, lr=4e-3, seed=0)
    run = nocl.simulate(ocp, nocl.CND(ocp, net), [[0.2, 0.5], [-0.3, -0.4]])
    assert run.reached.all(), run.message
    assert np.abs(run.x[:, -1, 1]).max() < 0.1


def test_the_loss_is_the_likelihood_of_a_mixture() -> None:
    ocp, labels = nocl.load_ocp("double_integrator"), signs(7)
    labels = dataclasses.replace(labels, weight=np.linspace(1, 2, 7))
    torch.manual_seed(1)
    net, inverse = policy_net(ocp, labels, (5,), branches=3)
    net.float()
    loss = policy_loss(ocp, net, inverse, labels)
    phi = net.features(torch.from_numpy(labels.x), torch.from_numpy(labels.t)[:, None])[0].float()
    y = net.nets[0](phi).detach().double().numpy()
    target = np.array(inverse(labels.u.T)[0]).T
    share = np.exp(y[:, 3:]) / np.exp(y[:, 3:]).sum(axis=1, keepdims=True)
    density = (share * np.exp(-((y[:, :3] - target) ** 2) / SAME)).sum(axis=1)
    expected = -SAME * (labels.weight / labels.weight.mean() * np.log(density)).mean()
    assert loss(torch.arange(7)).item() == pytest.approx(expected, rel=1e-5)


def test_torch_casadi_and_c_take_the_same_branch(two: tuple[nocl.CND, float], tmp_path: Path) -> None:
    law, _ = two
    rng = np.random.default_rng(2)
    x, t = rng.uniform(-1, 1, (500, 2)), rng.uniform(0, 2, 500)
    u = law(x, t)
    np.testing.assert_allclose(np.array(law.to_casadi()(x.T, t[None])).T, u, atol=1e-12)
    assert "parity ok" in str(export([law], tmp_path, ["c"], against=["casadi", "c"]))


def test_files_keep_the_branches(two: tuple[nocl.CND, float], tmp_path: Path) -> None:
    law, _ = two
    law.save(tmp_path / "law")
    x = np.random.default_rng(3).uniform(-1, 1, (50, 2))
    np.testing.assert_array_equal(nocl.CND.load(tmp_path / "law")(x, 0.5), law(x, 0.5))


def test_the_branch_with_the_largest_number_is_taken() -> None:
    rng = np.random.default_rng(0)
    y = ca.SX.sym("y", 3 * 2 + 3)
    of = ca.Function("of", [y], [_blended(y, 2, 3, lambda own: own)])
    for values in rng.standard_normal((20, 9)):
        answers, numbers = values[:6].reshape(3, 2), values[6:]
        share = np.exp(numbers / SHARP) / np.exp(numbers / SHARP).sum()
        np.testing.assert_allclose(of(values).full().ravel(), share @ answers, atol=1e-12)
        clear = np.r_[values[:6], 10 * np.eye(3)[numbers.argmax()]]
        np.testing.assert_allclose(of(clear).full().ravel(), answers[numbers.argmax()], atol=1e-12)
    with pytest.raises(ValueError, match="branches is 0"):
        TrainSettings(branches=0)
