"""Implicit steps in torch, and the paper's method on what is stiff."""

from __future__ import annotations

import numpy as np
import pytest
import stiff
import torch
from scipy.integrate import solve_ivp

from nocl import hjb
from nocl.solvers.cnd.paper import PaperSettings, train_paper
from nocl.translate.implicit import RadauStep
from nocl.translate.torch_functions import to_torch

H = 0.025


def problem():
    """(ocp, f, L, a step of it)."""
    ocp = stiff.van_der_pol()
    return ocp, to_torch(ocp.system.f), to_torch(ocp.L_soft), RadauStep(np.array([1.0, 10.0]))


def rows(n: int = 3):
    rng = np.random.default_rng(0)
    return [torch.from_numpy(rng.uniform(low, high, (n, m))).requires_grad_() for low, high, m in (
        (1.5, 2.5, 2), (-20, 20, 1))]


def test_a_step_is_casadis_and_so_are_its_derivatives():
    ocp, f, L, step = problem()
    x, u = rows()
    end, cost = step(f, L, x, u, H)
    in_casadi = ocp.functions.step(soft=True, integrator="radau")
    slopes = in_casadi.jacobian()
    for i in range(3):
        given = x[i].detach().numpy(), u[i].detach().numpy(), H
        said, paid = (one.full().ravel() for one in in_casadi(*given)[:2])
        np.testing.assert_allclose(end[i].detach().numpy(), said, rtol=1e-8)
        np.testing.assert_allclose(cost[i].detach().numpy(), paid, rtol=1e-8)
        blocks = [block.full() for block in slopes(*given, *[0 * one for one in in_casadi(*given)])]
        for k, one in enumerate([end[i, 0], end[i, 1]]):
            own = torch.autograd.grad(one, (x, u), retain_graph=True)
            np.testing.assert_allclose(own[0][i], blocks[0][k], rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(own[1][i], blocks[1][k], rtol=1e-6, atol=1e-9)


def test_under_a_policy_it_is_the_closed_loop_and_its_gradient_that_of_finite_differences():
    _, f, L, step = problem()
    x0, gain = torch.tensor([[2.0, 0.0], [1.6, 0.5]], dtype=torch.float64), torch.tensor([3.0, 0.2], requires_grad=True,
                                                                                      dtype=torch.float64)

    def run(gain, steps=30):
        return hjb.rollout(lambda x, t: -(x * gain).sum(-1, keepdim=True) * (1 + t), f, L, x0, 0.5, steps, step=step,
                           hold=False)

    path = run(gain, 160)
    g = gain.detach().numpy()

    def closed(t, z):
        x, v, _ = z
        u = -(g[0] * x + g[1] * v) * (1 + t)
        return [v, 50 * ((1 - x**2) * v - x) + u, x**2 + 0.01 * u**2]

    for i in range(2):
        true = solve_ivp(closed, (0, 0.5), [*x0[i].numpy(), 0.0], method="Radau", rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(path.x[i, -1].detach().numpy(), true[:2], rtol=1e-4)
        assert float(path.running[i].detach()) == pytest.approx(true[2], rel=1e-4)
    path = run(gain)
    slope, = torch.autograd.grad(path.running.sum() + path.x[:, -1].sum(), gain)
    for k in range(2):
        ends = [run(gain.detach() + s * 1e-5 * torch.eye(2, dtype=torch.float64)[k]) for s in (1, -1)]
        more, less = (float(path.running.sum() + path.x[:, -1].sum()) for path in ends)
        assert float(slope[k]) == pytest.approx((more - less) / 2e-5, rel=1e-5)


def test_a_constant_cost_and_more_batch_dimensions():
    _, f, _, step = problem()
    x, u = rows(4)
    end, cost = step(f, lambda x, u: 1 + 0 * u, x, u, H)
    np.testing.assert_allclose(cost.detach(), H, rtol=1e-12)
    folded, _ = step(f, lambda x, u: 1 + 0 * u, x.reshape(2, 2, 2), u.reshape(2, 2, 1), H)
    torch.testing.assert_close(folded.reshape(4, 2), end)


def test_what_does_not_converge_is_nan():
    step = RadauStep(np.ones(1))
    end, _ = step(lambda x, u: x**2, lambda x, u: 0 * u, torch.tensor([[1.0], [100.0]]), torch.zeros(2, 1), 0.1)
    assert torch.isfinite(end[0]).all()  # 1 / (1 - t)
    assert float(end[0]) == pytest.approx(1 / 0.9, rel=1e-4)
    assert torch.isnan(end[1]).all()  # infinite at t = 0.01


def test_a_stiff_problem_is_trained_on_implicit_steps():
    ocp = stiff.linear()
    settings = {"iterations": 60, "race": 2, "race_iterations": 15, "intervals": 20, "batch": 16, "hidden": (16,),
                "value_hidden": (16,)}
    with pytest.warns(UserWarning, match=r"fastest mode 0\.0001 s, step 0\.1 s: implicit Radau, 3 stages"):
        *_, card = train_paper(ocp, None, PaperSettings(**settings), progress=False)
    costs = card["history"]["cost"]
    assert card["step"] == "radau"
    assert np.isfinite(costs).all()
    assert card["held_out_cost"] < 0.7 * max(card["race"])
    assert card["dynamics_evaluations"] > 1000
    with pytest.raises(ValueError, match="diverged"):
        train_paper(ocp, None, PaperSettings(**settings, step="rk4"), progress=False)
