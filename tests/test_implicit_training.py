"""Training on implicit steps: those in torch are the solvers' own, the policy's runs the judge's, and stiff plants get
controllers."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import stiff
import torch

import nocl
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.regression import implicit
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Problems, continuous_run
from nocl.solvers.ddp.solver import DDP


def forced() -> nocl.OCP:
    """A stiff plant whose dynamics and cost hold the time and two parameters."""
    x, v, u, t = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("u"), nocl.time()
    rate, goal = nocl.parameter("rate", nominal=500.0), nocl.parameter("goal", nominal=0.5)
    system = nocl.System("forced", x=ca.vertcat(x, v), u=u, p=rate, lbu=[-2], ubu=[2], lbx=[-2, -2], ubx=[2, 2],
                         xdot=ca.vertcat(v, rate * (u - v - v**3 / 5) + ca.sin(3 * t)))
    return nocl.OCP(system, horizon=2.0, running=(x - goal)**2 + 0.1 * u**2 + 0.1 * t * v**2, terminal=x**2,
                    p=goal, parameters=nocl.Uniform([100.0, -1.0], [2000.0, 1.0]),
                    initial_states=nocl.Uniform([-1, -1], [1, 1]))


@pytest.mark.parametrize("make", [stiff.linear, stiff.van_der_pol, stiff.robertson, stiff.polymerisation, forced])
def test_steps_in_torch_are_those_of_casadi(make):
    ocp, B = make(), 6
    x, p = ocp.initial_states.sample(B, 0), ocp.sample_parameters(B, 1)
    u = np.random.default_rng(2).uniform(ocp.system.lbu, ocp.system.ubu, (B, ocp.system.nu))
    h, t = ocp.horizon / 80, np.linspace(0, 0.5, B)
    step = ocp.functions.step(substeps=2, integrator="radau")
    with torch.no_grad():
        end, cost = InTorch(ocp, integrator="radau").at(p).interval(*map(torch.from_numpy, (x, u, t[:, None])), h, 2)
    for i in range(B):
        given = {"x": x[i], "u": u[i], "t": t[i], "p": p[i]}
        state, spent = step(*(given[name] for name in ocp.functions.arguments.names), h)
        np.testing.assert_allclose(end[i], state.full().ravel(), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(cost[i], spent.full().ravel(), rtol=1e-7)


def test_where_newton_finds_nothing_a_row_is_lost_and_the_others_go_on():
    """x' = u - sqrt(x) has no slope below 0."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("tank", x=x, u=u, xdot=u - ca.sqrt(x), lbu=[0], ubu=[1], lbx=[0.1], ubx=[3])
    ocp = nocl.OCP(system, horizon=1.0, running=x**2, terminal=x**2, initial_states=nocl.Uniform([0.2], [2]))
    with torch.no_grad():
        end, cost = InTorch(ocp, integrator="radau").at(np.zeros((2, 0))).interval(
            torch.tensor([[-0.2], [1.0]], dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64), 0.0, 1.0)
    assert torch.isnan(end[0]).all()
    assert torch.isnan(cost[0]).all()
    np.testing.assert_allclose(end[1], 0.25, rtol=1e-5)  # (sqrt(x0) - t / 2)^2


@pytest.mark.parametrize("gain", [0.0, -0.9, -1.2])
def test_a_policy_runs_as_under_the_judge(gain):
    """Feedback on a stiff plant, on its fast state too: with -1.2 a loop that holds its control for a step explodes."""
    ocp = stiff.linear(1e4)
    K = np.array([[-2.0, -2.5, gain]])
    x, t = ca.SX.sym("x", 3), ca.SX.sym("t")
    x0 = ocp.initial_states.sample(4, 0)
    judged = nocl.simulate(ocp, ca.Function("law", [x, t], [K @ x]), x0)
    at = Problems(x0, np.zeros(4), np.zeros((4, 0)))

    def law(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return x @ torch.from_numpy(K.T)

    error = []
    for steps in (80, 320):
        J, _, _ = continuous_run(law, InTorch(ocp, integrator="radau"), at, steps)
        error.append(np.abs(J / judged.cost - 1).max())
    assert error[1] < error[0] < 2e-3
    assert error[1] < 5e-4  # of layers of 0.1 ms in steps of 6 ms
    exploded, _, _ = continuous_run(law, InTorch(ocp), at, 320)
    assert not (np.abs(exploded) < 1e6).any()  # Runge and Kutta's steps do not follow it


def test_pieces_are_one_and_a_lost_row_costs_the_others_nothing(monkeypatch):
    ocp, B = stiff.van_der_pol(), 9
    x, u = torch.from_numpy(ocp.initial_states.sample(B, 0)), torch.zeros(B, 1, dtype=torch.float64)
    x[4] = torch.nan
    asked, solve, found = [], torch.linalg.solve_ex, []
    monkeypatch.setattr(torch.linalg, "solve_ex", lambda *given: asked.append(1) or solve(*given))
    with torch.no_grad():
        for size in (4096, 2):
            monkeypatch.setattr(implicit, "ROWS", size)
            steps = InTorch(ocp, integrator="radau")
            found.append(steps.at(np.zeros((B, 0))).interval(x, u, 0.0, 0.02)[0].numpy())
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)
    assert np.isnan(found[0]).all(axis=1).tolist() == [k == 4 for k in range(B)]
    assert len(asked) < 6 * 10


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("make", [stiff.linear, stiff.robertson])
def test_stiff_plants_get_controllers(make):
    ocp = make()
    cnd = nocl.train(ocp, settings=TrainSettings.of("quick", value=False), progress=False)
    assert cnd.card["integrator"] == "radau"
    assert cnd.card["history"][-1]["unsolved"] == 0
    x0 = ocp.initial_states.sample(20, 99)
    best = DDP(ocp, intervals=320).solve(x0, progress=False)
    run = nocl.simulate(ocp, cnd, x0)
    assert run.success.all()
    gap = run.cost / best.cost - 1
    assert np.median(gap) < 1e-3
    assert np.quantile(gap, 0.9) < 0.02


def test_what_is_not_to_be_had_is_refused():
    with pytest.raises(ValueError, match=r"integrator.*'euler'.*auto, rk4, radau"):
        TrainSettings(integrator="euler")
    implicit = TrainSettings(integrator="radau")
    stationary = replace(nocl.load_ocp("double_integrator"), horizon=nocl.INFINITE, terminal=None)
    with pytest.raises(ValueError, match="INFINITE horizon, and its law is trained by Runge-Kutta steps"):
        nocl.train(stationary, settings=implicit)
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    line = nocl.System("line", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    fastest = nocl.OCP(line, horizon=nocl.Free(0.1, 2), running=1.0, terminal=0.0, x_goal=[0], u_goal=[0],
                       initial_states=nocl.Uniform([-1], [1]), terminal_constraints={"at 0": (0, x, 0)})
    with pytest.raises(ValueError, match="free horizon, and its law is trained by Runge-Kutta steps"):
        nocl.train(fastest, settings=implicit)
