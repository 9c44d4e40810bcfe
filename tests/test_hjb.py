"""The HJB equation in torch, against the Riccati solution, numbers computed by hand, and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lq import A, B, lq_value
from scipy.integrate import solve_ivp

from nocl import hjb
from nocl.nets import MLP
from nocl.systems import cartpole, double_integrator
from nocl.translate.rk4 import rk4_cost
from nocl.translate.torch_functions import to_torch

T = 2.0
R = 0.01


def tensor(x):
    return torch.as_tensor(x, dtype=torch.float64)


def numbers(terms):
    return [term.item() for term in terms.terms()]


@pytest.fixture(scope="module")
def lq():
    """(f, L, G, riccati P(t), dP/dt of P): the double integrator's problem, V = x' P(t) x."""
    ocp = double_integrator.ocp(horizon=T, R=R)

    def P_dot(P):
        return P @ B @ B.T @ P / R - A.T @ P - P @ A

    return *map(to_torch, (ocp.system.f, ocp.L, ocp.G)), (lambda t: lq_value([t], T=T, R=R)[0][0]), P_dot


class RiccatiValue(torch.autograd.Function):
    """p(t) = vec P(t), with dP/dt from the Riccati equation itself."""

    @staticmethod
    def forward(ctx, t, P, P_dot):
        P_t = np.stack([P(float(s)) for s in t[:, 0]])
        ctx.save_for_backward(tensor(np.stack([P_dot(p) for p in P_t])))
        return tensor(P_t)

    @staticmethod
    def backward(ctx, g):
        return (g * ctx.saved_tensors[0]).sum((1, 2))[:, None], None, None


def riccati_value(P, P_dot):
    return lambda x, t: torch.einsum("ni,nij,nj->n", x, RiccatiValue.apply(t, P, P_dot), x)[:, None]


def riccati_policy(P):
    return lambda x, t: torch.stack([-(tensor(B.T @ P(float(s))) @ z) / R for z, s in zip(x, t, strict=True)])


def samples(n=40, nx=2, seed=0):
    rng = np.random.default_rng(seed)
    return tensor(rng.uniform(-2, 2, (n, nx))), tensor(rng.uniform(0, T, (n, 1)))


def test_residuals_vanish_on_the_riccati_solution(lq):
    f, L, G, P, P_dot = lq
    x, t = samples()
    V, u = riccati_value(P, P_dot), riccati_policy(P)(x, t)
    scale = float(V(x, t).max())
    assert scale > 0.1
    assert hjb.hjb_residual(V, f, L, x, u, t).abs().max() < 1e-10
    assert hjb.hamiltonian_gradient(V, f, L, x, u, t).abs().max() < 1e-12
    assert hjb.terminal_residual(V, G, x, T).abs().max() < 1e-12
    assert hjb.hjb_residual(V, f, L, x, u + 0.3, t).min() > 8e-4  # L + V_x'f grows by R 0.3^2 = 9e-4 off the optimum


@pytest.mark.slow
def test_losses_vanish_and_the_cost_is_the_value_on_the_riccati_solution(lq):
    f, L, G, P, P_dot = lq
    x, _ = samples(8)
    policy, V = riccati_policy(P), riccati_value(P, P_dot)
    terms = hjb.losses(policy, V, f, L, G, x, T, 400)
    J = float(V(x, torch.zeros(8, 1, dtype=torch.float64)).mean())
    assert terms.cost.item() == pytest.approx(J, rel=1e-3)  # above it by what the hold costs, O(h^2)
    assert terms.cost.item() > J
    assert terms.hjb.item() < 1e-10
    assert terms.hamil.item() < 1e-12
    assert terms.final.item() < 1e-12


def any_value(x, t):
    """V = x1^2 x2 + t^2 x2: V_x = (2 x1 x2, x1^2 + t^2), V_t = 2 t x2."""
    return x[:, :1] ** 2 * x[:, 1:] + t**2 * x[:, 1:]


def any_f(x, u):
    return torch.cat([x[:, 1:] * u, torch.sin(x[:, :1]) + u[:, :1] ** 2], 1)


def any_L(x, u):
    return 0.5 * u**2 + x[:, :1]


def any_G(x):
    return 2 * x[:, :1] + x[:, 1:] ** 2


def by_hand(x1, x2, u, t):
    """(residual, dH/du) of the functions above, written out."""
    V_x1, V_x2, V_t = 2 * x1 * x2, x1**2 + t**2, 2 * t * x2
    H = 0.5 * u**2 + x1 + V_x1 * x2 * u + V_x2 * (np.sin(x1) + u**2)
    return V_t + H, u + V_x1 * x2 + V_x2 * 2 * u


def test_each_residual_is_what_it_is_by_hand_far_from_any_optimum():
    x, t = samples(seed=3)
    u = tensor(np.random.default_rng(4).uniform(-1, 1, (len(x), 1)))
    residual, gradient = by_hand(x[:, 0].numpy(), x[:, 1].numpy(), u[:, 0].numpy(), t[:, 0].numpy())
    np.testing.assert_allclose(hjb.hjb_residual(any_value, any_f, any_L, x, u, t).detach()[:, 0], residual, atol=1e-13)
    np.testing.assert_allclose(hjb.hamiltonian_gradient(any_value, any_f, any_L, x, u, t).detach()[:, 0], gradient,
                               atol=1e-13)
    np.testing.assert_allclose(hjb.terminal_residual(any_value, any_G, x, 1.5)[:, 0],
                               (any_value(x, torch.full_like(t, 1.5)) - any_G(x))[:, 0], atol=1e-14)
    assert not x.requires_grad
    assert not t.requires_grad


def any_policy(x, t):
    return torch.tanh(x[:, :1] - x[:, 1:] + t)


def numpy_rollout(x0, K, t0=0.0):
    """Nodes, held controls and cost by RK4, written anew in numpy: one trajectory."""
    def rhs(z, u):
        return np.array([z[1] * u, np.sin(z[0]) + u**2, 0.5 * u**2 + z[0]])

    h, z, xs, us = (T - t0) / K, np.r_[x0, 0.0], [x0], []
    for k in range(K):
        u = np.tanh(z[0] - z[1] + t0 + k * h)
        k1 = rhs(z, u)
        k2 = rhs(z + h / 2 * k1, u)
        k3 = rhs(z + h / 2 * k2, u)
        k4 = rhs(z + h * k3, u)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        xs.append(z[:2])
        us.append(u)
    return np.array(xs), np.array(us), z[2] + 2 * z[0] + z[1] ** 2


@pytest.mark.parametrize("detach", [False, True])
@pytest.mark.parametrize("t0", [0.0, 0.7])
def test_each_loss_is_what_it_is_by_hand_on_trajectories(detach, t0):
    x0, K = tensor(np.random.default_rng(5).uniform(-0.8, 0.8, (6, 2))), 12
    got = hjb.losses(any_policy, any_value, any_f, any_L, any_G, x0, T, K, t0=t0, detach=detach)
    runs = [numpy_rollout(x, K, t0) for x in x0.numpy()]
    t = t0 + (T - t0) / K * np.arange(K)
    hand = [by_hand(x[:-1, 0], x[:-1, 1], u, t) for x, u, _ in runs]
    off = np.array([x[-1, 0]**2 * x[-1, 1] + T**2 * x[-1, 1] - 2 * x[-1, 0] - x[-1, 1]**2 for x, _, _ in runs])
    for signed in (np.array([r for r, _ in hand]), np.array([g for _, g in hand]), off):
        assert signed.min() < 0 < signed.max()  # so that a loss without absolute values is another
    wanted = (np.mean([J for _, _, J in runs]), np.mean([abs(r) for r, _ in hand]), np.mean(abs(off)),
              np.mean([abs(g) for _, g in hand]))
    np.testing.assert_allclose(numbers(got), wanted, rtol=1e-5)  # hamil is smoothed by 1e-6
    np.testing.assert_allclose(numbers(got)[:3], wanted[:3], rtol=1e-12)
    assert got.total().item() == pytest.approx(wanted[0] + wanted[1] + 0.01 * wanted[2] + 0.01 * wanted[3], rel=1e-6)
    assert float(got.total((0.0, 0.0, 2.0, 0.0))) == pytest.approx(2 * wanted[2])


def test_the_rollout_integrates_to_the_order_of_its_step():
    f, L = (to_torch(g) for g in (cartpole.ocp().system.f, cartpole.ocp().L))
    x0, policy = tensor([[0.1, 0.0, 2.0, 0.3]]), lambda x, t: 0.0 * t + 0.7
    fine = hjb.rollout(policy, f, L, x0, 1.0, 400).x[:, -1]
    errors = {(step, K): float((hjb.rollout(policy, f, L, x0, 1.0, K, step=step).x[:, -1] - fine).norm())
              for step in (rk4_cost, hjb.euler_cost) for K in (20, 40)}
    assert errors[rk4_cost, 20] / errors[rk4_cost, 40] == pytest.approx(16, rel=0.2)
    assert errors[hjb.euler_cost, 20] / errors[hjb.euler_cost, 40] == pytest.approx(2, rel=0.1)


def test_feedback_inside_the_ode_is_the_continuous_closed_loop():
    def closed_loop(t, z):
        u = np.tanh(z[0] - z[1] + t)
        return [z[1] * u, np.sin(z[0]) + u**2, 0.5 * u**2 + z[0]]

    x0 = np.array([[0.3, -0.4], [-0.2, 0.1]])
    exact = np.stack([solve_ivp(closed_loop, (0.5, T), [*x, 0.0], rtol=1e-12, atol=1e-13).y[:, -1] for x in x0])
    errors = []
    for K in (20, 40):
        path = hjb.rollout(any_policy, any_f, any_L, tensor(x0), T, K, t0=0.5, hold=False)
        errors.append(np.abs(torch.cat([path.x[:, -1], path.running], 1).numpy() - exact).max())
        np.testing.assert_allclose(path.u[:, 0], any_policy(tensor(x0), 0.5))
        np.testing.assert_allclose(path.u[:, -1], any_policy(path.x[:, -2], float(path.t[-2])))
    assert errors[1] < 1e-6
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)


def networks(dtype=torch.float64, nx=4):
    torch.manual_seed(0)
    u, V = MLP((nx + 1, 8, 8, 1)).to(dtype), MLP((nx + 1, 8, 8, 1), skip=True).to(dtype)
    return u, V, (lambda x, t: 3 * torch.tanh(u(torch.cat([x, t], 1)))), (lambda x, t: V(torch.cat([x, t], 1)))


@pytest.mark.parametrize(("detach", "hold"), [(False, True), (True, True), (False, False)])
@pytest.mark.parametrize("which", ["cost", "hjb", "final", "hamil"])
def test_gradients_of_the_losses_are_finite_differences(which, detach, hold):
    ocp = cartpole.ocp()
    f, L, G = map(to_torch, (ocp.system.f, ocp.L, ocp.G))
    u, V, policy, value = networks()
    x0 = tensor(ocp.initial_states.sample(3, 0))
    frozen = hjb.rollout(policy, f, L, x0, 1.0, 10)
    frozen = hjb.Rollout(*(z.detach() for z in (frozen.t, frozen.x, frozen.u, frozen.running)))

    def loss():
        if detach and which != "cost":  # the states held at where they are
            return getattr(hjb.path_losses(frozen, policy, value, f, L, G, detach=True), which)
        return getattr(hjb.losses(policy, value, f, L, G, x0, 1.0, 10, detach=detach, hold=hold), which)

    parameters = [*u.parameters(), *V.parameters()]
    terms = hjb.losses(policy, value, f, L, G, x0, 1.0, 10, detach=detach, hold=hold)
    gradients = torch.autograd.grad(getattr(terms, which), parameters, materialize_grads=True)
    rng, h = np.random.default_rng(1), 1e-6
    for _ in range(3):
        direction = [tensor(rng.standard_normal(tuple(p.shape))) for p in parameters]
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                for p, d in zip(parameters, direction, strict=True):
                    p += sign * h * d
            values.append(loss().item())
            with torch.no_grad():
                for p, d in zip(parameters, direction, strict=True):
                    p -= sign * h * d
        slope = sum((g * d).sum().item() for g, d in zip(gradients, direction, strict=True))
        assert slope == pytest.approx((values[0] - values[1]) / (2 * h), rel=1e-5, abs=1e-7)


def test_detached_terms_leave_the_course_alone():
    ocp = cartpole.ocp()
    f, L, G = map(to_torch, (ocp.system.f, ocp.L, ocp.G))
    u, _, policy, value = networks()
    x0 = tensor(ocp.initial_states.sample(3, 0))
    terms = hjb.losses(policy, value, f, L, G, x0, 1.0, 10, detach=True)
    assert torch.autograd.grad(terms.final, list(u.parameters()), allow_unused=True)[0] is None
    terms = hjb.losses(policy, value, f, L, G, x0, 1.0, 10)
    assert float(torch.autograd.grad(terms.final, list(u.parameters()))[0].norm()) > 0


def test_the_norm_has_a_gradient_at_zero_and_is_a_norm_elsewhere():
    g = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.equal(torch.autograd.grad(hjb.smooth_norm(g).sum(), g)[0], torch.zeros_like(g))
    assert float(hjb.smooth_norm(tensor([[3.0, 4.0]]))) == pytest.approx(5.0, abs=2e-6)


def test_float32_agrees_with_float64():
    ocp = cartpole.ocp()
    f, L, G = map(to_torch, (ocp.system.f, ocp.L, ocp.G))
    x0, terms = ocp.initial_states.sample(4, 0), []
    for dtype in (torch.float32, torch.float64):
        _, _, policy, value = networks(dtype)
        terms.append(hjb.losses(policy, value, f, L, G, torch.as_tensor(x0, dtype=dtype), 1.0, 10))
        assert all(term.dtype == dtype for term in terms[-1].terms())
    np.testing.assert_allclose(numbers(terms[0]), numbers(terms[1]), rtol=1e-4)
