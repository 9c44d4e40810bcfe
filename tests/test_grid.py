"""Steps that are too long for a plant: found, told, and cured by substeps, which all solvers share."""

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.definition.substeps import COARSE, FINE, TRIED, WANTED
from nocl.solvers import DDP, NMPC
from nocl.solvers.ddp.solver import substeps_for
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.solvers.grid import measured
from nocl.solvers.nmpc.solver import shared_program
from nocl.solvers.nmpc.tasks import attempt
from nocl.sysid.settings import LogSettings
from nocl.systems import NAMES

X0 = np.array([1.0, 0.0])


def lag(rate):
    """An integrator behind an actuator that lags by 1 / rate: for rate h > 2.8 RK4 is unstable."""
    x, z, u = ca.SX.sym("x"), ca.SX.sym("z"), ca.SX.sym("u")
    system = nocl.System("lag", x=ca.vertcat(x, z), u=u, xdot=ca.vertcat(z, rate * (u - z)), lbu=[-1], ubu=[1],
                         lbx=[-3, -2], ubx=[3, 2])
    return nocl.OCP(system, horizon=4.0, running=0.1 * u**2, terminal=5 * x**2 + z**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian(mean=X0, std=[0.1, 0.1]))


def pole():
    """A mass that a pole draws in: from X0 it gets there in finite time, whatever the control; RK4 steps over it."""
    p, v, u = (ca.SX.sym(name) for name in "pvu")
    system = nocl.System("pole", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, 1 / (1 - p) + 0.1 * u), lbu=[-1], ubu=[1],
                         lbx=[-5, -5], ubx=[5, 5])
    return nocl.OCP(system, horizon=3.0, running=0.1 * u**2 + p**2, terminal=p**2 + v**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian([0.5, 0.0], [0.1, 0.1]))


@pytest.mark.parametrize("substeps", [2, 3])
def test_ddp_and_nmpc_share_the_discretisation(substeps):
    ocp = nocl.load_ocp("cartpole")
    x0 = ocp.initial_states.sample(3, 0)
    mine = DDP(ocp, intervals=20, substeps=substeps).solve(x0)
    theirs = NMPC(ocp, 20, substeps=substeps, starts=1, passes=0).solve(x0, mine, gains=True, workers=1)
    assert mine.success.all()
    np.testing.assert_allclose(theirs.cost, mine.cost, rtol=1e-8)
    np.testing.assert_allclose(theirs.V_x, mine.V_x, rtol=0, atol=1e-5 * np.abs(mine.V_x).max())
    np.testing.assert_allclose(theirs.gain, mine.gain, rtol=0, atol=1e-4 * np.abs(mine.gain).max())


@pytest.mark.parametrize("problem", ["dubins", "quadrotor", "acrobot"])
def test_the_compiled_sweep_over_substeps_is_that_of_casadis_derivatives(problem):
    ocp = nocl.load_ocp(problem)
    ddp, x0 = DDP(ocp, intervals=12, substeps=3, constraints="soft"), ocp.initial_states.sample(5, 0)
    compiled = ddp.solve(x0, curvature=True)
    ddp.kernel = NumpyKernel(ocp, None, 3)
    slow = ddp.solve(x0, curvature=True)
    for name in ("x", "u", "gain", "V", "V_x", "V_xx"):
        a, b = getattr(compiled, name), getattr(slow, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8 * max(np.abs(b).max(), 1.0), err_msg=name)


def test_one_step_of_four_substeps_is_four_steps_with_the_control_held():
    ocp = nocl.load_ocp("pendulum")
    u = np.random.default_rng(0).uniform(-2, 2, (3, 10, 1))
    x0 = ocp.initial_states.sample(3, 0)
    long, short = DDP(ocp, intervals=10, substeps=4), DDP(ocp, intervals=40)
    np.testing.assert_allclose(long.rollout(x0, u=u), short.rollout(x0, u=np.repeat(u, 4, axis=1))[:, ::4], rtol=1e-12)


@pytest.mark.parametrize("rate", [54.0, 60.0, 150.0])
def test_a_grid_that_is_too_coarse_is_told_by_both_solvers_and_what_helps_helps(rate):
    ocp = lag(rate)
    for make in (lambda n: DDP(ocp, substeps=n), lambda n: NMPC(ocp, 80, substeps=n, starts=2, passes=0)):
        with pytest.warns(UserWarning, match="the grid is too coarse for this system"):
            coarse = make(1).solve(X0)
        grid = measured(ocp, ocp.functions, coarse, 1)
        assert grid.error > COARSE
        assert grid.fastest == pytest.approx(1 / rate)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fine = make(grid.needed).solve(X0)
        judged = nocl.simulate(ocp, fine.u, X0).cost[0]
        assert fine.cost[0] == pytest.approx(judged, rel=1e-3)
        assert judged == pytest.approx({54.0: 0.02523, 60.0: 0.02522, 150.0: 0.02519}[rate], rel=1e-3)
    chosen = substeps_for(ocp, None, 80, FINE)
    assert measured(ocp, ocp.functions, fine, chosen).error <= FINE


@pytest.mark.parametrize("rate", [60.0, 1000.0])
@pytest.mark.parametrize("make", [lambda ocp: DDP(ocp), lambda ocp: NMPC(ocp, 80, starts=2, passes=0)])
def test_left_to_themselves_solvers_take_as_many_as_the_plant_asks_for(make, rate, tmp_path):
    ocp = lag(rate)
    shared_program.cache_clear()  # NMPC says it once for each program
    with pytest.warns(UserWarning, match=r"too coarse .* so they are taken|4 are taken|implicit Radau, 3 stages"):
        found = make(ocp).solve(X0)
    judged = nocl.simulate(ocp, found.u, X0).cost[0]
    assert found.cost[0] == pytest.approx(judged, rel=1e-3)
    assert judged == pytest.approx({60.0: 0.02522, 1000.0: 0.025187}[rate], rel=1e-3)
    with warnings.catch_warnings():  # remembered, and resumed from a folder
        warnings.simplefilter("error")
        again = make(ocp).solve(X0 + 0.01)
    assert nocl.simulate(ocp, again.u, X0 + 0.01).cost[0] == pytest.approx(again.cost[0], rel=1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        kept = [make(lag(rate)).solve(X0, out=tmp_path) for _ in range(2)]
    assert kept[0].cost == kept[1].cost == pytest.approx(found.cost, rel=1e-6)


@pytest.mark.parametrize("make", [lambda ocp, **given: DDP(ocp, intervals=20, **given),
                                  pytest.param(lambda ocp, **given: NMPC(ocp, 20, starts=3, passes=0, time_limit=5.0,
                                                                         **given), marks=pytest.mark.slow)])
def test_a_plan_that_steps_over_a_singularity_is_not_solved(make):
    x0 = np.array([[0.5, 0.5], [0.8, 0.2]])
    shared_program.cache_clear()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solver = make(pole())
        found = solver.solve(x0)
    assert any("not even with substeps=32" in str(w.message) for w in said)
    for again in (found, solver.solve(x0 + 1e-3)):
        assert not again.success.any()
        assert np.isinf(again.cost).all()
    assert any("plan and plant differ" in message for message in found.message)
    with pytest.warns(UserWarning, match="too coarse"):  # a grid of one's own is only told of
        assert make(pole(), substeps=1).solve(x0).success.any()


def test_what_one_nmpc_was_given_is_not_what_another_chooses():
    ocp = lag(60.0)
    shared_program.cache_clear()
    with pytest.warns(UserWarning, match="too coarse"):
        NMPC(ocp, 40, starts=1, passes=0, substeps=1).solve(X0)
    left = NMPC(ocp, 40, starts=1, passes=0)
    with pytest.warns(UserWarning, match="so they are taken"):
        left.solve(X0)
    assert left.settled.substeps > 1


def test_where_nothing_is_solved_finer_steps_are_tried_on_a_few_states_alone(monkeypatch):
    """A wall that comes faster than x can go: 20 states with one step, three with each other number."""
    tried = []

    def counted(program, task, guesses):
        tried.append((program.substeps, task.row))
        return attempt(program, task, guesses)

    monkeypatch.setattr("nocl.solvers.nmpc.solver.attempt", counted)
    ocp = lag(60.0)
    ocp = replace(ocp, path_constraints={"wall": ocp.system.x[0] - 0.5 - 2 * nocl.time()})
    x0 = ocp.initial_states.sample(20, 0)
    with pytest.warns(UserWarning, match="nothing was solved, not even with substeps=32"):
        found = NMPC(ocp, 40, starts=1, passes=0).solve(x0, workers=1)
    assert not found.success.any()
    assert sorted(n for n, _ in tried) == [1] * 20 + [4] * 3 + [16] * 3 + [32] * 3


def test_nmpc_tells_its_program_with_the_substeps_that_were_chosen():
    shared_program.cache_clear()
    nmpc = NMPC(lag(60.0), 40, starts=1, passes=0)
    assert nmpc.settled.substeps == 1
    with pytest.warns(UserWarning, match="so they are taken"):
        found = nmpc.solve(X0, gains=True, workers=1)
    assert nmpc.settled.substeps == nmpc.program.substeps > 1
    assert np.isfinite(found.gain).all()
    x, cost = X0, 0.0
    for k in range(40):
        x, part = (v.full().ravel() for v in nmpc.program.step(x, found.u[0, k], 0.1))
        cost += part[0]
    assert found.cost[0] == pytest.approx(cost + 5 * x[0]**2 + x[1]**2, rel=1e-6)


def test_it_is_told_once():
    ddp = DDP(lag(60.0), substeps=1)
    with pytest.warns(UserWarning, match="substeps="):
        ddp.solve(X0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ddp.solve(X0)


def test_what_no_explicit_step_can_follow_is_said_to_be():
    solution = DDP(lag(60.0), substeps=8).solve(X0)
    grid = measured(lag(3e3), lag(3e3).functions, solution, 1)
    assert grid.coarse
    assert grid.needed is None
    assert f"not even with substeps={TRIED[-1]}" in str(grid)
    assert "0.333 ms" in str(grid)


@pytest.mark.parametrize("name", NAMES)
def test_the_problems_that_come_with_nocl_need_one_step(name):
    ocp = nocl.load_ocp(name)
    assert substeps_for(ocp, None, 80, FINE) == 1
    assert WANTED < FINE < COARSE


@pytest.mark.slow
def test_a_log_whose_samples_are_far_apart_is_fitted_by_shorter_steps():
    """The actuator settles in 33 ms, a sample comes every 50 ms: one Runge-Kutta step is 6 % off."""
    s, h, K = lag(30.0).system, 0.05, 40
    step = ca.integrator("step", "cvodes", {"x": s.x, "p": s.u, "ode": s.xdot}, 0, h, {"reltol": 1e-10})
    t, x, u = np.arange(K + 1) * h, np.zeros((3, K + 1, 2)), np.zeros((3, K + 1, 1))
    for run in range(3):
        u[run, :, 0] = 0.7 * np.sin(2 * t + run) + 0.3 * np.sin(9 * t - run)
        for k in range(K):
            x[run, k + 1] = step(x0=x[run, k], p=u[run, k])["xf"].full().ravel()
    log = nocl.Log.of(s, np.tile(t, 3), x.reshape(-1, 2), u.reshape(-1, 1), run=np.repeat(np.arange(3), K + 1))
    given = {"known": {"x": "z"}, "control_affine": True}
    settings = LogSettings.of("quick", window=4, steps=25)
    with pytest.warns(UserWarning, match="identify: the grid is too coarse .* so it is fitted again"):
        model = nocl.identify(s, data=log, settings=settings, **given)
    with pytest.warns(UserWarning, match=r"with substeps=\d"):
        coarse = nocl.identify(s, data=log, settings=replace(settings, substeps=1), **given)
    assert (model.card["substeps"], coarse.card["substeps"]) == (4, 1)
    errors = [m.validate(log, (1,)).relative[0] for m in (model, coarse)]
    assert errors[0] < 0.5 * errors[1]
    at = torch.tensor([[0.0, 0.3]], dtype=torch.float64), torch.tensor([[0.0]], dtype=torch.float64)
    assert model(*at)[0, 1].item() == pytest.approx(-9.0, rel=0.1)


def test_a_limit_that_is_touched_does_not_make_a_grid_coarse():
    """The penalty that soft constraints have is no cost of plans that hold them: its kink is no error of theirs."""
    x, v, u = (ca.SX.sym(name) for name in "xvu")
    system = nocl.System("cart", x=ca.vertcat(x, v), u=u, xdot=ca.vertcat(v, u), lbu=[-4], ubu=[4], lbx=[-2, -2],
                         ubx=[2, 2])
    ocp = nocl.OCP(system, horizon=3.0, running=1e-3 * u**2, terminal=1e-2 * (x**2 + v**2), x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Gaussian(mean=[1.5, 0], std=[0.1, 0.05]), state_bounds={"v": (-0.6, 0.6)})
    for solver in (DDP(ocp, substeps=1, threads=1), NMPC(ocp, substeps=1)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            solution = solver.solve(ocp.initial_states.sample(3, 0))
        assert np.abs(solution.x[:, :, 1]).max() == pytest.approx(0.6, abs=1e-5)
        assert measured(ocp, ocp.functions, solution, 1).error < 1e-12  # RK4 is exact for it
        assert measured(ocp, ocp.functions, solution, 1, soft=True).error > 1e-3  # ... but not for the penalty
