"""Settling time, overshoot, offset and limit cycles, held against closed forms."""

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.judge import response, simulate


def plant(xdot, nx: int = 2, horizon: float = 20.0, **more) -> nocl.OCP:
    """A system that runs by itself; the goal is 0."""
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u")
    system = nocl.System("plant", x=x, u=u, xdot=xdot(x, u), lbu=[-1], ubu=[1], lbx=[-4] * nx, ubx=[4] * nx, **more)
    return nocl.OCP(system, horizon=horizon, running=u**2 + 1e-3 * ca.sumsqr(ca.sin(x)), terminal=0 * x[0],
                    x_goal=[0] * nx, u_goal=[0], initial_states=nocl.Gaussian([0] * nx, [1] * nx))


def still(x, t):
    return np.zeros((len(x), 1))


def run(ocp: nocl.OCP, x0, nodes: int = 2001):
    return simulate(ocp, still, x0, hold=nodes - 1)


def test_a_damped_oscillator():
    """x'' + 2 z w x' + w^2 x = 0 from (1, 0): the overshoot is exp(-pi z / sqrt(1 - z^2))."""
    z, w = 0.3, 2.0
    ocp = plant(lambda x, u: ca.vertcat(x[1], -2 * z * w * x[1] - w**2 * x[0] + u))
    s = run(ocp, [[1.0, 0.0], [0.0, 0.0]])
    r = response(ocp, s, band=0.01)
    assert r.overshoot[0, 0] == pytest.approx(np.exp(-np.pi * z / np.sqrt(1 - z**2)), rel=1e-4)
    assert np.isnan(r.overshoot[1]).all()  # it is there already
    assert r.settling[1] == 0
    wd, t = w * np.sqrt(1 - z**2), np.linspace(0, 20, 400_001)
    x = np.exp(-z * w * t) * (np.cos(wd * t) + z * w / wd * np.sin(wd * t))
    v = -np.exp(-z * w * t) * w**2 / wd * np.sin(wd * t)
    assert r.settling[0] == pytest.approx(t[np.flatnonzero(np.maximum(abs(x), abs(v)) > 0.04)[-1]], abs=2e-4)
    assert not r.cycles.any()
    assert np.isnan(r.period).all()
    np.testing.assert_allclose(r.offset, 0, atol=1e-4)


def test_a_limit_cycle_is_found():
    """Van der Pol's oscillator with mu = 1: amplitude 2.0086, period 6.6633 (its series in mu; Hairer and Wanner)."""
    ocp = plant(lambda x, u: ca.vertcat(x[1], (1 - x[0]**2) * x[1] - x[0] + u), horizon=80.0)
    r = response(ocp, run(ocp, [[0.1, 0.0]], 8001))
    assert r.cycles.tolist() == [True]
    assert r.period[0] == pytest.approx(6.6633, abs=1e-3)
    assert r.swing[0, 0] == pytest.approx(2.0086, abs=1e-3)
    assert r.settling[0] == np.inf


def test_what_stays_beside_the_goal():
    ocp = plant(lambda x, u: -x + 0.5 + u, nx=1)
    r = response(ocp, run(ocp, [[2.0]]))
    assert r.offset[0, 0] == pytest.approx(0.5, abs=1e-6)
    assert r.settling[0] == np.inf
    assert not r.cycles[0]
    assert r.overshoot[0, 0] == 0


def test_a_swing_past_hanging_is_no_overshoot():
    """From pi - 0.1 away from the goal and over to its next image: it goes 2 pi - (pi - 0.1), and not past that."""
    ocp = plant(lambda x, u: ca.vertcat(x[1], 0 * x[0] + u - 0.6 * x[1]), angles=["x_0"])
    r = response(ocp, run(ocp, [[np.pi - 0.1, 0.6 * (np.pi + 0.1)]]))
    assert r.overshoot[0, 0] == pytest.approx(0.0, abs=1e-4)


def test_failed_runs_and_wrong_input():
    ocp = plant(lambda x, u: x**2 + u, nx=1)
    r = response(ocp, run(ocp, [[1.0], [-1.0]], 101))
    assert r.settling[0] == np.inf
    assert np.isnan(r.overshoot[0]).all()
    assert not r.cycles[0]
    with pytest.raises(ValueError, match="expected at least 32"):
        response(ocp, run(ocp, [[-1.0]], 11))
    with pytest.raises(ValueError, match="band"):
        response(ocp, run(ocp, [[-1.0]], 101), band=0.0)
