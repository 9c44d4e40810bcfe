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


@pytest.fixture(scope="module")
def varied():
    """Two masses to a moving goal, with drag that fades: f in t and p, L in t and p, a constraint in p."""
    x, u, t = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("u"), nocl.time()
    mass, goal = nocl.parameter("mass", 1.0, "kg"), nocl.parameter("goal", 0.5)
    s = nocl.System("varied", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], u / mass - ca.exp(-t) * x[1]), lbu=[-2], ubu=[2],
                    lbx=[-4, -4], ubx=[4, 4])
    return nocl.OCP(s, p=goal, horizon=2.0, running=0.1 * u**2 + (x[0] - goal * ca.sin(t))**2, terminal=mass * x[1]**2,
                    x_goal=[goal, 0], u_goal=[0], initial_states=nocl.Gaussian([0, 0], [0.3, 0.3]),
                    parameters=nocl.Uniform([0.5, -1], [2, 1]), path_constraints={"wall": goal + 2 - x[0]})


@pytest.mark.parametrize("integrator", ["rk4", "cvodes"])
def test_each_episode_has_its_own_parameters(varied, integrator):
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    env = nocl.to_gymnasium(varied, steps=40, integrator=integrator)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(infinity|symmetric and normalized|spec).*")
        check_env(env, skip_render_check=True)
    seen = np.array([env.reset(seed=i)[0] for i in range(200)])
    assert seen.shape == (200, 5)
    low, high = varied.parameter_box
    assert ((low <= seen[:, 3:]) & (seen[:, 3:] <= high)).all()
    assert np.abs(np.corrcoef(seen[:, [0, 1, 3, 4]].T)[:2, 2:]).max() < 0.3  # p is drawn apart from x0
    x0, p, u = np.array([0.2, -0.1]), {"mass": 1.5, "goal": 0.8}, np.random.default_rng(0).uniform(-2, 2, (40, 1))
    observation, info = env.reset(options={"x0": x0, "p": p})
    np.testing.assert_array_equal(observation, [*x0, 0, 1.5, 0.8])
    assert info["clearance"] == pytest.approx(2.6)
    total = sum(env.step(held)[1] for held in u)
    run = nocl.simulate(varied, u[None], x0, p=p)
    assert -total == pytest.approx(run.cost[0], rel=1e-4 if integrator == "rk4" else 1e-7)
    with pytest.raises(ValueError, match="p lacks goal"):
        env.reset(options={"p": {"mass": 1.0}})


def test_control_has_parameters_and_time(varied):
    control, s = pytest.importorskip("control"), varied.system
    plant, x, u = nocl.to_control(s), np.array([0.2, -0.1]), np.array([0.5])
    for t, mass in ((0.0, 1.0), (0.7, 1.8)):
        rate = s.f(x, u, t, mass).full().ravel()
        np.testing.assert_allclose(plant.dynamics(t, x, u, params={"mass": mass}), rate, rtol=1e-14)
    np.testing.assert_allclose(plant.dynamics(0.0, x, u), s.f(x, u, 0.0, 1.0).full().ravel(), rtol=1e-14)
    A, B = s.linearize(x, u, 0.7, [1.8])
    linear = nocl.to_control(s, x, u, t=0.7, p=[1.8])
    np.testing.assert_array_equal(np.hstack([linear.A, linear.B]), np.hstack([A, B]))
    times, inputs = nocl.held_inputs(np.linspace(0, 2, 41), np.full((40, 1), 0.5))
    response = control.input_output_response(plant, times, inputs, x, params={"mass": 1.8},
                                             solve_ivp_kwargs={"max_step": 0.05, "rtol": 1e-9})
    run = nocl.simulate(varied, np.full((1, 40, 1), 0.5), x, p=[1.8, 0.0])
    np.testing.assert_allclose(response.states[:, -1], run.x[0, -1], rtol=1e-6)


def test_acados_has_parameters_and_time(varied, monkeypatch):
    class AcadosModel:
        pass

    monkeypatch.setitem(sys.modules, "acados_template", SimpleNamespace(AcadosModel=AcadosModel))
    model, f = nocl.to_acados(varied.system), varied.system.f
    equations = ca.Function("equations", [model.x, model.u, model.t, model.p], [model.f_expl_expr])
    at = (np.array([0.1, 0.2]), 0.5, 0.7, 1.8)
    np.testing.assert_allclose(equations(*at).full(), f(*at).full(), rtol=1e-14)


def test_do_mpc_has_parameters_and_no_time(varied, monkeypatch):
    class Model:
        def __init__(self, *_):
            self.made, self.rates = [], {}

        def set_variable(self, kind, name):
            self.made.append((kind, ca.SX.sym(name)))
            return self.made[-1][1]

        def set_rhs(self, name, rate):
            self.rates[name] = rate

        def setup(self):
            pass

    monkeypatch.setitem(sys.modules, "do_mpc", SimpleNamespace(model=SimpleNamespace(Model=Model)))
    with pytest.raises(ValueError, match=r"holds the time; expected f\(x, u, p\)"):
        nocl.to_do_mpc(varied.system)
    s = varied.system
    still = replace(s, xdot=ca.substitute(s.equations, nocl.time(), 0.7))
    model = nocl.to_do_mpc(still)
    assert [kind for kind, _ in model.made] == ["_x", "_x", "_u", "_p"]
    f = ca.Function("f", [symbol for _, symbol in model.made], [ca.vertcat(*model.rates.values())])
    np.testing.assert_allclose(f(0.1, 0.2, 0.5, 1.8).full(), s.f([0.1, 0.2], 0.5, 0.7, 1.8).full(), rtol=1e-14)
