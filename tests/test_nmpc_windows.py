"""Short horizons with a terminal cost, learned dynamics, closed loops: shrinking and receding."""

import casadi as ca
import numpy as np
import pytest
from lq import rk4_lq
from test_nmpc import walled

import nocl
from nocl.judge import simulate
from nocl.solvers import NMPC


def lq_value(N):
    """The double integrator's discrete value function as a casadi.Function at each node's time: (x, t) -> V."""
    P = rk4_lq(2.0 / N, N)[3]
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    S = sum(ca.if_else(ca.fabs(t - 2.0 * k / N) < 1e-6, ca.DM(P[k]), 0) for k in range(N + 1))
    return ca.Function("V", [x, t], [ca.bilin(S, x, x) / 2])


def test_a_short_horizon_with_the_value_function_is_the_whole_problem():
    """Bellman: the first 6 of 20 intervals with V(x, t_6) as terminal cost have the same optimum, at any start time."""
    ocp, N, n = nocl.load_ocp("double_integrator"), 20, 6
    x0 = ocp.initial_states.sample(2, 0)
    whole = NMPC(ocp, N, starts=1).solve(x0)
    short = NMPC(ocp, n, horizon=0.6, terminal=lq_value(N), starts=1)
    part = short.solve(x0)
    assert part.t == pytest.approx(whole.t[:, : n + 1])
    assert part.cost == pytest.approx(whole.cost, abs=1e-9)
    assert part.u == pytest.approx(whole.u[:, :n], abs=1e-6)
    assert part.costate == pytest.approx(whole.costate[:, : n + 1], abs=1e-7)
    tail = short.solve(whole.x[:, 10], t0=1.0)
    assert tail.t[:, -1] == pytest.approx(1.6)
    assert tail.u == pytest.approx(whole.u[:, 10:16], abs=1e-6)
    gain = short.solve(x0, gains=True).gain
    assert gain[0] == pytest.approx(-np.array(rk4_lq(2.0 / N, N)[2][:n]), abs=1e-7)


def test_a_terminal_cost_without_time_and_one_of_a_value_function_object():
    ocp = nocl.load_ocp("double_integrator")
    x = ca.SX.sym("x", 2)
    G = ca.Function("G", [x], [ca.sumsqr(x)])

    class Value:
        def value_to_casadi(self):
            return ca.Function("V", [x, ca.SX.sym("t")], [ca.sumsqr(x)])

    costs = [NMPC(ocp, 10, terminal=g, starts=1).solve([1.0, 0.3]).cost[0] for g in (None, G, Value())]
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-9)


def test_a_trained_value_function_as_terminal_cost():
    """A network as MX: the costate at the window's end is its gradient, for both solvers."""
    torch = pytest.importorskip("torch")
    from nocl.exports.casadi_forms import to_casadi

    ocp = nocl.load_ocp("pendulum")
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(2, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1)).double()
    inner = to_casadi(net, n_in=2)
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    V = ca.Function("value", [x, t], [ca.sumsqr(x) + inner(x)])
    x0 = ocp.initial_states.sample(1, 0)
    solutions = [NMPC(ocp, 15, horizon=0.6, terminal=V, starts=3, passes=0, solver=s).solve(x0)
                 for s in ("fatrop", "ipopt")]
    gradient = ca.Function("dV", [x, t], [ca.gradient(V(x, t), x)])
    for solution in solutions:
        assert solution.success.all()
        assert solution.costate[0, -1] == pytest.approx(gradient(solution.x[0, -1], 0.6).full().ravel(), abs=1e-7)
    assert solutions[0].cost == pytest.approx(solutions[1].cost, rel=1e-7)


def test_identified_dynamics():
    """A model by nocl.identify: its optimum costs on the exact plant what the exact one costs, up to its error."""
    ocp = nocl.load_ocp("pendulum")
    model = nocl.identify(ocp.system, seed=0, progress=False)
    x0 = ocp.initial_states.sample(2, 0)
    exact = NMPC(ocp, 30, starts=4).solve(x0)
    learned = NMPC(ocp, 30, dynamics=model, starts=4).solve(x0, exact, gains=True)
    assert learned.success.all()
    assert np.isfinite(learned.gain).all()
    assert simulate(ocp, learned.u, x0).cost == pytest.approx(exact.cost, rel=0.05)
    u = learned(learned.t[0, 3])[1]
    assert (u == learned.u[:, 3]).all()


def test_soft_constraints_are_l_soft_of_the_ocp():
    """The same program as one whose running cost is L_soft and that has no path constraint."""
    ocp = walled(-0.1)
    p, v = ca.vertsplit(ocp.system.x)
    plain = nocl.OCP(ocp.system, horizon=2.0, running=ocp.L_soft(ocp.system.x, ocp.system.u), terminal=p**2 + v**2,
                     x_goal=[0.0, 0.0], u_goal=[0.0], initial_states=ocp.initial_states)
    x0 = [1.0, -2.6]
    soft, other = NMPC(ocp, 30, constraints="soft", starts=2).solve(x0), NMPC(plain, 30, starts=2).solve(x0)
    assert soft.cost == pytest.approx(other.cost, rel=1e-10)
    assert soft.u == pytest.approx(other.u, abs=1e-7)


def test_receding_horizon_on_a_linear_quadratic_problem():
    """The same feedback at each time: u = -K_0 x of the window's own Riccati recursion."""
    ocp, N = nocl.load_ocp("double_integrator"), 10
    loop = NMPC(ocp, N, horizon=1.0, starts=1).controller(hold=20, receding=True)
    K = rk4_lq(0.1, N)[2][0]
    for t, x in ((0.0, [1.0, 0.2]), (0.1, [0.9, -0.4]), (1.7, [0.1, 0.3])):
        assert loop(x, t) == pytest.approx(-K @ x, abs=1e-6)
    assert [step["t"] for step in loop.stats] == [0.0, 0.1, 1.7]
    assert loop.failures == 0
    assert all((step["source"] == "solved").all() for step in loop.stats)


def test_warm_starts_save_iterations_and_a_new_state_starts_afresh():
    ocp = nocl.load_ocp("cartpole")
    nmpc, x0 = NMPC(ocp, 30, starts=2), ocp.initial_states.sample(2, 0)
    loop = nmpc.controller()
    loop(x0[0], 0.0)
    x = nmpc.solve(x0[0]).x[0, 1]
    loop(x, 4 / 30)
    cold, warm = (step["iterations"][0] for step in loop.stats)
    assert warm < cold / 2
    loop(x0[1], 4 / 30)  # the same time, another state: nothing of the last plan is used
    assert len(loop.stats) == 1


def test_a_failed_step_holds_the_last_plan_and_is_flagged():
    """Out of iterations: the plan stays, shifted; success False, the source and the count of failures say so."""
    ocp = nocl.load_ocp("pendulum")
    good = NMPC(ocp, 20, starts=4)
    loop = good.controller()
    x0 = ocp.initial_states.sample(1, 0)[0]
    loop(x0, 0.0)
    plan = loop.plan
    loop.nmpc = NMPC(ocp, 20, starts=1, options={"fatrop.max_iter": 1})
    u = loop(plan.x[0, 3] + 0.3, plan.t[0, 3])
    assert u == pytest.approx(plan.u[0, 3])
    assert loop.stats[-1]["source"].tolist() == ["last plan"]
    assert "limit of iterations" in loop.stats[-1]["message"][0]
    assert loop.failures == 1


def test_a_state_outside_the_box_is_solved_and_noted():
    ocp = nocl.load_ocp("double_integrator")
    solution = NMPC(ocp, 10, starts=1).solve([[5.0, 0.0], [1.0, 0.0]])
    assert solution.success.all()
    assert "p = 5 outside [-3, 3]" in solution.message[0]
    assert "outside" not in solution.message[1]


@pytest.mark.parametrize(("options", "words"), [
    ({"horizon": 3.0}, "at most 2"), ({"horizon": 0.0}, "horizon is 0"), ({"terminal": 3}, "terminal is a int"),
    ({"terminal": ca.Function("V", [ca.SX.sym("x", 3)], [1])}, r"vectors of length \[3\]"),
])
def test_bad_windows(options, words):
    with pytest.raises(ValueError, match=words):
        NMPC(nocl.load_ocp("double_integrator"), 10, **options)


def test_a_bad_hold_is_refused():
    with pytest.raises(ValueError, match="hold, how many controls the horizon has, is 0"):
        NMPC(nocl.load_ocp("double_integrator"), 10).controller(hold=0)


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
def test_a_solution_nearby_is_a_warm_start(solver):
    """A Solution as a guess takes fewer iterations than its arrays, which are taken for any guess; same optimum.

    So near, 0.6 times as many: Newton's steps converge at once, and a cold start brings its barrier down first.
    """
    ocp = nocl.load_ocp("acrobot")
    nmpc, x0 = NMPC(ocp, 30, starts=2, passes=0, solver=solver), ocp.initial_states.sample(4, 0)
    solution = nmpc.solve(x0)
    warm, cold = nmpc.solve(x0 + 1e-3, solution), nmpc.solve(x0 + 1e-3, (solution.x, solution.u))
    assert warm.cost == pytest.approx(cold.cost, rel=1e-7)
    assert warm.u == pytest.approx(cold.u, abs=1e-3)
    assert warm.iterations.sum() < cold.iterations.sum()


def test_a_controller_as_a_start():
    """LQR and a policy's rollout are starts like others; one that fails gives way without an error."""
    ocp = nocl.load_ocp("pendulum")
    nmpc, x0 = NMPC(ocp, 30), ocp.initial_states.sample(2, 0)
    best = nmpc.solve(x0)

    def pump(x, t):
        return np.clip(5 * np.sign(x[..., 1:2] + 1e-9) * np.where(np.cos(x[..., :1]) < 0.7, 1, -1), -5, 5)

    from nocl.solvers import LQR
    for controllers in (pump, [LQR(ocp), pump, lambda x, t: np.array([np.nan])]):
        found = nmpc.solve(x0, controllers, starts=8)
        assert found.cost == pytest.approx(best.cost, rel=1e-6)
    assert (nmpc.solve(x0, [pump, LQR(ocp)]).starts == 2).all()


def test_distinct_optima_are_listed():
    """Cart-pole from hanging swings up in several ways: costs rise, the best first, starts add up."""
    ocp = nocl.load_ocp("cartpole")
    x0 = np.random.default_rng(0).uniform(-1, 1, (3, 4)) * [2.0, 3.0, np.pi, 5.0]
    solution = NMPC(ocp, 40, starts=8).solve(x0)
    for i, optima in enumerate(solution.optima):
        assert optima[0, 0] == solution.cost[i]
        assert (np.diff(optima[:, 0]) > 1e-3 * optima[1:, 0]).all()
        assert optima[0, 1] == solution.hits[i]
        assert optima[:, 1].sum() <= solution.starts[i]
    assert max(len(optima) for optima in solution.optima) > 1


def test_mirror_images_and_sides():
    """Dubins is its own mirror image at py = 0: found, used, and a start passes the obstacle on either side."""
    from nocl.solvers.mirrors import mirrors
    from nocl.solvers.nmpc import guesses

    ocp = nocl.load_ocp("dubins")
    assert [(x.tolist(), u.tolist()) for x, u in mirrors(ocp)] == [([1, -1, -1], [1, -1])]
    assert len(mirrors(nocl.load_ocp("cartpole"))) == 1
    shifted = ca.Function("f", [ocp.system.x, ocp.system.u], [ocp.system.f(ocp.system.x, ocp.system.u) + 0.1])
    assert not mirrors(ocp, shifted)  # those of the dynamics that are solved with, not of the exact ones
    assert {tuple(x[:3]) for x, _ in mirrors(nocl.load_ocp("quadrotor"))} == {
        (-1, 1, 1), (1, -1, 1), (-1, -1, 1)}  # not up and down: there is gravity
    assert not any((x < 0).any() for x, _ in mirrors(walled()))  # the wall stands on one side
    lines = guesses.sides(ocp, np.array([-3.0, 0.0, 0.3]), 40)
    assert sorted(np.sign(line[20, 1]) for line in lines) == [-1, 1]
    assert all(ocp.h(line.T).full().min() >= 0 for line in lines)
    assert guesses.sides(ocp, np.array([-3.0, 3.0, 0.0]), 40) == []
    x0 = np.array([[-3.0, 0.7, 0.4], [-3.0, -0.7, -0.4]])
    images = NMPC(ocp, 40, starts=3).solve(x0)
    assert images.cost[0] == pytest.approx(images.cost[1], rel=1e-6)


@pytest.mark.slow
def test_a_closed_loop_is_a_method_of_compare():
    """Beside open loop: the same cost on the exact plant, and no failed step."""
    from nocl.comparisons import compare

    ocp = nocl.load_ocp("pendulum")
    nmpc = NMPC(ocp, 40, starts=4)
    loop = nmpc.controller()
    report = compare(ocp, {"open": nmpc, "closed": loop}, n=3, hold=40, progress=False)
    costs = [[row["cost"] for row in report.rows() if row["method"].startswith(name)] for name in ("open", "closed")]
    assert costs[1] == pytest.approx(costs[0], rel=5e-3)
    assert loop.failures == 0
