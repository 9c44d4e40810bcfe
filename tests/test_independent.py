"""benchmarks/independent.py against analytic answers: what examples are judged by has to be right itself."""

import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from lq import lq_symbols

import nocl

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from independent import ALLOWED, Collocation, Guess, Judge, Plan

NONE = np.zeros(0)  # parameters


def line(**changed):
    """x' = u in [-1, 1]."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("line", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-2], ubx=[2])
    usual = {"horizon": 1.0, "running": u**2, "terminal": x**2, "initial_states": nocl.Uniform([0], [0.5])}
    return nocl.OCP(system, **{**usual, **changed}), x


def double_integrator():
    """nocl's, with controls that no bound holds; and Riccati's law and cost."""
    ocp = nocl.load_ocp("double_integrator")
    t, S, K = lq_symbols(T=ocp.horizon)
    x = ca.SX.sym("x", 2)
    law = ca.Function("law", [x, t], [-K @ x])
    return ocp, law, ca.Function("V", [x, t], [x.T @ S @ x])


X0 = np.array([0.1, -0.05])


def test_riccatis_law_costs_what_riccati_says():
    ocp, law, V = double_integrator()
    run = Judge(ocp, NONE).feedback(law, X0)
    assert run.holds
    assert run.cost == pytest.approx(float(V(X0, 0)), rel=1e-6)


def test_collocation_finds_riccatis_cost():
    ocp, _, V = double_integrator()
    judge = Judge(ocp, NONE)
    run = Collocation(judge, 20).best(judge, X0, [Guess.straight(ocp, NONE, X0)])
    assert run.holds
    assert run.cost == pytest.approx(float(V(X0, 0)), rel=1e-6)


def test_a_bound_is_exceeded_by_as_much_as_it_is():
    """u = 1 from 0 ends at 1, half of it beyond the bound; shares are of the bound's scale."""
    ocp, _ = line(state_bounds={"x": (None, 0.5)}, scales={"x": 0.25})
    run = Judge(ocp, NONE).plan(Plan(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), np.array([[1.0]])))
    assert (run.of, run.holds, run.ends) == ("x", False, True)
    assert run.violation == pytest.approx(2.0, rel=1e-9)
    assert run.cost == pytest.approx(1.0 + 1.0, rel=1e-9)


def test_collocation_keeps_to_a_bound():
    """From 0.4 towards x = 2 with |u| <= 0.05, u free of charge: x(T) = 0.45."""
    ocp, x = line(running=0.0)
    held = nocl.OCP(ocp.system, horizon=1.0, running=0.0, terminal=(x - 2)**2,
                    initial_states=ocp.initial_states, constraints={"slow": (-0.05, ocp.system.u, 0.05)})
    judge = Judge(held, NONE)
    run = Collocation(judge, 8).best(judge, np.array([0.4]), [Guess.straight(held, NONE, np.array([0.4]))])
    assert run.holds
    assert run.cost == pytest.approx((2 - 0.45)**2, rel=1e-4)


def test_a_plan_that_the_plant_does_not_follow_is_none():
    """Its nodes are elsewhere: what its controls lead to is judged."""
    ocp, _ = line()
    wrong = Plan(np.array([0.0, 0.5, 1.0]), np.array([[0.0], [3.0], [5.0]]), np.array([[1.0], [1.0]]))
    run = Judge(ocp, NONE).plan(wrong)
    assert run.cost == pytest.approx(2.0, rel=1e-9)


def test_feedback_arrives_when_it_does():
    """u = -k x, clipped: to 1 / k in a straight line, from there as exp(-k t) to the tolerance."""
    k, scale = 20.0, 0.5
    ocp, x = line()
    free = nocl.OCP(ocp.system, horizon=nocl.Free(0.05, 3.0), running=1.0, terminal=0.0, scales={"there": scale},
                    initial_states=ocp.initial_states, terminal_constraints={"there": (0, x, 0)})
    y, t = ca.MX.sym("y"), ca.MX.sym("t")
    run = Judge(free, NONE).feedback(ca.Function("law", [y, t], [-k * y]), np.array([0.5]))
    expected = 0.5 - 1 / k + np.log(1 / k / (ALLOWED * scale)) / k
    assert run.ends
    assert run.cost == pytest.approx(expected, abs=3.0 / 2000)  # a look
    away = Judge(free, NONE).feedback(ca.Function("law", [y, t], [k * (y + 1)]), np.array([0.5]))
    assert not away.ends
    assert "does not arrive" in away.why


def test_collocation_finds_the_least_time():
    """Of the double integrator from rest: 2 sqrt(x)."""
    p, v, u = (ca.SX.sym(name) for name in "pvu")
    system = nocl.System("cart", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-2, -2],
                         ubx=[2, 2])
    ocp = nocl.OCP(system, horizon=nocl.Free(0.2, 10.0), running=1.0, terminal=0.0, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([0.9, 0], [1, 0]),
                   terminal_constraints={"p": (0, p, 0), "v": (0, v, 0)})
    judge, x0 = Judge(ocp, NONE), np.array([1.0, 0.0])
    run = Collocation(judge, 20).best(judge, x0, [Guess.straight(ocp, NONE, x0)])
    assert run.holds
    assert run.cost == pytest.approx(2.0, rel=1e-3)
