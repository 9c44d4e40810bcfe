"""The README's code runs as it stands: the user's view (with small settings), and the system of one's own."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import pytest

import nocl
from nocl import comparisons
from nocl.solvers.cnd import TrainSettings
from nocl.sysid.settings import Settings

README = Path(__file__).parents[1] / "README.md"
SMALL = TrainSettings(seeds=4, starts=4, states=20, tails=60, visits=40, rounds=1, iterations=60, value_initial=10,
                      value_iterations=40, held_out=8, hidden=(16, 16))

QUICK = Settings.of("quick")


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)


@pytest.mark.slow
def test_the_users_view_runs(tmp_path, monkeypatch):
    pytest.importorskip("l4casadi")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(nocl, "train", partial(nocl.train, settings=SMALL), raising=False)
    monkeypatch.setattr(nocl, "identify", partial(nocl.identify, settings=QUICK), raising=False)
    monkeypatch.setattr(comparisons, "compare", partial(_compare_few, comparisons.compare))
    names: dict[str, object] = {}
    exec(compile(blocks()[0], str(README), "exec"), names)
    assert names["u"].shape == (8, 1)
    assert names["V"].shape == (8,)
    assert names["dVdx"].shape == (8, 2)
    assert names["solution"].success.all()
    assert {p.name for p in tmp_path.iterdir()} == {"runs", "build"}
    assert (tmp_path / "runs/pendulum/report/report.html").stat().st_size > 10_000


def _compare_few(compare, *args, n, **options):
    assert n == 100
    return compare(*args, n=4, **options)


def test_the_system_of_ones_own_is_a_problem(tmp_path):
    path = tmp_path / "my_system.py"
    path.write_text(blocks()[1])
    assert len(blocks()[1].splitlines()) <= 25
    ocp = nocl.load_ocp(str(path))
    assert (ocp.system.nx, ocp.system.nu) == (6, 2)
    assert not ocp.system.f(ocp.x_goal, ocp.u_goal).full().any()
