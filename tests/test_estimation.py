"""Parameters estimated on line: against Bayes in closed form and the truth, and laws that act on it."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import nocl
from nocl.solvers.estimation import Adaptive, ParameterEstimator
from nocl.systems import cartpole

DT = 0.1


def cart(unit: float = 1.0, **change: object) -> nocl.OCP:
    """A cart of some mass and friction, its position in other units."""
    x, u = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("force")
    inverse, friction = nocl.parameter("inverse_mass", 1.0), nocl.parameter("friction", 0.2)
    goal = nocl.parameter("goal", 0.5)
    s = nocl.System("cart", x=x, u=u, p=ca.vertcat(inverse, friction), lbu=[-3], ubu=[3], lbx=[-5 * unit, -5 * unit],
                    ubx=[5 * unit, 5 * unit], xdot=ca.vertcat(x[1], unit * u * inverse - friction * x[1]))
    options: dict[str, object] = {
        "p": goal, "horizon": 2.0, "running": 0.01 * u**2, "terminal": (x[0] / unit - goal) ** 2 + (x[1] / unit) ** 2,
        "x_goal": [unit * goal, 0], "u_goal": [0], "initial_states": nocl.Gaussian([0, 0], [0.1, 0.1]),
        "parameters": nocl.Uniform([0.5, 0.0, -1], [1.5, 0.4, 1])}
    return nocl.OCP(s, **{**options, **change})  # type: ignore[arg-type]


def record(ocp: nocl.OCP, p: np.ndarray, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """States [steps+1, B, nx] and controls [steps, B, nu] of the plant at p [B, np], by scipy's DOP853."""
    rng, (B, s) = np.random.default_rng(seed), (len(p), ocp.system)
    u, x = rng.uniform(s.lbu, s.ubu, (steps, B, s.nu)), np.zeros((steps + 1, B, s.nx))
    for k in range(steps):
        for b in range(B):
            def rate(t: float, z: np.ndarray, b: int = b, k: int = k) -> np.ndarray:
                return np.asarray(s.f(z, u[k, b], p[b, :s.np]).full().ravel())
            x[k + 1, b] = solve_ivp(rate, (0, DT), x[k, b], method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    return x, u


def run(filter_: ParameterEstimator, x: np.ndarray, u: np.ndarray) -> nocl.solvers.estimation.Estimate:
    known = filter_.start(x.shape[1])
    for k in range(len(u)):
        known = filter_.update(known, x[k], u[k], x[k + 1], k * DT)
    return known


def test_exact_measurements_give_the_parameters():
    ocp = cart()
    p = np.array([[0.7, 0.35], [1.4, 0.05], [1.0, 0.2]])
    filter_ = ParameterEstimator(ocp, DT, noise=[1e-5, 1e-5])
    found = run(filter_, *record(ocp, p, 20))
    np.testing.assert_allclose(found.p, p, atol=5e-4)
    assert (found.std < 1e-3 * filter_.start(3).std).all()


@pytest.mark.parametrize("memory", [100, 2])  # what is forgotten is kept to first order: here that is all
def test_it_is_the_posterior_of_least_squares_where_the_model_is_linear_in_p(memory):
    """With friction known to be 0, the state after an interval is affine in 1 / m: the mean and variance of Bayes."""
    ocp = cart(parameters=nocl.Uniform([0.5, 0.0, -1], [1.5, 0.0, 1]))
    x, u = record(ocp, np.array([[1.2, 0.0]]), 6)
    noise = np.array([0.3, 0.2])
    noisy = x + noise * np.random.default_rng(1).standard_normal(x.shape) / 10
    found = run(ParameterEstimator(ocp, DT, noise=noise, memory=memory), noisy, u)
    slope = np.stack([u[:, 0, 0] * DT**2 / 2, u[:, 0, 0] * DT], axis=1)
    rest = noisy[1:, 0] - noisy[:-1, 0] - np.stack([noisy[:-1, 0, 1] * DT, np.zeros(6)], axis=1)
    information = 1 / 0.5**2 + ((slope / noise) ** 2).sum()
    mean = (1.0 / 0.5**2 + (slope * rest / noise**2).sum()) / information
    assert found.p[0, 0] == pytest.approx(mean, rel=1e-9)
    assert found.covariance[0, 0, 0] == pytest.approx(1 / information, rel=1e-9)


def test_it_is_not_sure_of_wrong_values_where_p_acts_nonlinearly():
    """A cart-pole's length is in every entry of its accelerations, the other constants in quotients."""
    units: dict[str, tuple[float, float]] = {"l": (0.7, 1.3), "m_pole": (0.07, 0.13), "gain": (2.1, 3.9)}
    constants = [nocl.parameter(name, sum(box) / 2) for name, box in units.items()]
    system = cartpole.system(**dict(zip(units, constants, strict=True)), parameters=ca.vertcat(*constants))
    low, high = zip(*units.values(), strict=True)
    ocp = nocl.OCP.quadratic(system, horizon=4.0, x_goal=[0, 0, 0, 0], u_goal=[0],
                             initial_states=nocl.Gaussian([0, 0, np.pi, 0], [0.1] * 4),
                             parameters=nocl.Uniform(low, high))
    p, noise = ocp.sample_parameters(20, 3), np.array([1e-5, 1e-4, 1e-5, 1e-4])
    x, u = record(ocp, p, 12)
    filter_ = ParameterEstimator(ocp, DT, noise=noise, substeps=8)
    known, rng = filter_.start(20), np.random.default_rng(4)
    for k in range(12):
        after = x[k + 1] + noise * rng.standard_normal((20, 4))
        known = filter_.update(known, x[k], u[k], after, k * DT)
        assert (np.abs(known.p - p) < 4.5 * known.std + 1e-12).all()
    assert (known.std < 0.05 * filter_.half).all()


def test_at_the_edge_of_the_box_it_is_bounded_least_squares():
    """Friction 0, the lower bound: what it would be beyond is not taken off the mass."""
    ocp, noise = cart(), np.array([2e-4, 2e-3])
    p = np.tile([0.9, 0.0], (12, 1))
    x, u = record(ocp, p, 15)
    noisy = x + noise * np.random.default_rng(2).standard_normal(x.shape)
    filter_ = ParameterEstimator(ocp, DT, noise=noise)
    found = run(filter_, noisy, u)
    step = ocp.functions.step(substeps=4)
    for b in range(12):
        def off(q: np.ndarray, b: int = b) -> np.ndarray:
            given = np.tile(np.r_[q, 0.0][:, None], (1, 15))
            after = step(noisy[:-1, b].T, u[:, b].T, given, DT)[0].full().T
            return np.r_[((noisy[1:, b] - after) / noise).ravel(), (q - ocp.nominal[:2]) / filter_.half]
        best = least_squares(off, [1.0, 0.2], bounds=(filter_.low, filter_.high), xtol=1e-12, ftol=1e-12).x
        assert (np.abs(found.p[b] - best) < 0.02 * found.std[b]).all()
    assert (found.p[:, 1] == 0).sum() >= 3


def test_units_of_states_change_nothing():
    p = np.array([[0.7, 0.35], [1.4, 0.05]])
    one, two = (run(ParameterEstimator(cart(unit), DT), *record(cart(unit), p, 8)) for unit in (1.0, 1e6))
    np.testing.assert_allclose(two.p, one.p, rtol=1e-7)
    np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-6)


def test_what_is_not_excited_stays_and_says_so():
    ocp = cart()
    filter_ = ParameterEstimator(ocp, DT)
    known = filter_.start(1)
    for _ in range(30):
        known = filter_.update(known, np.zeros((1, 2)), np.zeros((1, 1)), np.zeros((1, 2)))
    np.testing.assert_allclose(known.p, [[1.0, 0.2]])
    np.testing.assert_allclose(known.std, filter_.start(1).std)


def test_a_kick_is_no_change_of_mass():
    ocp, p = cart(), np.array([[0.8, 0.3]])
    x, u = record(ocp, p, 30)
    kicked = x.copy()
    kicked[20:, :, 1] += 0.5  # a push; what comes after starts from there, which the plant's friction forgets slowly
    filter_ = ParameterEstimator(ocp, DT)
    known = run(filter_, x[:20], u[:19])
    pushed = filter_.update(known, x[19], u[19], kicked[20], 19 * DT)
    assert (np.abs(pushed.p - known.p) < 0.05 * filter_.half).all()


def test_estimates_stay_in_the_box_and_a_blown_up_state_tells_nothing():
    ocp = cart()
    filter_ = ParameterEstimator(ocp, DT, noise=[1e-4, 1e-4])
    known = filter_.start(2)
    after = np.array([[0.0, 3.0], [np.nan, np.inf]])  # as if it weighed far less than any in the box
    found = filter_.update(known, np.zeros((2, 2)), np.ones((2, 1)), after)
    assert 0.5 <= found.p[0, 0] <= 1.5
    np.testing.assert_array_equal(found.p[1], known.p[1])
    np.testing.assert_array_equal(found.covariance[1], known.covariance[1])


def test_a_law_with_the_estimate_does_as_the_law_with_the_truth_and_better_than_with_the_nominal_one():
    ocp = cart()
    p = np.array([[0.55, 0.4, 0.8], [1.45, 0.0, -0.7], [0.7, 0.1, 0.5]])

    def law(x: np.ndarray, t: float, p: np.ndarray) -> np.ndarray:
        """Computed torque to the goal."""
        wanted = 6 * (p[:, 2] - x[:, 0]) - 4 * x[:, 1]
        return ((wanted + p[:, 1] * x[:, 1]) / p[:, 0])[:, None]

    def nominal(x: np.ndarray, t: float, p: np.ndarray) -> np.ndarray:
        return law(x, t, np.c_[np.tile(ocp.nominal[:2], (len(p), 1)), p[:, 2]])

    x0, hold = np.zeros((3, 2)), 20
    adaptive = Adaptive(law, ParameterEstimator(ocp, ocp.horizon / hold))
    told, learned, blind = (nocl.simulate(ocp, c, x0, p=p, hold=hold).x for c in (law, adaptive, nominal))
    off, without = (np.abs(x - told).max(axis=(1, 2)) for x in (learned, blind))
    assert (off < 0.7 * without).all()
    assert len(adaptive.estimates) == hold
    np.testing.assert_allclose(adaptive.estimates[-1].p[:, 0], p[:, 0], atol=0.02)
    np.testing.assert_array_equal(nocl.simulate(ocp, adaptive, x0, p=p, hold=hold).x, learned)  # it begins anew


def test_what_is_refused():
    ocp = cart()
    plain = nocl.load_ocp("pendulum")
    filter_ = ParameterEstimator(ocp, DT)
    for make, words in [
            (lambda: ParameterEstimator(plain, DT), "has no parameters"),
            (lambda: ParameterEstimator(ocp, 0.0), "dt is 0"),
            (lambda: ParameterEstimator(ocp, DT, noise=[1.0, 0.0]), "noise is"),
            (lambda: ParameterEstimator(ocp, DT, noise=[1.0]), "noise"),
            (lambda: ParameterEstimator(ocp, DT, substeps=0), "substeps is 0"),
            (lambda: ParameterEstimator(ocp, DT, memory=0), "memory is 0"),
            (lambda: Adaptive(3, filter_), "law is a int"),
            (lambda: Adaptive(lambda x, t, p: x, 3), "estimator"),
            (lambda: nocl.simulate(ocp, Adaptive(lambda x, t, p: x[:, :1], filter_), [0, 0], p=[1, 0.1, 0], hold=5),
             "the estimator's dt is 0.1: give simulate hold=20")]:
        with pytest.raises(ValueError, match=words):
            make()
