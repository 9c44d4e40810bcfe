"""Constraints in DDP: IPOPT's optimum on the same nodes, KKT conditions, analytic answers; units; no plan."""

import pickle
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from constrained import PROBLEMS, TIGHT, Problem, Shooting, kkt_residual, rk4_step

import nocl
from nocl.data import Solution
from nocl.definition.scales import usual_sizes
from nocl.solvers import NMPC, solve_globally
from nocl.solvers.ddp import augmented
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.constraints import Block, ConstraintRows, rows_of
from nocl.solvers.ddp.kernel import ddp_source
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.solvers.starts import random_controls

FIELDS = ("cost", "x", "u", "gain", "V", "V_x", "success", "message")
problem = lru_cache(lambda name: PROBLEMS[name]())


def solver(of: Problem, K: int, **options) -> DDP:
    ddp = DDP(of.ocp, intervals=K, substeps=1, rows=of.rows, threads=1, **options)
    ddp.checked = True
    return ddp


def best(of: Problem, K: int, n: int, starts: int = 4, seed: int = 1):
    """The best of a few cold starts from n initial states."""
    ddp, x0 = solver(of, K), np.repeat(of.ocp.initial_states.sample(n, seed), starts, axis=0)
    u = random_controls(of.ocp, K, len(x0), np.random.default_rng(seed), np.zeros((len(x0), 0)))
    u[::starts] = of.ocp.u_goal
    s = ddp.solve(x0, u=u)
    return s[s.cost.reshape(n, starts).argmin(axis=1) + starts * np.arange(n)]


def largest_violation(of: Problem, s) -> float:
    program, K = Shooting(of, s.u.shape[1]), s.u.shape[1]
    worst = [0.0]
    for x, u in zip(s.x, s.u, strict=True):
        first, later = program.first(x[0], u[0]), program.stage(x[1:K].T, u[1:].T)
        worst += [-c.full().min(initial=0.0) for c in (first, later, program.end(x[K]))]
        worst.append(np.abs(program.equal(x[K]).full()).max(initial=0.0))
    return max(worst)


def assert_ipopts(of: Problem, s, nodes) -> None:
    """Cost to 1e-8, costates to 1e-6 and gains to 1e-3, each relative to its own size."""
    K = s.u.shape[1]
    program = Shooting(of, K)
    for i in range(len(s)):
        other = program.solve(s.x[i, 0], s.t[i, 1] - s.t[i, 0], s.x[i], s.u[i] + 1e-4)
        assert abs(s.cost[i] / other.cost - 1) < 1e-8
        costate = other.costate()
        assert np.abs(s.V_x[i, 1:] - costate).max() < 1e-6 * np.abs(costate).max()
        gains = {k: other.gain(k) for k in nodes}
        known = {k: gain for k, gain in gains.items() if np.isfinite(gain).all()}
        assert len(known) > len(nodes) / 2
        for k, gain in known.items():
            assert np.abs(s.gain[i, k] - gain).max() < 1e-3 * (np.abs(gain).max() + 1e-3)


@pytest.mark.parametrize("name", PROBLEMS)
def test_optimum_is_ipopts(name):
    of = problem(name)
    s = best(of, 30, 1)
    assert s.success.all()
    assert largest_violation(of, s) <= 1e-9
    assert_ipopts(of, s, (1, 10, 20))
    assert kkt_residual(of, s, 0) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_optimum_is_ipopts_on_many_states_and_nodes(name):
    of = problem(name)
    s = best(of, 80, 6, starts=8)
    assert s.success.all()
    assert largest_violation(of, s) <= 1e-9
    assert_ipopts(of, s, range(1, 70, 10))
    assert max(kkt_residual(of, s, i) for i in range(6)) < 1e-6


# Analytic answers


def double_integrator(**options) -> tuple[nocl.System, dict]:
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("cart", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-5], ubu=[5], lbx=[-3, -3],
                         ubx=[3, 3])
    return system, {"horizon": 2.0, "running": u**2, "terminal": ca.SX(0), "x_goal": [0, 0], "u_goal": [0],
                    "initial_states": nocl.Uniform([-1.1, 0], [-1, 0]), **options}


def test_speed_limit_and_rest_at_the_end():
    """From rest to rest over d in T with v <= w: u falls linearly to 0 in t1 = 1.5 (T - d / w), then v = w; the cost is
    8 w^2 / (3 t1)."""
    system, options = double_integrator()
    v, w, d = system.x[1], 0.7, 1.0
    limit = [("speed", w - v, w)]
    of = Problem(nocl.OCP(system, **options), limit, limit, [("rest", x, 1.0) for x in ca.vertsplit(system.x)])
    s = solver(of, 100).solve([-d, 0.0])
    t1 = 1.5 * (2.0 - d / w)
    assert s.success.all()
    assert abs(s.cost[0] / (8 * w**2 / (3 * t1)) - 1) < 2e-3
    coasting = (s.t[0] > t1 + 0.03) & (s.t[0] < 2 - t1 - 0.03)
    assert np.abs(s.x[0, coasting, 1] - w).max() < 1e-9
    assert np.abs(s.x[0, -1]).max() < 1e-9


def test_an_equality_at_stages_is_a_control_less():
    x, u, v = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("v")
    common = {"horizon": 1.0, "terminal": x**2, "x_goal": [0], "initial_states": nocl.Uniform([1], [2])}
    box = {"lbx": [-3], "ubx": [3]}
    plant = nocl.System("two", x=x, u=ca.vertcat(u, v), xdot=u - 2 * v + ca.sin(x), lbu=[-2, -2], ubu=[2, 2], **box)
    two = nocl.OCP(plant, running=u**2 + 0.1 * v**2, u_goal=[0, 0], **common)
    one = nocl.OCP(nocl.System("one", x=x, u=u, xdot=u - 2 * (1 - u * u) + ca.sin(x), lbu=[-2], ubu=[2], **box),
                   running=u**2 + 0.1 * (1 - u * u)**2, u_goal=[0], **common)
    rows = ConstraintRows(Block.of(v - (1 - u * u), [True], ["tied"], [1.0]))
    x0 = [[1.0], [1.5], [2.0]]
    a = DDP(two, intervals=20, substeps=1, rows=rows, threads=1).solve(x0)
    b = DDP(one, intervals=20, substeps=1, threads=1).solve(x0)
    assert a.success.all()
    assert np.abs(a.u[..., 1] - (1 - a.u[..., 0]**2)).max() < 1e-9
    np.testing.assert_allclose(a.cost, b.cost, rtol=1e-8)
    np.testing.assert_allclose(a.V_x, b.V_x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(a.gain[:, :, 0], b.gain[:, :, 0], rtol=0, atol=1e-4)


def random_half_planes() -> Problem:
    """A point that goes to the origin past a half plane n'x + b >= 0, all of it parameters."""
    x, u, p = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.vertcat(*map(nocl.parameter, ("nx", "ny", "b")))
    system = nocl.System("point", x=ca.vertcat(*ca.vertsplit(x)), u=ca.vertcat(*ca.vertsplit(u)),
                         xdot=ca.vertcat(x[2:], u), lbu=[-3, -3], ubu=[3, 3], lbx=[-3] * 4, ubx=[3] * 4)
    ocp = nocl.OCP(system, horizon=2.0, running=0.1 * ca.sumsqr(u) + ca.sumsqr(x[:2]), terminal=ca.sumsqr(x), p=p,
                   x_goal=[0] * 4, u_goal=[0, 0], initial_states=nocl.Uniform([-1] * 4, [1] * 4),
                   parameters=nocl.Uniform([-1, -1, -2.1], [1, 1, 2.1]))
    rows = [("plane", p[0] * x[0] + p[1] * x[1] + p[2], 1.0)]
    return Problem(ocp, rows, rows)


def test_random_constraints_satisfy_kkt_and_their_slopes():
    of, n = random_half_planes(), 40
    ocp, ddp = of.ocp, solver(of, 15)
    p, x0 = ocp.parameters.sample(n, 0), ocp.initial_states.sample(n, 0)
    x0[:, 2:] = 0
    p[:, 2] = 0.05 - (p[:, :2] * x0[:, :2]).sum(axis=1)  # x0 holds it, the origin often not
    s = ddp.solve(x0, p=p)
    assert s.success.all()
    assert max(kkt_residual(of, s, i, p[i]) for i in range(n)) < 1e-7
    held = np.flatnonzero(np.abs(s.V_p).max(axis=1) > 1e-4)
    assert 4 < len(held) < n
    for j in range(3):
        up, down = (ddp.solve(x0, u=s.u, x=s.x, gain=s.gain, p=p + e * np.eye(3)[j]).cost for e in (1e-5, -1e-5))
        np.testing.assert_allclose((up - down) / 2e-5, s.V_p[:, j], rtol=0, atol=1e-4 * np.abs(s.V_p).max())


# Units


def mass(unit=1.0, wall=1.0, cost=1.0, **options) -> nocl.OCP:
    """A mass that flies towards a wall: lengths in `unit` m, h and cost in any unit."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u / unit), lbu=[-2], ubu=[2],
                         lbx=[-5 / unit] * 2, ubx=[5 / unit] * 2)
    P, W = unit * p, unit * v
    return nocl.OCP(system, horizon=2.0, running=cost * 0.1 * u**2, terminal=cost * ((P - 1)**2 + W**2), x_goal=[0, 0],
                    u_goal=[0], initial_states=nocl.Gaussian([0, 1 / unit], np.array([0.1, 0.1]) / unit),
                    path_constraints={"wall": wall * (0.8 - P)}, **options)


def test_units_change_nothing():
    x0 = np.array([[0.0, 1.0], [-0.5, 1.2], [0.3, 0.5]])
    reference = DDP(mass(), intervals=20, substeps=1, threads=1).solve(x0)
    assert reference.success.all()
    assert np.abs(reference.clearance).max() < 1e-9
    for unit, wall, cost in ((1e-4, 1e6, 1.0), (1.0, 1e-6, 1e6)):
        s = DDP(mass(unit, wall, cost), intervals=20, substeps=1, threads=1).solve(x0 / unit)
        assert s.success.all()
        np.testing.assert_allclose(s.cost / cost, reference.cost, rtol=1e-8)
        np.testing.assert_allclose(s.V_x / cost / unit, reference.V_x, rtol=0, atol=1e-6)
        np.testing.assert_allclose(s.gain / unit, reference.gain, rtol=0, atol=1e-3 * np.abs(reference.gain).max())


# Between nodes


def deepest(of: Problem, s) -> float:
    """The largest violation of a row of x along plans whose intervals are cut in 50, in scales."""
    h, system = s.t[:, 1] - s.t[:, 0], of.ocp.system
    fine = ca.Function("least", [system.x, system.u], [ca.vertcat(*(c / scale for _, c, scale in of.end))])
    step, worst = rk4_step(of.ocp), 0.0
    for i, k in np.ndindex(s.u.shape[:2]):
        x = s.x[i, k]
        for _ in range(50):
            x = step(x, s.u[i, k], h[i] / 50)[0].full().ravel()
            worst = max(worst, -float(fine(x, s.u[i, k]).full().min()))
    return worst


def test_margins_hold_constraints_between_nodes():
    of = problem("point")
    x0 = [[-2.5, 0.2, 0.0, 0.0], [-2.2, -0.1, 0.1, 0.0]]
    plain, held = (solver(of, 20, between=between).solve(x0) for between in (False, True))
    assert plain.success.all()
    assert held.success.all()
    assert (held.message == "converged").all()
    assert largest_violation(of, held) <= 1e-9
    assert deepest(of, plain) > 1e-3
    assert deepest(of, held) < 0.02 * deepest(of, plain)
    assert (held.cost > plain.cost).all()
    assert (held.cost < 1.05 * plain.cost).all()


def car(**changed) -> nocl.OCP:
    """A cart to rest in 2 s, its drive of little power: a row of state and control."""
    pos, v, force = (ca.SX.sym(name) for name in ("pos", "v", "force"))
    system = nocl.System("car", x=ca.vertcat(pos, v), u=force, xdot=ca.vertcat(v, force), lbu=[-3], ubu=[3],
                         lbx=[-5, -5], ubx=[5, 5])
    good = {"horizon": 2.0, "running": 0.1 * force**2 + pos**2, "terminal": pos**2 + v**2, "x_goal": [0, 0],
            "u_goal": [0], "initial_states": nocl.Uniform([0.9, -0.1], [1.1, 0.1]),
            "constraints": {"power": (-0.5, force * v, 0.5)}}
    return nocl.OCP(system, **{**good, **changed})


def test_margins_hold_rows_of_the_control_whose_end_no_node_bounds():
    """Within an interval force * v moves on while the force is held; at the next node another force acts."""
    ocp, x0 = car(), [[1.0, -0.5], [0.9, -0.4]]
    plain, held = (DDP(ocp, intervals=40, substeps=1, threads=1, between=between).solve(x0)
                   for between in (False, True))
    by_nmpc = NMPC(ocp, 40, substeps=1, starts=2, passes=0, between=True).solve(x0, workers=1, progress=False)
    assert not nocl.simulate(ocp, plain.u, x0).success.any()
    for s in (held, by_nmpc):
        assert s.success.all()
        assert not s.cut.any()
        assert nocl.simulate(ocp, s.u, x0).violation.max() < 1e-3
    np.testing.assert_allclose(by_nmpc.cost, held.cost, rtol=1e-6)
    at_rest = DDP(ocp, intervals=20, substeps=1, threads=1, between=True).solve([[1.0, 0.0]])
    assert at_rest.cut.tolist() == [True]  # force * 0 at the first node, whatever the force
    assert "it may cut corners" in at_rest.message[0]


def test_dips_see_what_the_plans_steps_see():
    """A servo whose position swings about 50 times a second, with a bound on it, on 20 intervals of 32 substeps."""
    q, v, u = (ca.SX.sym(name) for name in ("q", "v", "u"))
    system = nocl.System("servo", x=ca.vertcat(q, v), u=u, xdot=ca.vertcat(v, 300**2 * (u - q) - 300 * v), lbu=[-2],
                         ubu=[2], lbx=[-2, -400], ubx=[2, 400])
    ocp = nocl.OCP(system, horizon=1.0, running=(q - 1)**2 + 0.01 * u**2, terminal=0.0, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([-0.1, 0], [0.1, 0]), state_bounds={"q": (None, 0.8)})
    found = DDP(ocp, intervals=20, substeps=32, threads=1, between=True).solve([[0.0, 0.0]])
    assert found.cut.tolist() == [False]
    assert nocl.simulate(ocp, found.u, [0.0, 0.0]).violation[0] < 0.01


def test_known_solutions_that_cut_corners_are_seen_as_such():
    of = problem("point")
    x0 = [[-2.5, 0.2, 0.0, 0.0], [-2.2, -0.1, 0.1, 0.0]]
    plain = solver(of, 20).solve(x0)
    found = solve_globally(solver(of, 20), x0, starts=1, rounds=1, known=plain)
    assert found.cut.tolist() == [False, False]
    assert deepest(of, found) < 0.02 * deepest(of, plain)
    assert (found.cost > plain.cost).all()
    assert (found.cost <= np.nanmin(np.where(np.isfinite(found.tried), found.tried, np.nan), axis=1) + 1e-12).all()


def test_no_problem_at_all_is_no_problem():
    assert len(DDP(car(), intervals=20, between=True).solve(np.zeros((0, 2)))) == 0


def test_a_global_search_holds_them_between_nodes_unless_told_otherwise():
    of = problem("point")
    x0 = [[-2.5, 0.2, 0.0, 0.0], [-2.2, -0.1, 0.1, 0.0]]
    found = [solve_globally(solver(of, 20, **said), x0, starts=2, rounds=0) for said in ({}, {"between": False})]
    assert deepest(of, found[0]) < 0.02 * deepest(of, found[1])
    assert found[0].cut.tolist() == [False, False]
    assert found[1].cut is None


def corridor(width: float) -> nocl.OCP:
    """A corridor that swings out by 0.1 between all nodes of a grid of 20: too narrow, nothing stays in it there."""
    x, u, t = ca.SX.sym("x"), ca.SX.sym("u"), nocl.time()
    system = nocl.System("walker", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    return nocl.OCP(system, horizon=1.0, running=1 + u**2 + x**2, terminal=0.0, x_goal=[0], u_goal=[0],
                    initial_states=nocl.Uniform([-0.001], [0.001]), scales={"corridor": 1.0},
                    constraints={"corridor": (-width, x - 0.1 * ca.sin(20 * ca.pi * t), width)})


def test_what_cuts_corners_is_told_and_loses_to_what_does_not():
    narrow, wide = (DDP(corridor(w), intervals=20, substeps=1, threads=1, between=True).solve([[0.0]])
                    for w in (0.02, 0.3))
    assert narrow.success.all()
    assert "it may cut corners" in narrow.message[0]
    assert (narrow.cut.tolist(), wide.cut.tolist()) == ([True], [False])
    assert "corners" not in wide.message[0]
    dear = replace(wide, cost=narrow.cost + 1)
    for a, b in ((narrow, dear), (dear, narrow)):
        assert not better(a, b).cut.any()
        assert better(a, b).cost == dear.cost
    none = replace(dear, cost=np.array([np.inf]), success=np.array([False]))
    for a, b in ((narrow, none), (none, narrow)):
        assert better(a, b).cost == narrow.cost
    assert Solution.join([narrow, wide]).cut.tolist() == [True, False]


# What cannot be held


def test_infeasible_starts_are_told_from_others():
    """From 0.3 m at 2.2 m/s braking takes 1.21 m, the wall is 0.5 m away; 0.9 m is behind it."""
    ddp, K = DDP(mass(), intervals=40, substeps=1, threads=1), 40
    good = np.array([[0.0, 1.0], [-0.5, 1.2], [0.3, 0.5]])
    s = ddp.solve(np.insert(good, [1, 2], [[0.3, 2.2], [0.9, 0.0]], axis=0))
    alone = ddp.solve(good)
    assert s.success.tolist() == [True, False, True, False, True]
    assert np.isinf(s.cost[[1, 3]]).all()
    said = re.fullmatch(r"infeasible: no plan holds 'wall' from here, worst at node (\d+) by ([\d.]+)", s.message[1])
    node, amount = int(said[1]), float(said[2])
    assert 0 < node <= K
    assert amount == pytest.approx(s.x[1, node, 0] - 0.8, rel=1e-2)
    assert 0.4 < amount < 0.8
    assert s.iterations[1] < 80
    assert s.message[3] == "infeasible: the initial state itself violates 'wall', worst at node 0 by 0.1: move it"
    assert s.iterations[3] == 0
    for field in FIELDS:
        assert np.array_equal(getattr(s, field)[[0, 2, 4]], getattr(alone, field)), field


def test_what_cannot_be_held_is_told_with_its_parameters():
    wall, system = nocl.parameter("wall", 0.8), mass().system
    ocp = nocl.OCP(system, p=wall, horizon=2.0, running=ca.sumsqr(system.u), terminal=ca.sumsqr(system.x),
                   x_goal=[0, 0], u_goal=[0], initial_states=nocl.Gaussian([0, 0], [0.1, 0.1]),
                   parameters=nocl.Uniform([0.5], [1.0]), constraints={"wall": wall - system.x[0]})
    s = DDP(ocp, intervals=20, substeps=1, threads=1).solve([[0.3, 2.2], [0.9, 0], [0, 0.1]], p=[[0.6], [0.7], [0.6]])
    assert s.success.tolist() == [False, False, True]
    assert "no plan holds 'wall' from here at wall = 0.6, worst at node" in s.message[0]
    assert "the initial state itself violates 'wall' at wall = 0.7, worst" in s.message[1]


def test_soft_constraints_are_the_penalty_as_before():
    ocp, x0 = mass(), [[0.3, 2.2], [0.0, 1.0]]
    soft = replace(ocp, running=ocp.functions.soft, path_constraints={})
    a, b = (DDP(o, intervals=20, substeps=1, constraints="soft", threads=1).solve(x0) for o in (ocp, soft))
    assert a.success.all()
    for field in FIELDS:
        assert np.array_equal(getattr(a, field), getattr(b, field)), field


def test_elastic_is_hard_where_that_is_possible():
    ocp = mass()
    x0 = np.array([[0.0, 1.0], [-0.5, 1.2], [0.3, 0.5]])
    hard, elastic = (DDP(ocp, intervals=20, substeps=1, constraints=c, threads=1) for c in ("hard", "elastic"))
    a, b = hard.solve(x0), elastic.solve(x0)
    np.testing.assert_allclose(a.cost, b.cost, rtol=1e-9)
    assert (b.message == "converged").all()
    s = elastic.solve([[0.3, 2.2], [0.9, 0.0]])
    assert s.success.all()
    assert "'wall' is left, worst at node" in s.message[0]
    assert (s.clearance < -0.05).all()


def test_elastic_answer_minimises_the_cost_and_the_price_of_violations():
    """IPOPT with a slack for each row, each at that price."""
    ocp, K = mass(), 20
    s = DDP(ocp, intervals=K, substeps=1, constraints="elastic", threads=1).solve([0.3, 2.2])
    program = Shooting(Problem(ocp, []), K)
    price, slack = augmented.PRICE * usual_sizes(ocp).cost / K, ca.MX.sym("slack", K)
    c = ca.vertcat(*((0.8 - program.parts(program.z, k)[1][0]) / ocp.constraint_scales[0] for k in range(K)))
    nlp = {"x": ca.vertcat(program.z, slack), "p": ca.vertcat(program.x0, program.h),
           "f": program.cost + price * ca.sum1(slack), "g": ca.vertcat(program.g, c + slack)}
    low, high = program.bounds
    over = np.maximum((s.x[0, 1:, 0] - 0.8) / ocp.constraint_scales[0], 0)
    got = ca.nlpsol("elastic", "ipopt", nlp, TIGHT)(
        x0=np.r_[np.c_[s.u[0], s.x[0, 1:]].ravel(), over + 0.1], p=[0.3, 2.2, 2.0 / K], lbx=np.r_[low, np.zeros(K)],
        ubx=np.r_[high, np.full(K, np.inf)], lbg=0, ubg=np.r_[program.upper, np.full(K, np.inf)])
    assert s.success[0]
    assert over.max() > 0.1
    assert abs(s.cost[0] / float(got["f"]) - 1) < 1e-8
    np.testing.assert_allclose(got["x"].full().ravel()[:2 * K + K].reshape(K, 3)[:, 1:], s.x[0, 1:], atol=1e-6)


# The kernel


def test_rows_are_the_problems_own():
    rows = rows_of(mass(wall=7.0))
    assert rows.stage.names == rows.end.names == ("wall",)
    assert not rows.stage.equal.any()
    assert rows.count(20) == 21
    assert rows.names(20, 20) == ("wall", 20, rows.end.scales[0])
    assert rows.names(3, 20)[1] == 3
    with pytest.raises(ValueError, match="a block of 1 rows has"):
        Block(ca.SX(1, 1), np.zeros(2, dtype=bool), ("a",), np.ones(1))
    with pytest.raises(ValueError, match="cannot go to another process"):
        pickle.dumps(solver(problem("cartpole"), 30))
    again = pickle.loads(pickle.dumps(DDP(mass(), intervals=20, constraints="elastic", between=True)))
    assert (again.constraints, again.between, again.held) == ("elastic", True, 21)


@pytest.mark.parametrize(("mu", "bend"), [(0.0, 1.0), (3.0, 0.0), (3.0, 1.0)])
@pytest.mark.parametrize("name", ["point", "planes"])
def test_numpy_computes_what_the_kernel_does(name, mu, bend):
    of = random_half_planes() if name == "planes" else problem(name)
    ocp, K, B, rng = of.ocp, 8, 5, np.random.default_rng(4)
    s, results = ocp.system, []
    u, p = rng.uniform(s.lbu, s.ubu, (B, K, s.nu)), ocp.sample_parameters(B, 0)
    rows = of.rows.count(K)
    y, margin = rng.uniform(0, 1, (B, rows)) * (rng.random((B, rows)) < 0.5), rng.uniform(0, 0.1, (B, rows))
    for slow in (False, True):
        d = solver(of, K)
        if slow:
            d.kernel = NumpyKernel(ocp, None, 1, of.rows)
        work = augmented.Augmented(d, ocp.initial_states.sample(B, 0), np.zeros(B), u, None, None, p)
        work.mu[:], work.y[:], work.margin = mu, y, margin
        work.penalty[:, :4] = np.array([[3.0, np.inf, 0, np.inf], [50, np.inf, 0, np.inf], [3, 0.4, 0, 0.7],
                                        [3, 0.4, 1e3, 0.2], [9, np.inf, 1e6, np.inf]])
        work.penalty[:, 4] = bend
        V, V_x, V_xx = np.zeros((B, K + 1)), np.zeros((B, K + 1, s.nx)), np.zeros((B, K + 1, s.nx, s.nx))
        V_p = np.zeros((B, ocp.np)) if ocp.np else None
        work.backward(np.arange(B), V, V_x, V_xx, V_p)
        work.alpha[:] = 0.25
        work.rollout(np.arange(B), work.x, work.u, work.gain)
        work._take(np.arange(B))
        first = [work.J.copy(), work.parts.copy()]
        work._next_round(np.arange(B), np.arange(B) % 2 == 0)
        results.append([V, V_x, V_xx, work.k, work.gain, work.slope, work.curve, work.positive, work.c, *first, work.y,
                        work.penalty, work.J, work.parts, *([V_p] if ocp.np and bend else [])])
    sound = results[0][7] > 0
    assert sound.any()
    assert np.array_equal(results[0][7], results[1][7])
    for a, b in zip(*results, strict=True):
        finite = np.where(np.isfinite(a[sound]), a[sound], 0.0)
        np.testing.assert_allclose(a[sound], b[sound], rtol=1e-8, atol=1e-9 * np.abs(finite).max())


def test_problems_without_constraints_have_the_kernel_they_had():
    free, ocp = nocl.load_ocp("pendulum"), nocl.load_ocp("dubins")
    assert not DDP(free, intervals=4, substeps=1).held
    assert "#define NC" not in ddp_source(free)
    assert "#define NC" not in ddp_source(ocp)  # as training has it: softly
    assert "#define NC 1\n#define NT 1\n" in ddp_source(ocp, rows=rows_of(ocp))


def test_every_kind_of_constraint_as_nmpc_holds_it():
    """Two-sided, of the control, a state's bound, in time, with a parameter, and equations at the end."""
    p, v, u, wall = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u"), nocl.parameter("wall", 1.3)
    cart = nocl.System("cart", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u - 0.1 * v), lbu=[-3], ubu=[3],
                       lbx=[-5, -5], ubx=[5, 5])
    ocp = nocl.OCP(cart, p=wall, horizon=2.0, running=0.1 * u**2 + 0.01 * p**2, terminal=0.0, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([0.6, -0.1], [1.0, 0.1]), parameters=nocl.Uniform([1.2], [1.6]),
                   constraints={"track": (-0.05, p, None), "wall": wall - p, "power": (None, u * v, 0.8),
                                "slower": 1.2 - 0.2 * nocl.time() + v},
                   state_bounds={"v": (-0.72, None)}, terminal_constraints={"at rest": (0, v, 0), "there": (0, p, 0)})
    x0, at = np.array([[1.0, 0.0], [0.8, 0.1], [0.7, -0.1]]), np.array([[1.3], [1.2], [1.5]])
    ddp = DDP(ocp, intervals=40).solve(x0, p=at)
    nmpc = NMPC(ocp, 40, substeps=1, starts=1, passes=0).solve(x0, p=at, workers=1)
    assert ddp.success.all()
    assert nmpc.success.all()
    np.testing.assert_allclose(ddp.cost, nmpc.cost, rtol=1e-7)
    np.testing.assert_allclose(ddp.x, nmpc.x, atol=1e-5)
    np.testing.assert_allclose(ddp.V_x[:, 0], nmpc.costate[:, 0], rtol=1e-4, atol=1e-5)
    assert np.abs(ddp.x[:, -1]).max() < 1e-8
    assert (ddp.x[:, :, 1].min(axis=1) < -0.72 + 1e-6).any()  # it is active


def test_what_bends_only_by_the_equations_is_damped_with_second_derivatives():
    """A Mayer problem: without second derivatives of f there are none, and the descent crawls."""
    ocp = nocl.load_ocp(Path(__file__).resolve().parents[1] / "examples" / "orbit_transfer.py")
    ddp = DDP(ocp, intervals=40, substeps=1)
    ddp.checked = True
    s = ddp.solve(ocp.initial_states.sample(4, np.random.default_rng(1)))
    assert s.success.all(), s.message
    assert s.iterations.max() < 200
    nmpc = NMPC(ocp, 40, substeps=1, passes=0).solve(s.x[:, 0], s, workers=1)
    np.testing.assert_allclose(s.cost, nmpc.cost, rtol=1e-7)
    np.testing.assert_allclose(s.V_x[:, 0], nmpc.costate[:, 0], rtol=1e-5, atol=1e-6)
