"""Level sets against what is known: the Riccati solution, a problem in one dimension, periodicity, limits, sampling."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.judge import simulate
from nocl.solvers.lqr import LQR

pytest.importorskip("hj_reachability")

from nocl.solvers.levelset import scheme, solver
from nocl.solvers.levelset.solver import LevelSet, LevelSetSolution, refine


@pytest.fixture(scope="module")
def integrator() -> LevelSetSolution:
    return LevelSet(nocl.load_ocp("double_integrator"), (61, 61), slices=21).solve()


def states(n: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (n, 2))


def test_double_integrator_has_the_riccati_value_gradient_and_feedback(integrator):
    """On these states u stays within its bounds, so that LQR's value is the exact one."""
    exact, x = LQR(integrator.problem.ocp), states()
    V = exact.value(x)
    assert np.abs(integrator.value(x) - V).max() < 0.03 * V.max()
    gradient = 2 * 0.5 * x @ exact.P(0.0)
    assert np.abs(integrator.value_gradient(x) - gradient).max() < 0.03 * np.abs(gradient).max()
    assert np.abs(integrator(x) - exact(x)).max() < 0.02
    assert integrator.value(x[0]) == pytest.approx(integrator.value(x)[0])
    assert integrator(x[0]).shape == (1,)


def test_its_feedback_costs_what_the_optimum_costs(integrator):
    exact, x = LQR(integrator.problem.ocp), integrator.problem.ocp.initial_states.sample(4, 1)
    cost = simulate(integrator.problem.ocp, integrator, x, hold=160).cost
    np.testing.assert_allclose(cost, exact.value(x), rtol=0.01)


def test_the_value_at_the_horizon_is_G(integrator):
    x = states()
    np.testing.assert_allclose(integrator.value(x, 2.0), integrator.problem.ocp.G(x.T).full().ravel(), atol=1e-6)


def test_outside_the_box_there_is_no_answer(integrator):
    x = np.array([[0.5, 0.0], [3.1, 0.0]])
    assert np.isnan(integrator.value(x)).tolist() == [False, True]
    assert np.isnan(integrator(x)[:, 0]).tolist() == [False, True]
    run = simulate(integrator.problem.ocp, integrator, x, hold=20)
    assert run.success.tolist() == [True, False]
    assert "NaN" in run.message[1]


@pytest.mark.slow
def test_refinement_converges_to_the_riccati_value():
    ocp, x = nocl.load_ocp("double_integrator"), states()
    study = refine(ocp, [(31, 31), (61, 61), (91, 91)], x)
    V = LQR(ocp).value(x)
    errors = np.abs(study.V - V).mean(axis=1) / V.mean()
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 0.01
    assert study.order > 1
    with pytest.raises(ValueError, match="at least 2"):
        refine(ocp, [(31, 31)], x)


def test_richardson_is_exact_for_pure_powers():
    h, limit = np.array([1.0, 0.5, 0.25]), np.array([1.0, -2.0])
    study = solver.Refinement(h, limit + 0.3 * h[:, None] ** 2, np.zeros(3))
    assert study.order == pytest.approx(2.0, abs=1e-6)
    np.testing.assert_allclose(study.limit, limit, atol=1e-9)


def turning(G: str, bounded: float = 1.0, **options) -> nocl.OCP:
    """dtheta/dt = u on a circle, or along a line where G is not periodic."""
    theta, u = ca.SX.sym("theta"), ca.SX.sym("u")
    system = nocl.System("turning", x=theta, u=u, xdot=u, lbu=[-bounded], ubu=[bounded], lbx=[-4.0], ubx=[4.0],
                         angles=["theta"])
    return nocl.OCP(system, horizon=1.0, running=options.pop("running", lambda u: 0.5 * u**2)(u),
                    terminal=1 - ca.cos(theta) if G == "periodic" else theta**2 / 2, x_goal=[0.0], u_goal=[0.0],
                    initial_states=nocl.Uniform(lb=[-1.0], ub=[1.0]))


def test_an_axis_is_periodic_only_where_the_problem_is():
    round_, line = LevelSet(turning("periodic"), (64,)), LevelSet(turning("line"), (64,))
    assert round_.periodic.tolist() == [True]
    assert round_.upper[0] == pytest.approx(-4 + 2 * np.pi)
    assert not line.periodic.any()
    assert not LevelSet(turning("periodic"), (64,), box=([-2.0], [2.0])).periodic.any()
    solution = round_.solve()
    x = np.linspace(-3, 3, 20)[:, None]
    np.testing.assert_allclose(solution.value(x + 2 * np.pi), solution.value(x), atol=1e-12)
    np.testing.assert_allclose(solution.value(x), solution.value(-x), atol=2e-3)  # V has a kink at pi


def test_known_value_on_a_line_with_and_without_an_active_bound():
    """V(x, 0) = x^2 / (2 (1 + T)) where |u| = |x| / (1 + T) is allowed; else the distance shrinks at full speed."""
    x = np.linspace(-2.5, 2.5, 41)[:, None]
    free = LevelSet(turning("line", bounded=5.0), (161,)).solve()
    np.testing.assert_allclose(free.value(x), x[:, 0] ** 2 / 4, atol=2e-3)
    bound = LevelSet(turning("line", bounded=0.5), (161,)).solve()
    wanted = np.where(np.abs(x) <= 1, x**2 / 4, 0.125 + (np.abs(x) - 0.5) ** 2 / 2)[:, 0]
    np.testing.assert_allclose(bound.value(x), wanted, atol=2e-3)


@pytest.mark.slow
def test_a_cost_that_is_not_quadratic_is_sampled():
    """L = |u|^4 / 4: H* = -3/4 |p|^(4/3), and V(x, 0) = c^4 / 4 + (x - c)^2 / 2 with c^3 = x - c."""
    ocp = turning("line", bounded=2.0, running=lambda u: u**4 / 4)
    problem = LevelSet(ocp, (121,))
    assert not problem.exact
    p = np.linspace(-3, 3, 25)[:, None]
    np.testing.assert_allclose(problem.minimise.rows(np.zeros_like(p), p), -np.cbrt(p), atol=1e-3)
    u = np.linspace(0.2, 1.1, 20)
    x = (u**3 + u)[:, None]
    np.testing.assert_allclose(problem.solve().value(x), u**4 / 4 + u**6 / 2, atol=3e-3)


def test_stretched_axes_are_finest_at_the_goal_which_is_a_node():
    for lower, upper, goal in ((-4.0, 0.5, 0.0), (-1.0, 3.0, 1.0), (0.0, 2.0, 0.0), (-2.0, 1.0, 1.0)):
        axis = scheme.axis(lower, upper, 31, goal, 0.3, False)
        cells = np.diff(axis.nodes)
        assert len(axis.nodes) == 31
        assert np.abs(axis.nodes - goal).min() < 1e-12
        assert axis.nodes[0] <= lower + 1e-12
        assert axis.nodes[-1] >= upper - 1e-12
        assert abs(axis.nodes[np.argmin(cells)] - goal) < 1.01 * cells.min()
        np.testing.assert_allclose(np.diff(axis.y), axis.spacing, rtol=1e-9)
        np.testing.assert_allclose(np.asarray(axis.slope(axis.nodes)), 0.3 * np.cosh(axis.y), rtol=1e-6)


@pytest.mark.slow
def test_the_upwind_hamiltonian_is_the_minimum_over_controls_each_with_its_own_side():
    """By brute force over controls, at random states and differences; with equal sides it is the Hamiltonian itself."""
    ocp = nocl.load_ocp("dubins")
    axes = tuple(scheme.axis(-4.0, 4.0, 21, 0.0, w, False) for w in (np.inf, 0.5, 1.0))
    with solver.jax.enable_x64(True):
        dynamics = scheme.Dynamics(ocp, scheme.exact_minimiser(ocp), axes, 9)
        assert dynamics.undecided == [2]  # v >= 0: where px and py go is known from psi
        rng = np.random.default_rng(0)
        x, left, right = rng.uniform(-3, 3, (300, 3)), rng.normal(0, 0.1, (300, 3)), rng.normal(0, 0.1, (300, 3))
        slopes = np.stack([np.asarray(a.slope(x[:, i])) for i, a in enumerate(axes)], -1)
        H = np.asarray(dynamics.upwind(x, left * slopes, right * slopes))
        best = np.full(300, np.inf)
        for u in np.stack(np.meshgrid(np.linspace(0, 1, 41), np.linspace(-1, 1, 81)), -1).reshape(-1, 2):
            f, L = (np.asarray(g(x.T, u)).T for g in (ocp.system.f, ocp.L_soft))
            best = np.minimum(best, L[:, 0] + (np.maximum(f, 0) * right + np.minimum(f, 0) * left).sum(axis=1))
        np.testing.assert_allclose(H, best, atol=1e-3)
        same = np.asarray(dynamics.upwind(x, left * slopes, left * slopes))
        np.testing.assert_allclose(same, np.asarray(dynamics.minimise.traced(x, left)[1]), atol=1e-12)


def test_the_upwind_hamiltonian_holds_a_drifting_state_still_in_a_fold_of_v():
    """By brute force again: gravity drives omega, so the best control in a fold is neither side's nor that of 0."""
    ocp = nocl.load_ocp("pendulum")
    axes = tuple(scheme.axis(-4.0, 4.0, 21, 0.0, np.inf, False) for _ in range(2))
    with solver.jax.enable_x64(True):
        dynamics = scheme.Dynamics(ocp, scheme.exact_minimiser(ocp), axes, 9)
        assert dynamics.undecided == [1]
        rng = np.random.default_rng(0)
        x, left, right = rng.uniform(-3, 3, (300, 2)), rng.normal(0, 0.1, (300, 2)), rng.normal(0, 0.1, (300, 2))
        H, best = np.asarray(dynamics.upwind(x, left, right)), np.full(300, np.inf)
        for u in np.linspace(-5, 5, 4001):
            f, L = (np.asarray(g(x.T, u)).T for g in (ocp.system.f, ocp.L_soft))
            best = np.minimum(best, L[:, 0] + (np.maximum(f, 0) * right + np.minimum(f, 0) * left).sum(axis=1))
        np.testing.assert_allclose(H, best, atol=1e-3)


@pytest.mark.slow
def test_stretching_helps_where_the_goal_is_small():
    """van der Pol's V against the optimum of DDP: 4 % off where it is 8 % on uniform axes."""
    from nocl.solvers.ddp.solver import DDP

    ocp = nocl.load_ocp("van_der_pol")
    x = ocp.initial_states.sample(20, 3)
    J = DDP(ocp, intervals=200).solve(x).cost
    box = ([-2.7, -3.3], [2.9, 3.3])
    uniform, fine = (LevelSet(ocp, (61, 61), box=box, slices=2, stretch=w, scheme="weno5").solve().value(x)
                     for w in (None, [0.5, 0.5]))
    assert np.abs(fine / J - 1).mean() < 0.05
    assert np.abs(fine / J - 1).mean() < 0.6 * np.abs(uniform / J - 1).mean()


def test_eased_penalties_are_never_dearer_and_the_same_near_the_edge():
    ocp = nocl.load_ocp("dubins")
    eased, x = scheme.eased(ocp, 0.3), np.zeros((400, 3))  # bent at a depth of 0.3 / 600 m
    x[:, 0], x[:, 1] = -1.0, np.linspace(0.0, 0.6, 400)
    soft, less = (np.asarray(o.L_soft(x.T, np.zeros(2))).ravel() for o in (ocp, eased))
    depth = np.maximum(ocp.penalty_margin - np.asarray(ocp.h(x.T)).ravel(), 0)
    assert (less <= soft + 1e-15).all()
    np.testing.assert_allclose(less[depth < 5e-4], soft[depth < 5e-4], atol=1e-15)
    deep = depth > 6e-4
    np.testing.assert_allclose(np.diff(less[deep]) / np.diff(depth[deep]), 0.3, rtol=1e-6)


@pytest.mark.slow
def test_obstacles_enter_as_the_soft_cost():
    ocp = nocl.load_ocp("double_integrator")
    wall = replace(ocp, path_constraints={"wall": 0.5 - ocp.system.x[0]}, penalty=100.0)
    free, held = (LevelSet(o, (41, 41)).solve() for o in (ocp, wall))
    assert held.value([1.0, 0.0]) > 2 * free.value([1.0, 0.0])
    assert held.value([-1.0, 0.0]) == pytest.approx(free.value([-1.0, 0.0]), rel=0.05)


@pytest.mark.slow
def test_what_is_too_large_is_refused_before_it_starts():
    ocp = nocl.load_ocp("double_integrator")
    with pytest.raises(ValueError, match=r"40000 x 40000 nodes would take about .* GB.*max_memory = 4 GB"):
        LevelSet(ocp, (40000, 40000)).solve()
    with pytest.raises(ValueError, match=r"would take about .* s \(\d+ steps\).*max_seconds"):
        LevelSet(ocp, (31, 31), max_seconds=1e-6).solve()
    prediction = LevelSet(ocp, (31, 31)).predict()
    assert prediction.points == 31 * 31
    assert prediction.steps > 50
    assert 0 < prediction.memory < 0.1


def test_misuse_is_explained():
    ocp = nocl.load_ocp("double_integrator")
    with pytest.raises(ValueError, match="12 states; expected at most 3"):
        LevelSet(nocl.load_ocp("quadrotor"), (8,) * 12)
    for grid in ((31,), (31, 4), (31, 31.5), 31):
        with pytest.raises(ValueError, match="expected 2 numbers of nodes"):
            LevelSet(ocp, grid)
    with pytest.raises(ValueError, match="scheme is 'best'"):
        LevelSet(ocp, (31, 31), scheme="best")
    for widths in ([0.5], [0.5, -1.0]):
        with pytest.raises(ValueError, match="expected 2 widths"):
            LevelSet(ocp, (31, 31), stretch=widths)
    with pytest.raises(ValueError, match="outside the box"):
        LevelSet(ocp, (31, 31), box=([1.0, -3.0], [3.0, 3.0]), stretch=[0.5, np.inf])
    with pytest.raises(ValueError, match="is periodic"):
        LevelSet(turning("periodic"), (64,), stretch=[0.5])
    with pytest.raises(ValueError, match="penalty_slope"):
        LevelSet(ocp, (31, 31), penalty_slope=-1.0)
    with pytest.warns(UserWarning, match="4 states"):
        LevelSet(nocl.load_ocp("cartpole"), (9, 9, 9, 9))


def test_it_is_saved_and_loaded(integrator, tmp_path):
    path = integrator.save(tmp_path / "V.safetensors")
    again, x = LevelSetSolution.load(path, integrator.problem), states(5)
    np.testing.assert_array_equal(again.value(x, 0.7), integrator.value(x, 0.7))
    with pytest.raises(ValueError, match="another problem or grid"):
        LevelSetSolution.load(path, LevelSet(integrator.problem.ocp, (31, 31), slices=21))
