"""NMPC under constraints of controls, at the end, with a free horizon: analytic optima, programs of its own, units."""

import re
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nocl
from nocl.cli import main
from nocl.solvers import DDP, NMPC

P, V, U = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
SERIAL = {"workers": 1, "progress": False}


def integrator(unit=1.0, u_max=1.0, **changed):
    """The double integrator, x in `unit` m."""
    system = nocl.System("integrator", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(V, U), lbu=[-u_max / unit],
                         ubu=[u_max / unit], lbx=[-5 / unit] * 2, ubx=[5 / unit] * 2)
    good = {"horizon": 2.0, "running": (unit * U)**2, "terminal": 0.0, "x_goal": [0, 0], "u_goal": [0],
            "initial_states": nocl.Uniform([0.5 / unit, -0.1 / unit], [2 / unit, 0.1 / unit])}
    return nocl.OCP(system, **{**good, **changed})


AT_REST = {"at p": (0, P, 0), "at v": (0, V, 0)}
FASTEST = {"horizon": nocl.Free(0.5, 10), "running": 1.0, "terminal_constraints": AT_REST}


def solver(ocp, N=20, **options):
    return NMPC(ocp, N, **{"substeps": 1, "starts": 2, "passes": 0, **options})


@pytest.mark.parametrize("backend", ["fatrop", "ipopt"])
def test_minimum_time_is_twice_the_root_of_the_distance(backend):
    """One switch, in the middle: on a node of any even grid, so that held controls lose nothing."""
    d = np.array([0.5, 1.0, 2.0])
    s = solver(integrator(**FASTEST), solver=backend).solve(np.c_[d, 0 * d], **SERIAL)
    assert s.success.all()
    assert s.cost == pytest.approx(2 * np.sqrt(d), rel=1e-7)
    assert s.t[:, -1] == pytest.approx(2 * np.sqrt(d), rel=1e-7)
    assert s.u[:, :, 0] == pytest.approx(np.tile(np.repeat([-1, 1], 10), (3, 1)), abs=1e-5)
    assert s.x[:, -1] == pytest.approx(np.zeros((3, 2)), abs=1e-7)
    assert s.costate[:, 0, 0] == pytest.approx(1 / np.sqrt(d), rel=1e-4)  # of T = 2 sqrt(d)
    np.testing.assert_allclose(s.V, s.t[:, -1:] - s.t, atol=1e-7)


def test_a_speed_limit_makes_it_coast():
    """|v| <= .8: .8 s to that speed, .8 s along, .8 s to rest over 1.28 m; T = d / .8 + .8 from any d > .64."""
    ocp = integrator(**FASTEST, state_bounds={"v": (-0.8, 0.8)})
    s = solver(ocp, 30).solve([[1.28, 0.0], [2.0, 0.0]], **SERIAL)
    assert s.cost[0] == pytest.approx(2.4, rel=1e-7)
    assert s.cost[1] == pytest.approx(2 / 0.8 + 0.8, rel=2e-3)  # it switches between nodes
    assert (s.x[:, :, 1] >= -0.8 - 1e-7).all()
    u = s.u[0, :, 0]
    assert (u[:10], u[10:20], u[20:]) == (pytest.approx(-1, abs=1e-5), pytest.approx(0, abs=1e-5),
                                          pytest.approx(1, abs=1e-5))
    assert s.clearance == pytest.approx(np.zeros(2), abs=1e-6)


def test_two_limits_of_the_control_itself():
    """p from 1 to 0 at rest in T = 2.5: |u| <= .8 by a constraint is |u| <= .8 by U."""
    held = integrator(horizon=2.5, terminal_constraints=AT_REST, constraints={"push": (None, U**2, 0.64)})
    boxed = integrator(u_max=0.8, horizon=2.5, terminal_constraints=AT_REST)
    a, b = (solver(ocp).solve([1.0, 0.0], **SERIAL) for ocp in (held, boxed))
    assert np.abs(b.u).max() == pytest.approx(0.8, abs=1e-6)
    assert a.cost == pytest.approx(b.cost, rel=1e-6)
    assert a.x == pytest.approx(b.x, abs=1e-5)
    assert a.costate == pytest.approx(b.costate, abs=1e-4)


def test_the_least_effort_to_rest_is_a_cubic():
    """min int u^2, p = 1 to rest at 0 in T: u = (12 t / T - 6) / T^2, cost 12 / T^3; held controls cost little more."""
    s = solver(integrator(u_max=9, terminal_constraints=AT_REST), 40).solve([1.0, 0.0], **SERIAL)
    assert s.cost[0] == pytest.approx(12 / 8, rel=2e-3)
    middle = (s.t[0, 1:] + s.t[0, :-1]) / 2
    assert s.u[0, :, 0] == pytest.approx((12 * middle / 2 - 6) / 4, abs=2e-3)
    assert s.costate[0, 0] == pytest.approx([24 / 8, 12 / 4], rel=2e-3)  # J = 12 p^2 / T^3 + 12 p v / T^2 + 4 v^2 / T


def arm(**changed):
    """A pendulum with power, speed and torque limits that all bind, and an end on a line."""
    theta, omega, tau = ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("tau")
    system = nocl.System("arm", x=ca.vertcat(theta, omega), u=tau, xdot=ca.vertcat(omega, ca.sin(theta) + tau),
                         lbu=[-3], ubu=[3], lbx=[-4, -6], ubx=[4, 6])
    good = {"horizon": 1.5, "running": 0.1 * tau**2 + theta**2, "terminal": omega**2, "x_goal": [0, 0],
            "u_goal": [0], "initial_states": nocl.Uniform([1, -0.5], [2, 0.5]),
            "constraints": {"power": (None, tau * omega, 1.5), "torque": (-2.5, tau, 2.2)},
            "state_bounds": {"omega": (-1.6, None)}, "terminal_constraints": {"line": (0.1, theta + omega, 0.1)}}
    return nocl.OCP(system, **{**good, **changed})


@cache
def by_hand(theta0, omega0, N=25):
    """The same program written out for IPOPT on nodes of its own: (cost, x [N+1, 2], u [N], costate [N+1, 2])."""
    h, opti = 1.5 / N, ca.Opti()
    X, tau = opti.variable(2, N + 1), opti.variable(1, N)

    def rate(z, u):
        return ca.vertcat(z[1], ca.sin(z[0]) + u, 0.1 * u**2 + z[0]**2)

    cost, gaps = 0, []
    for k in range(N):
        z, u = ca.vertcat(X[:, k], 0), tau[k]
        k1 = rate(z, u)
        k2 = rate(z + h / 2 * k1, u)
        k3 = rate(z + h / 2 * k2, u)
        k4 = rate(z + h * k3, u)
        end = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        cost += end[2]
        gaps.append(X[:, k + 1] - end[:2] == 0)
    begin = X[:, 0] == [theta0, omega0]
    opti.subject_to([begin, *gaps])
    opti.subject_to([*(tau[k] * X[1, k] <= 1.5 for k in range(N)), *(X[1, k] >= -1.6 for k in range(1, N + 1))])
    opti.subject_to(opti.bounded(-2.5, tau, 2.2))
    opti.subject_to(X[0, N] + X[1, N] == 0.1)
    opti.minimize(cost + X[1, N]**2)
    opti.set_initial(X, np.linspace([theta0, omega0], [0, 0], N + 1).T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "tol": 1e-11})
    found = opti.solve()
    costate = [-found.value(opti.dual(row)).ravel() for row in (begin, *gaps)]
    return found.value(opti.f), found.value(X).T, found.value(tau), np.array(costate)


@pytest.mark.parametrize("backend", ["fatrop", "ipopt"])
def test_the_program_is_the_one_that_is_written_out(backend):
    x0 = [1.8, 0.2]
    s = solver(arm(), 25, solver=backend).solve(x0, **SERIAL)
    cost, x, u, costate = by_hand(*x0)
    assert s.success.all()
    assert s.cost[0] == pytest.approx(cost, rel=1e-8)
    assert s.x[0] == pytest.approx(x, abs=1e-5)
    assert s.u[0, :, 0] == pytest.approx(u, abs=1e-4)
    assert s.costate[0] == pytest.approx(costate, abs=1e-4)
    c = arm().functions.c(s.x[0, :-1].T, s.u[0].T).full()
    assert c.min() >= -1e-6
    active = np.abs(c).min(axis=1) < 1e-5
    assert active.sum() >= 2  # the test is of constraints that bind
    assert float(arm().functions.c_end(s.x[0, -1])) == pytest.approx(0, abs=1e-8)


def test_the_costate_is_the_gradient_of_the_optimal_cost():
    nmpc, x0, step = solver(arm(), 15, solver="ipopt"), np.array([1.5, 0.1]), 1e-4
    s = nmpc.solve(x0, **SERIAL)
    around = x0 + step * np.vstack([np.eye(2), -np.eye(2)])
    guess = tuple(np.repeat(v, 4, axis=0) for v in (s.x, s.u))
    cost = nmpc.solve(around, guess, **SERIAL).cost.reshape(2, -1)
    assert s.costate[0, 0] == pytest.approx((cost[0] - cost[1]) / (2 * step), abs=1e-4)


def test_the_costate_is_the_gradient_of_the_least_time():
    """T* = v + 2 sqrt(p + v^2 / 2) to the right of the switching curve, up to what held controls lose: 40 intervals."""
    s = solver(integrator(**FASTEST), 40).solve([1.0, 0.4], **SERIAL)
    root = np.sqrt(1 + 0.08)
    assert s.cost[0] == pytest.approx(0.4 + 2 * root, rel=1e-3)
    assert s.costate[0, 0] == pytest.approx([1 / root, 1 + 0.4 / root], rel=3e-2)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_nothing_depends_on_units(unit):
    p, v, u = unit * P, unit * V, unit * U
    ocp = integrator(unit, horizon=2.2, terminal_constraints={"at p": (0, 1e3 * p, 0), "at v": (0, V, 0)},
                     constraints={"power": (-0.4e3, 1e3 * u * v, 0.4e3)}, state_bounds={"v": (-0.75 / unit, None)})
    x0 = np.array([[1.0, 0.0], [2.0, 0.0]]) / unit
    s = solver(ocp).solve(x0, **SERIAL)
    assert s.success.tolist() == [True, False]
    right = solver(integrator(horizon=2.2, terminal_constraints=AT_REST, constraints={"power": (-0.4, U * V, 0.4)},
                              state_bounds={"v": (-0.75, None)})).solve(x0 * unit, **SERIAL)
    assert s.cost[0] == pytest.approx(right.cost[0], rel=1e-6)
    assert unit * s.x[0] == pytest.approx(right.x[0], abs=1e-5)
    assert s.costate[0] / unit == pytest.approx(right.costate[0], abs=1e-3)
    amounts = [float(re.search(r"is exceeded by ([\d.e+-]+) at node \d+", m).group(1)) for m in
               (s.message[1], right.message[1])]
    assert [m.split(" is exceeded")[0].rpartition(", ")[2] for m in (s.message[1], right.message[1])] == \
        ["terminal constraint 'at p'"] * 2
    assert amounts[0] == pytest.approx(1e3 * amounts[1], rel=1e-2)


def test_what_cannot_be_held_is_named_with_its_node_and_amount():
    """At |v| <= .4 from rest 2 s take a point .72 m: from 1 m .28 m are left."""
    ocp = integrator(terminal_constraints={"at p": (0, P, 0)}, state_bounds={"v": (-0.4, 0.4)})
    s = solver(ocp).solve([[1.0, 0.0], [0.5, 0.0], [0.5, 0.6]], **SERIAL)
    assert s.success.tolist() == [False, True, False]
    assert np.isinf(s.cost[[0, 2]]).all()
    assert "0.28" in s.message[0]
    assert "terminal constraint 'at p'" in s.message[0]
    assert "at node 20, t = 2" in s.message[0]
    assert "where none of them holds 'v' and 'at p' from there" in s.message[0]
    assert "state bound 'v' is violated by 0.2 at node 0, by x0 = [0.5, 0.6] itself" in s.message[2]
    clash = solver(integrator(constraints={"tied": (0, U + V, 0), "up": U - 0.1}, terminal=P**2)).solve([1.0, 0.3],
                                                                                                       **SERIAL)
    assert not clash.success[0]
    assert "constraint 'tied' is exceeded by 0.4 at node 0" in clash.message[0] or "'up'" in clash.message[0]


def test_an_exact_penalty_holds_what_can_be_held():
    ocp = integrator(terminal_constraints={"at p": (0, P, 0)}, state_bounds={"v": (-0.4, 0.4)},
                     constraints={"push": (-0.9, U, 0.9)})
    x0 = [[0.5, 0.0], [1.0, 0.0]]
    hard = solver(ocp).solve(x0[0], **SERIAL)
    for backend in ("fatrop", "ipopt"):
        s = solver(ocp, soft=["at p", "v"], solver=backend).solve(x0, **SERIAL)
        assert s.success.all()
        assert s.slack.shape == (2, 21, 2)
        assert s.cost[0] == pytest.approx(hard.cost[0], rel=1e-6)
        assert s.x[0] == pytest.approx(hard.x[0], abs=1e-4)
        assert s.slack[0].max() < 1e-8
        scale = {"v": 0.4, "at p": ocp.functions.end_scales[0]}
        over = (np.abs(s.x[1, :, 1]) - 0.4) / scale["v"]
        assert s.slack[1, 1:, 1] == pytest.approx(np.maximum(over, 0)[1:], abs=1e-9)
        assert s.slack[1, -1, 0] == pytest.approx(abs(s.x[1, -1, 0]) / scale["at p"], abs=1e-9)
        assert s.slack[1].max() > 1e-3
        assert s.V[:, 0] == pytest.approx(s.cost, rel=1e-9)
    one = solver(ocp, soft=["at p"]).solve(x0[1], **SERIAL)
    left = 1 - (0.4 * 2 - 0.4**2 / 1.8)  # from rest, at .9 up to the speed limit
    assert one.x[0, -1, 0] == pytest.approx(left, abs=2e-3)
    assert one.slack[0, -1, 0] * ocp.functions.end_scales[0] == pytest.approx(one.x[0, -1, 0], rel=1e-6)


def test_a_start_that_breaks_a_soft_constraint_is_solved():
    ocp = integrator(state_bounds={"v": (-0.4, 0.4)}, terminal=P**2)
    s = solver(ocp, soft=["v"]).solve([0.5, 0.8], **SERIAL)
    assert s.success[0]
    assert s.slack[0, 1, 0] > 0
    assert s.slack[0, 0, 0] == 0  # x_0 is given
    assert s.slack[0, -1, 0] < 1e-8


def test_a_constraint_in_time_moves_with_the_free_horizon():
    """Nobody may be below 1 - t / 4, and braking to 0 at rest is (T - t)^2 / 2: it never is from T = 4 + 1/8 on."""
    ocp = integrator(**FASTEST, constraints={"gate": P - 1 + nocl.time() / 4})
    s = solver(ocp, starts=3).solve([1.2, 0.0], **SERIAL)
    assert s.success[0]
    assert s.cost[0] == pytest.approx(4.125, abs=6e-3)  # a little less where only nodes are held
    assert (s.x[0, :, 0] >= 1 - s.t[0] / 4 - 1e-6)[1:].all()


def test_parameters_bind_as_numbers_do():
    limit, goal = nocl.parameter("limit"), nocl.parameter("goal")
    ocp = integrator(p=ca.vertcat(limit, goal), parameters=nocl.Uniform([0.5, -0.2], [0.8, 0.2]),
                     horizon=nocl.Free(1, 9), running=1.0, constraints={"slow": limit - V**2},
                     terminal_constraints={"at p": (0, P - goal, 0), "at v": (0, V, 0)})
    p = [[0.6, 0.1], [0.7, -0.1]]
    both = solver(ocp).solve([[1.5, 0.0], [1.5, 0.0]], p=p, **SERIAL)
    for i, own in enumerate(p):
        one = solver(ocp.at(p=own)).solve([1.5, 0.0], **SERIAL)
        assert both.cost[i] == pytest.approx(one.cost[0], rel=1e-6)
    v = np.sqrt(0.6)
    assert both.cost[0] == pytest.approx(1.4 / v + v, rel=1e-2)
    assert both.V_p[0, 1] == pytest.approx(-1 / v, rel=1e-2)  # T = (1.5 - goal) / v + v


def test_free_solutions_are_guesses_and_neighbours():
    ocp = integrator(**FASTEST)
    s = solver(ocp).solve([[1.0, 0.0]], **SERIAL)
    near = solver(ocp).solve([[1.1, 0.0]], s, **SERIAL)
    assert near.cost[0] == pytest.approx(2 * np.sqrt(1.1), rel=1e-6)
    moved = solver(ocp).solve([[1.0, 0.0]], (s.x, s.u), **SERIAL)
    assert moved.cost[0] == pytest.approx(2, rel=1e-6)
    many = solver(ocp, starts=1, passes=2).solve([[0.8, 0.1], [1.0, 0.0], [1.2, -0.1]], **SERIAL)
    assert many.success.all()
    assert (many.starts > 1).all()
    for wrong in (s.u, lambda x, t: 0 * x[:, :1]):
        with pytest.raises(ValueError, match="which says no horizon, and that is free; expected a Solution"):
            solver(ocp).solve([[1.0, 0.0]], wrong, **SERIAL)
    for fixed in ({"t0": 0.5}, {"nodes": np.linspace(0, 1, 21)}):
        with pytest.raises(ValueError, match="but the horizon is free; expected t0 = 0 and no nodes"):
            solver(ocp).solve([[1.0, 0.0]], **fixed, **SERIAL)
    with pytest.raises(ValueError, match=r"horizon is 1.0, but that of the problem is Free"):
        NMPC(ocp, horizon=1.0)


def test_the_judge_agrees_where_the_horizon_was_found():
    ocp = integrator(**FASTEST, state_bounds={"v": (-0.8, 0.8)})
    s = solver(ocp, 30).solve([1.28, 0.0], **SERIAL)
    run = nocl.simulate(replace(ocp, horizon=float(s.t[0, -1])), s.u, [1.28, 0.0])
    assert run.cost[0] == pytest.approx(s.cost[0], rel=1e-7)
    assert run.violation[0] < 1e-5


@pytest.mark.parametrize("soft", [["wall"], ["v", "v"], "v", [3]])
def test_soft_names_are_names(soft):
    with pytest.raises(ValueError, match=r"NMPC: soft is .*; expected"):
        NMPC(integrator(state_bounds={"v": (-1, 1)}), soft=soft)


def test_one_meaning_of_soft():
    with pytest.raises(ValueError, match=r"constraints is 'soft' and soft is .'v'.; expected one of them"):
        NMPC(integrator(state_bounds={"v": (-1, 1)}), soft=["v"], constraints="soft")
    with pytest.raises(ValueError, match="gains are not implemented for soft constraints"):
        solver(integrator(state_bounds={"v": (-1, 1)}), soft=["v"]).solve([1.0, 0.0], gains=True)


def test_states_are_held_hard_by_bounds_as_by_path_constraints():
    """The same wall as a bound and as a path constraint: one solution, gains as well."""
    bound = integrator(terminal=P**2 + V**2, state_bounds={"v": (-0.3, None)})
    path = integrator(terminal=P**2 + V**2, path_constraints={"v": V + 0.3})
    a, b = (solver(ocp).solve([1.0, 0.0], gains=True, **SERIAL) for ocp in (bound, path))
    assert a.cost == pytest.approx(b.cost, rel=1e-7)
    assert a.gain == pytest.approx(b.gain, abs=1e-4)
    assert a.x[:, :, 1].min() == pytest.approx(-0.3, abs=1e-6)


def test_a_limit_of_the_rate_makes_a_jerk():
    """p''' = j, |j| <= 1, from rest to rest in least time: j is -1, 1, -1 over T / 4, T / 2, T / 4, p(0) = T^3 / 32."""
    slow = nocl.limit_rates(integrator().system, {"u": 1.0})
    assert (slow.state_names, slow.control_names) == (("p", "v", "u"), ("u_rate",))
    ends = {name: (0, e, 0) for name, e in zip(("p end", "v end", "u end"), (P, V, U), strict=True)}
    ocp = nocl.OCP(slow, horizon=nocl.Free(0.5, 20), running=1.0, terminal=0.0, x_goal=[0, 0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([0.1, 0, 0], [2, 0, 0]), terminal_constraints=ends,
                   state_bounds={"u": (-1, 1)})
    s = solver(ocp).solve([0.25, 0.0, 0.0], **SERIAL)
    assert s.cost[0] == pytest.approx(8**(1 / 3), rel=1e-6)
    assert s.u[0, :, 0] == pytest.approx(np.repeat([-1, 1, -1], [5, 10, 5]), abs=1e-4)
    rate = np.diff(s.x[0, :, 2]) / np.diff(s.t[0])
    assert np.abs(rate).max() <= 1 + 1e-7


FILE = """
import casadi as ca
import nocl

p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
system = nocl.System("integrator", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-5, -5],
                     ubx=[5, 5])
ocp = nocl.OCP(system, horizon=nocl.Free(0.5, 10), running=1.0, terminal=0.0, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Uniform([1, 0], [2, 0]), terminal_constraints={"p": (0, p, 0), "v": (0, v, 0)})
"""


def test_the_command_line_solves_a_free_horizon_and_trains_none_on_learned_dynamics(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fast.py").write_text(FILE)
    assert main(["solve", "fast.py", "--solver", "nmpc", "--n", "2", "--intervals", "20", "--out", "a"]) == 0
    assert "2 of 2 solved" in capsys.readouterr().out
    with np.load(tmp_path / "a" / "solutions" / "nmpc.npz") as data:
        assert data["t"][:, -1] == pytest.approx(2 * np.sqrt(data["x0"][:, 0]), rel=1e-5)
        assert data["judged_success"].all()
    for command in ("train", "run"):
        assert main([command, "fast.py", "--out", "b"]) == 2
        assert "takes a number as horizon" in "".join(capsys.readouterr())


def test_outcomes_are_kept_with_their_horizons(tmp_path):
    """The second call finds what the first one left."""
    nmpc = solver(integrator(**FASTEST))
    first, again = (nmpc.solve([[1.0, 0.0], [1.5, 0.0]], out=tmp_path, **SERIAL) for _ in range(2))
    for name in ("t", "x", "u", "cost", "V_x", "seconds"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


def point():
    """A point in the plane from rest to rest, around a disc, with a speed limit."""
    x, y, vx, vy, ax, ay = (ca.SX.sym(name) for name in ("x", "y", "vx", "vy", "ax", "ay"))
    system = nocl.System("point", x=ca.vertcat(x, y, vx, vy), u=ca.vertcat(ax, ay), xdot=ca.vertcat(vx, vy, ax, ay),
                         lbu=[-3] * 2, ubu=[3] * 2, lbx=[-4] * 4, ubx=[4] * 4)
    rest = {f"{name} there": (0, e, 0) for name, e in zip(("x", "y", "vx", "vy"), (x, y, vx, vy), strict=True)}
    return nocl.OCP(system, horizon=3.0, running=ax**2 + ay**2, terminal=0.0, x_goal=[0] * 4, u_goal=[0, 0],
                    initial_states=nocl.Uniform([-2.6, -0.3, 0, 0], [-2.0, 0.3, 0, 0]), terminal_constraints=rest,
                    constraints={"disc": (x + 1)**2 + y**2 - 0.25, "speed": (None, vx**2 + vy**2, 1.2)})


def test_margins_hold_constraints_between_nodes_as_those_of_ddp():
    ocp = point()
    x0 = ocp.initial_states.sample(3, 1)
    plain, held = (solver(ocp, between=between, starts=4).solve(x0, **SERIAL) for between in (False, True))
    ddp = DDP(ocp, intervals=20, substeps=1, threads=1, between=True).solve(x0, u=held.u)
    left = [solver(ocp).program.dips.left(s.t, s.x, s.u, np.zeros((3, 0))) for s in (plain, held)]
    assert left[0].min() > 1e-3
    assert left[1].max() < 2e-5
    np.testing.assert_allclose(held.cost, ddp.cost, rtol=1e-7)
    np.testing.assert_allclose(held.V_x, ddp.V_x, atol=1e-4 * np.abs(ddp.V_x).max())
    assert ((held.cost > plain.cost) & (held.cost < 1.05 * plain.cost)).all()
    assert not held.cut.any()
    assert plain.cut is None


def test_margins_that_cannot_be_held_are_told(tmp_path):
    """A corridor that swings out by 0.1 between all nodes."""
    x, u, t = ca.SX.sym("x"), ca.SX.sym("u"), nocl.time()
    system = nocl.System("walker", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    ocp = nocl.OCP(system, horizon=1.0, running=1 + u**2 + x**2, terminal=0.0, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Uniform([-0.001], [0.001]), scales={"corridor": 1.0},
                   constraints={"corridor": (-0.02, x - 0.1 * ca.sin(20 * ca.pi * t), 0.02)})
    nmpc = solver(ocp, between=True)
    first, again = (nmpc.solve([[0.0]], out=tmp_path, **SERIAL) for _ in range(2))
    for s in (first, again):
        assert s.success.all()
        assert s.cut.tolist() == [True]
        assert s.message[0] == "solved; between nodes it may cut corners, margins there could not be held"
    soft = solver(ocp, between=True, soft=["corridor"]).solve([[0.0]], **SERIAL)
    assert soft.success.all()


def test_a_loop_holds_constraints_of_the_control():
    """Closed loop, each control held for an interval: |u v| <= .12 where it acts."""
    ocp = integrator(terminal=5 * (P**2 + V**2), constraints={"power": (-0.12, U * V, 0.12)})
    loop = NMPC(ocp, 10, substeps=1, starts=2).controller()
    run = nocl.simulate(ocp, loop, [0.8, 0.0], hold=10)
    assert loop.failures == 0
    plan = solver(ocp, 10).solve([0.8, 0.0], **SERIAL)
    assert run.cost[0] == pytest.approx(plan.cost[0], rel=1e-2)
    power = run.u[0, :-1, 0] * run.x[0, :-1, 1]
    assert np.abs(power).max() <= 0.12 + 1e-6
    assert np.abs(plan.u[0, :, 0] * plan.x[0, :-1, 1]).max() == pytest.approx(0.12, abs=1e-6)  # it binds


@pytest.mark.parametrize("kind", ["path_constraints", "constraints"])
def test_each_row_is_scaled_by_its_own_size(kind):
    """A place in micrometres, a speed in m/s, and a limit of it in a unit of its own: costates in theirs."""
    small = nocl.System("small", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(1e6 * V, U), lbu=[-1], ubu=[1],
                        lbx=[-5e6, -5], ubx=[5e6, 5])
    p = 1e-6 * P
    ocp = nocl.OCP(small, horizon=2.0, running=U**2, terminal=p**2 + V**2, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([0.5e6, -0.1], [2e6, 0.1]), **{kind: {"slow": 1e7 * (V + 0.3)}})
    right = integrator(terminal=P**2 + V**2, state_bounds={"v": (-0.3, None)})
    a, b = (solver(one).solve(x0, **SERIAL) for one, x0 in ((ocp, [1e6, 0.0]), (right, [1.0, 0.0])))
    assert a.cost == pytest.approx(b.cost, rel=1e-6)
    assert a.costate[0] * [1e6, 1] == pytest.approx(b.costate[0], abs=1e-4)


def test_one_state_is_enough():
    """v' = u in least time: from 1 to 0 under |u| <= 1 it takes 1, under u >= -.8 by a constraint 1.25."""
    one = nocl.System("one", x=V, u=U, xdot=U, lbu=[-1], ubu=[1], lbx=[-2], ubx=[2])
    ocp = nocl.OCP(one, horizon=nocl.Free(0.1, 5), running=1.0, terminal=0.0, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Uniform([0.5], [1]), terminal_constraints={"end": (0, V, 0)})
    assert solver(ocp, 4).solve([1.0], **SERIAL).cost[0] == pytest.approx(1, rel=1e-7)
    slow = replace(ocp, constraints={"slow": U + 0.8})
    assert solver(slow, 4).solve([1.0], **SERIAL).cost[0] == pytest.approx(1.25, rel=1e-7)
    assert solver(slow, 4, soft=["end"]).solve([1.0], **SERIAL).cost[0] == pytest.approx(1.25, rel=1e-7)


NUMBERS = st.floats(-1, 1)


@settings(max_examples=6, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.floats(0.01, 0.3)), min_size=1, max_size=3), NUMBERS)
def test_a_plan_that_holds_them_is_never_beaten_by_one_that_does_not(rows, push):
    """Random quadratic constraints that some plan holds, at the nodes and at the end: a better one that holds them."""
    N, x0 = 10, np.array([1.0, -0.2])
    u = 0.6 * np.sin(push + np.arange(N) / 3)
    nodes = np.array([[*x0]] * (N + 1))
    for k in range(N):
        nodes[k + 1] = nodes[k] + 0.2 * np.array([nodes[k, 1] + 0.1 * u[k], u[k]])

    def constraint(c, p, v, w):
        return c[0] * p + c[1] * v + c[2] * p * v + c[3] * v * w

    most = [max(constraint(c, *x, w) for x, w in zip(nodes, [*u, 0.0], strict=True)) for c in rows]
    held = {f"c{i}": (None, constraint(c, P, V, U), c[4] + high)
            for i, (c, high) in enumerate(zip(rows, most, strict=True))}
    ends = {"end": (nodes[-1, 0] - 0.05, P, nodes[-1, 0] + 0.05)}
    ocp = integrator(constraints=held, terminal_constraints=ends, terminal=(P - 1)**2)
    s = solver(ocp, N).solve(x0, u[None, :, None], starts=1, **SERIAL)
    assert s.success[0], s.message[0]
    assert ocp.functions.c(s.x[0, :-1].T, s.u[0].T).full().min() >= -1e-6
    assert ocp.functions.c_end(s.x[0, -1]).full().min() >= -1e-6
    assert s.cost[0] <= 0.2 * (u**2).sum() + (nodes[-1, 0] - 1)**2 + 1e-8
