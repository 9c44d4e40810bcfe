"""Other tools get the same system, cost and initial states."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.translate.rk4 import rk4_cost


@pytest.fixture(scope="module")
def ocp():
    return nocl.load_ocp("cartpole")


def test_control_has_the_same_dynamics_and_linearisation(ocp):
    control, s = pytest.importorskip("control"), ocp.system
    plant = nocl.to_control(s)
    x, u = np.array([0.1, -0.2, 0.3, 0.4]), np.array([0.5])
    np.testing.assert_allclose(plant.dynamics(0, x, u), s.f(x, u).full().ravel(), rtol=1e-14)
    assert (plant.state_labels, plant.input_labels) == (list(s.state_names), list(s.control_names))
    linear = nocl.to_control(s, x, u)
    A, B = s.linearize(x, u)
    np.testing.assert_array_equal(linear.A, A)
    np.testing.assert_array_equal(linear.B, B)
    np.testing.assert_allclose(plant.linearize(x, u).A, A, atol=1e-5)
    times = np.linspace(0, 1, 11)
    response = control.input_output_response(plant, times, np.full((1, 11), 0.5), x, solve_ivp_kwargs={"rtol": 1e-9})
    run = nocl.simulate(ocp, np.full((1, 40, 1), 0.5), x)
    np.testing.assert_allclose(response.states[:, -1], run.x[0, 10], atol=1e-5)
    with pytest.raises(ValueError, match="expected both"):
        nocl.to_control(s, x)


def test_held_controls_are_held_by_control(ocp):
    """Joined by lines they end 1.2 elsewhere."""
    control = pytest.importorskip("control")
    x, u = np.array([0.0, 0.0, np.pi, 0.0]), np.random.default_rng(0).uniform(-3, 3, (20, 1))
    times, inputs = nocl.held_inputs(np.linspace(0, 4, 21), u)
    response = control.input_output_response(nocl.to_control(ocp.system), times, inputs, x,
                                             solve_ivp_kwargs={"max_step": 0.2, "rtol": 1e-8, "atol": 1e-10})
    run = nocl.simulate(ocp, u[None], x)
    np.testing.assert_allclose(response.states[:, -1], run.x[0, -1], rtol=0, atol=1e-4)
    np.testing.assert_array_equal(inputs[0, ::2], inputs[0, 1::2])
    for t, wrong in ((np.linspace(0, 4, 20), u), ([0.0, np.nan], u[:1]), ([1.0, 0.0], u[:1])):
        with pytest.raises(ValueError, match="held_inputs"):
            nocl.held_inputs(t, wrong)


@pytest.mark.parametrize("problem", ["cartpole", "dubins"])
@pytest.mark.parametrize("integrator", ["rk4", "cvodes"])
def test_gymnasium_accepts_the_environment(problem, integrator):
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    env = nocl.to_gymnasium(nocl.load_ocp(problem), steps=20, integrator=integrator)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(infinity|symmetric and normalized|spec).*")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize(("horizon", "steps"), [(0.1, 3), (0.7, 7), (2.3, 23), (1 / 3, 49)])
def test_observed_times_lie_in_their_space(ocp, horizon, steps):
    """0.1 / 3 * 3 is a digit above 0.1."""
    pytest.importorskip("gymnasium")
    env = nocl.to_gymnasium(replace(ocp, horizon=horizon), steps=steps)
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        assert env.observation_space.contains(observation)
        observation, *_ = env.step([0.0])
    assert env.observation_space.contains(observation)
    assert observation[-1] == horizon


@pytest.mark.parametrize("integrator", ["rk4", "cvodes"])
def test_the_return_is_minus_the_cost(ocp, integrator):
    pytest.importorskip("gymnasium")
    env = nocl.to_gymnasium(ocp, steps=40, integrator=integrator)
    x0, u = ocp.initial_states.sample(1, 3)[0], np.random.default_rng(0).uniform(-4, 4, (40, 1))
    observation, info = env.reset(options={"x0": x0})
    np.testing.assert_array_equal(observation, [*x0, 0])
    total, over = 0.0, False
    for held in u:
        assert not over
        observation, reward, over, truncated, info = env.step(held)
        total += reward
        assert not truncated
    assert over
    assert info["cost"] == pytest.approx(-total)
    clipped = np.clip(u, -3, 3)
    if integrator == "cvodes":
        run = nocl.simulate(ocp, clipped[None], x0)
        x, cost = run.x[0, -1], run.cost[0]
    else:
        x, cost = x0, 0.0
        for held in clipped:
            x, part = rk4_cost(ocp.system.f, ocp.L, x, held, 0.1)
            cost += float(part)
        x, cost = x.full().ravel(), cost + float(ocp.G(x))
    np.testing.assert_allclose(observation, [*x, 4], rtol=1e-5, atol=1e-5)  # it tumbles
    assert -total == pytest.approx(cost, rel=1e-5)
    with pytest.raises(ValueError, match="expected reset"):
        env.step(u[0])


def test_initial_states_are_the_problems(ocp):
    pytest.importorskip("gymnasium")
    env = nocl.to_gymnasium(ocp, observe_time=False)
    first, _ = env.reset(seed=7)
    again, _ = env.reset(seed=7)
    np.testing.assert_array_equal(first, again)
    assert first.shape == (4,)
    states = np.array([env.reset()[0] for _ in range(300)])
    np.testing.assert_allclose(states.mean(axis=0), ocp.initial_states.mean, atol=0.03)
    np.testing.assert_allclose(states.std(axis=0), ocp.initial_states.std, atol=0.02)


def test_a_system_from_a_function(ocp):
    s = ocp.system
    box = {"lbu": s.lbu, "ubu": s.ubu, "lbx": s.lbx, "ubx": s.ubx}
    x, u = ca.MX.sym("x", 4), ca.MX.sym("u", 1)
    for f in (s.f, ca.Function("wrapped", [x, u], [s.f(x, u)])):
        made = nocl.System.from_casadi(f, name="mine", states=s.state_names, controls=["force"], angles=["theta"],
                                       **box)
        assert (made.name, made.control_names, made.angles) == ("mine", ("force",), ("theta",))
        z = np.array([0.1, 0.2, 0.3, 0.4])
        np.testing.assert_allclose(made.f(z, 0.5).full(), s.f(z, 0.5).full(), rtol=1e-14)
    assert nocl.System.from_casadi(s.f, **box).names == ("x0", "x1", "x2", "x3", "u0")
    with pytest.raises(ValueError, match="states has 2 names; f has 4"):
        nocl.System.from_casadi(s.f, states=["a", "b"], **box)
    with pytest.raises(ValueError, match=r"expected a casadi\.Function \(x \[nx\], u \[nu\]\) -> xdot"):
        nocl.System.from_casadi(ca.Function("f", [x], [x]), **box)


def test_do_mpc_gets_the_equations(ocp):
    pytest.importorskip("do_mpc")
    model = nocl.to_do_mpc(ocp.system)
    assert model.n_x == 4


def test_acados_gets_the_equations(ocp, monkeypatch):
    class AcadosModel:  # acados' own is a plain record, too
        pass

    try:
        import acados_template  # noqa: F401
    except ImportError:
        monkeypatch.setitem(sys.modules, "acados_template", SimpleNamespace(AcadosModel=AcadosModel))
    model, f = nocl.to_acados(ocp.system), ocp.system.f
    equations = ca.Function("equations", [model.x, model.u, model.xdot], [model.f_expl_expr, model.f_impl_expr])
    x, u = np.array([0.1, 0.2, 0.3, 0.4]), 0.5
    explicit, implicit = equations(x, u, f(x, u))
    np.testing.assert_allclose(explicit.full(), f(x, u).full(), rtol=1e-14)
    np.testing.assert_allclose(implicit.full(), 0.0, atol=1e-14)
    assert model.name == "cartpole"


@pytest.mark.parametrize("options", [{"steps": 0}, {"integrator": "euler"}])
def test_refusals(ocp, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        nocl.to_gymnasium(ocp, **options)


def test_missing_packages_say_how_to_install_them(ocp, monkeypatch):
    modules = __import__("sys").modules
    for name in ("control", "gymnasium", "do_mpc", "acados_template"):
        monkeypatch.setitem(modules, name, None)
    for call, thing in ((nocl.to_control, ocp.system), (nocl.to_gymnasium, ocp), (nocl.to_do_mpc, ocp.system),
                        (nocl.to_acados, ocp.system)):
        with pytest.raises(ValueError, match="pip install"):
            call(thing)
