"""Free horizons in DDP: analytic least times, NMPC on the same nodes, slopes and gains, what is refused."""

import pickle
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.cli import main
from nocl.data import Solution
from nocl.solvers import DDP, NMPC, SolutionBank, solve_globally

P, V, U = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
AT_REST = {"at p": (0, P, 0), "at v": (0, V, 0)}
FIELDS = ("cost", "t", "x", "u", "gain", "V", "V_x", "success", "message")


def integrator(unit=1.0, **changed) -> nocl.OCP:
    """The double integrator to rest at 0 in minimum time, lengths in `unit` m."""
    system = nocl.System("integrator", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(V, U), lbu=[-1 / unit],
                         ubu=[1 / unit], lbx=[-5 / unit] * 2, ubx=[5 / unit] * 2)
    good = {"horizon": nocl.Free(0.5, 10), "running": 1.0, "terminal": 0.0, "x_goal": [0, 0], "u_goal": [0],
            "initial_states": nocl.Uniform([-2 / unit, -1 / unit], [2 / unit, 1 / unit]),
            "terminal_constraints": AT_REST}
    return nocl.OCP(system, **{**good, **changed})


def pendulum(**changed) -> nocl.OCP:
    theta, omega, u = (ca.SX.sym(name) for name in ("theta", "omega", "tau"))
    system = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=u,
                         xdot=ca.vertcat(omega, 9.81 * ca.sin(theta) + u), lbu=[-5], ubu=[5], lbx=[-7, -8], ubx=[7, 8])
    good = {"horizon": nocl.Free(0.5, 10), "running": 1 + 1e-3 * u**2, "terminal": 0.0, "x_goal": [0, 0],
            "u_goal": [0], "initial_states": nocl.Uniform([np.pi - 0.3, -0.3], [np.pi + 0.3, 0.3]),
            "terminal_constraints": {"up": (0, theta, 0), "still": (0, omega, 0)}}
    return nocl.OCP(system, **{**good, **changed})


@lru_cache
def fastest() -> nocl.OCP:
    return integrator()


@lru_cache
def smooth() -> nocl.OCP:
    """Time and effort: no control at a bound."""
    return integrator(running=1 + 0.1 * U**2, unit=0.1)


def solver(ocp: nocl.OCP, K: int = 20, **options) -> DDP:
    ddp = DDP(ocp, intervals=K, **{"substeps": 1, "threads": 1, **options})
    ddp.checked = True
    return ddp


def least_time(x: np.ndarray) -> np.ndarray:
    """From the right of the switching curve p = -v |v| / 2 first u = -1, then +1; mirrored from its left."""
    p, v = x.T
    side = np.sign(p + v * np.abs(v) / 2)
    return side * v + 2 * np.sqrt(v**2 / 2 + side * p)


def assert_nmpcs(ocp: nocl.OCP, s: Solution, cost=1e-8, costates=1e-5) -> None:
    """The optimum that IPOPT finds from there, on the same nodes."""
    nmpc = NMPC(ocp, s.u.shape[1], substeps=1, solver="ipopt", passes=0)
    other = nmpc.solve(s.x[:, 0], s, workers=1, p=s.p)
    assert other.success.all()
    np.testing.assert_allclose(s.cost, other.cost, rtol=cost)
    np.testing.assert_allclose(s.t, other.t, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(s.V_x, other.V_x, rtol=0, atol=costates * np.abs(other.V_x).max())


# Analytic answers


def test_minimum_time_is_twice_the_root_of_the_distance():
    """One switch, in the middle: on a node of any even grid, so that held controls lose nothing."""
    d = np.array([0.5, 1.0, 2.0])
    s = solver(fastest()).solve(np.c_[d, 0 * d])
    assert s.success.all()
    np.testing.assert_allclose(s.cost, 2 * np.sqrt(d), rtol=1e-7)
    np.testing.assert_allclose(s.t[:, -1], s.cost, rtol=1e-12)
    np.testing.assert_allclose(s.u[:, :, 0], np.tile(np.repeat([-1, 1], 10), (3, 1)), atol=1e-5)
    assert np.abs(s.x[:, -1]).max() < 1e-8
    np.testing.assert_allclose(s.V_x[:, 0, 0], 1 / np.sqrt(d), rtol=1e-5)  # of T = 2 sqrt(d)
    np.testing.assert_allclose(s.V, s.t[:, -1:] - s.t, atol=1e-7)


def test_minimum_time_from_anywhere_is_the_switching_curves():
    ocp, K = fastest(), 40
    x0 = ocp.initial_states.sample(20, 3)
    x0 = x0[least_time(x0) > 0.6]
    s = solver(ocp, K).solve(x0)
    assert s.success.mean() >= 0.9
    off = s.cost[s.success] / least_time(x0[s.success]) - 1
    assert off.min() > -1e-9
    assert off.max() < 2 / K**2  # controls are held: a switch between nodes costs a little
    assert s.clearance[s.success].min() > -1e-9


def test_a_speed_limit_makes_it_coast():
    """|v| <= .8: .8 s to that speed, .8 s along, .8 s to rest over 1.28 m."""
    s = solver(integrator(state_bounds={"v": (-0.8, 0.8)}), 30).solve([1.28, 0.0])
    assert s.success.all()
    assert s.cost[0] == pytest.approx(2.4, rel=1e-8)
    np.testing.assert_allclose(s.u[0, :, 0], np.repeat([-1, 0, 1], 10), atol=1e-6)
    assert s.x[0, :, 1].min() > -0.8 - 1e-9


def test_units_change_nothing():
    x0 = np.array([[1.0, 0.3], [-1.5, 0.2]])
    reference = solver(fastest()).solve(x0)
    s = solver(integrator(unit=1e-4)).solve(x0 / 1e-4)
    assert s.success.all()
    np.testing.assert_allclose(s.cost, reference.cost, rtol=1e-8)


def test_bounds_of_the_horizon_are_kept():
    """In 3 s, more than it needs, the least effort is a cubic: int u^2 = 12 / T^3."""
    s = solver(integrator(horizon=nocl.Free(3, 10), running=1 + U**2), 40).solve([1.0, 0.0])
    assert s.success[0]
    assert s.t[0, -1] == 3.0
    assert s.cost[0] == pytest.approx(3 + 12 / 27, rel=2e-3)


def test_a_horizon_that_is_too_short_is_told():
    s = solver(integrator(horizon=nocl.Free(0.5, 1.5))).solve([1.0, 0.0])
    assert not s.success[0]
    assert "infeasible: no plan holds 'at" in s.message[0]
    assert s.t[0, -1] == pytest.approx(1.5)


# The same nodes as NMPC


def test_optimum_is_nmpcs():
    ocp = pendulum()
    s = solver(ocp, 40).solve([[np.pi, 0.0], [np.pi - 0.2, 0.1]])
    assert s.success.all()
    assert_nmpcs(ocp, s)


def test_without_constraints_the_end_costs():
    ocp = integrator(running=1 + 0.01 * U**2, terminal_constraints={}, terminal=20 * (P**2 + V**2))
    s = solver(ocp).solve([[1.0, 0.2], [-0.5, 0.5]])
    assert s.success.all()
    assert np.abs(s.x[:, -1]).max() > 1e-3
    assert_nmpcs(ocp, s, cost=3e-6, costates=1e-4)  # with most controls at their bounds IPOPT's barrier costs as much:
    other = NMPC(ocp, 20, substeps=1, solver="ipopt", passes=0).solve(s.x[:, 0], s, workers=1)
    assert (s.cost < other.cost * (1 + 1e-9)).all()


def test_a_force_that_depends_on_time_and_parameters():
    mass, t = nocl.parameter("mass", nominal=1.0), nocl.time()
    force = U + 0.3 * ca.sin(2 * t)
    system = nocl.System("pushed", x=ca.vertcat(P, V), u=U, p=mass, xdot=ca.vertcat(V, force / mass),
                         lbu=[-1], ubu=[1], lbx=[-5, -5], ubx=[5, 5])
    ocp = nocl.OCP(system, horizon=nocl.Free(0.5, 10), running=1 + 0.1 * U**2, terminal=0.0, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([-2, -1], [2, 1]), parameters=nocl.Uniform([0.8], [1.2]),
                   terminal_constraints=AT_REST, constraints={"slow": (None, V - 0.1 * t, 1.0)})
    x0, p = [[1.0, 0.1], [-1.5, 0.0]], np.array([[0.9], [1.1]])
    ddp = solver(ocp, 30)
    s = ddp.solve(x0, p=p)
    assert s.success.all()
    assert_nmpcs(ocp, s)
    guess = {"u": s.u, "x": s.x, "gain": s.gain, "t": s.t}
    up, down = (ddp.solve(x0, p=p + e, **guess).cost for e in (1e-5, -1e-5))
    np.testing.assert_allclose((up - down) / 2e-5, s.V_p[:, 0], rtol=1e-5)


# Slopes and gains


def test_gains_and_curvature_find_the_horizon_anew():
    """u_0 and V_x of solutions from states nearby, each with a horizon of its own."""
    ddp, x0, e = solver(smooth()), np.array([[12.0, 3.0]]), 1e-3
    s = ddp.solve(x0, curvature=True)
    sides = [[ddp.solve(x0 + sign * e * np.eye(2)[i]) for i in range(2)] for sign in (1, -1)]
    for field, found in (("u", s.gain[0, 0]), ("V_x", s.V_xx[0, 0])):
        up, down = (np.column_stack([getattr(one, field)[0, 0] for one in side]) for side in sides)
        np.testing.assert_allclose((up - down) / (2 * e), found, rtol=0, atol=1e-4 * np.abs(found).max())
    fixed = solver(replace(smooth(), horizon=float(s.t[0, -1]))).solve(x0)
    np.testing.assert_allclose(fixed.V_x, s.V_x, rtol=0, atol=1e-6 * np.abs(s.V_x).max())  # costates are the same
    assert np.abs(fixed.gain[0, 0] - s.gain[0, 0]).max() > 0.1 * np.abs(s.gain[0, 0]).max()


# Batches, starts, files


def test_rows_do_not_depend_on_each_other():
    ddp, x0 = solver(fastest()), np.array([[1.0, 0.3], [-1.5, 0.2], [0.3, -0.9], [2.0, 1.0], [0.1, 0.7]])
    together, apart = ddp.solve(x0), [ddp.solve(x) for x in x0]
    for i, alone in enumerate(apart):
        for field in FIELDS:
            assert np.array_equal(getattr(together, field)[i], getattr(alone, field)[0]), field


def test_warm_starts_are_short():
    ddp, x0 = solver(pendulum(), 40), np.array([[np.pi, 0.0], [np.pi - 0.2, 0.1]])
    s = ddp.solve(x0)
    near = ddp.solve(x0 + 0.01, u=s.u, x=s.x, gain=s.gain, t=s.t)
    assert near.success.all()
    assert (near.iterations < 0.7 * s.iterations).all()
    np.testing.assert_allclose(near.t[:, -1], s.t[:, -1], rtol=0.05)


def test_the_best_of_many_starts():
    ddp = solver(fastest())
    x0 = np.array([[1.0, 0.3], [-1.5, 0.2], [0.3, -0.9], [2.0, 1.0], [0.1, 0.7]])
    s = solve_globally(ddp, x0, starts=4, rounds=2)
    assert s.success.all()
    np.testing.assert_allclose(s.cost, least_time(x0), rtol=6e-3)
    assert (s.hits > 2).all()
    np.testing.assert_allclose(s.t[:, -1], s.cost, rtol=1e-12)
    again = solve_globally(ddp, x0, starts=0, rounds=1, known=s)
    np.testing.assert_allclose(again.cost, s.cost, rtol=1e-6)


def test_it_goes_to_files_and_other_processes(tmp_path):
    ddp = solver(fastest())
    s = pickle.loads(pickle.dumps(ddp)).solve([[1.0, 0.0]], out=tmp_path / "kept")
    again = ddp.solve([[1.0, 0.0]], out=tmp_path / "kept")
    for field in FIELDS:
        assert np.array_equal(getattr(s, field), getattr(again, field)), field
    same = Solution.of_arrays(pickle.loads(pickle.dumps(s.arrays())))
    assert np.array_equal(same.t, s.t)


def test_optima_that_damped_sweeps_misjudge_are_found():
    """Without the second derivatives of f, which damping leaves out, V_TT is negative here."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("sink", x=x, u=u, xdot=u + 0.8 * ca.sin(x), lbu=[-20], ubu=[20], lbx=[-5], ubx=[5])
    ocp = nocl.OCP(system, horizon=nocl.Free(0.2, 5), running=1 + u**2, terminal=20 * x**2, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Uniform([-3], [3]))
    x0 = np.linspace(-3, 3, 13)[:, None]
    s, reference = solver(ocp, 40).solve(x0), NMPC(ocp, intervals=40).solve(x0, progress=False)
    assert (s.message == "converged").all()
    np.testing.assert_allclose(s.cost, reference.cost, rtol=1e-7, atol=1e-5)
    np.testing.assert_allclose(s.t[:, -1], reference.t[:, -1], rtol=1e-4)


def test_at_the_command_line(tmp_path, capsys):
    file = tmp_path / "fastest.py"
    file.write_text("""import casadi as ca, nocl
p, v, u = (ca.SX.sym(name) for name in "pvu")
system = nocl.System("cart", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-5, -5],
                     ubx=[5, 5])
ocp = nocl.OCP(system, horizon=nocl.Free(0.5, 10), running=1.0, terminal=0.0, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Uniform([1, -0.1], [2, 0.1]), terminal_constraints={"p": (0, p, 0), "v": (0, v, 0)})
""")
    options = ["--solver", "ddp", "--n", "3", "--intervals", "20", "--out", str(tmp_path / "run")]
    assert main(["solve", str(file), *options]) == 0
    assert "ddp: 3 of 3 solved" in capsys.readouterr().out


def test_what_cannot_be_is_refused():
    ddp, x0 = solver(fastest()), [[1.0, 0.0]]
    with pytest.raises(ValueError, match="the horizon is free; expected 0"):
        ddp.solve(x0, 0.5)
    with pytest.raises(ValueError, match=r"t ends at 20 in row 0; expected a horizon of Free\(0.5, 10\)"):
        ddp.solve(x0, t=np.linspace(0, 20, 21)[None])
    with pytest.raises(ValueError, match="the guess t has shape"):
        ddp.solve(x0, t=np.linspace(0, 5, 20)[None])
    number = solver(integrator(horizon=2.0, running=U**2))
    with pytest.raises(ValueError, match="the guess has nodes t, but the horizon is 2"):
        number.solve(x0, t=np.linspace(0, 2, 21)[None])
    with pytest.raises(ValueError, match=r"SolutionBank takes a number as horizon"):
        SolutionBank.of(ddp, ddp.solve(x0))
