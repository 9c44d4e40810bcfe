"""Systems in discrete time, x+ = F(x, u, t, p): against Riccati's recursion, IPOPT on the same steps, plain loops."""

import dataclasses
import json
import pickle
import re

import casadi as ca
import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are

import nocl
from nocl.cli.commands import main
from nocl.comparisons import compare
from nocl.comparisons.stability import stability
from nocl.solvers import DDP, LQR, NMPC, SolutionBank, solve_globally
from nocl.solvers.cnd import CND, TrainSettings
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Labels, Problems, continuous_run, policy_controls, tube
from nocl.solvers.ddp.bank import extend
from nocl.solvers.ddp.without_compiler import NumpyKernel

A, B = np.array([[1.0, 0.1], [0.02, 0.97]]), np.array([[0.005], [0.1]])
Q, R, P_END = np.diag([1.0, 0.1]), np.array([[0.01]]), np.diag([3.0, 1.0])
STATES = np.array([[1.0, 0.5], [-0.3, 0.8], [0.0, -1.0]])
K = 12


def linear(dt=0.1, **changes):
    """The linear-quadratic problem with A, B a step and dt (x'Q x + u'R u) for it, K steps."""
    x, u = ca.vertcat(ca.SX.sym("a"), ca.SX.sym("b")), ca.SX.sym("u")
    s = nocl.System.discrete("linear", x=x, u=u, x_next=ca.DM(A) @ x + ca.DM(B) @ u, dt=dt, lbu=[-90], ubu=[90],
                             lbx=[-2, -2], ubx=[2, 2])
    usual = {"horizon": K * dt, "terminal": ca.bilin(ca.DM(P_END), x, x)}
    return nocl.OCP(s, running=ca.bilin(ca.DM(Q), x, x) + 0.01 * u**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Uniform([-1, -1], [1, 1]), **{**usual, **changes})


def recursion(dt):
    """(P [K+1, 2, 2] of V = x'P x, gains [K, 1, 2] of u = -gain x) of linear(dt)."""
    P, gains = [P_END], []
    for _ in range(K):
        gain = np.linalg.solve(dt * R + B.T @ P[-1] @ B, B.T @ P[-1] @ A)
        closed = A - B @ gain
        P.append(dt * Q + dt * gain.T @ R @ gain + closed.T @ P[-1] @ closed)
        gains.append(gain)
    return np.array(P[::-1]), np.array(gains[::-1])


def value(P, x):
    return np.einsum("bi,ij,bj->b", x, P, x)


def fish(**changes):
    """A stock that grows by Ricker's law and is harvested by a share of it, its price falling with the time."""
    n, e, share, growth = ca.SX.sym("n"), ca.SX.sym("e"), ca.SX.sym("share"), nocl.parameter("growth", nominal=1.1)
    t = nocl.time()
    s = nocl.System.discrete("fish", x=ca.vertcat(n, e), u=share, p=growth, dt=0.5,
                             x_next=ca.vertcat(n * (1 - share) * ca.exp(growth * (1 - n * (1 - share))),
                                               0.8 * e + share + 0.05 * ca.sin(t)),
                             lbu=[0.0], ubu=[0.9], lbx=[0.05, 0.0], ubx=[3.0, 4.0])
    usual = {"terminal": (n - 0.9) ** 2, "horizon": 5.0}
    return nocl.OCP(s, running=-n * share * ca.exp(-0.1 * t) + 0.3 * share**2 + 0.02 * e**2,
                    initial_states=nocl.Uniform([0.5, 0.0], [1.5, 0.5]), parameters=nocl.Uniform([0.8], [1.4]),
                    **{**usual, **changes})


def by_hand(x0, growth, first=0, steps=10, dt=0.5, most=None):
    """(cost, u [steps - first]) of fish(), by IPOPT in Opti; most: of share times stock, at every step."""
    opti = ca.Opti()
    N = steps - first
    u, x, cost = opti.variable(N), ca.DM(x0), 0
    for k in range(N):
        t, share = dt * (first + k), u[k]
        kept = x[0] * (1 - share)
        cost += dt * (-x[0] * share * np.exp(-0.1 * t) + 0.3 * share**2 + 0.02 * x[1] ** 2)
        if most is not None:
            opti.subject_to(x[0] * share <= most)
        x = ca.vertcat(kept * ca.exp(growth * (1 - kept)), 0.8 * x[1] + share + 0.05 * np.sin(t))
    opti.minimize(cost + (x[0] - 0.9) ** 2)
    opti.subject_to(opti.bounded(0, u, 0.9))
    opti.set_initial(u, 0.3)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-11})
    found = opti.solve()
    return float(found.value(cost + (x[0] - 0.9) ** 2)), np.atleast_1d(found.value(u))


@pytest.mark.parametrize("dt", [1.0, 0.1])
def test_linear_quadratic_problems_have_riccatis_answer(dt):
    ocp, (P, gains) = linear(dt), recursion(dt)
    ddp, nmpc, lqr = DDP(ocp), NMPC(ocp), LQR(ocp)
    assert (ddp.intervals, nmpc.intervals, ddp.integrator, nmpc.substeps) == (K, K, "map", 1)
    d, n = ddp.solve(STATES, curvature=True), nmpc.solve(STATES, gains=True, workers=1)
    for s in (d, n):
        np.testing.assert_allclose(s.cost, value(P[0], STATES), rtol=1e-9)
        np.testing.assert_allclose(s.gain, -np.tile(gains, (3, 1, 1, 1)), atol=1e-7)
        np.testing.assert_allclose(s.V_xx, 2 * np.tile(P, (3, 1, 1, 1)), atol=1e-7)
        np.testing.assert_allclose(s.V[:, 0], s.cost, rtol=1e-9)
        np.testing.assert_allclose(s.V_x[:, 0], 2 * STATES @ P[0], atol=1e-6)
        np.testing.assert_allclose(s.t, np.tile(dt * np.arange(K + 1), (3, 1)), atol=1e-12)
    np.testing.assert_allclose(lqr.P(3 * dt) / 2, P[3], rtol=1e-10)
    np.testing.assert_allclose([lqr.K(dt * k) for k in range(K)], gains, rtol=1e-10)
    np.testing.assert_allclose(lqr.value(STATES, 5 * dt), value(P[5], STATES), rtol=1e-10)
    policy = lqr.to_casadi()
    at = [float(policy(STATES[0], dt * k)) for k in range(K)]
    np.testing.assert_allclose(at, [lqr(STATES[0], dt * k)[0] for k in range(K)], rtol=1e-9)


def test_for_ever_lqr_is_that_of_the_algebraic_equation():
    ocp = linear(horizon=nocl.INFINITE, terminal=None)
    lqr = LQR(ocp)
    P = solve_discrete_are(A, B, 0.1 * Q, 0.1 * R)
    np.testing.assert_allclose(lqr.P() / 2, P, rtol=1e-9)
    np.testing.assert_allclose(lqr.K(7.0), np.linalg.solve(0.1 * R + B.T @ P @ B, B.T @ P @ A), rtol=1e-9)
    for law in (lqr, lqr.to_casadi()):
        run = nocl.simulate(ocp, law, STATES, duration=200.0)
        np.testing.assert_allclose(run.cost, value(P, STATES), rtol=1e-8)
    unstable = dataclasses.replace(ocp, system=ocp.system.under(ca.Function("F", [ocp.system.x, ocp.system.u], [
        ca.vertcat(1.2 * ocp.system.x[0], 0.5 * ocp.system.x[1] + ocp.system.u)])))
    with pytest.raises(ValueError, match="no stabilising gain"):
        LQR(unstable)


def test_tails_begin_at_samples_and_have_fewer_steps():
    ocp, (P, _) = linear(), recursion(0.1)
    first = np.array([0, 5, K - 1])
    s = DDP(ocp).solve(STATES, 0.1 * first, curvature=True)
    np.testing.assert_allclose(s.cost, [value(P[k], x[None])[0] for k, x in zip(first, STATES, strict=True)], rtol=1e-9)
    assert s.x.shape == (3, K + 1, 2)
    np.testing.assert_allclose(s.t[1], 0.1 * np.minimum(5 + np.arange(K + 1), K))
    np.testing.assert_array_equal(s.x[1, K - 5:], np.tile(s.x[1, K - 5], (6, 1)))
    assert not s.gain[1, K - 5:].any()
    np.testing.assert_allclose(s.V_xx[2, 1:], np.tile(2 * P_END, (K, 1, 1)))
    again = DDP(ocp).solve(STATES, 0.1 * first, u=s.u, x=s.x, gain=s.gain)
    np.testing.assert_allclose(again.cost, s.cost, rtol=1e-12)
    for k in (5, K - 1):
        n = NMPC(ocp).solve(STATES[:1], t0=0.1 * k, workers=1)
        assert n.u.shape == (1, K - k, 1)
        np.testing.assert_allclose(n.cost, value(P[k], STATES[:1]), rtol=1e-9)


def test_windows_and_loops_go_from_sample_to_sample():
    ocp, (P, _) = linear(), recursion(0.1)
    loop = NMPC(ocp).controller()
    run = nocl.simulate(ocp, loop, STATES[:1])
    np.testing.assert_allclose(run.cost, value(P[0], STATES[:1]), rtol=1e-9)
    assert [len(loop.nodes(0.1 * k)) for k in (0, 4, K - 1, K)] == [K + 1, K - 3, 2, 2]
    window = NMPC(ocp, horizon=0.4)
    assert window.intervals == 4
    np.testing.assert_allclose(window.solve(STATES[:1], workers=1).cost, value(P[K - 4], STATES[:1]), rtol=1e-9)
    np.testing.assert_allclose(window.controller().nodes(1.0), [1.0, 1.1, 1.2])
    np.testing.assert_allclose(window.controller(receding=True).nodes(1.0), [0.0, 0.1, 0.2, 0.3, 0.4])


def test_a_nonlinear_map_with_time_and_parameters_is_what_ipopt_finds():
    ocp, x0, p = fish(), np.array([[0.6, 0.1], [1.2, 0.4]]), np.array([[0.9], [1.3]])
    true = [by_hand(x, float(g)) for x, g in zip(x0, p[:, 0], strict=True)]
    d, n = DDP(ocp).solve(x0, p=p), NMPC(ocp).solve(x0, p=p, workers=1)
    for s in (d, n):
        np.testing.assert_allclose(s.cost, [cost for cost, _ in true], atol=1e-8)
        np.testing.assert_allclose(s.u[:, :, 0], [u for _, u in true], atol=1e-4)
    np.testing.assert_allclose(d.V_p, n.V_p, atol=1e-5)
    tail = DDP(ocp).solve(x0[0], 2.0, p=p[0])
    np.testing.assert_allclose(tail.cost, by_hand(x0[0], 0.9, first=4)[0], atol=1e-8)
    np.testing.assert_allclose(NMPC(ocp).solve(x0[0], t0=2.0, p=p[0], workers=1).cost, tail.cost, atol=1e-8)
    np.testing.assert_allclose(nocl.simulate(ocp, d.u, x0, p=p).cost, d.cost, rtol=1e-12)


def test_constraints_hold_at_samples_and_those_of_controls_where_controls_act():
    free = fish()
    n, share = free.system.x[0], free.system.u
    ocp = dataclasses.replace(free, constraints={"catch": (None, n * share, 0.25)})
    x0, p = np.array([[1.2, 0.1]]), [1.2]
    cost, u = by_hand(x0[0], 1.2, most=0.25)
    for s in (DDP(ocp).solve(x0, p=p), NMPC(ocp).solve(x0, p=p, workers=1),
              solve_globally(DDP(ocp), x0, p=p, starts=3, progress=False)):
        np.testing.assert_allclose(s.cost, cost, atol=1e-6)
        np.testing.assert_allclose(s.u[0, :, 0], u, atol=1e-4)
        run = nocl.simulate(ocp, s.u, x0, p=p)
        assert run.success.all()
        assert run.violation.max() < 1e-6
    late = DDP(ocp).solve(x0, 2.0, p=p)
    np.testing.assert_allclose(late.cost, by_hand(x0[0], 1.2, first=4, most=0.25)[0], atol=1e-6)
    rough = nocl.simulate(ocp, np.full((1, 10, 1), 0.5), x0, p=p)
    stock, catch = 1.2, []
    for _ in range(10):
        catch.append(0.5 * stock)
        stock = 0.5 * stock * np.exp(1.2 * (1 - 0.5 * stock))
    assert not rough.success.any()
    np.testing.assert_allclose(rough.violation, (max(catch) - 0.25) / ocp.functions.scales[0], rtol=1e-9)


def test_the_judge_iterates_the_map():
    ocp, x0, p = fish(), np.array([[0.6, 0.1], [1.2, 0.4]]), np.array([[0.9], [1.3]])
    asked = []

    def law(x, t, p):
        asked.append(t)
        return 0.2 + 0.3 * x[:, :1] - 0.01 * t

    def iterate(x, p, first=0, kick=None):
        path, cost = [x], 0.0
        for k in range(first, 10):
            x = path[-1] + (0.0 if kick is None or k != kick else np.array([0.1, -0.05]))
            path[-1] = x
            t, u = 0.5 * k, np.clip(0.2 + 0.3 * x[0] - 0.005 * k, 0, 0.9)
            cost += 0.5 * (-x[0] * u * np.exp(-0.1 * t) + 0.3 * u**2 + 0.02 * x[1] ** 2)
            kept = x[0] * (1 - u)
            path.append(np.array([kept * np.exp(p * (1 - kept)), 0.8 * x[1] + u + 0.05 * np.sin(t)]))
        return np.array(path), cost + (path[-1][0] - 0.9) ** 2

    own = ca.Function("law", [x := ca.SX.sym("x", 2), t := ca.SX.sym("t"), q := ca.SX.sym("p")],
                      [0.2 + 0.3 * x[0] - 0.01 * t + 0 * q])
    for controller in (law, own):
        run = nocl.simulate(ocp, controller, x0, p=p)
        for i in range(2):
            path, cost = iterate(x0[i], p[i, 0])
            np.testing.assert_allclose(run.x[i], path, rtol=1e-13, atol=1e-15)
            np.testing.assert_allclose(run.cost[i], cost, rtol=1e-12)
        np.testing.assert_array_equal(run.t, 0.5 * np.arange(11))
    assert asked == [0.5 * k for k in range(10)]
    late = nocl.simulate(ocp, law, x0[:1], p=p[:1], t0=1.5, kicks=[(2.5, [0.1, -0.05])])
    path, cost = iterate(x0[0], 0.9, first=3, kick=5)
    np.testing.assert_allclose(late.x[0], path, rtol=1e-13)
    np.testing.assert_allclose(late.cost, cost, rtol=1e-12)
    blown = nocl.simulate(ocp, np.full((1, 10, 1), np.nan), x0[:1], p=p[:1])
    assert not blown.success[0]
    assert "NaN" in blown.message[0]


@pytest.mark.parametrize("make", [linear, fish])
def test_kernels_agree_and_loops_over_rows_too(make, monkeypatch, tmp_path):
    ocp = make()
    x0, p = ocp.initial_states.sample(3, 1), ocp.sample_parameters(3, 1) if ocp.np else None
    first = np.array([0.0, 2.0, 4.0]) * ocp.system.dt
    fast, slow = DDP(ocp), DDP(ocp)
    slow.kernel = NumpyKernel(ocp, integrator="map")
    monkeypatch.setattr("nocl.solvers.ddp.kernel.STRAIGHT", 0)
    looped = DDP(ocp, cache=tmp_path)
    a, *others = (ddp.solve(x0, first, p=p, curvature=True) for ddp in (fast, slow, looped))
    for b in others:
        np.testing.assert_allclose(b.cost, a.cost, rtol=1e-12)
        np.testing.assert_allclose(b.u, a.u, atol=1e-8)
        np.testing.assert_allclose(b.V_xx, a.V_xx, atol=1e-7)
        if p is not None:
            np.testing.assert_allclose(b.V_p, a.V_p, atol=1e-8)


@pytest.mark.parametrize("make", [linear, fish])
def test_data_pickles_and_files_keep_the_map(make):
    ocp = make()
    s = ocp.system
    for other in (nocl.OCP.from_data(json.loads(json.dumps(ocp.to_data()))), pickle.loads(pickle.dumps(ocp))):
        assert (other.system.dt, other.steps, other.system.difference(s)) == (s.dt, ocp.steps, "")
        at = np.linspace(0.3, 0.9, s.nx), [0.4], *([1.5] if s.uses_time else []), *([1.2] if s.np else [])
        np.testing.assert_array_equal(other.system.F(*at), s.F(*at))
        assert repr(other) == repr(ocp)
    assert "in steps of" in repr(s)
    assert f"{s.state_names[0]}+ = " in repr(s)
    slower = dataclasses.replace(s, dt=2 * s.dt)
    assert "steps of" in s.difference(slower)
    assert not s.at(p=[1.2]).np if s.np else True


def test_rates_and_jacobians_are_those_of_a_step():
    s = fish().system
    at = [0.7, 0.2], [0.3], 1.5, [1.2]
    F = s.F(*at).full().ravel()
    np.testing.assert_allclose(np.array(at[0]) + s.dt * s.f(*at).full().ravel(), F, rtol=1e-14)
    given = {"t": 1.5, "p": [1.2]}
    J, G = s.linearize(at[0], at[1], **given)
    moved = [s.F(np.add(at[0], d), at[1], *at[2:]).full().ravel() for d in 1e-6 * np.eye(2)]
    np.testing.assert_allclose(J, (np.array(moved) - F).T / 1e-6, atol=1e-5)
    np.testing.assert_allclose(G[:, 0], (s.F(at[0], [0.3 + 1e-6], *at[2:]).full().ravel() - F) / 1e-6, atol=1e-5)
    with pytest.raises(ValueError, match="one in continuous time"):
        nocl.load_ocp("pendulum").system.F  # noqa: B018


def test_systems_that_are_made_of_others_stay_discrete():
    s = linear().system
    slow = nocl.limit_rates(s, {"u": 2.0})
    np.testing.assert_allclose(slow.F([0.1, 0.2, 0.5], [1.5]).full().ravel(),
                               [*(A @ [0.1, 0.2] + B[:, 0] * 0.5), 0.5 + 0.1 * 1.5])
    split = nocl.split_controls(s, ["u"])
    np.testing.assert_allclose(split.F([0.1, 0.2], [0.7, 0.3]), s.F([0.1, 0.2], [0.4]))
    z = ca.SX.sym("z")
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    dae = nocl.System.discrete("dae", x=x, u=u, x_next=0.5 * x + z, z=z, alg=z + 0.1 * z**3 - u, lbu=[-1], ubu=[1],
                               lbx=[-1], ubx=[1])
    root = np.roots([0.1, 0, 1, -0.6]).real[np.isreal(np.roots([0.1, 0, 1, -0.6]))][0]
    np.testing.assert_allclose(float(dae.F(0.4, 0.6)), 0.2 + root, rtol=1e-9)
    kept = nocl.System.from_data(dae.to_data())
    np.testing.assert_allclose(float(kept.F(0.4, 0.6)), 0.2 + root, rtol=1e-9)


def test_other_tools_get_the_steps():
    ocp = linear()
    space = nocl.to_control(ocp.system, [0, 0], [0])
    np.testing.assert_allclose(space.A, A)
    assert space.dt == 0.1
    assert nocl.to_control(ocp.system).dt == 0.1
    env = nocl.to_gymnasium(ocp)
    plan = DDP(ocp).solve(STATES[:1])
    env.reset(options={"x0": STATES[0]})
    rewards = [env.step(u)[1] for u in plan.u[0]]
    np.testing.assert_allclose(-sum(rewards), plan.cost[0], rtol=1e-12)


def test_labels_and_runs_of_training_are_those_of_the_steps():
    ocp, (P, gains) = linear(), recursion(0.1)
    ddp, torch_ocp = DDP(ocp), InTorch(ocp, integrator="map")
    bank = SolutionBank.of(ddp, ddp.solve(ocp.initial_states.sample(20, 0)))
    tails = tube(ddp, bank, 50, 0.3, np.random.default_rng(0))
    first = np.round(tails.t[:, 0] / 0.1).astype(int)
    np.testing.assert_allclose(tails.t[:, 0], 0.1 * first, atol=1e-12)
    assert len(set(first)) > 5
    np.testing.assert_allclose(tails.cost, [value(P[k], x[None])[0] for k, x in zip(first, tails.x[:, 0], strict=True)],
                               rtol=1e-8)
    labels = Labels.of(tails, torch_ocp, 1.0)
    assert len(labels) == (K - first).sum()
    k = np.round(labels.t / 0.1).astype(int)
    np.testing.assert_allclose(labels.u, -np.einsum("nij,nj->ni", gains[k], labels.x), atol=1e-7)
    table = torch.from_numpy(gains)

    def optimal(x, t):
        k = torch.round(t[:, 0] / 0.1).long().clamp(max=K - 1)
        return -torch.einsum("bij,bj->bi", table[k], x)

    at = Problems(tails.x[:, 0], tails.t[:, 0], np.zeros((50, 0)))
    J, x, t = continuous_run(optimal, torch_ocp, at, 999)
    np.testing.assert_allclose(J, tails.cost, rtol=1e-8)
    np.testing.assert_allclose(x, tails.x, atol=1e-7)
    np.testing.assert_allclose(t, tails.t, atol=1e-12)
    u = policy_controls(optimal, torch_ocp, at, K)
    acting = np.diff(tails.t, axis=1) > 0
    np.testing.assert_allclose(u[acting], tails.u[acting], atol=1e-7)
    again = extend(ddp, bank, tails.x[:, 0], 3, tails.t[:, 0], kept=1)
    np.testing.assert_allclose(again.cost, tails.cost, rtol=1e-8)


def test_compare_judges_all_by_the_steps(tmp_path):
    ocp, (P, _) = linear(), recursion(0.1)
    methods = {"NMPC": NMPC(ocp), "DDP": DDP(ocp), "LQR": LQR(ocp), "mine": lambda x, t: -x[:, :1] - x[:, 1:]}
    report = compare(ocp, methods, x0=STATES, progress=False)
    for judged in report.judged[:3]:
        np.testing.assert_allclose(judged.simulation.cost, value(P[0], STATES), rtol=1e-9)
    assert report.judged[3].simulation.t.shape == (K + 1,)
    assert f"held on {K} intervals" in report.judged[2].how
    report.save(tmp_path / "report")
    assert (tmp_path / "report" / "report.html").exists()
    with pytest.raises(ValueError, match="discrete time"):
        compare(ocp, methods, x0=STATES, hold=40)
    with pytest.raises(ValueError, match="stability is for systems in continuous time"):
        stability(report, methods)


def refused():
    """(what is asked, what the error says)."""
    ocp, x0 = linear(), STATES
    s, lqr = ocp.system, LQR(ocp)
    u, x = s.u, s.x
    given = {"x": x, "u": u, "lbu": [-1], "ubu": [1], "lbx": [-1, -1], "ubx": [1, 1]}
    yield "a horizon between samples", lambda: linear(horizon=1.25), "whole number of steps, like 1.2 or 1.3"
    yield "a free horizon", lambda: linear(horizon=nocl.Free(0.5, 2.0)), "whole number of steps of dt = 0.1"
    yield "dt 0", lambda: nocl.System.discrete("s", x_next=x, dt=0.0, **given), "dt, the time between two samples"
    yield "no x_next", lambda: nocl.System("s", xdot=None, dt=0.1, **given), "dt is given and x_next is not"
    yield "no dt", lambda: nocl.System("s", xdot=None, x_next=x, **given), "x_next is given and dt is not"
    yield "rows", lambda: nocl.System.discrete("s", x_next=u, **given), "x_next"
    yield "intervals, DDP", lambda: DDP(ocp, intervals=80), "expected 12: leave it out"
    yield "intervals, NMPC", lambda: NMPC(ocp, 80), "expected 12: leave it out"
    yield "substeps", lambda: DDP(ocp, substeps=2), "whose step is F itself"
    yield "radau", lambda: NMPC(ocp, integrator="radau"), "whose step is F itself"
    yield "rk4", lambda: DDP(ocp, integrator="rk4"), "whose step is F itself"
    yield "map elsewhere", lambda: DDP(nocl.load_ocp("pendulum"), integrator="map"), "integrator"
    yield "between", lambda: DDP(ocp, between=True), "nothing is between two nodes"
    yield "between, NMPC", lambda: NMPC(ocp, between=True), "nothing is between two nodes"
    yield "t0, DDP", lambda: DDP(ocp).solve(x0, 0.05), "t0 is 0.05"
    yield "t0, NMPC", lambda: NMPC(ocp).solve(x0, t0=0.05), "t0 is 0.05"
    yield "t0, simulate", lambda: nocl.simulate(ocp, lqr, x0, t0=0.05), "t0 is 0.05"
    yield "t0 at the end", lambda: DDP(ocp).solve(x0, 1.2 - 1e-9), "a sample before the end"
    yield "nodes, NMPC", lambda: NMPC(ocp).solve(x0, nodes=np.linspace(0, 1.2, 7)), "the samples of 'linear'"
    yield "hold, loop", lambda: NMPC(ocp).controller(hold=6), "a control for each step"
    yield "window", lambda: NMPC(ocp, horizon=0.25), "whole number of steps"
    yield "hold", lambda: nocl.simulate(ocp, lqr, x0, hold=40), "expected 12: leave it out"
    yield "nodes", lambda: nocl.simulate(ocp, lqr, x0, nodes=40), "expected 13: leave it out"
    yield "delay", lambda: nocl.simulate(ocp, lqr, x0, delay=0.05), "delay is 0.05"
    yield "kick", lambda: nocl.simulate(ocp, lqr, x0, kicks=[(0.25, [0, 0])]), "the time of a kick is 0.25"
    yield "plans", lambda: nocl.simulate(ocp, np.zeros((3, 7, 1)), x0), "expected K = 12"
    yield "plant", lambda: nocl.simulate(ocp, lqr, x0, f=s.f), "ocp.system.under(F)"
    yield "identify", lambda: nocl.identify(s), "nocl.identify is for systems in continuous time"
    yield "paper", lambda: nocl.train(ocp, method="paper"), "for systems in continuous time"
    yield "settings", lambda: nocl.train(ocp, settings=TrainSettings(intervals=40)), "expected 12: leave it out"
    yield "rates", lambda: nocl.train(ocp, settings=TrainSettings(control_dt=True)), "control_dt"
    yield "for ever", lambda: nocl.train(linear(horizon=nocl.INFINITE, terminal=None)), "INFINITE"
    yield "acados", lambda: nocl.to_acados(s), "for systems in continuous time"
    yield "do-mpc", lambda: nocl.to_do_mpc(s), "for systems in continuous time"
    yield "gymnasium", lambda: nocl.to_gymnasium(ocp, steps=80), "expected 12: leave it out"


@pytest.mark.parametrize(("ask", "says"), [pytest.param(ask, says, id=name) for name, ask, says in refused()])
def test_what_is_about_continuous_time_is_refused(ask, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        ask()


FILE = """
import casadi as ca
import nocl

a, b, u = ca.SX.sym("a"), ca.SX.sym("b"), ca.SX.sym("u")
system = nocl.System.discrete("pend", x=ca.vertcat(a, b), u=u, dt=0.1, lbu=[-1.5], ubu=[1.5], lbx=[-2, -2], ubx=[2, 2],
                              x_next=ca.vertcat(a + 0.1 * b, b + 0.1 * (ca.sin(a) + u)))
ocp = nocl.OCP(system, horizon=2.0, running=a**2 + 0.1 * b**2 + 0.01 * u**2, terminal=3 * a**2 + b**2,
               x_goal=[0, 0], u_goal=[0], initial_states=nocl.Uniform([-1, -1], [1, 1]))
"""


def test_the_command_line_solves_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pend.py").write_text(FILE)
    costs = []
    for solver in ("nmpc", "ddp", "lqr"):
        assert not main(["solve", "pend.py", "--solver", solver, "--n", "3"])
        with np.load(tmp_path / "runs" / "pend" / "solutions" / f"{solver}.npz") as found:
            assert found["success"].all()
            assert found["u"].shape[1] in (20, 21)
            costs.append(found["cost"])
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-6)
    assert (costs[2] >= costs[0] - 1e-9).all()
    assert main(["solve", "pend.py", "--intervals", "40"]) == 2
    assert "expected 20: leave it out" in capsys.readouterr().err
    assert main(["run", "pend.py"]) == 2
    assert "--exact" in capsys.readouterr().err


@pytest.mark.slow
def test_a_controller_is_trained_saved_and_exported(tmp_path):
    place: dict = {}
    exec(FILE, place)
    ocp, few = place["ocp"], {"rounds": 1, "states": 60, "tails": 300, "visits": 200, "held_out": 16}
    settings = TrainSettings.of("quick", **few)
    cnd = nocl.train(ocp, settings=settings, progress=False)
    assert cnd.card["integrator"] == "map"
    assert cnd.card["gap_median"] < 1e-3
    x0 = ocp.initial_states.sample(20, 5)
    best, run = DDP(ocp).solve(x0), nocl.simulate(ocp, cnd, x0)
    assert np.median(run.cost / best.cost - 1) < 1e-3
    assert np.median(np.abs(cnd.value(x0) / best.cost - 1)) < 0.02
    cnd.save(tmp_path / "cnd")
    loaded = CND.load(tmp_path / "cnd")
    np.testing.assert_array_equal(loaded(x0), cnd(x0))
    moved = loaded.closed_loop_to_casadi()(x0[0], 0.3).full().ravel()
    np.testing.assert_allclose(moved, ocp.system.F(x0[0], cnd(x0[0], 0.3)).full().ravel(), rtol=1e-12)
    assert loaded.export(tmp_path / "export", to=("casadi",)).ok


def test_an_infinite_horizon_s_maximum_is_no_answer():
    """x+ = x + u with -(x^2 + u^2): the Riccati equation has a stabilising solution, which costs the most."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System.discrete("most", x=x, u=u, x_next=x + u, lbu=[-9], ubu=[9], lbx=[-3], ubx=[3])
    ocp = nocl.OCP(system, horizon=5.0, running=-(x**2 + u**2), terminal=0.0, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Uniform([-1], [1]))
    with pytest.raises(ValueError, match="stabilis"):
        LQR(ocp, infinite=True)
