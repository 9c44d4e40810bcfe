"""The Hamiltonian's minimiser over U: no control of a dense sample does better, whatever the form of H in u."""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.definition.hamiltonian import hamiltonian, minimiser


def problem(couple: str) -> nocl.OCP:
    """Three controls; H is diagonal, coupled and convex, indefinite, bilinear, or not quadratic in u."""
    x, u = ca.vertcat(*(ca.SX.sym(f"x{i}") for i in range(2))), ca.vertcat(*(ca.SX.sym(f"u{i}") for i in range(3)))
    R = {"coupled": [[2, 0.9, 0], [0.9, 1, 0.3], [0, 0.3, 1]], "indefinite": [[1, 2, 0], [2, -1, 0.5], [0, 0.5, 0]],
         "concave": -np.eye(3), "linear": np.zeros((3, 3))}.get(couple, np.diag([1.0, 2, 3]))
    xdot = ca.vertcat(x[1] + u[0] - u[2], ca.sin(x[0]) + u[1])
    if couple == "bilinear":
        xdot = ca.vertcat(u[0] * u[1], u[0] * ca.cos(x[1]) + u[1] * u[2])
    if couple == "cubic":
        xdot = ca.vertcat(u[0] ** 3, u[1] + u[2])
    system = nocl.System("three", x=x, u=u, xdot=xdot, lbu=[-1, -2, 0], ubu=[1, 0.5, 1.5], lbx=[-1, -1], ubx=[1, 1])
    return nocl.OCP(system, horizon=1.0, running=ca.bilin(ca.DM(R), u, u) / 2 + x[0] ** 2 + u[0] * x[1],
                    terminal=ca.sumsqr(x), x_goal=[0, 0], u_goal=[0, 0, 0],
                    initial_states=nocl.Uniform(lb=[-1, -1], ub=[1, 1]))


@pytest.mark.parametrize("couple", ["diagonal", "concave", "linear", "coupled", "indefinite", "bilinear"])
def test_no_control_does_better(couple):
    ocp = problem(couple)
    s, rng, best, H = ocp.system, np.random.default_rng(0), minimiser(ocp), hamiltonian(ocp)
    x, p = rng.uniform(-1, 1, (60, 2)), rng.normal(size=(60, 2)) * 3
    u, lowest = (m.full() for m in best(x.T, p.T))
    assert (u >= np.asarray(s.lbu)[:, None]).all()
    assert (u <= np.asarray(s.ubu)[:, None]).all()
    np.testing.assert_allclose(H(x.T, u, p.T).full(), lowest, rtol=1e-12, atol=1e-12)
    for v in itertools.product(*(np.linspace(a, b, 13) for a, b in zip(s.lbu, s.ubu, strict=True))):
        tried = H(x.T, np.repeat(np.array(v)[:, None], 60, axis=1), p.T).full()
        assert (lowest <= tried + 1e-12).all()


def test_what_is_not_quadratic_has_no_closed_form():
    assert minimiser(problem("cubic")) is None


def test_dubins_by_hand():
    """H = R (v^2 + alpha^2) + v (p.heading + p_psi alpha / r): with p_psi = 0, alpha = 0 and v = -p.heading / 2R."""
    best = minimiser(nocl.load_ocp("dubins"))
    u, _ = best([-3.0, 0, 0], [-0.01, 0.3, 0.0])
    np.testing.assert_allclose(u.full().ravel(), [0.5, 0.0], atol=1e-12)
    u, _ = best([-3.0, 0, 0], [-1.0, 0.0, 2.0])  # both at their bounds
    np.testing.assert_allclose(u.full().ravel(), [1.0, -1.0])
