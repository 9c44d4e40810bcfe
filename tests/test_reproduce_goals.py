"""The problems of the table of goals are the bundled ones at some p, and its rows say what was judged."""

from dataclasses import replace

import numpy as np
import pytest

import nocl
from nocl.comparisons.reproduce.goals import CLEAR, PROBLEMS, TABLE, Cell, _entry, drawn

OF = {"cartpole-goal": ("cartpole", {"goal": 0.0}),
      "cartpole-pole": ("cartpole", {"l": 1.0, "m_pole": 0.1, "goal": 0.0}),
      "cartpole-all": ("cartpole", {"l": 1.0, "m_pole": 0.1, "m_cart": 1.0, "gain": 3.0, "friction": 0.0, "goal": 0.0}),
      "quadrotor-goal": ("quadrotor", {"goal_x": 3.0, "goal_y": 3.0, "goal_z": 3.0}),
      "acrobot-goal": ("acrobot", {"m1": 1.0, "m2": 1.0, "goal": 0.0}),
      "dubins-obstacle": ("dubins", {"obstacle_x": -1.0, "obstacle_y": 0.0, "radius": 0.5, "goal_x": 0.0, "goal_y": 0.0,
                                     "goal_psi": 0.0}),
      "pendulum-goal": ("pendulum", {"mass": 1.0, "goal": 0.0})}


@pytest.mark.filterwarnings("ignore:.*extrapolation")  # the paper's goal of the quadrotor lies outside the box of goals
@pytest.mark.parametrize("name", PROBLEMS)
def test_at_the_bundled_constants_it_is_the_bundled_problem(name):
    ocp, (bundled, p) = PROBLEMS[name][1](), OF[name]
    one, known, rng = ocp.at(p), nocl.load_ocp(bundled), np.random.default_rng(0)
    s = known.system
    x, u = rng.uniform(s.lbx, s.ubx, (30, s.nx)).T, rng.uniform(s.lbu, s.ubu, (30, s.nu)).T
    for a, b in ((one.system.f(x, u), s.f(x, u)), (one.L(x, u), known.L(x, u)), (one.G(x), known.G(x)),
                 (one.h(x), known.h(x))):
        np.testing.assert_allclose(a.full(), b.full(), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.r_[one.x_goal, one.u_goal], np.r_[known.x_goal, known.u_goal])
    assert one.horizon == known.horizon


def test_what_no_optimum_is_known_of_counts_in_no_gap():
    cell = Cell("dubins-obstacle", "exact", 0, {}, [0.01, float("nan"), 0.03], 0, 0.0, 1.0, 1.0)
    entry = _entry("dubins-obstacle", "exact", [cell])
    assert (entry.n, entry.worst) == (2, 3.0)
    failed = _entry("dubins-obstacle", "exact", [replace(cell, gap=[0.01, float("inf")])])
    assert (failed.n, failed.worst) == (2, float("inf"))


def test_what_is_judged_begins_and_ends_clear_of_the_obstacle():
    ocp = PROBLEMS["dubins-obstacle"][1]()
    x0, p = drawn(ocp, 50, 0)
    assert x0.shape == (50, 3)
    centre, radius, goal = p[:, :2], p[:, 2], p[:, 3:5]
    for place in (x0[:, :2], goal):
        assert (np.linalg.norm(place - centre, axis=1) > radius + CLEAR - 1e-3).all()
    again = drawn(ocp, 20, 0)
    np.testing.assert_array_equal(again[1][:5], p[:5])
    assert not np.array_equal(drawn(ocp, 20, 1)[1], again[1])


def test_rows_are_over_all_seeds(tmp_path):
    cells = [Cell("pendulum-goal", "exact", seed, {}, gap, collisions, 0.0, 10.0 + seed, 20.0)
             for seed, (gap, collisions) in enumerate([([0.001, 0.002], 0), ([0.003, np.inf], 2)])]
    entry, = TABLE.entries(cells)
    assert (entry.median, entry.worst) == (pytest.approx(0.3), np.inf)
    assert (entry.collisions, entry.n, entry.seconds) == (2, 4, 10.5)
    paths = TABLE.write(tmp_path, cells)
    assert [path.name for path in paths] == ["goals.md", "goals.tex", "goals.csv", "goals.png"]
    assert "pendulum: goal, mass" in paths[0].read_text()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*costs .* more than the optimum")
def test_a_quick_cell_of_each_way_runs(tmp_path):
    plan = TABLE.plan(quick=True, problems=("pendulum-goal",))
    cells = TABLE.run(tmp_path, plan, progress=False)
    assert [cell.way for cell in cells] == ["exact", "learned"]
    assert all(len(cell.gap) == 8 and np.median(cell.gap) < 0.1 for cell in cells)
    assert cells[1].identify > 0
    assert TABLE.run(tmp_path, plan, progress=False) == cells
