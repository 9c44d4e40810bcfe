"""The judge on problems whose horizon is free: when runs end, what they cost, what is said of those that do not."""

from __future__ import annotations

import base64

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.comparisons import compare, study
from nocl.comparisons.report.payload import payload
from nocl.solvers import DDP

p, v, u = (ca.SX.sym(name) for name in "pvu")
SYSTEM = nocl.System("integrator", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-5, -5],
                     ubx=[5, 5], units={"p": "m", "v": "m/s"})
STATES = nocl.Uniform([-2, -1], [2, 1])
T, X = ca.MX.sym("t"), ca.MX.sym("x", 2)


def problem(**options):
    given = {"horizon": nocl.Free(0.05, 10), "running": 1.0, "terminal": 0.0, "x_goal": [0, 0], "u_goal": [0],
             "initial_states": STATES, "terminal_constraints": {"at p": (0, p, 0), "at v": (0, v, 0)}, **options}
    return nocl.OCP(SYSTEM, **given)


def law(expression):
    return ca.Function("law", [X, T], [expression])


ALWAYS = law(ca.MX(1.0))


def least_time(x):
    """Of the double integrator, from right of the switching curve u = -1 and then 1."""
    side = np.sign(x[:, 0] + x[:, 1] * np.abs(x[:, 1]) / 2)
    p, v = side * x[:, 0], side * x[:, 1]
    return v + 2 * np.sqrt(p + v**2 / 2)


def test_a_run_ends_where_its_terminal_constraint_holds():
    ocp = problem(terminal_constraints={"fast": (1, v, None)}, scales={"fast": 2.0})
    x0 = np.array([[0.0, -0.5], [1.0, 0.25], [0.3, 0.99]])
    run = nocl.simulate(ocp, ALWAYS, x0, tolerance=1e-2)
    assert run.success.all()
    np.testing.assert_allclose(run.t[:2, -1], 1 - x0[:2, 1] - 0.02 * 0.95, rtol=1e-7)
    assert run.t[2, -1] == 0.05  # it has arrived before the least horizon
    np.testing.assert_allclose(run.x[:, -1, 1], x0[:, 1] + run.t[:, -1], atol=1e-8)
    np.testing.assert_allclose(run.cost, run.t[:, -1], rtol=1e-9)


@pytest.mark.parametrize("speed", [0.7, 4.9])
def test_a_run_that_only_passes_through_is_seen(speed):
    ocp = problem(terminal_constraints={"at p": (0.5, p, 0.5)}, scales={"at p": 1.0})
    for tolerance in (1e-3, 1e-6):
        run = nocl.simulate(ocp, law(ca.MX(0.0)), [[0.0, speed]], tolerance=tolerance)
        assert run.t[0, -1] == pytest.approx((0.5 - 0.95 * tolerance) / speed, abs=2e-5 / speed)


def test_time_optimal_feedback_takes_the_analytic_time():
    x0 = STATES.sample(4, 1)
    ocp = problem(scales={"at p": 1.0, "at v": 1.0})
    run = nocl.simulate(ocp, switching(), x0, tolerance=1e-2)
    assert run.success.all()
    left = np.abs(run.x[:, -1, 1])  # on the switching curve, what is left takes as long as the speed says
    np.testing.assert_allclose(run.cost + left, least_time(x0), rtol=2e-3)


def switching():
    return law(-ca.tanh((X[0] + X[1] * ca.fabs(X[1]) / 2) / 1e-4))


@pytest.fixture(scope="module")
def studied():
    """The switching law, continuous and held, and DDP's plans beside the reference."""
    ocp = problem(scales={"at p": 1.0, "at v": 1.0})
    return study(ocp, {"switching": switching(), "DDP": DDP(ocp)}, n=4, seed=5, hold=[None, 400], tolerance=1e-2,
                 progress=False)


def test_the_reference_ends_as_near_as_feedback_does(studied):
    """Not later than the least time to the goal itself, and by no more sooner than the goal is away from where it may
    end."""
    best, least = studied.judged[-1].simulation, least_time(studied.x0)
    assert [j.name for j in studied.judged] == ["switching", "switching (400 holds)", "DDP", "reference"]
    assert best.success.all()
    assert (best.cost < least).all()
    corner = least_time(np.array([[0.01, 0.01]]))
    assert (best.cost > least - corner).all()
    assert (studied.gap[-1] <= 0.02).all()  # per cent: held controls against a law in continuous time
    assert len(studied.promises) == 6  # three methods, within 2 % and on constraints


def test_held_runs_have_all_their_nodes_before_they_arrive():
    """Bang-bang: |u| = 1 all the time, although the law is held."""
    ocp, x0 = problem(scales={"at p": 1.0, "at v": 1.0}), STATES.sample(3, 6)
    run = nocl.simulate(ocp, switching(), x0, hold=400, tolerance=5e-2)
    assert run.success.all()
    assert run.t.shape == (3, 401)
    assert (np.diff(run.t) > 0).all()
    np.testing.assert_allclose(run.control_magnitude, 1.0, rtol=1e-3)
    np.testing.assert_allclose(run.saturation, 1.0, rtol=1e-3)
    v = x0[:, 1:] + np.cumsum(run.u[:, :-1, 0] * np.diff(run.t), axis=1)
    np.testing.assert_allclose(run.x[:, 1:, 1], v, atol=1e-8)  # each control acts where it stands


def test_the_page_has_each_run_on_its_own_times(studied, tmp_path):
    data = payload(studied)
    at, runs = data["channels"]["time"], data["methods"][0]
    limits = np.frombuffer(base64.b64decode(runs["limits"]), "<f4").reshape(4, -1, 2)
    ends = np.array([j.simulation.t[:, -1] for j in studied.judged])
    np.testing.assert_allclose(limits[:, at], np.stack([0 * ends[0], ends[0]], axis=1), rtol=1e-6)
    assert runs["t"] is None
    assert data["horizon"] == ends.max()
    page = studied.save(tmp_path / "page", animation=True)
    assert page.exists()
    assert (tmp_path / "page" / "animation.gif").exists()


def test_plans_end_on_time():
    ocp, x0 = problem(), STATES.sample(4, 2)
    plan = DDP(ocp).solve(x0)
    run = nocl.simulate(ocp, plan.u, x0, horizon=plan.t[:, -1])
    assert run.success.all()
    np.testing.assert_allclose(run.t, plan.t, rtol=1e-12)
    np.testing.assert_allclose(run.x, plan.x, atol=1e-7)
    np.testing.assert_allclose(run.cost, plan.cost, rtol=1e-9)
    early = nocl.simulate(ocp, plan.u, x0, horizon=0.7 * plan.t[:, -1])
    assert not early.success.any()
    assert early.reached.all()


def test_held_feedback_is_the_plan_of_its_answers():
    ocp = problem(terminal_constraints={"fast": (1, v, None)})
    asked = []

    def ask(x, t):
        asked.append(t)
        return np.full((len(x), 1), 0.5 if t < 1 else 1.0)

    run = nocl.simulate(ocp, ask, [[0.0, -0.5]], hold=40, tolerance=1e-6)
    assert asked == [0.25 * k for k in range(len(asked))]
    assert run.t[0, -1] == pytest.approx(2.0, abs=1e-4)
    np.testing.assert_allclose(run.t[0], np.linspace(0, 2, 41), atol=1e-4)  # each of 8 intervals in 5 parts
    np.testing.assert_allclose(run.cost, 2.0, atol=1e-4)
    np.testing.assert_allclose(run.x[0, 20], [-0.25, 0.0], atol=1e-8)


def test_what_does_not_arrive_says_by_how_much():
    ocp = problem(horizon=nocl.Free(0.05, 2.0), scales={"at p": 1.0, "at v": 1.0})
    run = nocl.simulate(ocp, law(ca.MX(0.0)), [[1.0, 0.25], [-1.0, 0.25]])
    assert not run.reached.any()
    assert np.isinf(run.cost).all()
    assert "does not arrive within 2: at best 'at p' is off by 1.0" in run.message[0]
    assert "t = 2" in run.message[1]


def test_a_law_that_blows_up_has_failed():
    run = nocl.simulate(problem(), law(ca.sqrt(X[0])), [[-1.0, 0.0], [1.0, 0.0]])
    assert not run.success.any()
    assert "blows up or the control is NaN" in run.message[0]


def test_each_state_has_its_own_parameters():
    goal = nocl.parameter("goal", unit="m/s")
    ocp = problem(p=goal, terminal_constraints={"fast": (0, v - goal, None)}, scales={"fast": 1.0},
                  parameters=nocl.Uniform([0.5], [2.0]))
    x0, goals = np.array([[0.0, 0.0], [0.0, 0.0]]), [[0.5], [1.5]]
    for controller, options in ((lambda x, t, p: np.ones((len(x), 1)), {"hold": 100}),
                                (ca.Function("law", [X, T, ca.MX.sym("p")], [ca.MX(1.0)]), {})):
        run = nocl.simulate(ocp, controller, x0, p=goals, tolerance=1e-6, **options)
        np.testing.assert_allclose(run.t[:, -1], [0.5, 1.5], atol=1e-5)


def test_what_makes_no_sense_is_refused():
    ocp, x0 = problem(), [[1.0, 0.0]]
    with pytest.raises(ValueError, match="no terminal constraints"):
        nocl.simulate(problem(terminal_constraints={}), ALWAYS, x0)
    with pytest.raises(ValueError, match="kicks is"):
        nocl.simulate(ocp, ALWAYS, x0, kicks=[(0.5, [0.1, 0])])
    with pytest.raises(ValueError, match="when each plan ends"):
        nocl.simulate(ocp, np.zeros((1, 20, 1)), x0)
    with pytest.raises(ValueError, match="when each plan ends"):
        nocl.simulate(ocp, np.zeros((1, 20, 1)), x0, horizon=11.0)
    with pytest.raises(ValueError, match="feedback says itself"):
        nocl.simulate(ocp, ALWAYS, x0, horizon=2.0)
    with pytest.raises(ValueError, match=r"no nocl\.Free"):
        nocl.simulate(problem(horizon=2.0), ALWAYS, x0, horizon=2.0)


def test_methods_are_compared_on_a_free_horizon():
    ocp = problem(scales={"at p": 1.0, "at v": 1.0})
    methods = {"law": switching(), "DDP": DDP(ocp), "never": ALWAYS}
    report = compare(ocp, methods, n=3, seed=2, tolerance=1e-2)
    own, plan, never = report.judged
    assert own.simulation.success.all()
    assert plan.simulation.success.all()
    assert not never.simulation.reached.any()
    x0 = report.x0
    np.testing.assert_allclose(plan.simulation.cost, least_time(x0), rtol=2e-3)
    assert (own.simulation.cost < plan.simulation.cost).all()  # it ends within the tolerance
    assert plan.simulation.t.shape == (3, 81)
    assert "Feedback ends as soon as" in str(report)


def test_a_comparison_is_resumed_with_each_horizon(tmp_path):
    ocp = problem()
    first, again = (compare(ocp, {"DDP": DDP(ocp)}, n=2, seed=3, out=tmp_path) for _ in range(2))
    np.testing.assert_array_equal(first.judged[0].simulation.t, again.judged[0].simulation.t)
