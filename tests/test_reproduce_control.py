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
from nocl.comparisons.reproduce import control, control_tables
from nocl.comparisons.reproduce.control import Made, Plan
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.lqr import LQR


def cell(way: str, error: list[float], seed: int = 0, problem: str = "acrobot", **more) -> control.Cell:
    magnitude = [10 * e for e in error]
    return control.Cell(problem, way, seed, {"n": len(error)}, "by hand", error, magnitude, error, 3.0, 2.0, 1.0, 640.0,
                        5.0, more.get("paths", []))


def standing(task):
    return Made(lambda x, t: np.tile(task.ocp.u_goal, (len(x), 1)), "u*", 7.0)


def test_every_row_of_a_seed_comes_before_the_next_seed():
    cells = Plan("gym", seeds=2).cells()
    assert cells[:3] == [(0, "acrobot", "cnd"), (0, "acrobot", "cnd-paper"), (0, "acrobot", "nmpc")]
    assert [seed for seed, _, _ in cells] == [0] * 6 + [1] * 6
    assert {way for _, _, way in cells} == {"cnd-paper", "cnd", "nmpc"}  # the others are not run


@pytest.mark.parametrize(("wrong", "named"), [
    ({"table": "walker"}, "expected gym or quadrotor"), ({"n": 0}, "n is 0"), ({"seeds": True}, "seeds is True"),
    ({"iterations": 2.5}, "iterations is 2.5"), ({"ways": ("sac",)}, "some of cnd, cnd-paper, nmpc"),
    ({"ways": ("pets",)}, "some of cnd, cnd-paper, nmpc")])
def test_plans_are_checked(wrong, named):
    with pytest.raises(ValueError, match=named):
        Plan(**{"table": "gym", **wrong})


def test_the_judge_has_the_exact_f_and_the_problems_own_cost(monkeypatch):
    """A cart-pole that nobody pushes, trained on whatever: hanging, it costs about pi^2 and is about pi away."""
    given = []
    monkeypatch.setattr(control, "_identified", lambda ocp, seed, plan: given.append(seed) or "f_theta")
    monkeypatch.setitem(control.GYM.ways, "cnd", replace(control.GYM.ways["cnd"], make=standing))
    made = control.make(Plan("gym", n=3), "cartpole", "cnd", 1)
    ocp = nocl.load_ocp("cartpole")
    x0 = ocp.initial_states.sample(3, control.HIDDEN + 1)
    s = nocl.simulate(ocp, np.zeros((3, 80, 1)), x0)
    assert given == [1]
    np.testing.assert_allclose(made.error, s.terminal_error, rtol=1e-6)
    np.testing.assert_allclose(made.cost, s.cost, rtol=1e-6)
    assert made.magnitude == [0.0] * 3
    assert made.evaluations == 7.0
    assert made.ms > 0
    assert not made.paths  # of the quadrotor only


def test_lqr_flies_to_the_goal_and_its_flight_is_kept():
    made = control.make(Plan("quadrotor", n=2), "quadrotor", "lqr", 0)
    assert max(made.error) < 0.2
    path = np.array(made.paths)
    assert path.shape == (2, control.NODES, 3)
    assert np.abs(path[:, -1] - 3).max() < 0.1
    x0 = nocl.load_ocp("quadrotor").initial_states.sample(2, control.HIDDEN)
    np.testing.assert_allclose(path[:, 0], x0[:, :3], atol=1e-3)


def test_what_ships_is_judged_without_training():
    plan = Plan("quadrotor", n=2, shipped=True)
    made = control.make(plan, "quadrotor", "cnd-learned", 0)
    card = nocl.pretrained("quadrotor", "learned").card
    assert made.seconds == card["seconds"]
    assert math.isnan(made.cpu)
    assert max(made.error) < 0.1
    assert made.key["controller"] == control._key(plan, "quadrotor", "cnd-learned", 0)["controller"]
    assert "controller" not in control._key(plan, "quadrotor", "cnd-learned", 1)  # which is trained
    entries = control.table([made], "quadrotor")
    assert f"| {card['seconds']:.0f} |" in control_tables.markdown(entries, "quadrotor")


def test_nmpc_runs_in_closed_loop():
    made = control.make(Plan("quadrotor", n=1), "quadrotor", "nmpc", 0)
    x0 = nocl.load_ocp("quadrotor").initial_states.sample(1, control.HIDDEN)
    best = DDP(nocl.load_ocp("quadrotor")).solve(x0)
    assert made.cost[0] == pytest.approx(float(best.cost[0]), rel=1e-3)
    assert made.ms > 0


def test_without_a_control_cost_nocls_default_says_why_it_refuses(monkeypatch):
    monkeypatch.setattr(control, "_identified", lambda ocp, seed, plan: None)
    made = control.make(Plan("quadrotor", n=2, quick=True), "quadrotor", "r0", 0)
    assert made.error == []
    assert "refused: " in made.made
    assert "not convex in the controls" in made.made
    entry = next(e for e in control.table([made], "quadrotor") if e.way == "r0")
    assert math.isnan(entry.error)
    assert "refused: no problem of quadrotor" in control_tables.markdown([entry], "quadrotor")


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
    plan = Plan("quadrotor", iterations=7)
    key = control._key(plan, "quadrotor", "r0-paper", 0)
    assert key == json.loads(json.dumps(key))
    assert (key["iterations"], key["near_goal"]) == (7, 1e-3)
    assert key != control._key(replace(plan, iterations=8), "quadrotor", "r0-paper", 0)
    assert control._key(replace(plan, table="gym"), "cartpole", "cnd-paper", 0)["near_goal"] is None
    assert "iterations" not in control._key(plan, "quadrotor", "cnd", 0)


def test_means_spread_over_states_and_over_seeds():
    cells = [cell("cnd", [1.0, 3.0]), cell("cnd", [5.0, math.inf], seed=1)]
    entry = next(e for e in control.table(cells, "gym") if e.way == "cnd")
    assert (entry.error, entry.error_low, entry.error_high) == (3.0, 2.0, 5.0)
    assert entry.error_std == pytest.approx(np.std([1, 3, 5]))
    assert entry.magnitude == 30.0
    assert (entry.failed, entry.n, entry.seeds) == (1, 2, 2)


def test_tables_and_figures(tmp_path):
    cells = [cell("cnd", [0.2]), cell("cnd", [0.3], seed=1), cell("cnd", [0.04], problem="cartpole")]
    paths = control_tables.write(tmp_path, cells, "gym")
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
    made = control_tables.write(tmp_path, [cell("lqr", [0.1], problem="quadrotor", paths=paths)], "quadrotor")
    assert made[-1].name == "quadrotor-3d.png"
    assert made[-1].stat().st_size > 5000


def test_the_command_resumes_and_keeps_the_cells(tmp_path, monkeypatch, capsys):
    made = []

    def way(task):
        made.append(task.seed)
        return standing(task)

    monkeypatch.setattr(control, "_identified", lambda ocp, seed, plan: None)
    monkeypatch.setitem(control.GYM.ways, "cnd", replace(control.GYM.ways["cnd"], make=way))
    arguments = ["reproduce", "gym", "--quick", "--n", "2", "--ways", "cnd", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert made == [0, 0]  # two problems
    assert main(arguments) == 0
    assert made == [0, 0]
    assert main([*arguments, "--seeds", "2"]) == 0
    assert made == [0, 0, 1, 1]
    assert "2 x 2" in capsys.readouterr().out
    first = control.finished(tmp_path, "gym")
    assert [(c.seed, c.problem) for c in first] == [(0, "acrobot"), (0, "cartpole"), (1, "acrobot"), (1, "cartpole")]
    plan = Plan("gym", 2, 2, 10, quick=True, ways=("cnd",))
    assert control.run(tmp_path, plan, progress=False) == first
    (tmp_path / "cells" / "gym-acrobot-cnd-0.json").write_text("{}")
    with pytest.raises(ValueError, match="no cell of the tables of control"):
        control.finished(tmp_path, "gym")


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
    ways = control.TABLES["gym"].ways
    assert [Plan("gym").states(ways[name]) for name in ("nmpc", "cnd")] == [5, 1000]
    assert Plan("gym", n=3).states(ways["nmpc"]) == 3
