"""nocl doctor: each test finds what is wrong with a problem that was made so, and nothing on one that is well."""

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.cli import main
from nocl.comparisons.diagnosis import OK, PROBLEM, REMARK, _held, doctor
from nocl.solvers import NMPC

X, V, U = ca.SX.sym("pos"), ca.SX.sym("v"), ca.SX.sym("force")


def cart(xdot=(V, U), **changed):
    system = nocl.System("cart", x=ca.vertcat(X, V), u=U, xdot=None if xdot is None else ca.vertcat(*xdot), lbu=[-3],
                         ubu=[3], lbx=[-2, -2], ubx=[2, 2], units={"pos": "m"})
    good = {"horizon": 2.0, "running": 0.1 * U**2, "terminal": X**2 + V**2, "x_goal": [0, 0], "u_goal": [0],
            "initial_states": nocl.Uniform([0.9, -0.1], [1.1, 0.1])}
    return nocl.OCP(system, **{**good, **changed})


def said(ocp, **options):
    found = doctor(ocp, **{"intervals": 20, **options})
    return found, {finding.about: finding for finding in found.findings}


def test_a_good_problem_is_well():
    found, by = said(cart())
    assert found.ok
    assert {finding.verdict for finding in found.findings} == {OK}
    assert list(by) == ["goal", "controllability", "convexity", "symmetries", "boundedness", "integration", "solutions",
                        "box X", "rival optima", "second opinion", "time needed"]
    assert "on this machine" in by["time needed"].text
    assert by["solutions"].text.startswith("8 of 8 initial states")
    assert "nothing better on 2 state(s)" in str(found)


def test_states_that_blow_up_under_held_controls():
    """v' = v^2 + u from v = 1 at most is infinite before 1 s."""
    (found,) = _held(cart((V, V**2 + U), horizon=3.0), 0)
    assert (found.about, found.verdict) == ("boundedness", REMARK)
    assert "ubu (4 of 4 states)" in found.text
    assert "lbu" not in found.text


@pytest.mark.parametrize(("x_dot", "L", "verdict", "says"), [
    (V**2 + U, -V, PROBLEM, "bounded below"), (3 * V + U, -V**2, REMARK, "the horizon alone ends it")])
def test_a_cost_that_rewards_what_runs_away(x_dot, L, verdict, says):
    """In finite time: no plan is the best. Exponentially: one is, far outside the box. Constraints end both."""
    worth = {"terminal": 0.0, "x_goal": None, "u_goal": None, "horizon": 4.0}
    (found,) = _held(cart((V, x_dot), running=L + 0.1 * U**2, **worth), 0)
    assert (found.about, found.verdict) == ("boundedness", verdict)
    assert says in found.text
    (found,) = _held(cart((V, x_dot), running=L + 0.1 * U**2, state_bounds={"v": (-2, 2)}, **worth), 0)
    assert found.verdict != PROBLEM
    assert says not in found.text
    (found,) = _held(cart((V, U - V), running=-V + 0.1 * U**2, **worth), 0)
    assert found.verdict == OK


def test_a_goal_that_drifts():
    _, by = said(cart((V, U - 0.5 * V + 1), u_goal=[0]))
    assert by["goal"].verdict == REMARK
    assert "d v / dt is 1 there" in by["goal"].text


def test_a_mode_that_no_control_moves():
    """v grows by itself; a mode that falls off is nobody's business."""
    _, by = said(cart((U, 0.3 * V), terminal=X**2))
    assert by["controllability"].verdict == REMARK
    assert "no control moves v (linearised)" in by["controllability"].text
    assert said(cart((U, -0.3 * V), terminal=X**2))[1]["controllability"].verdict == OK


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_weak_control_is_one_in_any_unit(unit):
    x, v, u = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("cart", x=ca.vertcat(x, v), u=u, xdot=ca.vertcat(v, u / unit), lbu=[-3], ubu=[3],
                         lbx=[-2 / unit] * 2, ubx=[2 / unit] * 2)
    ocp = nocl.OCP(system, horizon=2.0, running=0.1 * u**2, terminal=unit**2 * (x**2 + v**2), x_goal=[0, 0],
                   u_goal=[0], initial_states=nocl.Uniform([0.9 / unit, 0], [1.1 / unit, 0]))
    assert said(ocp)[1]["controllability"].verdict == OK


def test_a_cost_that_is_linear_in_the_control_is_taken(tmp_path, capsys):
    found, by = said(cart(running=U))
    assert found.ok
    assert by["convexity"].verdict == REMARK
    assert "linear in force" in by["convexity"].text
    assert by["solutions"].text.startswith("8 of 8 initial states")
    file = tmp_path / "bang.py"
    file.write_text("""import casadi as ca, nocl
x, u = ca.SX.sym("x"), ca.SX.sym("u")
system = nocl.System("bang", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-2], ubx=[2])
ocp = nocl.OCP(system, horizon=1.0, running=x**2, terminal=x**2, x_goal=[0], u_goal=[0],
               initial_states=nocl.Uniform([1], [1.1]))
""")
    assert main(["doctor", str(file), "--intervals", "10"]) == 0
    assert "convexity  remark" in capsys.readouterr().out


def test_plans_that_leave_the_box():
    _, by = said(cart(terminal=10 * ((X + 3) ** 2 + V**2), x_goal=[-2, 0]))
    assert by["box X"].verdict == REMARK
    assert "pos by" in by["box X"].text


def test_a_constraint_that_nothing_holds():
    _, by = said(cart(terminal_constraints={"far": (1.9, X, 2.0), "still": (0, V, 0)}, horizon=0.3))
    assert by["solutions"].verdict == PROBLEM
    assert "0 of 8" in by["solutions"].text
    assert "'far'" in by["solutions"].text or "'still'" in by["solutions"].text


def test_an_opinion_that_is_not_there(monkeypatch):
    solve = NMPC.solve

    def second_fails(self, *args, **options):
        s = solve(self, *args, **options)
        s.x[1], s.u[1], s.cost[1], s.success[1] = np.nan, np.nan, np.inf, False
        return s

    monkeypatch.setattr(NMPC, "solve", second_fails)
    assert "nothing better on 1 state(s)" in said(cart())[1]["second opinion"].text

    def all_fail(self, *args, **options):
        s = solve(self, *args, **options)
        s.x[:], s.u[:], s.cost[:], s.success[:], s.message[:] = np.nan, np.nan, np.inf, False, "given up"
        return s

    monkeypatch.setattr(NMPC, "solve", all_fail)
    assert "NMPC solves none of 2 states: given" in said(cart())[1]["second opinion"].text


@pytest.mark.slow
def test_time_scales_that_are_far_apart_are_no_lack_of_control():
    _, by = said(cart((1e-4 * V, 1e5 * (U - V)), horizon=1e4, running=1e-5 * U**2), intervals=10)
    assert by["controllability"].verdict == OK


@pytest.mark.slow
def test_a_coarse_grid_is_seen_where_constraints_are_held():
    _, by = said(cart((V, 600 * (U - V)), terminal=X**2, state_bounds={"v": (-0.9, 0.9)}))
    assert by["integration"].verdict == REMARK
    assert "implicit Radau step(s)" in by["integration"].text


def test_a_stiff_plant_and_a_switch():
    _, by = said(cart((V, 200 * (U - V)), terminal=X**2))
    assert by["integration"].verdict == REMARK
    assert "the fastest time constant where it starts is 0.005" in by["integration"].text
    theta, omega, tau = ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("tau")
    pendulum = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=tau, angles=["theta"],
                           xdot=ca.vertcat(omega, 9.81 * ca.sin(theta) + tau), lbu=[-5], ubu=[5], lbx=[-6.3, -8],
                           ubx=[6.3, 8])
    ocp = nocl.OCP(pendulum, horizon=3.0, running=0.01 * tau**2, terminal=theta**2 + omega**2, x_goal=[0, 0],
                   u_goal=[0], initial_states=nocl.Gaussian([np.pi, 0], [0.05, 0.05]))
    by = said(ocp, intervals=40)[1]
    assert by["rival optima"].verdict == REMARK
    assert by["symmetries"].text.startswith("1 mirror image")


def test_parameters_free_horizons_and_unknown_plants():
    goal = nocl.parameter("goal", 0.0)
    assert said(cart(p=goal, terminal=(X - goal) ** 2 + V**2, x_goal=ca.vertcat(goal, 0),
                     parameters=nocl.Uniform([-0.5], [0.5])))[0].ok
    quick = cart(horizon=nocl.Free(0.5, 5), running=1 + 0.1 * U**2, terminal=0.0,
                 terminal_constraints={"pos": (0, X, 0), "v": (0, V, 0)})
    assert said(quick)[0].ok
    found, by = said(cart(None))
    assert found.ok
    assert "nocl identify --data" in by["dynamics"].text
    with pytest.raises(ValueError, match="intervals is 1"):
        doctor(cart(), intervals=1)
