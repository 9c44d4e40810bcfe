"""Batched DDP: Riccati's answer on LQ problems, elsewhere finite differences, NMPC's optimum; failures one by one."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
import torch
from lq import riccati

import nocl
from nocl.data import Solution
from nocl.nets import MLP, FeatureNet
from nocl.solvers import NMPC
from nocl.solvers.ddp.solver import DDP, DDPSettings, Work
from nocl.sysid.identification import LearnedDynamics
from nocl.translate.rk4 import rk4_cost

BUNDLED = ("cartpole", "acrobot", "quadrotor", "dubins", "pendulum", "van_der_pol")
problem = lru_cache(nocl.load_ocp)


@lru_cache
def solver(name: str, K: int = 80) -> DDP:
    return DDP(problem(name), intervals=K, threads=1, constraints="soft")


@lru_cache
def solved(name: str, n: int = 4) -> Solution:
    """n problems from t0 between 0 and half the horizon, with V_xx."""
    ocp = problem(name)
    t0 = np.linspace(0, ocp.horizon / 2, n)
    solution = solver(name).solve(ocp.initial_states.sample(n, 3), t0, curvature=True)
    assert solution.success.all()
    return solution


def again(name: str, s: Solution, x0: np.ndarray, curvature: bool = False) -> Solution:
    """The problems of s from other states, started from s."""
    repeat = len(x0) // len(s)
    u, x, gain, t0 = (np.repeat(a, repeat, axis=0) for a in (s.u, s.x, s.gain, s.t[:, 0]))
    solution = solver(name).solve(x0, t0, u=u, x=x, gain=gain, curvature=curvature)
    assert solution.success.all()
    return solution


def scalar_problem(xdot, running, *, x=None, u=None, lbx=-1.0, ubx=1.0, u_max=1.0, terminal=None, horizon=1.0):
    """An OCP with one state and one control, about x = u = 0."""
    x0 = (lbx + ubx) / 2
    system = nocl.System("scalar", x=x, u=u, xdot=xdot, lbu=[-u_max], ubu=[u_max], lbx=[lbx], ubx=[ubx])
    return nocl.OCP(system, horizon=horizon, running=running, terminal=x**2 if terminal is None else terminal,
                    x_goal=[x0], u_goal=[0.0], initial_states=nocl.Uniform(lb=[x0], ub=[x0 + 1e-3]))


# Linear-quadratic problems


@pytest.mark.parametrize("t0", [0.0, 0.3, 1.9])
def test_linear_quadratic_problem_is_riccatis(t0):
    A, B = np.array([[0, 1], [0, 0.0]]), np.array([[0.0], [1.0]])
    S, gains, F, G = riccati(A, B, 0.01 * np.eye(1), np.eye(2), 2.0 - t0, 80)
    x0 = np.array([[1.0, 0.2], [-0.5, 0.1], [0.0, 0.0]]) * min(1.0, 2 - t0)
    s = solver("double_integrator").solve(x0, t0, curvature=True)
    assert s.success.all()
    x = x0
    for k in range(80):
        assert np.abs(s.u[:, k] - x @ gains[k].T).max() < 1e-9
        assert np.abs(s.V[:, k] - np.einsum("bi,ij,bj->b", x, S[k], x)).max() < 1e-9
        assert np.abs(s.V_x[:, k] - 2 * x @ S[k]).max() < 1e-9
        x = x @ F.T + x @ gains[k].T @ G.T
        assert np.abs(s.x[:, k + 1] - x).max() < 1e-9
    assert np.abs(s.V_xx - 2 * S).max() < 1e-9
    assert np.abs(s.gain - gains).max() < 1e-9
    assert np.abs(s.cost - s.V[:, 0]).max() < 1e-12
    assert np.abs(s.t[:, 0] - t0).max() == 0
    assert np.abs(s.t[:, -1] - 2.0).max() < 1e-14


def test_one_state_one_control_and_one_interval():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    ocp = scalar_problem(0.5 * x + u, 0.1 * u**2, x=x, u=u, u_max=10.0)
    for K in (1, 7):
        S, gains, *_ = riccati(np.array([[0.5]]), np.eye(1), 0.1 * np.eye(1), np.eye(1), 1.0, K)
        s = DDP(ocp, intervals=K).solve([0.7], curvature=True)
        assert s.u.shape == (1, K, 1)
        assert np.abs(s.gain[0] - gains).max() < 1e-9
        assert abs(s.cost[0] - 0.49 * S[0, 0, 0]) < 1e-9
        assert np.abs(s.V_xx[0] - 2 * S).max() < 1e-9


@pytest.mark.slow
def test_ten_thousand_intervals():
    S, *_ = riccati(np.array([[0, 1], [0, 0.0]]), np.array([[0.0], [1.0]]), 0.01 * np.eye(1), np.eye(2), 2.0, 10_000)
    s = solver("double_integrator", 10_000).solve([1.0, 0.0])
    assert s.success.all()
    assert abs(s.cost[0] - S[0, 0, 0]) < 1e-9


# Derivatives and optima


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "quadrotor", "dubins"])
def test_costate_is_the_slope_of_the_optimal_cost(name):
    s, e = solved(name), 1e-4
    moved = (s.x[:, :1] + e * np.vstack([np.eye(s.x.shape[2]), -np.eye(s.x.shape[2])])).reshape(-1, s.x.shape[2])
    cost = again(name, s, moved).cost.reshape(len(s), 2, -1)
    slope = (cost[:, 0] - cost[:, 1]) / (2 * e)
    assert np.abs(slope - s.V_x[:, 0]).max() < 1e-6 * (1 + np.abs(slope).max())


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])  # no bound is active there
def test_curvature_is_the_slope_of_the_costate_and_gains_that_of_controls(name):
    s, e = solved(name), 1e-4
    n = s.x.shape[2]
    r = again(name, s, (s.x[:, :1] + e * np.vstack([np.eye(n), -np.eye(n)])).reshape(-1, n))
    V_x, u = (a.reshape(len(s), 2, n, -1) for a in (r.V_x[:, 0], r.u[:, 0]))
    V_xx = (V_x[:, 0] - V_x[:, 1]) / (2 * e)
    gain = ((u[:, 0] - u[:, 1]) / (2 * e)).transpose(0, 2, 1)
    assert np.abs(V_xx - s.V_xx[:, 0]).max() < 1e-6 * np.abs(V_xx).max()
    assert np.abs(gain - s.gain[:, 0]).max() < 1e-4 * np.abs(gain).max()
    assert np.array_equal(s.V_xx, s.V_xx.transpose(0, 1, 3, 2))


@pytest.mark.parametrize("name", BUNDLED)
def test_optimum_is_nmpcs(name):
    s, ocp = solved(name), problem(name)
    nmpc = NMPC(ocp, constraints="soft")
    for i in (0, 2):
        guess = s.u[i] + 1e-3 * np.random.default_rng(i).standard_normal(s.u[i].shape)
        other = nmpc.solve(s.x[i, 0], guess[None], t0=s.t[i, 0])
        assert other.success[0]
        ours = s[i:i + 1]
        if name == "dubins":  # from the same guess they may pass the obstacle on different sides
            ours = solver(name).solve(s.x[i, 0], s.t[i, 0], u=other.u)
        assert abs(other.cost[0] - ours.cost[0]) < 1e-6 * abs(ours.cost[0])
        assert np.abs(other.costate[0, 0] - ours.V_x[0, 0]).max() < 1e-4 * (1e-2 + np.abs(ours.V_x[0, 0]).max())


def gradient(ocp, K):
    """(x0, U, h) -> d cost / dU by CasADi's adjoint of the rollout."""
    x, u, h = ca.SX.sym("x", ocp.system.nx), ca.SX.sym("u", ocp.system.nu), ca.SX.sym("h")
    step = ca.Function("step", [x, u, h], list(rk4_cost(ocp.system.f, ocp.L_soft, x, u, h)))
    x0, U, H = ca.MX.sym("x0", ocp.system.nx), ca.MX.sym("U", ocp.system.nu, K), ca.MX.sym("h")
    cost, state = ca.MX(0), x0
    for k in range(K):
        state, c = step(state, U[:, k], H)
        cost += c
    cost += ocp.G(state)
    return ca.Function("gradient", [x0, U, H], [ca.gradient(cost, U)])


def assert_kkt(ocp, s: Solution, tolerance: float) -> np.ndarray:
    """Stationary inside the box, pushed outwards at its bounds; returns the share of controls at bounds."""
    lb, ub = np.asarray(ocp.system.lbu), np.asarray(ocp.system.ubu)
    slope = gradient(ocp, s.u.shape[1])
    share = []
    for i in range(len(s)):
        g = slope(s.x[i, 0], s.u[i].T, s.t[i, 1] - s.t[i, 0]).full().T
        assert (s.u[i] >= lb).all()
        assert (s.u[i] <= ub).all()
        low, high = s.u[i] == lb, s.u[i] == ub
        assert np.abs(g[~low & ~high]).max(initial=0) < tolerance
        assert g[low].min(initial=0) > -tolerance
        assert g[high].max(initial=0) < tolerance
        assert np.abs(s.gain[i][low & (g > tolerance)]).max(initial=0) == 0
        share.append((low | high).mean())
    return np.array(share)


def test_saturated_controls_satisfy_kkt():
    assert (assert_kkt(problem("acrobot"), solved("acrobot"), 1e-6) > 0.02).any()
    assert_kkt(problem("dubins"), solved("dubins"), 1e-6)


def test_strongly_coupled_controls_at_their_bounds():
    # clipping a Newton step coordinate by coordinate would leave the valley of this cost and go uphill
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 3)
    system = nocl.System("coupled", x=ca.vertcat(*ca.vertsplit(x)), u=ca.vertcat(*ca.vertsplit(u)), xdot=u,
                         lbu=[-0.1, -5.0, -2.0], ubu=[0.1, 5.0, 2.0], lbx=[-9.0] * 3, ubx=[9.0] * 3)
    W = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]
    R = W @ np.diag([1.0, 1e-3, 1e-4]) @ W.T
    ocp = nocl.OCP.quadratic(system, horizon=1.0, R=(R + R.T) / 2, x_goal=[0.0] * 3, u_goal=[0.0] * 3,
                             initial_states=nocl.Uniform(lb=[-6.0] * 3, ub=[6.0] * 3))
    s = DDP(ocp, intervals=10, threads=1).solve(ocp.initial_states.sample(40, 0))
    assert s.success.all()
    share = assert_kkt(ocp, s, 1e-6)
    assert (share > 0).mean() > 0.9
    assert (share < 1).mean() > 0.5


def test_bang_bang_is_saturated_throughout():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    s = DDP(scalar_problem(u, 1e-6 * u**2, x=x, u=u, terminal=-x), intervals=9).solve([[0.0], [0.3]])
    assert s.success.all()
    assert (s.u == 1).all()


# Failures and input


def test_each_problem_fails_on_its_own_and_says_so():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    finite_escape = scalar_problem(x**3 + u, 0.1 * u**2, x=x, u=u, horizon=2.0)
    solve = DDP(finite_escape, intervals=40, threads=1).solve
    good = np.linspace(-0.3, 0.3, 13)[:, None]
    mixed = np.insert(good, [2, 5, 13], [[9.0], [-40.0], [1e140]], axis=0)
    bad = [2, 6, 15]
    s, alone = solve(mixed, curvature=True), solve(good, curvature=True)
    others = np.setdiff1d(np.arange(16), bad)
    assert not s.success[bad].any()
    assert np.isinf(s.cost[bad]).all()
    assert all("blows up" in m for m in s.message[bad])
    assert alone.success.all()
    for field in ("x", "u", "gain", "V", "V_x", "V_xx", "cost", "success", "message", "iterations", "t"):
        assert np.array_equal(getattr(s, field)[others], getattr(alone, field)), field


def test_nan_inside_the_box_is_one_problems_own():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    ocp = scalar_problem(-ca.sqrt(x) + u, 0.1 * u**2, x=x, u=u, lbx=0.5, ubx=1.5, terminal=(x - 1)**2)
    s = DDP(ocp, intervals=20).solve([[1.0], [0.01], [-1.0], [1.2]])
    assert s.success.tolist() == [True, False, False, True]
    assert all("not finite" in m for m in s.message[1:3])


def test_problems_that_run_out_of_iterations_say_so():
    ocp = problem("cartpole")
    x0 = np.vstack([[0.0, 0.0, 0.0, 0.0], ocp.initial_states.sample(3, 0)])
    s = DDP(ocp, threads=1, settings=DDPSettings(max_iterations=3)).solve(x0)
    assert s.success.tolist() == [True, False, False, False]
    assert (s.message[1:] == "stopped at max_iterations").all()
    assert s.iterations[1:].tolist() == [3] * 3
    assert np.isinf(s.cost[1:]).all()


def test_a_saddle_is_not_called_an_optimum():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    ocp = scalar_problem(u, ca.SX(0.01) * u**2, x=x, u=u, terminal=ca.cos(x), horizon=1.0)  # u = 0 at x = 0: the top
    s = DDP(ocp, intervals=10).solve([[0.0], [0.1]])
    assert s.success.tolist() == [False, True]
    assert "no minimum" in s.message[0]
    assert s.iterations[0] < 50
    useless = scalar_problem(-x, x**2, x=x, u=u)  # a control without any effect
    found = DDP(useless, intervals=5).solve([0.5])  # any control is optimal
    assert found.success[0]
    assert found.cost[0] == pytest.approx(nocl.simulate(useless, np.zeros((1, 5, 1)), [0.5]).cost[0], rel=1e-3)


def test_cost_units_do_not_change_the_answer():
    ocp = problem("pendulum")
    x0 = ocp.initial_states.sample(4, 0)
    reference = solver("pendulum").solve(x0)
    for scale in (1e-6, 1e6):
        scaled = replace(ocp, running=scale * ocp.running, terminal=scale * ocp.terminal)
        s = DDP(scaled, threads=1).solve(x0)
        assert s.success.all()
        assert np.abs(s.cost / scale - reference.cost).max() < 1e-6


def test_wrong_input_is_refused_before_any_work():
    solve = solver("pendulum").solve
    ocp = problem("pendulum")
    for x0, t0, text in [([1.0, 2.0, 3.0], 0.0, r"x0 has shape \(3,\)"), ([[np.nan, 0.0]], 0.0, "finite numbers"),
                         ([1.0, 0.0], 3.0, r"t0\[0\] is 3.0; expected 0 <= t0 < horizon"), ([1.0, 0.0], -0.1, "t0"),
                         ([1.0, 0.0], np.nan, "t0"), ([1.0, 0.0], [0.0, 1.0], r"t0 has shape \(2,\)")]:
        with pytest.raises(ValueError, match=text):
            solve(x0, t0)
    for guess in ({"u": np.zeros((1, 79, 1))}, {"x": np.zeros((1, 80, 2))}, {"gain": np.zeros((80, 1, 2))}):
        with pytest.raises(ValueError, match=f"the guess {next(iter(guess))} has shape"):
            solve([1.0, 0.0], **guess)
    for options in ({"intervals": 0}, {"intervals": 2.5}, {"intervals": True}, {"threads": 0}):
        with pytest.raises(ValueError, match="expected an integer >= 1"):
            DDP(ocp, **options)
    with pytest.raises(ValueError, match="dynamics is a int"):
        DDP(ocp, dynamics=3)
    with pytest.raises(ValueError, match="dynamics was learned for"):
        DDP(ocp, dynamics=random_model("cartpole"))
    for settings in ({"max_iterations": 0}, {"tolerance": -1.0}, {"damping": np.nan}, {"smallest_step": 2.0}):
        with pytest.raises(ValueError, match="DDPSettings"):
            DDPSettings(**settings)


def test_any_memory_layout_and_no_problem_at_all():
    solve, x0 = solver("pendulum").solve, problem("pendulum").initial_states.sample(6, 0)
    kept = x0.copy()
    assert np.array_equal(solve(x0[::2]).cost, solve(np.asfortranarray(x0)).cost[::2])
    assert np.array_equal(x0, kept)
    assert len(solve(np.zeros((0, 2)))) == 0


def test_batches_and_threads_do_not_change_a_bit():
    ocp = problem("acrobot")
    one = solver("acrobot")
    W = one.kernel.width
    x0 = ocp.initial_states.sample(3 * W + 2, 1)
    whole = one.solve(x0, curvature=True)
    two = DDP(ocp, threads=2).solve(x0, curvature=True)
    for n in (1, W - 1, W, W + 1, 3 * W + 2):
        part = one.solve(x0[:n], curvature=True)
        for field, value in part.arrays().items():
            assert field == "seconds" or np.array_equal(value, getattr(whole, field)[:n]), field
            assert field == "seconds" or np.array_equal(value, getattr(two, field)[:n]), field


def test_guess_is_followed_with_its_gain():
    s = solved("cartpole")
    moved = s.x[:, 0] + 0.01
    start = DDP(problem("cartpole"), threads=1, settings=DDPSettings(max_iterations=1))
    followed = start.solve(moved, s.t[:, 0], u=s.u, x=s.x, gain=s.gain)
    blind = start.solve(moved, s.t[:, 0], u=s.u)
    assert (followed.V[:, 0] < 1.01 * again("cartpole", s, moved).cost).all()
    assert (blind.V[:, 0] > followed.V[:, 0]).all()


def test_rows_and_join():
    s = solved("cartpole")
    joined = Solution.join([s[:1], s[np.array([1, 2, 3])]])
    assert all(np.array_equal(value, getattr(joined, name)) for name, value in vars(s).items())


# Learned dynamics


@lru_cache
def random_model(name: str, activations: tuple[str, ...] = ("sine", "tanh")) -> LearnedDynamics:
    """f plus networks with random weights: angles and products as features, a nonlinear output map."""
    system = problem(name).system
    x, u = ca.SX.sym("x", system.nx), ca.SX.sym("u", system.nu)
    features = [ca.vertcat(ca.sin(x[0]), ca.cos(x[0]), x[1] * u[0] / 5),
                ca.vertcat(x[-1] / 3, x[0] * x[-1], u, ca.sin(x[1] * x[0])), x[1]]
    layers, skips = [(7, 6), (5,), (3, 4, 9)], (True, False, True)
    generator = torch.random.get_rng_state()
    torch.manual_seed(0)
    nets = [MLP([p.numel(), *hidden, out], a, skip).double().eval() for p, hidden, out, a, skip in
            zip(features, layers, (2, 2, 1), activations, skips, strict=False)]
    torch.random.set_rng_state(generator)
    y = [ca.SX.sym(f"y{i}", net.sizes[-1]) for i, net in enumerate(nets)]
    xdot = system.f(x, u) + 0
    xdot[0] += 0.3 * y[0][0] * ca.cos(x[1]) + 0.2 * y[1][0] * y[0][1]
    xdot[-1] += 0.3 * y[0][1] * u[0] + 0.1 * ca.sin(y[1][1]) * x[0] + (0.1 * y[2] if len(y) > 2 else 0)
    net = FeatureNet(ca.Function("phi", [x, u], features[:len(nets)]), nets, ca.Function("xdot", [x, u, *y], [xdot]))
    return LearnedDynamics(system, net, "random")


@pytest.mark.parametrize(("name", "activations"), [
    ("cartpole", ("sine", "tanh", "silu")), ("acrobot", ("silu", "relu")), ("dubins", ("tanh", "sine"))])
def test_sweep_on_networks_equals_casadis_derivatives_of_the_step(name, activations):
    """One sweep about random controls, each stage of it by CasADi's AD of the native MX step."""
    ocp, model, K, B = problem(name), random_model(name, activations), 6, 9
    s, n = ocp.system, ocp.system.nx
    u = np.random.default_rng(1).uniform(0.5 * s.lbu, 0.5 * s.ubu, (B, K, s.nu))
    d = DDP(ocp, intervals=K, substeps=1, dynamics=model, constraints="soft", threads=1)
    work = Work(d, ocp.initial_states.sample(B, 0), np.zeros(B), u, None, None)
    V, V_x, V_xx = np.zeros((B, K + 1)), np.zeros((B, K + 1, n)), np.zeros((B, K + 1, n, n))
    work.backward(np.arange(B), V, V_x, V_xx)
    step, slopes, bend = step_functions(model.to_casadi(), ocp, ocp.horizon / K)
    newton = 0
    for b, k in np.ndindex(B, K):
        x, u_k, dk, gain = work.x[b, k], work.u[b, k], work.k[b, k], work.gain[b, k]
        ahead, cost = step(x, u_k)
        assert close(work.x[b, k + 1], ahead.full().ravel())
        assert close(V[b, k], V[b, k + 1] + float(cost))
        F, l = (v.full() for v in slopes(x, u_k))  # noqa: E741
        Q = bend(x, u_k, V_x[b, k + 1]).full() + F.T @ V_xx[b, k + 1] @ F
        q = l.ravel() + F.T @ V_x[b, k + 1]
        Q_uu, Q_ux = Q[n:, n:], Q[n:, :n]
        assert close(V_x[b, k], q[:n] + gain.T @ (q[n:] + Q_uu @ dk) + Q_ux.T @ dk)
        assert close(V_xx[b, k], Q[:n, :n] + gain.T @ Q_uu @ gain + gain.T @ Q_ux + Q_ux.T @ gain)
        least, *_, most = np.linalg.eigvalsh(np.kron(np.eye(2), Q_uu))  # each twice, where there is but one
        inside = (u_k + dk > s.lbu + 1e-9).all() and (u_k + dk < s.ubu - 1e-9).all()
        if least > 1e-3 * most and inside:
            assert close(dk, -np.linalg.solve(Q_uu, q[n:]))
            assert close(gain, -np.linalg.solve(Q_uu, Q_ux))
            newton += 1
    assert newton or name == "dubins"  # where Q_uu is not definite about such controls


def step_functions(f, ocp, h):
    """(x, u) -> (x after h, cost), (x, u) -> their Jacobians, (x, u, lam) -> Hessian of lam' x after h + cost."""
    x, u, lam = (ca.MX.sym(name, n) for name, n in (("x", ocp.system.nx), ("u", ocp.system.nu), ("l", ocp.system.nx)))
    z, (after, cost) = ca.vertcat(x, u), rk4_cost(f, ocp.L_soft, x, u, h)
    return (ca.Function("step", [x, u], [after, cost]),
            ca.Function("slopes", [x, u], [ca.jacobian(after, z), ca.jacobian(cost, z)]),
            ca.Function("bend", [x, u, lam], [ca.hessian(ca.dot(lam, after) + cost, z)[0]]))


def close(got, expected) -> bool:
    return bool(np.abs(got - expected).max() <= 1e-10 * (1 + np.abs(expected).max()))


def test_learned_optimum_is_nmpcs_and_its_costate_the_slope():
    ocp, model = problem("cartpole"), random_model("cartpole")
    d = DDP(ocp, intervals=40, dynamics=model, threads=1)
    x0 = ocp.initial_states.sample(3, 0)
    s = d.solve(x0)
    assert s.success.all()
    nmpc = NMPC(ocp, intervals=40, dynamics=model, solver="ipopt").solve(x0, (s.x, s.u + 1e-3))
    assert np.abs(nmpc.cost / s.cost - 1).max() < 1e-6
    e, n = 1e-4, ocp.system.nx
    moved = (x0[:, None] + e * np.vstack([np.eye(n), -np.eye(n)])).reshape(-1, n)
    cost = d.solve(moved, u=np.repeat(s.u, 2 * n, axis=0)).cost.reshape(len(x0), 2, n)
    slope = (cost[:, 0] - cost[:, 1]) / (2 * e)
    assert np.abs(slope - s.V_x[:, 0]).max() < 1e-6 * (1 + np.abs(slope).max())


def test_model_without_networks_equals_the_exact_f():
    ocp = problem("pendulum")
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    net = FeatureNet(ca.Function("phi", [x, u], []), [], ca.Function("xdot", [x, u], [ocp.system.f(x, u)]))
    x0 = ocp.initial_states.sample(5, 0)
    s = DDP(ocp, dynamics=LearnedDynamics(ocp.system, net, "known")).solve(x0)
    np.testing.assert_allclose(s.cost, solver("pendulum").solve(x0).cost, rtol=1e-12)
