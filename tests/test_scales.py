"""The same problem in other units, or with its costs times k, has the same answer, from every solver and the judge."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nocl
from nocl.definition.scales import usual_sizes
from nocl.solvers import DDP, LQR, NMPC
from nocl.solvers.cnd.regression.features import features
from nocl.solvers.cnd.regression.labels import Labels
from nocl.solvers.ddp.global_search import equilibria, solve_globally

X0 = np.array([1.5, -0.5])


def problem(k=1.0, unit_x=(1.0, 1.0), unit_u=1.0):
    """A pendulum with drag: states in `unit_x`, the control in `unit_u`, the cost times k."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    P, V, U = unit_x[0] * p, unit_x[1] * v, unit_u * u
    xdot = ca.vertcat(V / unit_x[0], (U - 0.3 * V * ca.sqrt(V**2 + 1e-6) - ca.sin(P)) / unit_x[1])
    unit = np.array(unit_x)
    system = nocl.System("drag", x=ca.vertcat(p, v), u=u, xdot=xdot, lbu=[-2 / unit_u], ubu=[2 / unit_u],
                         lbx=-3 / unit, ubx=3 / unit)
    return nocl.OCP(system, horizon=4.0, running=k * (0.1 * U**2 + P**2), terminal=k * (10 * P**2 + V**2),
                    x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian(mean=X0 / unit, std=np.array([0.1, 0.1]) / unit))


def answers(ocp, k, unit_x, unit_u):
    """Costs of both solvers and the judge's, gains of LQR: all in the units of the plain problem."""
    x0 = X0 / np.array(unit_x)
    by_nmpc = NMPC(ocp, 40, starts=2, passes=0).solve(x0, workers=1)
    by_ddp = DDP(ocp, intervals=40).solve(x0)
    assert by_nmpc.success.all(), by_nmpc.message
    assert by_ddp.success.all(), by_ddp.message
    judged = nocl.simulate(ocp, by_ddp.u, x0)
    gains = [LQR(ocp, infinite=infinite).K() * unit_u / np.array(unit_x) for infinite in (False, True)]
    return np.r_[by_nmpc.cost / k, by_ddp.cost / k, judged.cost / k, np.ravel(gains)]


@pytest.fixture(scope="module")
def right():
    return answers(problem(), 1.0, (1.0, 1.0), 1.0)


@pytest.mark.parametrize(("k", "unit_x", "unit_u"), [
    (1e-10, (1.0, 1.0), 1.0), (1e10, (1.0, 1.0), 1.0), (1.0, (1e9, 1e9), 1.0), (1.0, (1e-9, 1e-9), 1.0),
    (1.0, (1e9, 1e-9), 1.0), (1.0, (1.0, 1.0), 1e9), (1.0, (1.0, 1.0), 1e-9)])
def test_extreme_units(right, k, unit_x, unit_u):
    np.testing.assert_allclose(answers(problem(k, unit_x, unit_u), k, unit_x, unit_u), right, rtol=1e-6)


power = st.floats(-9, 9).map(lambda e: 10.0**e)


@pytest.mark.slow
@given(k=power, first=power, second=power, unit_u=power)
@settings(max_examples=6, deadline=None, derandomize=True)
def test_any_units(right, k, first, second, unit_u):
    unit_x = (first, second)
    np.testing.assert_allclose(answers(problem(k, unit_x, unit_u), k, unit_x, unit_u), right, rtol=1e-6)


def test_ordinary_problems_are_solved_as_they_stand():
    for name in ("pendulum", "cartpole", "acrobot", "dubins"):
        assert NMPC(nocl.load_ocp(name), 10).program.scales.ordinary


def swing(k=1.0, unit_u=1.0, unit_x=1.0):
    """A pendulum that has to be swung up: DDP damps its way there."""
    theta, omega, u = ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("u")
    T, W, U = unit_x * theta, unit_x * omega, unit_u * u
    system = nocl.System("swing", x=ca.vertcat(theta, omega), u=u, xdot=ca.vertcat(W, 9.81 * ca.sin(T) + U) / unit_x,
                         lbu=[-5 / unit_u], ubu=[5 / unit_u], lbx=np.array([-6.5, -8.0]) / unit_x,
                         ubx=np.array([6.5, 8.0]) / unit_x)
    return nocl.OCP(system, horizon=3.0, running=k * 0.01 * U**2, terminal=k * (T**2 + W**2), x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian(mean=np.array([3.0, 0.0]) / unit_x, std=np.full(2, 0.1) / unit_x))


@pytest.mark.parametrize(("k", "unit_u", "unit_x"), [
    (2.0**-30, 1.0, 1.0), (2.0**30, 1.0, 1.0), (1.0, 2.0**30, 1.0), (1.0, 2.0**-30, 1.0), (1.0, 1.0, 2.0**-30),
    (2.0**40, 2.0**-20, 2.0**20)])
def test_ddp_takes_the_same_steps_in_other_units(k, unit_u, unit_x):
    """Units that are powers of 1024 change no digit: damping, line searches and stopping rules must not either."""
    x0 = np.random.default_rng(0).normal([3.0, 0.0], [0.5, 1.0], (12, 2))
    plain, other = (DDP(ocp, intervals=40).solve(x0 / unit) for ocp, unit in ((swing(), 1.0),
                                                                            (swing(k, unit_u, unit_x), unit_x)))
    np.testing.assert_array_equal(other.iterations, plain.iterations)
    np.testing.assert_array_equal(other.success, plain.success)
    np.testing.assert_array_equal(other.cost / k, plain.cost)
    np.testing.assert_array_equal(other.u * unit_u, plain.u)
    assert plain.success.sum() > 6
    assert plain.iterations.max() > 15


def test_what_counts_as_the_same_cost_does_not_depend_on_its_unit():
    x0 = np.random.default_rng(0).normal([3.0, 0.0], [0.5, 1.0], (16, 2))
    found = [solve_globally(DDP(swing(k), intervals=30), x0, starts=8, rounds=1, seed=0) for k in (1.0, 2.0**-40)]
    np.testing.assert_array_equal(found[1].hits, found[0].hits)
    assert [len(o) for o in found[1].optima] == [len(o) for o in found[0].optima]
    assert max(len(o) for o in found[0].optima) > 1


@given(first=power, second=power)
@settings(max_examples=5, deadline=None, derandomize=True)
def test_features_do_not_depend_on_units(first, second):
    unit, rng = np.array([first, second]), np.random.default_rng(0)
    x, t = rng.normal(X0, [0.5, 0.5], (500, 2)), rng.uniform(0, 4, 500)
    def values(ocp, x):
        labels = Labels(x, t, np.zeros((500, 0)), np.zeros((500, 1)), np.ones(500), np.zeros(500))
        return features(ocp, labels, plain=True)(x.T, t[None]).full()

    right, got = values(problem(), x), values(problem(1.0, unit), x / unit)
    np.testing.assert_allclose(got, right, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_equilibria_are_found_in_any_unit(scale):
    def of(unit):
        found = equilibria(problem(1.0, (unit, unit)), 32, np.random.default_rng(1))
        return {tuple(np.round(z, 6) + 0.0) for z in found * [unit, unit, 1.0]}

    assert of(scale) == of(1.0)
    assert len(of(1.0)) > 1


def test_without_a_goal_costs_are_as_large_as_what_they_differ_by():
    """The farthest in a second: it begins at no cost, and where 0 is decides nothing."""
    def size(k=1.0, base=0.0):
        p, u = ca.SX.sym("p"), ca.SX.sym("u")
        system = nocl.System("far", x=p, u=u, xdot=u, lbu=[0], ubu=[50], lbx=[-1], ubx=[99])
        return usual_sizes(nocl.OCP(system, horizon=1.0, running=0.0, terminal=k * (base - p),
                                    initial_states=nocl.Uniform([0], [0]))).cost

    assert 25 < size() < 40  # the mean distance of two points in X is a third of its width
    np.testing.assert_allclose([size(1e6) / 1e6, size(1.0, 1e4)], size(), rtol=1e-9)
