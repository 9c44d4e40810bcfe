"""Controls that the Hamiltonian is linear in: bang-coast-bang against its formula, bang-bang and singular arcs against
IPOPT on the same nodes; costs and V are those of the problem itself."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_ddp import problem, random_model

import nocl
from nocl.solvers import DDP, NMPC
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.opinion import second_opinion
from nocl.solvers.ddp.smoothing import regularised, without_kinks

P, V, U = (ca.SX.sym(name) for name in ("pos", "v", "force"))
T, K = 4.0, 40


def cart(running, terminal=10 * (P**2 + V**2), **options):
    system = nocl.System("cart", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(V, U), lbu=[-1], ubu=[1], lbx=[-3, -3],
                         ubx=[3, 3])
    return nocl.OCP(system, **{"horizon": T, "running": running, "terminal": terminal, "x_goal": [0, 0], "u_goal": [0],
                               "initial_states": nocl.Uniform([0.8, 0], [1.2, 0]), **options})


def costs_of(ocp, s):
    """[B], the plans rolled out by RK4 under the problem's own L, restated in numpy for the double integrator."""
    L = ca.Function("L", [ocp.system.x, ocp.system.u], [ocp.running])
    G = ca.Function("G", [ocp.system.x], [ocp.terminal])
    found = []
    for x, u in zip(s.x[:, 0], s.u, strict=True):
        h, total = T / K, 0.0
        for (uk,) in u:
            ends = [x + np.array([s_ * x[1] + s_**2 / 2 * uk, s_ * uk]) for s_ in (0.0, h / 2, h)]
            total += h / 6 * sum(w * float(L(end, uk)) for w, end in zip((1, 4, 1), ends, strict=True))
            x = ends[-1]
        found.append(total + float(G(x)))
    return np.array(found)


@pytest.mark.parametrize("running", [P**2 + V**2, P**2 + 0.3 * U, (1 + P**2) * U], ids=["none", "linear", "product"])
def test_bang_bang_and_singular_arcs_cost_what_ipopt_finds(running):
    """IPOPT solves the problem itself, on the same nodes."""
    ocp = cart(running)
    x0 = ocp.initial_states.sample(2, 0)
    ours = DDP(ocp, intervals=K).solve(x0)
    best = NMPC(ocp, K, solver="ipopt", starts=2, passes=0, substeps=1).solve(x0, ours, starts=2, workers=1)
    assert ours.success.all()
    assert best.success.all()
    assert (ours.cost - best.cost <= 1e-3 * np.abs(best.cost)).all()
    assert (ours.cost >= best.cost - 1e-6 * np.abs(best.cost)).all()
    assert ours.p is None
    np.testing.assert_allclose(ours.cost, costs_of(ocp, ours), rtol=1e-5)
    np.testing.assert_allclose(ours.V[:, 0], ours.cost, rtol=1e-9)
    np.testing.assert_allclose(ours.V[:, -1], ocp.G(ours.x[:, -1].T).full()[0], rtol=1e-9, atol=1e-12)


@pytest.mark.filterwarnings("ignore:.*has a kink")
def test_least_fuel_is_bang_coast_bang():
    """From rest at p0 to rest at 0 in T: |u| = 1 for tau at both ends, tau (T - tau) = p0, and it costs 2 tau."""
    ocp = cart(ca.fabs(U), 0 * P, terminal_constraints={"there": (0, P, 0), "at rest": (0, V, 0)})
    x0 = np.array([[1.0, 0.0]])
    s = DDP(ocp, intervals=K).solve(x0)
    tau = (T - np.sqrt(T**2 - 4 * x0[:, 0])) / 2
    assert s.success.all()
    np.testing.assert_allclose(s.cost, 2 * tau, rtol=1e-2)  # no switch is at a node
    assert (s.cost > 2 * tau * (1 - 1e-6)).all()
    middle = np.abs(s.u[0, 4:-4, 0])
    assert middle.max() < 1e-3
    assert s.u[0, 0, 0] == pytest.approx(-1.0, abs=1e-6)
    assert s.u[0, -1, 0] == pytest.approx(1.0, abs=1e-6)


def test_costates_are_slopes_of_the_cost():
    ocp = cart(P**2 + 0.3 * U)
    x0, step = np.array([[1.0, 0.2]]), 1e-3
    moved = x0 + step * np.vstack([np.zeros((1, 2)), np.eye(2), -np.eye(2)])
    s = DDP(ocp, intervals=K).solve(moved)
    slope = (s.cost[1:3] - s.cost[3:]) / (2 * step)
    np.testing.assert_allclose(s.V_x[0, 0], slope, rtol=2e-2)


def test_parameters_of_the_user_stay_the_users():
    weight = nocl.parameter("w", nominal=1.0)
    ocp = cart(weight * P**2 + 0.3 * U, p=weight, parameters=nocl.Uniform([0.5], [2.0]))
    x0, p = ocp.initial_states.sample(2, 0), np.array([[0.5], [2.0]])
    s = DDP(ocp, intervals=K).solve(x0, p=p)
    np.testing.assert_array_equal(s.p, p)
    assert s.V_p.shape == (2, 1)
    for i, value in enumerate(p[:, 0]):
        alone = DDP(cart(value * P**2 + 0.3 * U), intervals=K).solve(x0[[i]])
        assert s.cost[i] == pytest.approx(alone.cost[0], rel=1e-3)


def test_the_term_is_in_flat_controls_alone():
    other = ca.SX.sym("other")
    system = nocl.System("two", x=P, u=ca.vertcat(U, other), xdot=U + other, lbu=[-1, 0], ubu=[1, 4], lbx=[-2], ubx=[2])
    ocp = nocl.OCP(system, horizon=1.0, running=P**2 + U**2 + other, terminal=P**2, x_goal=[0], u_goal=[0, 0],
                   initial_states=nocl.Uniform([1], [1.1]))
    assert ocp.flat_controls == ("other",)
    posed = regularised(ocp)
    weight = posed.p
    more = ca.Function("more", [system.x, system.u, weight], [posed.running - ocp.running])
    at = np.array([[0.3, 0], [0.3, 4], [0.9, 2], [-0.9, 2]]).T
    low, high, middle, other_u = more(0.0, at, 0.5).full()[0]
    assert low == high > 0  # it costs the same at both bounds
    assert middle == other_u == pytest.approx(0.0, abs=1e-15)


def test_strictly_convex_problems_are_left_alone():
    ocp = cart(P**2 + 0.1 * U**2)
    ddp = DDP(ocp, intervals=K)
    assert not ddp.smoothed
    assert ddp.posed is ocp
    assert without_kinks(ocp) is ocp


def test_no_states_are_no_solutions():
    assert len(DDP(cart(P**2 + V**2), intervals=20).solve(np.zeros((0, 2)))) == 0


def test_a_solver_goes_to_another_process():
    ddp = DDP(cart(P**2 + V**2), intervals=20)
    x0 = np.array([[1.0, 0.0]])
    again = pickle.loads(pickle.dumps(ddp))
    assert again.weights == ddp.weights
    np.testing.assert_allclose(again.solve(x0).cost, ddp.solve(x0).cost, rtol=1e-12)


def test_the_global_search_and_the_second_opinion():
    ocp = cart(P**2 + 0.3 * U)
    ddp, x0 = DDP(ocp, intervals=K), ocp.initial_states.sample(3, 0)
    s = solve_globally(ddp, x0, starts=3, rounds=1, seed=0)
    assert s.success.all()
    assert (s.hits >= 2).all()
    said = second_opinion(ddp, s, states=2, starts=1)
    assert said.solved == 2
    assert 0 <= said.price < 1e-3
    assert said.text.startswith("a quadratic term of ")
    assert "in force: it costs" in said.text


def test_the_second_opinion_mends_a_plan():
    """A plan that is held at a bound by mistake: NMPC, on the same nodes, is better, and DDP follows it."""
    ocp = cart(P**2 + 0.3 * U)
    ddp, x0 = DDP(ocp, intervals=K), np.array([[1.0, 0.0]])
    s = ddp.solve(x0)
    poor = s[[0]]
    poor.cost[:] *= 1.15
    said = second_opinion(ddp, poor, starts=1)
    assert said.improved
    assert said.apart == pytest.approx(0.15, abs=0.01)
    assert "two methods disagree by 15 % here" in said.text
    assert said.solution.cost[0] == pytest.approx(s.cost[0], rel=1e-6)


@pytest.mark.slow
def test_training_takes_a_problem_without_a_cost_on_the_control():
    settings = TrainSettings(intervals=K, seeds=3, starts=3, states=20, tails=150, visits=50, rounds=0, iterations=300,
                             hidden=(24, 24), value=False, held_out=8)
    card = nocl.train(cart(P**2 + V**2), settings=settings, seed=0, progress=False).card
    assert card["second_opinion"]["controls"] == ["force"]
    assert 0 <= card["second_opinion"]["price"] < 1e-3
    assert "it costs" in card["second_opinion"]["text"]
    assert np.isfinite(card["gap_median"])  # so few labels and iterations say nothing of how good it can be


def test_learned_dynamics_take_the_term_too():
    """f_theta plus random networks, no cost on the force: the cost is that of the plan under f_theta."""
    model = random_model("double_integrator")
    ocp = problem("double_integrator")
    flat = replace(ocp, running=ca.sumsqr(ocp.system.x))
    ddp = DDP(flat, intervals=20, substeps=1, dynamics=model)
    x0 = flat.initial_states.sample(2, 0)
    s = ddp.solve(x0)
    assert flat.flat_controls == ocp.system.control_names
    assert s.success.any()
    step = flat.functions.on(model.to_casadi()).step()
    for i in np.flatnonzero(s.success):
        x, total = x0[i], 0.0
        for u in s.u[i]:
            x, cost = (v.full().ravel() for v in step(x, u, flat.horizon / 20))
            total += float(cost[0])
        assert s.cost[i] == pytest.approx(total + float(flat.G(x)), rel=1e-9)
