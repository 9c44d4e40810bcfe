"""nocl reproduce gym, quadrotor: what is trained on f_theta is judged on f, cells resume, nothing is invented."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import nocl
from nocl.cli.commands import main
from nocl.comparisons.reproduce import control, controllers
from nocl.comparisons.reproduce.control import GYM_TABLE, QUADROTOR_TABLE
from nocl.comparisons.reproduce.controllers import Made, Plan
from nocl.comparisons.reproduce.table import Place
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.lqr import LQR


def cell(way: str, error: list[float], seed: int = 0, problem: str = "acrobot", **more) -> controllers.Cell:
    magnitude = [10 * e for e in error]
    return controllers.Cell(problem, way, seed, {"n": len(error)}, "by hand", error, magnitude, error, 3.0, 2.0, 1.0,
                            640.0, 5.0, more.get("paths", []))


def standing(task):
    return Made(lambda x, t: np.tile(task.ocp.u_goal, (len(x), 1)), "u*", 7.0)


def test_every_row_of_a_seed_comes_before_the_next_seed():
    places = GYM_TABLE.places(Plan(seeds=2))
    assert places[:3] == [("acrobot", "cnd", 0), ("acrobot", "cnd-paper", 0), ("acrobot", "nmpc", 0)]
    assert [seed for _, _, seed in places] == [0] * 6 + [1] * 6
    assert {way for _, way, _ in places} == {"cnd-paper", "cnd", "nmpc"}  # the others are not run
    assert {problem for problem, _, _ in GYM_TABLE.places(Plan(problems=("cartpole",)))} == {"cartpole"}


@pytest.mark.parametrize(("wrong", "named"), [
    ({"problems": ("walker",)}, "some of acrobot, cartpole"), ({"n": 0}, "n is 0"), ({"seeds": True}, "seeds is True"),
    ({"iterations": 2.5}, "iterations is 2.5"), ({"ways": ("sac",)}, "some of cnd, cnd-paper, nmpc"),
    ({"ways": ("pets",)}, "some of cnd, cnd-paper, nmpc")])
def test_plans_are_checked(wrong, named):
    with pytest.raises(ValueError, match=named):
        GYM_TABLE.places(Plan(**wrong))


def test_the_judge_has_the_exact_f_and_the_problems_own_cost(monkeypatch, tmp_path):
    """A cart-pole that nobody pushes, trained on whatever: hanging, it costs about pi^2 and is about pi away."""
    given = []
    monkeypatch.setattr(control, "identified", lambda ocp, seed, plan: given.append(seed) or "f_theta")
    monkeypatch.setitem(GYM_TABLE.ways, "cnd", replace(GYM_TABLE.ways["cnd"], make=standing))
    made = GYM_TABLE.make(Plan(n=3), Place("cartpole", "cnd", 1), tmp_path)
    ocp = nocl.load_ocp("cartpole")
    x0 = ocp.initial_states.sample(3, control.HIDDEN + 1)
    s = nocl.simulate(ocp, np.zeros((3, 80, 1)), x0)
    assert given == [1]
    np.testing.assert_allclose(made.error, np.linalg.norm(ocp.from_goal(s.x[:, -1]), axis=1), rtol=1e-6)
    np.testing.assert_allclose(made.cost, s.cost, rtol=1e-6)
    assert made.magnitude == [0.0] * 3
    assert made.evaluations == 7.0
    assert made.ms > 0
    assert not made.paths  # of the quadrotor only


def test_lqr_flies_to_the_goal_and_its_flight_is_kept(tmp_path):
    made = QUADROTOR_TABLE.make(Plan(n=2), Place("quadrotor", "lqr"), tmp_path)
    assert max(made.error) < 0.2
    path = np.array(made.paths)
    assert path.shape == (2, controllers.NODES, 3)
    assert np.abs(path[:, -1] - 3).max() < 0.1
    x0 = nocl.load_ocp("quadrotor").initial_states.sample(2, control.HIDDEN)
    np.testing.assert_allclose(path[:, 0], x0[:, :3], atol=1e-3)


def test_what_ships_is_judged_without_training(tmp_path):
    plan, place = Plan(n=2, shipped=True), Place("quadrotor", "cnd-learned")
    made = QUADROTOR_TABLE.make(plan, place, tmp_path)
    card = nocl.pretrained("quadrotor", "learned").card
    assert made.seconds == card["seconds"]
    assert math.isnan(made.cpu)
    assert max(made.error) < 0.1
    assert made.key["controller"] == QUADROTOR_TABLE.key(plan, place)["controller"]
    assert "controller" not in QUADROTOR_TABLE.key(plan, place._replace(seed=1))  # which is trained
    entries = QUADROTOR_TABLE.entries([made])
    assert f"| {card['seconds']:.0f} |" in QUADROTOR_TABLE.markdown(entries)


@pytest.mark.slow
def test_nmpc_runs_in_closed_loop(tmp_path):
    made = QUADROTOR_TABLE.make(Plan(n=1), Place("quadrotor", "nmpc"), tmp_path)
    x0 = nocl.load_ocp("quadrotor").initial_states.sample(1, control.HIDDEN)
    best = DDP(nocl.load_ocp("quadrotor")).solve(x0)
    assert made.cost[0] == pytest.approx(float(best.cost[0]), rel=1e-3)
    assert made.ms > 0


def test_a_method_that_refuses_a_problem_without_control_cost_says_why(monkeypatch, tmp_path):
    def refuses(*_, **__):
        raise ValueError("train: not this one")

    monkeypatch.setattr(control, "identified", lambda ocp, seed, plan: None)
    monkeypatch.setattr(controllers, "train", refuses)
    made = QUADROTOR_TABLE.make(Plan(n=2, quick=True), Place("quadrotor", "r0"), tmp_path)
    assert made.error == []
    assert made.made == "refused: train: not this one"
    entry = next(e for e in QUADROTOR_TABLE.entries([made]) if e.way == "r0")
    assert math.isnan(entry.error)
    assert "refused: train: not this one" in QUADROTOR_TABLE.markdown([entry])


def test_ddp_counts_its_forward_evaluations():
    ocp = nocl.load_ocp("double_integrator")
    ddp = DDP(ocp, intervals=10)
    x0 = ocp.initial_states.sample(4, 0)
    solution = ddp.solve(x0)
    rolled = ddp.evaluations["rollout"]
    assert rolled % (4 * 10) == 0
    assert rolled >= 4 * 10 * (4 + int(solution.iterations.sum()))  # the guesses, and a trial step an iteration
    ddp.solve(x0, workers=1)
    assert ddp.evaluations["rollout"] == 2 * rolled


def test_cells_of_the_papers_method_know_its_settings():
    """They survive JSON unchanged, and another budget is another cell."""
    plan, place = Plan(iterations=7), Place("quadrotor", "r0-paper")
    key = QUADROTOR_TABLE.key(plan, place)
    assert key == json.loads(json.dumps(key))
    assert (key["iterations"], key["near_goal"]) == (7, 1e-3)
    assert key != QUADROTOR_TABLE.key(replace(plan, iterations=8), place)
    assert GYM_TABLE.key(plan, Place("cartpole", "cnd-paper"))["near_goal"] is None
    assert "iterations" not in QUADROTOR_TABLE.key(plan, Place("quadrotor", "cnd"))


def test_means_spread_over_states_and_over_seeds():
    cells = [cell("cnd", [1.0, 3.0]), cell("cnd", [5.0, math.inf], seed=1)]
    entry = next(e for e in GYM_TABLE.entries(cells) if e.way == "cnd")
    assert (entry.error, entry.error_low, entry.error_high) == (3.0, 2.0, 5.0)
    assert entry.error_std == pytest.approx(np.std([1, 3, 5]))
    assert entry.magnitude == 30.0
    assert (entry.failed, entry.n, entry.seeds) == (1, 2, 2)


def test_tables_and_figures(tmp_path):
    cells = [cell("cnd", [0.2]), cell("cnd", [0.3], seed=1), cell("cnd", [0.04], problem="cartpole")]
    paths = GYM_TABLE.write(tmp_path, cells)
    assert [p.name for p in paths] == ["gym.md", "gym.tex", "gym.csv", "gym.png"]
    text = paths[0].read_text()
    assert "| acrobot | CND, nocl's default | f_theta | 0.25 ± 0.05 | 0.2 .. 0.3 |" in text
    assert "| cartpole | CND, nocl's default | f_theta | 0.04 ± 0 |  |" in text  # one seed has no spread
    assert text.count("not run yet") == 6
    assert "not run yet | 0.284 ± 0.1 | 4.62 ± 2.63 | 4789 |" in text  # the paper's Deep PILCO, beside nothing of ours
    widths = {line.count("|") for line in text.strip().splitlines()}
    assert len(widths) == 1
    rows = {(r["problem"], r["way"]): r for r in csv.DictReader(io.StringIO(paths[2].read_text()))}
    assert rows["acrobot", "pets"]["error"] == ""
    assert rows["acrobot", "pets"]["paper_evaluations"] == "12602"
    assert float(rows["cartpole", "cnd"]["error"]) == 0.04
    tex = paths[1].read_text()
    assert r"\color{gray}3.095\scriptsize{$\pm$0.69}" in tex
    assert len({line.count("&") for line in tex.splitlines() if "&" in line and "multicolumn" not in line}) == 1


def test_the_quadrotors_flights_are_drawn(tmp_path):
    paths = [[[0.0, 0.0, 0.0], [1.0, 1.0, 50.0], [3.0, 3.0, 3.0]]]
    made = QUADROTOR_TABLE.write(tmp_path, [cell("lqr", [0.1], problem="quadrotor", paths=paths)])
    assert made[-1].name == "quadrotor-3d.png"
    assert made[-1].stat().st_size > 5000


def test_the_command_resumes_and_keeps_the_cells(tmp_path, monkeypatch, capsys):
    made = []

    def way(task):
        made.append(task.seed)
        return standing(task)

    monkeypatch.setattr(control, "identified", lambda ocp, seed, plan: None)
    monkeypatch.setitem(GYM_TABLE.ways, "cnd", replace(GYM_TABLE.ways["cnd"], make=way))
    arguments = ["reproduce", "gym", "--quick", "--n", "2", "--ways", "cnd", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert made == [0, 0]  # two problems
    assert main(arguments) == 0
    assert made == [0, 0]
    assert main([*arguments, "--problems", "cartpole"]) == 0
    assert made == [0, 0]
    assert main([*arguments, "--seeds", "2"]) == 0
    assert made == [0, 0, 1, 1]
    assert "2 x 2" in capsys.readouterr().out
    first = GYM_TABLE.finished(tmp_path)
    assert [(c.seed, c.problem) for c in first] == [(0, "acrobot"), (0, "cartpole"), (1, "acrobot"), (1, "cartpole")]
    plan = Plan(n=2, seeds=2, iterations=10, quick=True, ways=("cnd",))
    assert GYM_TABLE.run(tmp_path, plan, progress=False) == first
    (tmp_path / "cells" / "gym-acrobot-cnd-0.json").write_text("{}")
    with pytest.raises(ValueError, match="no cell of the tables of control"):
        GYM_TABLE.finished(tmp_path)


def test_the_command_refuses_rows_that_are_not_there(tmp_path, capsys):
    assert main(["reproduce", "quadrotor", "--ways", "pid", "--out", str(tmp_path / "x")]) != 0
    assert "expected some of" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_lqr_is_no_hidden_optimum():
    """The row's controller is clipped to U like all others."""
    ocp = nocl.load_ocp("quadrotor")
    u = LQR(ocp)(np.r_[np.full(3, 1e4), np.zeros(9)], 3.9)
    assert np.abs(u).max() <= 100.0


def test_slow_ways_have_fewer_states():
    ways = GYM_TABLE.ways
    assert [GYM_TABLE.states(Plan(), ways[name]) for name in ("nmpc", "cnd")] == [5, 1000]
    assert GYM_TABLE.states(Plan(n=3), ways["nmpc"]) == 3
