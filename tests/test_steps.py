"""Steps by which initial states stay finite, where solutions that are found say nothing of those that run away."""

import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.definition.substeps import FINE, RADAU, RK4, STARTS, Grid, Steps, enduring
from nocl.solvers import DDP
from nocl.solvers.ddp.solver import steps_for
from nocl.solvers.grid import fastest, fastest_at_start

ONE = Steps()
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def chosen_of(kept, chosen=ONE, stiff=False, integrator=None, grid=None):
    """(the steps, what was followed) where kept says how many starts stay finite, and solutions show a grid."""
    asked = []

    def count(steps: Steps) -> int:
        if steps not in asked:
            asked.append(steps)
        return kept(steps)

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = enduring("x", chosen, count, lambda: stiff, lambda _: grid, FINE, integrator)
    assert bool(said) == (found != chosen)
    return found, asked


def test_where_all_stay_finite_nothing_else_is_followed():
    assert chosen_of(lambda _: STARTS) == (ONE, [ONE])
    assert chosen_of(lambda _: STARTS, Steps(RADAU, 2)) == (Steps(RADAU, 2), [Steps(RADAU, 2)])


def test_the_least_steps_are_taken_with_which_nearly_as_many_stay_finite_as_with_the_finest():
    counts = {1: 35, 2: 45, 4: 52, 8: 59, 16: 61, 32: 64}
    explicit = [Steps(RK4, n) for n in counts]

    def kept(steps: Steps) -> int:
        return counts[steps.substeps] if steps.integrator == RK4 else 0

    assert chosen_of(kept)[0] == Steps(RK4, 16)
    counts[16] = 60
    assert chosen_of(kept)[0] == Steps(RK4, 32)
    found, asked = chosen_of(kept, integrator=RK4)
    assert found == Steps(RK4, 32)
    assert set(asked) == set(explicit)


def test_an_implicit_step_is_taken_where_explicit_ones_would_take_longer():
    assert chosen_of(lambda s: 64 if s.integrator == RADAU or s.substeps == 32 else 40)[0] == Steps(RADAU)
    only_implicit = chosen_of(lambda s: 64 if s.integrator == RADAU and s.substeps > 1 else 10, stiff=True)
    assert only_implicit[0] == Steps(RADAU, 2)


def test_solutions_that_are_only_now_there_may_ask_for_more():
    def kept(steps: Steps) -> int:
        return 64 if steps.substeps > 1 else 40

    found = [chosen_of(kept, grid=Grid(0.1, 2, error, 8, 1e-5, 0.01))[0].substeps for error in (FINE / 2, 2 * FINE)]
    assert found == [2, 8]


def test_what_truly_runs_away_changes_nothing():
    found, asked = chosen_of(lambda s: 24 if s.substeps == 1 else 23)
    assert found == ONE
    assert Steps(RADAU) not in asked


def test_a_reactor_that_runs_away_between_steps_gets_as_many_as_keep_its_states_finite():
    """Of 64 states one step in an interval loses about half; the plant keeps all."""
    ocp = nocl.load_ocp(EXAMPLES / "exothermic_reactor.py")
    with pytest.warns(UserWarning, match=r"of 64 initial states under held controls \d+ stay finite with 1 Runge-Kutta "
                                         r"step in an interval, 6\d with 8"):
        chosen = steps_for(ocp, None, 160, FINE)
    assert chosen == Steps(RK4, 8)
    x0 = ocp.initial_states.sample(40, 7)
    alive = [np.isfinite(DDP(ocp, intervals=160 * n, substeps=1).rollout(x0)).all(axis=(1, 2)).sum() for n in (1, 8)]
    assert alive[0] < 32
    assert alive[1] >= 38
    run = nocl.simulate(ocp, np.tile(ocp.u_goal, (40, 160, 1)), x0)
    assert run.success.all()


def test_where_explicit_steps_alone_blow_up_implicit_ones_are_taken():
    """x' = u - 200 x^3: at |x| = 5 lambda h is 750, near 0 nothing is stiff."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    s = nocl.System("cubic", x=x, u=u, xdot=u - 200 * x**3, lbu=[-1], ubu=[1], lbx=[-5], ubx=[5])
    ocp = nocl.OCP(s, horizon=4.0, running=x**2 + 0.1 * u**2, terminal=x**2, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian([0.0], [1.5]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        chosen = steps_for(ocp, None, 80)
    assert chosen.integrator == RADAU
    assert any("implicit Radau" in str(w.message) for w in said)
    ddp = DDP(ocp, intervals=80, substeps=chosen.substeps, integrator=chosen.integrator)
    ddp.checked = True  # layers at the start are most of J, and off by a percent
    assert ddp.solve(ocp.initial_states.sample(16, 1)).success.all()


@pytest.mark.parametrize("name", ["van_der_vusse", "quadruple_tank", "fishing"])
def test_plain_problems_keep_one_step(name):
    ocp = nocl.load_ocp(EXAMPLES / f"{name}.py")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert steps_for(ocp, None, 80, FINE) == ONE


def test_the_fastest_mode_is_told_where_there_is_one():
    oscillator = nocl.load_ocp("van_der_pol")  # at the origin its eigenvalues are (1 +- i sqrt(3)) / 2
    at = {"x": np.zeros((1, 2)), "u": np.zeros((1, 1)), "t": np.zeros(1), "p": np.zeros((1, 0))}
    assert fastest(oscillator.functions, at) == pytest.approx(1.0)
    ocp = nocl.load_ocp("double_integrator")
    assert np.isinf(fastest_at_start(ocp, ocp.functions))
    with pytest.warns(UserWarning, match="nothing decays, grows or swings by itself, step 25 ms: implicit Radau"):
        steps_for(ocp, None, 80, FINE, RADAU)
