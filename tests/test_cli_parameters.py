"""The command line on a problem with parameters: one of each state, or the problem at those of --p."""

import json

import numpy as np
import pytest
from movers import law_of_mass, optimum

import nocl
from nocl.cli.commands import main
from nocl.solvers import DDP, LQR

MOVER = """
import casadi as ca
import nocl

x, u = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("u")
mass, goal = nocl.parameter("mass", nominal=1.0, unit="kg"), nocl.parameter("goal", unit="m")
mover = nocl.System("mover", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], u / mass), lbu=[-20], ubu=[20], lbx=[-4, -4],
                    ubx=[4, 4])
ocp = nocl.OCP.quadratic(mover, p=goal, horizon=2.0, R=0.01, x_goal=[goal, 0], u_goal=[0],
                         initial_states=nocl.Gaussian([0, 0], [0.5, 0.5]),
                         parameters=nocl.Uniform([0.8, -1], [1.2, 1]))
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mover.py").write_text(MOVER)
    return tmp_path


def solved(folder, name):
    facts = json.loads((folder / "solutions" / f"{name}.json").read_text())
    with np.load(folder / "solutions" / f"{name}.npz", allow_pickle=False) as data:
        return facts, dict(data)


@pytest.mark.parametrize("solver", ["ddp", "lqr"])
def test_each_state_is_solved_at_its_own_p(here, capsys, solver):
    assert main(["solve", "mover.py", "--solver", solver, "--n", "3", "--intervals", "20", "--out", "new"]) == 0
    assert "drawn with seed 1, each at its own mass, goal" in capsys.readouterr().out
    facts, data = solved(here / "new", solver)
    ocp = nocl.load_ocp("mover.py")
    np.testing.assert_array_equal(data["x0"], ocp.initial_states.sample(3, 1))
    assert facts["parameters"] == ["mass", "goal"]
    assert len(np.unique(data["p"], axis=0)) == 3
    best = optimum(data["x0"], data["p"])
    np.testing.assert_allclose(data["cost"], best, rtol=1e-6 if solver == "lqr" else 0.02)
    if solver == "ddp":
        plan = DDP(ocp, intervals=20).solve(data["x0"], p=data["p"])
        np.testing.assert_allclose(data["V_p"], plan.V_p, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(data["judged_cost"], data["cost"], rtol=1e-6)


def test_with_p_the_problem_is_that_at_p(here, capsys):
    line = ["solve", "mover.py", "--solver", "lqr", "--n", "2", "--out", "new", "--p", "goal=0.5, mass=1.2"]
    assert main(line) == 0
    said = capsys.readouterr().out
    assert "its own" not in said
    assert "drawn with seed 1, at goal = 0.5, mass = 1.2" in said
    facts, data = solved(here / "new", "lqr")
    assert facts["p"] == {"mass": 1.2, "goal": 0.5}
    assert "p" not in data
    np.testing.assert_allclose(data["cost"], optimum(data["x0"], np.array([[1.2, 0.5]] * 2)), rtol=1e-7)


def test_dynamics_are_learned_over_the_plants_parameters(here, capsys):
    assert main(["identify", "mover.py", "--quick", "--out", "new"]) == 0
    model = nocl.LearnedDynamics.load(here / "new" / "dynamics")
    assert model.to_casadi().name_in() == ["x", "u", "p"]
    np.testing.assert_array_equal(model.parameters.ub, [1.2])
    assert model.score().mean < 0.01


@pytest.mark.slow
def test_a_controller_of_p_is_compared_and_exported(here, capsys):
    law_of_mass().save(here / "law" / "cnd")
    assert main(["compare", "law", "--methods", "cnd,lqr", "--n", "2", "--out", "report"]) == 0
    assert "on 2 initial states, drawn with seed 1, each at its own mass, goal" in capsys.readouterr().out
    head, *rows = (here / "report" / "rows.csv").read_text().splitlines()
    assert {"p_mass", "p_goal"} < set(head.split(","))
    assert len(rows) == 3 * 2  # with the reference
    assert main(["compare", "law", "--methods", "cnd,lqr", "--n", "2", "--out", "at", "--p", "mass=0.9,goal=0.5"]) == 0
    assert capsys.readouterr().out.count("at mass = 0.9, goal = 0.5") == 2
    assert "mass = 0.9, goal = 0.5" in (here / "at" / "summary.json").read_text()
    assert "p_mass" not in (here / "at" / "rows.csv").read_text()
    summary = json.loads((here / "at" / "summary.json").read_text())["summary"]
    one = law_of_mass().ocp.at([0.9, 0.5])
    alone = nocl.simulate(one, LQR(one), one.initial_states.sample(2, 1)).cost
    assert summary[1]["cost_mean"] == pytest.approx(alone.mean(), rel=1e-7)
    assert main(["export", "law", "--to", "c", "--against", "casadi", "--out", "c", "--p", "mass=0.9,goal=0.5"]) == 0
    assert "const double *p" not in (here / "c" / "c" / "mover_policy.h").read_text()


@pytest.mark.parametrize(("line", "said"), [
    ("solve mover.py --p mass", "'mass'; expected different parameters with finite numbers, like mass=1.2,goal=0.5"),
    ("solve mover.py --p mass=inf,goal=0", "expected different parameters with finite numbers"),
    ("solve mover.py --p mass=1,mass=2", "expected different parameters"),
    ("solve mover.py --p mass=1", "p lacks goal; expected values of mass, goal"),
    ("solve mover.py --p mass=1,goal=0,size=3", "unknown size"),
    ("solve cartpole --p mass=1", "the problem has no parameters"),
    ("solve mover.py --solver neural-oc", "is made for one p, and the problem on 'mover' has the"),
    ("solve mover.py --solver level-sets", "is made for one p, and the problem on 'mover' has the")])
def test_mistakes_are_one_line_and_nothing_is_written(here, capsys, line, said):
    assert main([*line.split(), "--out", "new"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert {path.name for path in here.iterdir()} <= {"mover.py", "new", "__pycache__"}
    assert not list((here / "new").rglob("*.npz"))
