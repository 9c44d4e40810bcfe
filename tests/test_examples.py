"""Every file of examples/ is a whole problem: it loads, says what it is, and can be evaluated, kept and solved."""

import ast
import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import nocl
from nocl.solvers import NMPC

FILES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
POINTS = 16


@pytest.fixture(params=FILES, ids=lambda path: path.stem)
def path(request):
    return request.param


@pytest.fixture
def ocp(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a user's own problem loads without a remark
        return nocl.load_ocp(path)


def moments(ocp):
    """Initial states with random controls, times and parameters, as columns."""
    s, rng = ocp.system, np.random.default_rng(0)
    at = {"x": ocp.initial_states.sample(POINTS, 0), "u": rng.uniform(s.lbu, s.ubu, (POINTS, s.nu)),
          **ocp.moments(POINTS)}
    return ocp.functions.arguments.columns(**at), ocp.functions.end.columns(**at)


def values(ocp):
    """[nx + 2, POINTS]: f, L and G."""
    stage, end = moments(ocp)
    of = ocp.functions
    return np.vstack([of.f(*stage).full(), of.L(*stage).full(), of.G(*end).full()])


def test_there_are_twenty():
    assert len(FILES) >= 20


def test_it_says_what_it_is(path):
    """A line of its own, and then where it is from."""
    first, _, source = (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n\n")
    assert first.endswith(".")
    assert len(source) > 60


def test_its_name_is_that_of_its_file(path, ocp):
    assert ocp.system.name.removesuffix("_rates") == path.stem


def test_its_functions_are_finite(ocp):
    assert np.isfinite(values(ocp)).all()


def test_initial_states_hold_the_constraints(ocp):
    """... of states alone: those of controls are the solver's."""
    states = dict(zip(ocp.system.state_names, ocp.initial_states.sample(256, 1).T, strict=True))
    for name, (low, high) in ocp.state_bounds.items():
        assert low <= states[name].min(), name
        assert states[name].max() <= high, name


def test_its_goal_is_an_equilibrium(ocp):
    """What arrives stays."""
    if not ocp.has_goal:
        pytest.skip("it has no goal")
    rate = ocp.functions.f(*ocp.functions.arguments.columns(x=ocp.x_goal[None], u=ocp.u_goal[None])).full()[:, 0]
    assert np.abs(rate * ocp.longest).max() <= 1e-6 * np.abs(ocp.system.ubx).max()


def test_json_holds_it(ocp):
    again = nocl.OCP.from_data(json.loads(json.dumps(ocp.to_data())))
    assert again.constraint_names == ocp.constraint_names
    np.testing.assert_array_equal(values(again), values(ocp))


@pytest.mark.slow
def test_nmpc_solves_it(ocp):
    """From one of its initial states, with all constraints held at the nodes."""
    s = NMPC(ocp, intervals=60, starts=2).solve(ocp.initial_states.sample(1, 3), workers=1, progress=False)
    assert s.success[0], s.message[0]
    assert s.clearance[0] > -1e-4
