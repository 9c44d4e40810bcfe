"""How many intervals training's plans get: as many as bring what they cost, followed, near the optimum."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nocl
from nocl.solvers.cnd import fineness
from nocl.solvers.cnd.fineness import WORTH, _floor, intervals_for
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.training import _steps

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def steps(ocp):
    return lambda intervals: _steps(ocp, None, TrainSettings(), intervals)


@pytest.mark.parametrize(("name", "intervals"), [("pendulum", 80), (EXAMPLES / "van_der_vusse.py", 160)])
def test_plans_get_as_many_intervals_as_they_need(name, intervals):
    ocp = nocl.load_ocp(name)
    assert intervals_for(ocp, None, steps(ocp)) == intervals
    assert _floor(ocp, None, intervals, steps(ocp)(intervals)) <= WORTH
    if intervals > 80:
        assert _floor(ocp, None, intervals // 2, steps(ocp)(intervals // 2)) > WORTH


def test_where_nothing_is_solved_on_a_finer_grid_nothing_is_known(monkeypatch):
    ocp = nocl.load_ocp("pendulum")
    monkeypatch.setattr(fineness, "solved_again", lambda _, s: replace(s, success=np.zeros(len(s), dtype=bool)))
    assert intervals_for(ocp, None, steps(ocp)) == 80


def test_training_takes_them_unless_it_is_told(monkeypatch):
    from nocl.solvers.cnd import training

    monkeypatch.setattr(training, "intervals_for", lambda *_: 20)
    tiny = {"seeds": 3, "starts": 2, "states": 6, "tails": 30, "visits": 20, "rounds": 0, "iterations": 20,
            "value": False, "held_out": 4, "hidden": (8,)}
    ocp = nocl.load_ocp("double_integrator")
    for asked, taken in ((None, 20), (16, 16)):
        cnd = nocl.train(ocp, settings=TrainSettings(intervals=asked, **tiny), progress=False)
        assert cnd.card["settings"]["intervals"] == taken
