"""The same problem in other units, or with its costs times k, has the same answer, from every solver and the judge."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nocl
from nocl.solvers import DDP, LQR, NMPC

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


@given(k=power, first=power, second=power, unit_u=power)
@settings(max_examples=10, deadline=None, derandomize=True)
def test_any_units(right, k, first, second, unit_u):
    unit_x = (first, second)
    np.testing.assert_allclose(answers(problem(k, unit_x, unit_u), k, unit_x, unit_u), right, rtol=1e-6)


def test_ordinary_problems_are_solved_as_they_stand():
    for name in ("pendulum", "cartpole", "acrobot", "dubins"):
        assert NMPC(nocl.load_ocp(name), 10).program.scales.ordinary
