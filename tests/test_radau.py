"""Implicit steps: their order and damping, their derivatives in C, DDP = NMPC, and when they are chosen."""

import warnings
from functools import partial
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
import stiff
from lq import Array

import nocl
from nocl.definition.substeps import RADAU, RK4, Grid, Steps, settled
from nocl.solvers import DDP, NMPC
from nocl.solvers.ddp.solver import steps_for
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.solvers.grid import measured
from nocl.solvers.nmpc.solver import shared_program
from nocl.translate import radau


def radau_ddp(ocp: nocl.OCP, **options) -> DDP:
    ddp = DDP(ocp, integrator="radau", **{"substeps": 1, **options})
    ddp.checked = True
    return ddp


def test_it_is_of_order_five_with_its_cost():
    """x' = -x + sin(3 t): in closed form; L = x^2 is held against far shorter steps."""
    x, u, t = ca.SX.sym("x"), ca.SX.sym("u"), nocl.time()
    s = nocl.System("forced", x=x, u=u, xdot=-x + ca.sin(3 * t) + u, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    ocp = nocl.OCP(s, horizon=2.0, running=x**2, terminal=0 * x, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian([0.5], [0.1]))
    exact = 0.8 * np.exp(-2.0) + (np.sin(6.0) - 3 * np.cos(6.0)) / 10
    ends = [[v.full().item() for v in ocp.functions.step(substeps=n, integrator="radau")(0.5, 0, 0, 2.0)]
            for n in (4, 8, 16, 64)]
    error = np.abs(np.array(ends) - [exact, ends[-1][1]])[:3]
    orders = np.log2(error[:-1] / error[1:])
    assert orders.min() > 4.6, orders
    assert radau.STAGES == 3


def test_what_is_far_faster_than_a_step_is_at_rest_after_it_and_does_not_swing():
    ocp = stiff.linear(1e6)
    ddp = radau_ddp(ocp, intervals=10)
    x = ddp.rollout(np.array([[0.0, 0.0, 5.0]]), u=np.zeros((1, 10, 1)))[0]
    assert np.abs(x[1:, 2]).max() < 1e-4
    np.testing.assert_allclose(x[-1, 1], 5e-6, rtol=1e-3)  # the momentum that the actuator leaves, 5 / rate
    explicit = DDP(ocp, intervals=10, integrator="rk4", substeps=32).rollout(np.array([[0.0, 0.0, 5.0]]),
                                                                              u=np.zeros((1, 10, 1)))
    assert not np.abs(explicit[0, -1]).max() < 1e6


def discrete_riccati(ocp: nocl.OCP, K: int) -> Array:
    """V's Hessian at node 0 of the discretised problem, by Radau's stability function of a matrix; no bound acts."""
    s, h = ocp.system, ocp.horizon / K
    A, B = (m.full() for m in s.jacobian(np.zeros(3), np.zeros(1)))
    nz, eye = 4, np.eye(3)
    z = np.block([[A, B], [np.zeros((1, 4))]])
    stages = np.linalg.solve(np.eye(3 * nz) - h * np.kron(radau.WEIGHT, z), np.tile(np.eye(nz), (3, 1)))
    X = stages.reshape(3, nz, nz)
    cost = np.diag([1.0, 0, 0, 0.1])
    W = 2 * h * sum(b * part.T @ cost @ part for b, part in zip(radau.WEIGHT[-1], X, strict=True))
    F, P = X[-1][:3], np.diag([10.0, 2.0, 0.0]) @ eye
    for _ in range(K):
        Q = W + F.T @ P @ F
        P = Q[:3, :3] - Q[:3, 3:] @ Q[3:, :3] / Q[3, 3]
    return P


def test_a_stiff_linear_problem_has_the_optimum_of_riccati():
    ocp = stiff.linear()
    x0 = ocp.initial_states.sample(4, 0)
    s = radau_ddp(ocp, intervals=20).solve(x0, curvature=True)
    assert s.success.all()
    P = discrete_riccati(ocp, 20)
    np.testing.assert_allclose(s.V_xx[:, 0], np.tile(P, (4, 1, 1)), rtol=0, atol=1e-9 * np.abs(P).max())
    np.testing.assert_allclose(s.cost, 0.5 * np.einsum("bi,ij,bj->b", x0, P, x0), rtol=1e-10)


@pytest.mark.parametrize(("make", "K", "substeps"), [(partial(stiff.van_der_pol, 10.0), 20, 2), (stiff.robertson, 6, 1),
                                                     (stiff.polymerisation, 4, 1)])
def test_the_kernels_derivatives_are_casadis(make, K, substeps):
    """Of the same steps; CasADi differentiates its root finder by the implicit function theorem."""
    ocp = make()
    ddp, x0 = radau_ddp(ocp, intervals=K, substeps=substeps, constraints="soft"), ocp.initial_states.sample(3, 0)
    work = ddp._work(x0, np.zeros(3), {}, None)
    twin = radau_ddp(ocp, intervals=K, substeps=substeps, constraints="soft")
    twin.kernel = NumpyKernel(ocp, None, substeps, None, "radau")
    slow = twin._work(x0, np.zeros(3), {}, None)
    assert np.isfinite(work.J).all()
    np.testing.assert_allclose(work.J, slow.J, rtol=1e-10)
    n = ocp.system.nx
    found = [(np.zeros((3, K + 1)), np.zeros((3, K + 1, n)), np.zeros((3, K + 1, n, n))) for _ in range(2)]
    for one, out in zip((work, slow), found, strict=True):
        one.mu[:] = 1.0
        one.backward(np.arange(3), *out)
    unit = (ocp.system.ubx - ocp.system.lbx) / 2
    for mine, theirs, scale in zip(*found, (1.0, unit, np.outer(unit, unit)), strict=True):
        np.testing.assert_allclose(mine * scale, theirs * scale, rtol=0, atol=1e-7 * np.abs(theirs * scale).max())


def test_the_gradient_is_that_of_differences_with_time_and_parameters():
    x, v, u, rate, t = *(ca.SX.sym(n) for n in ("x", "v", "u")), nocl.parameter("rate", nominal=300.0), nocl.time()
    xdot = ca.vertcat(v - 0.2 * x**3, rate * (u + ca.sin(t) - v))
    s = nocl.System("timed", x=ca.vertcat(x, v), u=u, p=rate, xdot=xdot, lbu=[-1], ubu=[1], lbx=[-2, -2], ubx=[2, 2])
    ocp = nocl.OCP(s, horizon=1.0, running=x**2 + 0.1 * u**2, terminal=x**2, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Gaussian([1.0, 0.0], [0.1, 0.1]), parameters=nocl.Uniform([200], [400]))
    ddp, x0 = radau_ddp(ocp, intervals=8), np.array([[0.9, 0.3]])
    p = np.array([[300.0]])
    best = ddp.solve(x0, p=p)
    step = 1e-5
    slopes = [(ddp.solve(x0 + d, p=p).cost - ddp.solve(x0 - d, p=p).cost)[0] / (2 * step) for d in step * np.eye(2)]
    np.testing.assert_allclose(best.V_x[0, 0], slopes, rtol=1e-6, atol=1e-8)
    by_p = (ddp.solve(x0, p=p + 0.1).cost - ddp.solve(x0, p=p - 0.1).cost)[0] / 0.2
    assert best.V_p[0, 0] == pytest.approx(by_p, rel=1e-5)


@pytest.mark.parametrize(("make", "K", "substeps"), [(lambda: stiff.van_der_pol(10.0), 20, 2),
                                                     (stiff.robertson, 10, 1), (stiff.polymerisation, 10, 1)])
def test_ddp_and_collocation_have_the_same_optimum_on_the_same_nodes(make, K, substeps):
    ocp = make()
    x0 = ocp.initial_states.sample(2, 0)
    mine = radau_ddp(ocp, intervals=K, substeps=substeps).solve(x0)
    assert mine.success.all(), mine.message
    nmpc = NMPC(ocp, K, substeps=substeps, integrator="radau", solver="ipopt", starts=1, passes=0,
                options={"ipopt.bound_relax_factor": 0.0})  # else its controls are better by 1e-8 of 373 K
    theirs = nmpc.solve(x0, mine, gains=True, workers=1)
    np.testing.assert_allclose(theirs.cost, mine.cost, rtol=1e-8)
    unit = (ocp.system.ubx - ocp.system.lbx) / 2
    np.testing.assert_allclose(theirs.V_x * unit, mine.V_x * unit, rtol=0, atol=1e-5 * np.abs(mine.V_x * unit).max())


def test_constraints_hold_with_implicit_steps_by_multipliers_and_in_the_program():
    ocp = stiff.linear()
    p, v = ocp.system.x[0], ocp.system.x[1]
    ocp = nocl.OCP(ocp.system, horizon=2.0, running=p**2 + 0.1 * ocp.system.u**2, terminal=5 * p**2,
                   x_goal=[0, 0, 0], u_goal=[0], initial_states=ocp.initial_states, constraints={"slow": v + 0.5})
    x0 = np.array([[1.0, 0.0, 0.5]])
    mine = radau_ddp(ocp, intervals=20).solve(x0)
    nmpc = NMPC(ocp, 20, substeps=1, integrator="radau", solver="ipopt", starts=1, passes=0)
    theirs = nmpc.solve(x0, mine, workers=1)
    assert mine.success.all()
    assert mine.x[0, :, 1].min() == pytest.approx(-0.5, abs=1e-6)
    np.testing.assert_allclose(theirs.cost, mine.cost, rtol=1e-5)
    assert (mine.cost <= theirs.cost).all()  # IPOPT and fatrop stop 2e-6 above it, and 1e-6 apart


def test_rows_do_not_depend_on_each_other():
    ocp = stiff.van_der_pol(10.0)
    ddp, x0 = radau_ddp(ocp, intervals=20, substeps=2), ocp.initial_states.sample(5, 0)
    together = ddp.solve(x0)
    alone = [ddp.solve(row) for row in x0]
    np.testing.assert_array_equal(together.cost, [one.cost[0] for one in alone])


def test_a_step_that_does_not_converge_names_its_node():
    """x' = x^2 + 1 has no solution beyond t = pi / 2, nor its steps one beyond some length."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    s = nocl.System("burst", x=x, u=u, xdot=x**2 + 1 + u, lbu=[-0.1], ubu=[0.1], lbx=[-1], ubx=[1])
    ocp = nocl.OCP(s, horizon=4.0, running=x**2, terminal=0 * x, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian([0.0], [0.1]))
    found = radau_ddp(ocp, intervals=8, substeps=1).solve([0.0])
    assert not found.success[0]
    assert "the implicit step did not converge at node" in found.message[0]
    node = int(found.message[0].split("node ")[1].split(";")[0])
    assert 2 <= node <= 6


def test_a_root_that_is_none_is_not_a_number():
    """CasADi's root finder calls NaN, and where it stopped, a success."""
    z, c = ca.SX.sym("z", radau.STAGES), ca.SX.sym("c")
    given = [ca.MX.sym("c")]
    find = ca.Function("find", given, [radau.stages(ca.Function("g", [z, c], [z**2 + z + c]), np.ones(1), given)])
    np.testing.assert_allclose(find(0.0).full(), 0.0, atol=1e-12)
    assert np.isnan(find(1.0).full()).all()


@pytest.mark.parametrize("make", [lambda ocp, **given: DDP(ocp, **given),
                                  pytest.param(lambda ocp, **given: NMPC(ocp, 80, starts=2, passes=0, **given),
                                               marks=pytest.mark.slow)])
def test_they_are_chosen_where_explicit_ones_are_too_many_and_that_is_said(make):
    ocp = stiff.linear(1e5)
    x0 = ocp.initial_states.sample(2, 0)
    shared_program.cache_clear()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solver = make(ocp)
        found = solver.solve(x0)
    assert len(said) == 1
    assert "fastest mode 0.01 ms, step 25 ms: implicit Radau, 3 stages" in str(said[0].message)
    chosen = getattr(solver, "settled", solver)
    assert (chosen.integrator, chosen.substeps) == (RADAU, 1)
    np.testing.assert_allclose(found.cost, nocl.simulate(ocp, found.u, x0).cost, rtol=1e-3)
    with pytest.warns(UserWarning, match="nothing was solved, not even with substeps=32"):
        assert not make(ocp, integrator="rk4").solve(x0).success.any()


def test_few_runge_kutta_steps_are_kept():
    grid = Grid(0.05, 1, 0.5, 16, 1e-5, 0.01)
    asked = []

    def ask(steps: Steps) -> Grid | None:
        asked.append(steps)
        return grid if steps.substeps == 1 else Grid(0.05, 16, 1e-5, 16, 1e-5, 0.01)

    with pytest.warns(UserWarning, match="so they are taken"):
        assert settled("x", ask, 0.05, lambda: 0.01) == Steps(RK4, 16)
    assert asked == [Steps(RK4, 1), Steps(RK4, 16)]


def test_their_grid_is_measured_too():
    ocp = stiff.linear(1e5)
    s = radau_ddp(ocp, intervals=80).solve(ocp.initial_states.sample(2, 0))
    grids = [measured(ocp, ocp.functions, s, n, RADAU) for n in (1, 2)]
    assert all(grid.error < 1e-3 for grid in grids)
    assert grids[1].error < grids[0].error
    assert grids[0].fastest == pytest.approx(1e-5)
    assert 'integrator="radau"' in str(measured(ocp, ocp.functions, s, 1))


def test_a_wrong_integrator_is_refused():
    ocp = stiff.linear()
    for make in (DDP, NMPC):
        with pytest.raises(ValueError, match="integrator is 'euler'"):
            make(ocp, integrator="euler")


@pytest.mark.slow
def test_the_polymerisation_reactor_runs_untuned():
    """|lambda| h = 16 on 80 intervals: 8 or 16 Runge-Kutta steps are no dearer than an implicit one, and enough."""
    ocp = stiff.polymerisation()
    x0 = ocp.initial_states.sample(3, 0)
    with pytest.warns(UserWarning, match="are taken"):
        assert steps_for(ocp, None, 80).integrator == RK4
    costs = []
    for given in ({}, {"integrator": "radau", "substeps": 1}, {"integrator": "radau", "substeps": 2}):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = DDP(ocp, **given).solve(x0)
        assert found.success.all()
        costs.append(found.cost)
        np.testing.assert_allclose(found.cost, nocl.simulate(ocp, found.u, x0).cost, rtol=1e-3)
    for one, other in pairwise(costs):
        np.testing.assert_allclose(one, other, rtol=2e-3)
