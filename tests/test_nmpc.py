"""NMPC against the discrete Riccati recursion, finite differences of re-solved problems, IPOPT, and the judge."""

import pickle

import casadi as ca
import numpy as np
import pytest
from lq import rk4_lq

import nocl
from nocl.data import Trajectory
from nocl.judge import simulate
from nocl.solvers import DDP, NMPC
from nocl.solvers.ddp.global_search import solve_globally

BOX = [2.0, 3.0, np.pi, 5.0]  # cart-pole states from which one start often misses


def walled(wall=-0.5, u_max=10.0):
    """Double integrator that must stay at p >= wall."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("walled", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-u_max], ubu=[u_max],
                         lbx=[-3.0, -3.0], ubx=[3.0, 3.0])
    return nocl.OCP(system, horizon=2.0, running=0.01 * u**2, terminal=p**2 + v**2, x_goal=[0.0, 0.0], u_goal=[0.0],
                    initial_states=nocl.Gaussian([1.0, 0.0], [0.2, 0.2]), path_constraints={"wall": p - wall})


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
def test_linear_quadratic_equals_riccati(solver):
    ocp, N = nocl.load_ocp("double_integrator"), 20
    x0 = ocp.initial_states.sample(4, 0)
    solution = NMPC(ocp, N, solver=solver, starts=1).solve(x0)
    A, B, gains, P = rk4_lq(ocp.horizon / N, N)
    x = x0
    assert solution.cost == pytest.approx(np.einsum("bi,ij,bj->b", x, P[0], x) / 2, abs=1e-8)
    for k in range(N):
        assert solution.x[:, k] == pytest.approx(x, abs=1e-8)
        assert solution.costate[:, k] == pytest.approx(x @ P[k], abs=1e-8)
        u = -x @ gains[k].T
        assert solution.u[:, k] == pytest.approx(u, abs=1e-7)
        x = x @ A.T + u @ B.T
    assert solution.costate[:, N] == pytest.approx(2 * x, abs=1e-8)
    assert solution.success.all()
    assert solution.t == pytest.approx(np.tile(np.linspace(0, ocp.horizon, N + 1), (4, 1)))


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "dubins"])
def test_costate_is_the_gradient_of_the_optimal_cost(name):
    """lambda_0 = dJ*/dx0 by central differences of problems solved again; likewise at a later node."""
    ocp = nocl.load_ocp(name)
    nmpc, x0 = NMPC(ocp, 30, starts=1, solver="ipopt"), ocp.initial_states.sample(3, 0)[2:]
    best = nmpc.solve(x0)
    assert best.success.all()
    step = 1e-4
    for k in (0, 12):
        tail = nmpc if k == 0 else NMPC(ocp, 30 - k, starts=1, solver="ipopt")
        nodes = best.t[0, k:]
        around = best.x[:, k] + step * np.vstack([np.eye(ocp.system.nx), -np.eye(ocp.system.nx)])
        guess = tuple(np.repeat(v[:, k:], len(around), axis=0) for v in (best.x, best.u))
        cost = tail.solve(around, guess, nodes=nodes).cost.reshape(2, -1)
        assert best.costate[0, k] == pytest.approx((cost[0] - cost[1]) / (2 * step), abs=2e-5)


def test_stationarity_of_a_free_control():
    """d/du (interval's cost + lambda_{k+1}' x_{k+1}) = 0 where U is not active."""
    ocp = nocl.load_ocp("cartpole")
    nmpc = NMPC(ocp, 40, starts=1)
    solution = nmpc.solve(ocp.initial_states.sample(1, 0))
    x, u, costate = solution.x[0], solution.u[0], solution.costate[0]
    step = nmpc.program.step
    adjoint = ca.Function("adjoint", step.sx_in(), [ca.gradient(step(*step.sx_in())[1] + ca.dot(
        step(*step.sx_in())[0], ca.SX(ca.DM(costate[8]))), step.sx_in()[1])])
    assert np.abs(u[7]) < 2.9
    assert float(adjoint(x[7], u[7], 0.1)) == pytest.approx(0.0, abs=1e-8)


def test_fatrop_and_ipopt_agree():
    ocp = nocl.load_ocp("dubins")
    x0 = ocp.initial_states.sample(4, 2)
    fast = NMPC(ocp, 40, solver="fatrop", starts=3, passes=0).solve(x0)
    reference = NMPC(ocp, 40, solver="ipopt").solve(x0, fast)
    same = np.abs(fast.cost / reference.cost - 1) < 1e-3  # interior points may leave an optimum that they begin at
    assert same.any()
    assert fast.cost[same] == pytest.approx(reference.cost[same], rel=1e-6)
    assert fast.x[same] == pytest.approx(reference.x[same], abs=1e-4)
    assert fast.costate[same] == pytest.approx(reference.costate[same], abs=1e-4)


def test_the_known_optimum_and_the_judge():
    """Cart-pole's known mean optimum (of all states: these are four); the exact plant under the same held controls
    costs the same."""
    ocp = nocl.load_ocp("cartpole")
    x0 = ocp.initial_states.sample(4, 0)
    solution = NMPC(ocp, starts=2).solve(x0)
    assert solution.cost == pytest.approx(solve_globally(DDP(ocp), x0, seed=0).cost, rel=1e-5)
    assert solution.cost.mean() == pytest.approx(0.064, abs=0.006)
    assert simulate(ocp, solution.u, x0).cost == pytest.approx(solution.cost, rel=1e-4)
    assert np.linalg.norm(solution.x[:, -1], axis=1).mean() == pytest.approx(0.036, abs=0.006)


def test_several_starts_find_what_one_misses():
    ocp = nocl.load_ocp("cartpole")
    x0 = np.random.default_rng(0).uniform(-1, 1, (12, 4)) * BOX  # one start misses 4 to 8 of 12
    one, many = (NMPC(ocp, 40, starts=n, passes=0).solve(x0) for n in (1, 8))
    assert many.success.all()
    assert (many.cost <= one.cost + 1e-9).all()
    assert (many.cost < 0.9 * one.cost).any()
    assert (many.starts >= 8).all()  # one more where fatrop is given up
    assert ((many.hits >= 1) & (many.hits <= many.starts)).all()


@pytest.mark.slow
def test_neighbours_only_improve():
    ocp = nocl.load_ocp("dubins")
    x0 = ocp.initial_states.sample(24, 3)  # of which some are left in a worse optimum
    without, exchanged = (NMPC(ocp, 20, starts=1, passes=p).solve(x0) for p in (0, 3))
    assert (exchanged.cost <= without.cost + 1e-9).all()
    assert (exchanged.cost < 0.99 * without.cost).any()
    assert (exchanged.starts > without.starts).all()


def test_batch_equals_one_by_one_and_is_deterministic():
    ocp = nocl.load_ocp("acrobot")
    x0 = ocp.initial_states.sample(3, 0)
    nmpc = NMPC(ocp, 20, starts=4, passes=0)
    batch, again = nmpc.solve(x0), NMPC(ocp, 20, starts=4, passes=0).solve(x0)
    for i, x in enumerate(x0):
        single = nmpc.solve(x)
        for field in ("x", "u", "cost", "costate", "hits", "iterations"):
            assert (getattr(single, field)[0] == getattr(batch, field)[i]).all()
    assert (batch.u == again.u).all()


def test_hard_path_constraint():
    """From p = 1 at v = -2.6 the free optimum crosses p = -0.1; the wall holds at every node, and costs."""
    x0 = [1.0, -2.6]
    free, hard = NMPC(walled(-3.0), 30).solve(x0), NMPC(walled(-0.1), 30).solve(x0)
    assert free.x[0, :, 0].min() < -0.12
    assert hard.success.all()
    assert hard.x[0, :, 0].min() == pytest.approx(-0.1, abs=1e-6)
    assert hard.cost > free.cost


def test_soft_path_constraint_is_the_penalty():
    ocp = walled(-0.1)
    solution = NMPC(ocp, 30, constraints="soft").solve([1.0, -2.6])
    z, u = solution.x[0], solution.u[0]
    nmpc = NMPC(ocp, 30, constraints="soft")
    cost = sum(float(nmpc.program.step(z[k], u[k], 2.0 / 30)[1]) for k in range(30)) + float(ocp.G(z[-1]))
    assert solution.cost[0] == pytest.approx(cost, rel=1e-9)
    assert -0.1 < z[:, 0].min() < -0.1 + ocp.penalty_margin  # the penalty begins at the margin
    assert nmpc.program.n_path == 0


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
def test_an_infeasible_state_is_a_row_that_says_why(solver):
    """At v = -3 and |u| <= 0.1 nothing stops before the wall: its row fails, its neighbour does not."""
    solution = NMPC(walled(u_max=0.1), 15, solver=solver, starts=2).solve([[1.0, -3.0], [1.0, 0.0]])
    assert solution.success.tolist() == [False, True]
    assert solution.cost[0] == np.inf
    assert np.isnan(solution.x[0]).all()
    for words in ("no start of", "x0 = [ 1., -3.]", "at node", "t = ", "worst violation"):
        assert words in solution.message[0]


def test_out_of_iterations_is_told():
    solution = NMPC(walled(), 15, solver="ipopt", starts=1, options={"ipopt.max_iter": 1}).solve([1.0, -1.0])
    assert not solution.success[0]
    assert "limit of iterations" in solution.message[0]
    assert "feasible point" in solution.message[0]


def test_a_start_behind_the_wall_is_refused_with_its_distance():
    solution = NMPC(walled(), 15, starts=2).solve([[-0.7, 0.0], [1.0, 0.0]])
    assert solution.success.tolist() == [False, True]
    assert "'wall' is violated by 0.2 at node 0" in solution.message[0]
    assert solution.starts.tolist()[0] == 0


def test_learned_dynamics_as_mx():
    """MX dynamics equal to the exact ones give the same solution."""
    ocp = nocl.load_ocp("pendulum")
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u", 1)

    class Learned:
        def to_casadi(self):
            return ca.Function("f", [x, u], [ocp.system.f(x, u) + ca.DM([0, 0])])

    x0 = ocp.initial_states.sample(1, 0)
    exact, learned = (NMPC(ocp, 20, dynamics=f, starts=1).solve(x0) for f in (None, Learned()))
    assert learned.cost == pytest.approx(exact.cost, rel=1e-8)
    assert learned.costate == pytest.approx(exact.costate, abs=1e-6)


def test_guesses():
    ocp = nocl.load_ocp("cartpole")
    nmpc, x0 = NMPC(ocp, 20, passes=0), ocp.initial_states.sample(2, 0)
    first = nmpc.solve(x0)
    for guess in (first, Trajectory(first.t[0], first.x, first.u), first.u, (first.x, first.u), [first, first.u]):
        warm = nmpc.solve(x0, guess)
        assert warm.cost == pytest.approx(first.cost, rel=1e-9)
        assert (warm.starts == (2 if isinstance(guess, list) else 1)).all()
        assert (warm.iterations < first.iterations).all()
    assert (nmpc.solve(x0, first, starts=3).starts == 4).all()


def test_tails_on_any_grid():
    """From a node of a solution on, the rest of it is optimal: same cost to go, same controls."""
    ocp = nocl.load_ocp("cartpole")
    whole = NMPC(ocp, 40, starts=2).solve(ocp.initial_states.sample(1, 0))
    tail = NMPC(ocp, 30, starts=1).solve(whole.x[:, 10], (whole.x[:, 10:], whole.u[:, 10:]), t0=1.0)
    assert tail.t == pytest.approx(whole.t[:, 10:])
    assert tail.u == pytest.approx(whole.u[:, 10:], abs=1e-6)
    assert tail.costate == pytest.approx(whole.costate[:, 10:], abs=1e-6)


def test_closed_loop_costs_what_open_loop_does():
    """On the exact plant without disturbance; after a kick, feedback beats the plan made before it."""
    ocp = nocl.load_ocp("cartpole")
    nmpc, x0 = NMPC(ocp, 40, starts=2), ocp.initial_states.sample(2, 0)
    plan, loop = nmpc.solve(x0), nmpc.controller()
    closed = simulate(ocp, loop, x0, hold=40)
    assert closed.cost == pytest.approx(plan.cost, rel=5e-3)
    assert len(loop.stats) == 40
    assert all(step["success"].all() for step in loop.stats)
    kicks = [(2.0, [0.0, 0.0, 0.1, 0.0])]
    assert (simulate(ocp, loop, x0, hold=40, kicks=kicks).cost < simulate(ocp, plan.u, x0, kicks=kicks).cost).all()
    assert loop(x0[0], 0.0).shape == (1,)


def test_a_failed_step_of_the_loop_is_flagged():
    loop = NMPC(walled(u_max=0.1), 15, starts=1).controller()
    x = np.array([[1.0, -3.0], [1.0, 0.0]])
    u = loop(x, 0.0)
    assert u[0] == 0.0  # u*, since there is no plan yet
    assert np.isfinite(loop(x, 0.5)).all()
    assert [step["success"].tolist() for step in loop.stats] == [[False, True]] * 2


def test_pickle_and_cache():
    ocp = nocl.load_ocp("double_integrator")
    nmpc, x0 = NMPC(ocp, 10, starts=1), [1.0, 0.2]
    assert NMPC(ocp, 10, starts=5).program.solver is nmpc.program.solver
    assert (pickle.loads(pickle.dumps(nmpc)).solve(x0).u == nmpc.solve(x0).u).all()


@pytest.mark.parametrize(("call", "words"), [
    (lambda n: n.solve(np.zeros((2, 3))), "nx = 2"),
    (lambda n: n.solve([np.nan, 0.0]), "finite"),
    (lambda n: n.solve([1.0, 0.0], np.zeros((3, 10, 1))), r"\[B, N, nu\]"),
    (lambda n: n.solve([1.0, 0.0], np.full((1, 10, 1), np.nan)), "not finite in row 0"),
    (lambda n: n.solve([1.0, 0.0], t0=2.0), "t0 is 2.0"),
    (lambda n: n.solve([1.0, 0.0], nodes=[0.0, 1.0]), "expected \\[11\\]"),
    (lambda n: n.solve([1.0, 0.0], starts=0), "starts is 0"),
    (lambda n: NMPC(n.ocp, 1), "intervals is 1"),
    (lambda n: NMPC(n.ocp, starts=0), "starts is 0"),
    (lambda n: NMPC(n.ocp, solver="snopt9"), "solver is 'snopt9'"),
    (lambda n: NMPC(n.ocp, constraints="none"), "constraints is 'none'"),
    (lambda n: NMPC(n.ocp, dynamics=3), "the dynamics are a int"),
    (lambda n: NMPC(n.ocp, 10, solver="ipopt", options={"ipopt.max_it": 3}).solve([1.0, 0.0]), "max_it"),
])
def test_bad_input(call, words):
    nmpc = NMPC(nocl.load_ocp("double_integrator"), 10)
    with pytest.raises(ValueError, match=words):
        call(nmpc)


def two_valleys():
    """The plane, x' = u, over a hill between start and goal, with ground that costs more on the right of it."""
    p, q, a, b = (ca.SX.sym(name) for name in "pqab")
    plane = nocl.System("plane", x=ca.vertcat(p, q), u=ca.vertcat(a, b), xdot=ca.vertcat(a, b), lbu=[-9, -9],
                        ubu=[9, 9], lbx=[-3, -3], ubx=[3, 3])
    ground = 3 * ca.exp(-4 * (p**2 + q**2)) + 1 / (1 + ca.exp(-20 * p))
    return nocl.OCP(plane, horizon=1.0, running=0.02 * (a**2 + b**2) + ground, terminal=20 * (p**2 + (q - 1) ** 2),
                    x_goal=[0, 1], u_goal=[0, 0], initial_states=nocl.Gaussian(mean=[0, -1], std=[0.3, 0.1]))


def test_a_region_that_shares_a_wrong_basin_is_told_by_states_from_afar():
    ocp = two_valleys()
    x0 = np.c_[np.r_[np.linspace(0.3, 0.5, 6), -0.5, -0.3], np.full(8, -1.0)]  # neighbours of the first six: each other
    alone = NMPC(ocp, 20, starts=1, passes=0).solve(x0, workers=1)
    ours = NMPC(ocp, 20, starts=1).solve(x0, workers=1)
    many = NMPC(ocp, 20, starts=40, passes=0).solve(x0[:2], workers=1)
    assert (alone.cost[:6] > 1.5 * ours.cost[:6]).all()
    np.testing.assert_allclose(ours.cost[:2], many.cost, rtol=1e-6)


def test_no_states_are_refused():
    with pytest.raises(ValueError, match=r"x0 has shape \(0, 2\); expected at least one state"):
        NMPC(two_valleys(), 20).solve(np.zeros((0, 2)))


def test_more_starts_never_end_higher_where_fatrop_is_stuck_from_all():
    """From this state fatrop converges from none, and IPOPT from the most feasible point alone ended at 29."""
    x0 = [1.86974381, 1.09838893, -0.68094126, -3.1274743]
    one, four = (NMPC(nocl.load_ocp("cartpole"), 40, starts=n, passes=0).solve(x0) for n in (1, 4))
    assert four.success.all()
    assert four.cost[0] <= one.cost[0] * (1 + 1e-6)
