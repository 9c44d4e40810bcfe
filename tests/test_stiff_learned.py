"""Implicit steps of learned dynamics: f_theta's own derivatives in the kernel, in torch and in the program."""

import casadi as ca
import numpy as np
import pytest
import stiff_net
import torch

import nocl
from nocl.definition.substeps import FINE, RADAU, RK4
from nocl.solvers import DDP, NMPC
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Problems, continuous_run
from nocl.solvers.cnd.training import _steps
from nocl.solvers.ddp.solver import steps_for
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.sysid import Settings

TINY = {"seeds": 3, "starts": 2, "states": 6, "tails": 30, "visits": 20, "rounds": 0, "iterations": 40, "held_out": 4,
        "hidden": (8,), "intervals": 20, "value": False}


def ddp_of(ocp: nocl.OCP, dynamics, **options) -> DDP:
    ddp = DDP(ocp, dynamics=dynamics, **{"substeps": 1, "integrator": "radau", **options})
    ddp.checked = True
    return ddp


def test_the_network_is_stiff_by_itself():
    ocp = stiff_net.problem()
    A = ocp.functions.on(stiff_net.model(ocp.system).to_casadi()).jacobian(np.zeros(2), 0)[0].full()
    assert np.linalg.eigvals(A).real.min() == pytest.approx(-60, abs=0.5)


def test_implicit_steps_have_the_optimum_of_many_explicit_ones():
    ocp = stiff_net.problem()
    f, x0 = stiff_net.model(ocp.system), ocp.initial_states.sample(4, 0)
    mine = ddp_of(ocp, f, intervals=20, substeps=4).solve(x0)
    fine = ddp_of(ocp, f, intervals=20, substeps=128, integrator="rk4").solve(x0)
    assert mine.success.all()
    assert fine.success.all()
    np.testing.assert_allclose(mine.cost, fine.cost, rtol=1e-5)
    np.testing.assert_allclose(mine.V_x[:, 0], fine.V_x[:, 0], rtol=1e-4, atol=1e-5)


def test_the_kernels_derivatives_are_casadis():
    """CasADi differentiates its root finder by the implicit function theorem, and the networks that were exported."""
    ocp = stiff_net.problem()
    f, x0, K = stiff_net.model(ocp.system), ocp.initial_states.sample(3, 0), 10
    u = np.random.default_rng(1).uniform(-1, 1, (3, K, 1))
    compiled, twin = (ddp_of(ocp, f, intervals=K, substeps=2) for _ in range(2))
    twin.kernel = NumpyKernel(ocp, f, 2, None, "radau")
    found = []
    for ddp in (compiled, twin):
        work = ddp._work(x0, np.zeros(3), {"u": u}, None)
        V, V_x, V_xx = np.zeros((3, K + 1)), np.zeros((3, K + 1, 2)), np.zeros((3, K + 1, 2, 2))
        work.mu[:] = 1.0
        work.backward(np.arange(3), V, V_x, V_xx)
        found.append((work.J, V, V_x, V_xx, work.gain))
    assert np.isfinite(found[0][0]).all()
    for mine, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-8 * np.abs(theirs).max())


def test_the_gradient_is_that_of_differences_with_parameters():
    ocp = stiff_net.problem(p=nocl.parameter("strength", nominal=1.0))
    ddp = ddp_of(ocp, stiff_net.model(ocp.system), intervals=20)
    x0, p, step = np.array([[0.9, 0.3]]), np.array([[1.1]]), 1e-4
    best = ddp.solve(x0, p=p)
    slopes = [(ddp.solve(x0 + d, p=p).cost - ddp.solve(x0 - d, p=p).cost)[0] / (2 * step) for d in step * np.eye(2)]
    np.testing.assert_allclose(best.V_x[0, 0], slopes, rtol=1e-5, atol=1e-8)
    by_p = (ddp.solve(x0, p=p + step).cost - ddp.solve(x0, p=p - step).cost)[0] / (2 * step)
    assert best.V_p[0, 0] == pytest.approx(by_p, rel=1e-4)


def test_collocation_has_the_same_optimum_on_the_same_nodes():
    ocp = stiff_net.problem()
    f, x0 = stiff_net.model(ocp.system), ocp.initial_states.sample(2, 0)
    mine = ddp_of(ocp, f, intervals=20).solve(x0)
    nmpc = NMPC(ocp, 20, dynamics=f, substeps=1, integrator="radau", solver="ipopt", starts=1, passes=0)
    theirs = nmpc.solve(x0, mine, workers=1)
    assert theirs.success.all()
    np.testing.assert_allclose(theirs.cost, mine.cost, rtol=1e-7)


@pytest.mark.parametrize("p", [None, nocl.parameter("strength", nominal=1.0)])
def test_steps_in_torch_are_those_of_casadi(p):
    ocp, B, h = stiff_net.problem(p=p), 5, 0.1
    f = stiff_net.model(ocp.system)
    x, values = ocp.initial_states.sample(B, 0), ocp.sample_parameters(B, 1)
    u = np.random.default_rng(2).uniform(-1, 1, (B, 1))
    step = ocp.functions.on(f.to_casadi()).step(substeps=2, integrator="radau")
    with torch.no_grad():
        here = InTorch(ocp, f, "radau").at(values)
        end, cost = here.interval(torch.from_numpy(x), torch.from_numpy(u), 0.0, h, 2)
    given = [x.T, u.T, *([values.T] if p is not None else [])]
    state, spent = step(*given, np.full((1, B), h))
    np.testing.assert_allclose(end.T, state.full(), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(cost.T, spent.full(), rtol=1e-8)


def test_the_steps_that_are_chosen_are_those_of_f_theta_not_of_the_exact_f():
    slow = stiff_net.problem(rate=2.0)
    fast = stiff_net.model(slow.system, rate=5e3)
    assert steps_for(slow, None, 80, FINE).integrator == RK4
    with pytest.warns(UserWarning, match="fastest mode 0.2 ms, step 50 ms: implicit Radau, 3 stages"):
        assert _steps(slow, fast, TrainSettings(), 80).integrator == RADAU
    ddp = DDP(slow, dynamics=fast)
    assert ddp.integrator == RADAU
    assert ddp.solve(slow.initial_states.sample(2, 0)).success.all()


def test_a_policy_runs_on_a_learned_f_as_on_the_exact_one():
    """What is learned of a linear plant is the plant; its slopes are torch's, not CasADi's."""
    ocp = stiff_net.problem(2e3)
    f, K = nocl.identify(ocp.system, settings=Settings.of("quick"), progress=False), torch.tensor([[-1.0], [-0.5]])
    at = Problems(ocp.initial_states.sample(4, 0), np.zeros(4), np.zeros((4, 0)))
    J, x = zip(*(continuous_run(lambda x, t: x @ K.double(), InTorch(ocp, of, "radau"), at, 40)[:2]
                 for of in (None, f)), strict=True)
    np.testing.assert_allclose(J[0], J[1], rtol=1e-8)
    np.testing.assert_allclose(x[0], x[1], rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_training_takes_implicit_steps_of_f_theta():
    """On 20 intervals lambda h is 400: no explicit step that is tried follows."""
    ocp = stiff_net.problem(2e3)
    settings = TrainSettings(**TINY, integrator="radau", substeps=1)
    cnd = nocl.train(ocp, stiff_net.model(ocp.system, 2e3), settings=settings, progress=False)
    assert (cnd.card["integrator"], cnd.card["dynamics"]) == ("radau", "learned")
    last = cnd.card["history"][-1]
    assert last["unsolved"] == 0
    assert np.isfinite([last["gap_median"], last["kicked_median"]]).all()


@pytest.mark.slow
def test_a_stiff_plant_that_was_identified_has_the_optimum_of_many_explicit_steps():
    """z' = 2000 (u - z - tanh(3 z) / 10), identified from labels."""
    plain = stiff_net.problem()
    x, u = plain.system.x, plain.system.u
    xdot = ca.vertcat(x[1], 2e3 * (u - x[1] - ca.tanh(3 * x[1]) / 10))
    bent = nocl.System("bent_lag", x=x, u=u, xdot=xdot, lbu=[-1], ubu=[1], lbx=[-3, -2], ubx=[3, 2])
    ocp = nocl.OCP(bent, horizon=4.0, running=0.1 * u**2, terminal=5 * x[0]**2 + x[1]**2, x_goal=[0, 0], u_goal=[0],
                   initial_states=plain.initial_states)
    f = nocl.identify(ocp.system, settings=Settings.of("quick"), progress=False)
    assert len(f.net.nets)
    x0 = ocp.initial_states.sample(10, 99)
    exact, learned = (ddp_of(ocp, one, intervals=80, substeps=4).solve(x0) for one in (None, f))
    explicit = ddp_of(ocp, f, intervals=80, substeps=128, integrator="rk4").solve(x0)
    np.testing.assert_allclose(learned.cost, explicit.cost, rtol=1e-5)
    np.testing.assert_allclose(learned.cost, exact.cost, rtol=1e-2)  # what the fit is off by
