"""RRT*: paths are Dubins curves to the goal, round the obstacle, that the exact car follows."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.judge import simulate

pytest.importorskip("ompl")

from nocl.solvers.rrt_star import RRTStar

X0 = np.array([[-3.0, 1.0, 0.5], [-3.2, -2.0, 2.5]])


@pytest.fixture(scope="module")
def ocp() -> nocl.OCP:
    return nocl.load_ocp("dubins")


def test_the_exact_car_drives_the_path_to_the_goal(ocp):
    solution = RRTStar(ocp, iterations=150).solve(X0)
    assert solution.success.all()
    run = simulate(ocp, solution.u, X0)
    turns = (run.x[:, -1, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.c_[run.x[:, -1, :2], turns]).max() < 1e-3
    assert (run.clearance > -1e-3).all()
    assert np.abs(run.x - solution.x).max() < 1e-3
    np.testing.assert_allclose(run.cost, solution.cost, rtol=1e-3)
    length = solution.u[:, :, 0].mean(axis=1) * ocp.horizon
    assert (length >= np.hypot(X0[:, 0], X0[:, 1])).all()


def test_without_an_obstacle_it_is_the_dubins_curve():
    """Straight ahead: 2 m; with a quarter turn of radius 0.5, at least 2 m and that."""
    free = nocl.load_ocp("dubins", obstacle=False)
    solution = RRTStar(free, iterations=120).solve([[-2.0, 0.0, 0.0], [-2.5, -0.5, np.pi / 2]])
    length = solution.u[:, :, 0].mean(axis=1) * free.horizon
    assert length[0] == pytest.approx(2.0, abs=1e-6)
    assert length[1] >= 2.0 + np.pi / 4 - 1e-6


def test_same_seed_same_path(ocp):
    a, b = (RRTStar(ocp, iterations=60, seed=3).solve(X0) for _ in range(2))
    np.testing.assert_array_equal(a.x, b.x)


def test_more_iterations_are_never_worse(ocp):
    few, more = (RRTStar(ocp, iterations=n).path(X0[0]).length for n in (50, 150))
    assert more <= few + 1e-9


def test_a_path_that_cannot_be_is_a_row(ocp):
    slow = replace(ocp, horizon=2.0)
    solution = RRTStar(slow, iterations=60).solve(X0[:1])
    assert not solution.success[0]
    assert "above 1" in solution.message[0]
    assert np.isinf(solution.cost[0])
    walled = replace(ocp, path_constraints={"wall": ca.fabs(ocp.system.x[0] + 2) - 0.3})
    solution = RRTStar(walled, iterations=30).solve(X0[:1])
    assert "no path" in solution.message[0]


def test_a_budget_of_time(ocp):
    solution = RRTStar(ocp, seconds=0.05).solve(X0[:1])
    assert solution.iterations[0] > 0
    assert solution.seconds[0] >= 0.05


def test_other_systems_are_refused(ocp):
    with pytest.raises(ValueError, match=r"kinematic cars.*4 states"):
        RRTStar(nocl.load_ocp("cartpole"), iterations=10)
    s = ocp.system
    skid = nocl.System("skid", x=s.x, u=s.u, xdot=ca.vertcat(s.xdot[0] + 0.1, s.xdot[1], s.xdot[2]), lbu=s.lbu,
                       ubu=s.ubu, lbx=s.lbx, ubx=s.ubx)
    with pytest.raises(ValueError, match="other equations"):
        RRTStar(nocl.OCP.quadratic(skid, horizon=8.0, x_goal=[0] * 3, u_goal=[0, 0],
                                   initial_states=ocp.initial_states), iterations=10)
    reverse = nocl.System("reverse", x=s.x, u=s.u, xdot=s.xdot, lbu=[-1, -1], ubu=s.ubu, lbx=s.lbx, ubx=s.ubx)
    with pytest.raises(ValueError, match="no reverse gear"):
        RRTStar(nocl.OCP.quadratic(reverse, horizon=8.0, x_goal=[0] * 3, u_goal=[0, 0],
                                   initial_states=ocp.initial_states), iterations=10)
    with pytest.raises(ValueError, match="expected one of them"):
        RRTStar(ocp)
