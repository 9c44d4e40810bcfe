"""nocl reproduce dubins, approaches: cells resume, lengths and success are right, the paper's numbers stand beside."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

import nocl
from nocl.comparisons.reproduce import approaches, dubins
from nocl.comparisons.reproduce.dubins import TABLE

X0 = np.array([[-3.0, 1.0, 0.0], [-3.0, -1.0, 0.0]])


def cell(way: str, length: list[float], cost: list[float], error: list[float], clearance: list[float]) -> dubins.Cell:
    path = [[[-3.0, 1.0], [0.0, 0.0]]] * len(length)
    return dubins.Cell(way, 0, {"n": len(length)}, 2.0, "by hand", length, error, clearance, cost, path)


OPTIMUM = cell("optimum", [4.0, 4.0, 5.0], [0.04, 0.04, 0.05], [0.01] * 3, [0.1] * 3)
CND = cell("cnd", [4.2, 4.4, 9.0], [0.042, 0.044, math.inf], [0.01, 0.01, math.inf], [0.1] * 3)


def test_a_state_that_a_controller_has_no_answer_to_does_not_stop_the_clock():
    """Level sets: NaN outside their box, and states that are not finite are refused."""
    def controller(x, t):
        assert np.isfinite(x).all()
        return np.where(x[:, :1] < -2.0, [[0.5, 0.0]], np.nan)

    assert dubins.rollout_ms(nocl.load_ocp("dubins"), controller, X0) > 0


def test_lengths_are_those_of_the_driven_curve():
    """Half of the speed for 8 s: 4 m, in open loop; NaN controls are a failure, not a length."""
    ocp = nocl.load_ocp("dubins")
    u = np.tile([0.5, 0.2], (2, 80, 1))
    u[1, 3] = np.nan
    s, length = dubins.judged(ocp, u, X0)
    assert length[0] == pytest.approx(4.0)
    assert math.isinf(length[1])
    assert not s.success[1]


def test_a_feedback_is_rolled_out_for_all_states_at_once():
    ocp, asked = nocl.load_ocp("dubins"), []

    def controller(x, t):
        asked.append(len(x))
        return np.zeros((len(x), 2))

    assert dubins.rollout_ms(ocp, controller, X0) > 0
    assert asked == [2] * (dubins.INTERVALS + 1)


def test_both_sides_and_both_turning_directions_are_taken_each_where_it_is_better():
    """The shipped controller on states and their mirror images: mirrored paths, each at the cost of the best one."""
    from nocl.judge import simulate
    from nocl.solvers.ddp.solver import DDP

    ocp, mirror = nocl.load_ocp("dubins"), np.array([1.0, -1.0, -1.0])
    x0 = np.array([[-3.0, 1.0, 1.5], [-2.8, 2.0, -2.5], [-3.2, 0.6, 2.6], [-3.0, 2.0, 0.5]])
    run = simulate(ocp, nocl.pretrained("dubins", "exact"), np.concatenate([x0, x0 * mirror]), nodes=401)
    above = np.array([np.interp(-1.0, x[:, 0], x[:, 1]) for x in run.x]) > 0  # where px passes the obstacle's centre
    left = run.u[:, :40, 1].sum(axis=1) > 0  # the first 0.8 s
    n = len(x0)
    assert (above[:n] != above[n:]).all()
    assert (left[:n] != left[n:]).all()
    assert len({(bool(a), bool(b)) for a, b in zip(above, left, strict=True)}) == 4
    held = run.u[:, :-1].reshape(2 * n, 80, 5, 2).mean(axis=2)
    starts = [held, held * [1.0, -1.0], np.roll(held, n, axis=0), np.roll(held, n, axis=0) * [1.0, -1.0]]
    best = np.min([DDP(ocp).solve(np.concatenate([x0, x0 * mirror]), u=u).cost for u in starts], axis=0)
    assert (run.cost < 1.02 * best).all()


def test_success_needs_the_goal_and_the_obstacle():
    made = cell("cnd", [4.0] * 3, [1.0] * 3, [0.05, 0.2, 0.05], [0.1, 0.1, -0.01])
    assert made.success.tolist() == [True, False, False]
    assert TABLE.entries([made])[0].collisions == 1


def test_the_table_compares_with_the_optimum_of_the_same_states():
    entries = {e.way: e for e in TABLE.entries([CND, OPTIMUM])}
    assert list(entries) == ["cnd", "optimum"]
    assert entries["cnd"].success == pytest.approx(2 / 3)
    assert entries["cnd"].length == pytest.approx(4.3)
    assert entries["cnd"].collisions == 0
    assert entries["cnd"].gap == pytest.approx(7.5)
    assert entries["cnd"].ratio == pytest.approx(4.3 / 4.0)
    assert entries["optimum"].gap == pytest.approx(0.0)
    assert entries["cnd"].gap95 == pytest.approx(9.75)  # of 5 and 10 %
    assert math.isnan(TABLE.entries([CND])[0].gap)


def test_tables_and_figure(tmp_path):
    paths = TABLE.write(tmp_path, [cell("rrt-100", [5.0], [0.1], [0.0], [0.2]), CND, OPTIMUM])
    assert [p.name for p in paths] == ["dubins.md", "dubins.tex", "dubins.csv", "dubins.png"]
    text = paths[0].read_text()
    assert "4.887 ± 0.961" in text  # the paper's RRT*
    rows = list(csv.DictReader(io.StringIO(paths[2].read_text())))
    assert float(rows[0]["paper_success"]) == 0.889
    assert rows[1]["paper_success"] == ""
    (x, y), radius = dubins.obstacle()
    assert (x, y, radius) == pytest.approx((-1.0, 0.0, 0.5), abs=2e-3)


def test_cells_are_kept_and_made_anew_for_another_plan(tmp_path, monkeypatch):
    made = []

    def way(ocp, x0, seed, plan, folder):
        made.append(len(x0))
        return np.tile([0.5, 0.0], (len(x0), 80, 1)), 1.0, "straight on"

    monkeypatch.setitem(dubins.WAYS, "nmpc", replace(dubins.WAYS["nmpc"], make=way))
    plan = dubins.Plan(n=3, ways=("nmpc",))
    (first,) = TABLE.run(tmp_path, plan, progress=False)
    (again,) = TABLE.run(tmp_path, plan, progress=False)
    assert made == [3]
    assert again == first
    TABLE.run(tmp_path, replace(plan, n=4), progress=False)
    assert made == [3, 4]
    assert len(TABLE.finished(tmp_path)) == 1
    (tmp_path / "cells" / "dubins-nmpc-0.json").write_text("{}")
    with pytest.raises(ValueError, match="no cell of the Dubins table"):
        TABLE.run(tmp_path, plan, progress=False)


def test_plans_are_checked():
    with pytest.raises(ValueError, match="some of rrt-100"):
        TABLE.places(dubins.Plan(ways=("prm",)))
    with pytest.raises(ValueError, match="n is 0"):
        TABLE.places(dubins.Plan(n=0))
    with pytest.raises(ValueError, match="problems are"):
        approaches.TABLE.places(approaches.Plan(problems=("boat",)))


@pytest.mark.slow
def test_approaches_level_sets_end_where_memory_does(tmp_path):
    pytest.importorskip("hj_reachability")
    plan = approaches.Plan(nodes=11, states=8, problems=("double_integrator", "quadrotor"))
    small = approaches.WAYS["level-sets"].make("double_integrator", plan)
    large = approaches.WAYS["level-sets"].make("quadrotor", plan)
    assert small.memory < 10
    assert small.ms > 0
    assert 0 < small.error < 1
    fine = approaches.WAYS["level-sets"].make("double_integrator", replace(plan, nodes=41))
    assert fine.error < 0.5 * small.error
    assert math.isnan(large.error)
    assert large.memory > 1e7  # MB
    assert "not possible" in large.note
    paths = approaches.TABLE.write(tmp_path, [small, large])
    assert [p.suffix for p in paths] == [".md", ".tex", ".csv", ".png"]
    assert paths[3].read_bytes().startswith(b"\x89PNG")
    text = paths[0].read_text()
    assert "| quadrotor | 12 | HJB level sets |" in text
