"""One registry of methods: a new one is its object and its entry, and what does not apply is refused in one line."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import nocl
from nocl.cli.commands import main, parser
from nocl.cli.reproduce import TABLES, table_of
from nocl.comparisons import compare
from nocl.comparisons.each import is_plan
from nocl.solvers import NMPC, registry
from nocl.solvers.registry import METHODS, Method, Options
from nocl.systems import quadrotor


class Once:
    """A toy solver: NMPC from one start, for small problems."""

    def __init__(self, ocp: nocl.OCP, intervals: int) -> None:
        if ocp.system.nx > 2:
            raise ValueError(f"once is for at most 2 states; {ocp.system.name!r} has {ocp.system.nx}")
        self.nmpc = NMPC(ocp, intervals, starts=1, passes=0)

    def solve(self, x0):
        return self.nmpc.solve(x0, progress=False)


@pytest.fixture
def once(monkeypatch):
    """Its entry."""
    entry = Method("once", "Once", "from one start", f"{__name__}:Once", takes=("intervals",))
    monkeypatch.setitem(METHODS, "once", entry)
    return entry


def test_a_new_solver_is_an_object_and_an_entry(once, tmp_path, capsys):
    assert main(["solve", "double_integrator", "--solver", "once", "--n", "3", "--intervals", "7",
                 "--out", str(tmp_path)]) == 0
    assert "once: 3 of 3 solved" in capsys.readouterr().out
    ocp = nocl.load_ocp("double_integrator")
    x0 = ocp.initial_states.sample(3, 1)
    best = Once(ocp, 7).solve(x0)
    with np.load(tmp_path / "solutions" / "once.npz", allow_pickle=False) as data:
        np.testing.assert_array_equal(data["x0"], x0)
        np.testing.assert_allclose(data["cost"], best.cost, rtol=1e-9)
    methods = {METHODS[name].title: METHODS[name].build(ocp, Options(intervals=7)) for name in ("once", "lqr")}
    report = compare(ocp, methods, x0=x0, progress=False)
    np.testing.assert_allclose([row["cost"] for row in report.rows() if row["method"] == "Once"],
                               nocl.simulate(ocp, best.u, x0).cost, rtol=1e-6)
    assert main(["solve", "cartpole", "--solver", "once", "--out", str(tmp_path / "new")]) == 2
    assert "once is for at most 2 states; 'cartpole' has 4" in capsys.readouterr().err


def test_help_and_errors_read_the_registry(once, capsys):
    for command, option in (("solve", "--solver"), ("compare", "--methods"), ("run", "--methods")):
        with pytest.raises(SystemExit):
            parser().parse_args([command, "--help"])
        out = capsys.readouterr().out
        assert option in out
        assert "once: from one start" in " ".join(out.split())
    assert main(["compare", "x", "--methods", "CND,PID"]) == 2
    assert "rrt-star, once" in capsys.readouterr().err


REFUSED = {("rrt-star", "double_integrator"): "kinematic cars", ("rrt-star", "cartpole"): "kinematic cars",
           ("level-sets", "cartpole"): "at most 3"}


@pytest.mark.parametrize("name", [name for name in METHODS if METHODS[name].make])
@pytest.mark.parametrize("problem", ["double_integrator", "cartpole", "dubins"])
def test_every_method_applies_or_is_refused_in_a_line(name, problem):
    """Before anything is trained or solved."""
    if METHODS[name].missing:
        pytest.skip(METHODS[name].missing)
    ocp, why = nocl.load_ocp(problem), REFUSED.get((name, problem))
    if why is None:
        METHODS[name].refuse(ocp, Options(intervals=10))
        return
    with pytest.raises(ValueError, match=why) as refusal:
        METHODS[name].refuse(ocp, Options(intervals=10))
    assert "\n" not in str(refusal.value)


def test_neural_oc_is_refused_where_nothing_curves_in_the_controls():
    with pytest.raises(ValueError, match="NeuralOC of 'quadrotor'"):
        METHODS["neural-oc"].refuse(quadrotor.ocp(R=0.0), Options())


def test_level_sets_and_rrt_star_have_their_rows(tmp_path, capsys):
    if METHODS["level-sets"].missing or METHODS["rrt-star"].missing:
        pytest.skip("the extras are not installed")
    words = ["--n", "2", "--out", str(tmp_path)]
    assert main(["solve", "dubins", "--solver", "rrt-star", *words]) == 0
    assert "rrt-star: 2 of 2 solved" in capsys.readouterr().out
    facts = json.loads((tmp_path / "solutions" / "rrt-star.json").read_text())
    assert facts["seed"] == 1
    assert main(["solve", "cartpole", "--solver", "rrt-star", *words]) == 2
    assert "kinematic cars" in capsys.readouterr().err
    assert main(["solve", "cartpole", "--solver", "level-sets", *words]) == 2
    assert "'cartpole': the problem has 4 states; expected at most 3" in capsys.readouterr().err


@pytest.mark.slow
def test_level_sets_are_near_the_optimum_on_their_standard_grid():
    pytest.importorskip("hj_reachability")
    ocp = nocl.load_ocp("double_integrator")
    x0 = ocp.initial_states.sample(5, 1)
    law, best = METHODS["level-sets"].build(ocp, Options()), METHODS["ddp"].build(ocp, Options(320)).solve(x0)
    run = nocl.simulate(ocp, law, x0, hold=320)
    assert not is_plan(law)
    assert run.success.all()
    assert (run.cost < 1.01 * best.cost).all()


def test_what_is_missing_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(registry, "find_spec", lambda module: None)
    ocp = nocl.load_ocp("dubins")
    with pytest.raises(ValueError, match=r"of kinematic cars only\) needs ompl: pip install 'nocl\[ompl\]'"):
        METHODS["rrt-star"].refuse(ocp, Options())
    with pytest.raises(ValueError, match=r"level-sets .* needs hj_reachability, jax: pip install 'nocl\[levelset\]'"):
        METHODS["level-sets"].build(ocp, Options())
    with pytest.raises(ValueError, match="no method 'pid'; expected one of cnd, nmpc"):
        registry.find("pid")


@pytest.mark.parametrize("name", TABLES)
def test_the_help_of_a_table_tells_its_defaults(name):
    """They stand in words at the command line, which does not import the tables."""
    table = table_of(name)
    for flag, text in TABLES[name].flags.items():
        field = flag.removeprefix("--").replace("-", "_")
        for quick, pattern in ((False, r"default: (\d+(?:,\d+)*)"), (True, r"--quick (\d+)")):
            value = getattr(table.plan(quick), field)
            if found := re.search(pattern, text):
                assert found[1] == (",".join(map(str, value)) if isinstance(value, tuple) else str(value)), flag
        if field in ("ways", "problems"):
            assert re.search(r"default: (all|both|six)", text), flag
            assert set(re.findall(r"(?:^|,)([a-z0-9-]+)(?=[,;])", text)) <= {"systems", *table.ways, *table.problems}
