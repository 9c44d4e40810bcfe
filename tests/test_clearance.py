"""Path constraints in solutions: who crosses one has not solved the problem, in any unit, from any solver."""

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.cli import main
from nocl.comparisons import compare
from nocl.solvers import DDP, NMPC, solve_globally

MASS = """
import casadi as ca
import nocl

p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
system = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-5, -5],
                     ubx=[5, 5])
ocp = nocl.OCP(system, horizon=3.0, running=0.1 * u**2 + p**2, terminal=p**2 + v**2, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Gaussian(mean=[{p0}, {v0}], std=[0.01, 0.01]), path_constraints={{"wall": {wall}}})
"""


def mass(wall="1 - p", p0=0.5, v0=0.2, unit=1.0):
    """x in `unit` m; the wall in any unit."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u / unit), lbu=[-1], ubu=[1],
                         lbx=[-5 / unit] * 2, ubx=[5 / unit] * 2)
    P, W = unit * p, unit * v
    walls = {"1 - p": 1 - P, "disk": P**2 - 0.02**2, "in mm2": 1e6 * (1 - P), "always": 9 + P**2}
    return nocl.OCP(system, horizon=3.0, running=0.1 * u**2 + P**2, terminal=P**2 + W**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian(mean=np.array([p0, v0]) / unit, std=np.full(2, 0.01 / unit)),
                    path_constraints={"wall": walls[wall]})


def test_no_solver_says_solved_where_the_wall_cannot_be_missed():
    """From 0.5 m at 1.5 m/s braking takes 1.125 m, and the wall is 0.5 m away."""
    ocp, x0 = mass(), [[0.5, 1.5], [0.5, 0.2]]
    for found in (DDP(ocp).solve(x0), solve_globally(DDP(ocp), x0, starts=2, rounds=1)):
        assert found.success.tolist() == [False, True]
        assert np.isinf(found.cost[0])
        assert "no plan holds 'wall' from here, worst at node" in found.message[0]
        assert found.clearance[1] > -1e-8
    assert DDP(ocp, constraints="soft").solve(x0).success.all()
    planned = NMPC(ocp, 40, starts=2).solve(x0, workers=1)
    assert planned.success.tolist() == [False, True]
    assert "infeasible" in planned.message[0]
    assert "where none of them holds 'wall' from there" in planned.message[0]
    assert planned.clearance[1] >= -1e-6


def test_a_state_inside_the_wall_is_said_to_be():
    message = DDP(mass()).solve([1.5, 0.0]).message[0]
    assert message == "infeasible: the initial state itself violates 'wall', worst at node 0 by 0.5: move it"


def test_the_command_line_judges_what_it_solved(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "free.py").write_text(MASS.format(p0=0.5, v0=0.2, wall="1 - p"))
    (tmp_path / "lost.py").write_text(MASS.format(p0=0.5, v0=1.5, wall="1 - p"))
    for solver in ("ddp", "nmpc"):
        assert main(["solve", "free.py", "--solver", solver, "--n", "3", "--intervals", "30", "--out", "a"]) == 0
        said = capsys.readouterr().out
        assert "3 of 3 solved" in said
        assert "judged in open loop on the exact f, 3 plans: mean cost" in said
        assert "least clearance" in said
        with np.load(tmp_path / "a" / "solutions" / f"{solver}.npz") as data:
            np.testing.assert_allclose(data["judged_cost"], data["cost"], rtol=1e-3)
        assert main(["solve", "lost.py", "--solver", solver, "--n", "3", "--intervals", "30", "--out", "b"]) == 2
        said = "".join(capsys.readouterr())
        assert "0 of 3 solved" in said
        assert "infeasible" in said


def test_a_thin_obstacle_that_is_crossed_in_full_is_violated():
    """p^2 - 0.02^2 >= 0 is never worse than -4e-4, whatever crosses it."""
    ocp = mass("disk", p0=0.5, v0=-0.5)
    np.testing.assert_allclose(ocp.constraint_scales, 0.02**2, rtol=1e-6)
    report = compare(ocp, {"through": lambda x, t: -x[:, :1] - x[:, 1:]}, n=3, seed=0)
    assert not report.feasible.any()
    assert any("violate" in line for line in report.verdict())


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("wall", ["1 - p", "in mm2"])
def test_violations_do_not_depend_on_units(unit, wall):
    ocp = mass(wall, unit=unit)
    seen = nocl.simulate(ocp, lambda x, t: np.full((len(x), 1), 0.6), np.array([[0.5, 0.2], [-3.0, 0.0]]) / unit)
    right = nocl.simulate(mass(), lambda x, t: np.full((len(x), 1), 0.6), [[0.5, 0.2], [-3.0, 0.0]])
    np.testing.assert_allclose(seen.violation, right.violation, rtol=1e-4)
    assert right.violation[0] > 1
    assert right.violation[1] == 0


def test_a_constraint_that_always_holds_is_never_violated():
    ocp = mass("always")
    assert ocp.constraint_scales[0] > 0
    assert nocl.simulate(ocp, np.zeros((1, 4, 1)), [0.0, 0.0]).violation[0] == 0
    assert nocl.load_ocp("cartpole").constraint_scales.shape == (0,)
