"""What a controller exports is what it is: gradients, gain, closed loop; in any CasADi graph; in another process."""

from __future__ import annotations

import pickle
import subprocess
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.nets import MLP, FeatureNet

TIMES = np.linspace(0.1, 3.9, 7)


def untrained(seed: int = 0) -> nocl.CND:
    """A controller and value of cart-pole with random weights: angles, scaling, time and limits inside."""
    ocp = nocl.load_ocp("cartpole")
    s, t = ocp.system, ca.SX.sym("t")
    phi = ca.vertcat(s.x / 5, ca.sin(s.x[2]), ca.cos(s.x[2]), t / 2 - 1, 1 / (ocp.horizon - t + 0.1))
    features = ca.Function("features", [s.x, t], [phi], ["x", "t"], ["phi"])
    y, e = ca.SX.sym("y"), ca.SX.sym("e", 3)
    limited = ca.Function("controls", [s.x, t, y], [ca.fmin(ca.fmax(4 * y, -3), 3)], ["x", "t", "y"], ["u"])
    squares = ca.Function("squares", [s.x, t, e], [0.1 + ca.sumsqr(e)], ["x", "t", "y"], ["V"])
    torch.manual_seed(seed)
    policy = FeatureNet(features, [MLP([8, 16, 16, 1], "tanh")], limited)
    return nocl.CND(ocp, policy, FeatureNet(features, [MLP([8, 12, 3], "sine", True)], squares))


CONTROLLER = untrained()
STATES = np.random.default_rng(0).uniform(CONTROLLER.ocp.system.lbx, CONTROLLER.ocp.system.ubx, (7, 4))


def functions() -> list[ca.Function]:
    c = CONTROLLER
    return [c.to_casadi(), c.value_to_casadi(), c.value_gradient_to_casadi(), c.gain_to_casadi(),
            c.closed_loop_to_casadi()]


def rows(f: ca.Function) -> np.ndarray:
    return np.array([f(x, t).full() for x, t in zip(STATES, TIMES, strict=True)])


def test_gradient_gain_and_closed_loop_are_the_controllers():
    c = CONTROLLER
    policy, value, gradient, gain, loop = functions()
    signatures = [(f.name(), f.name_in(), f.name_out(), f.size_out(0)) for f in functions()]
    assert signatures == [("policy", ["x", "t"], ["u"], (1, 1)), ("value", ["x", "t"], ["V"], (1, 1)),
                          ("value_gradient", ["x", "t"], ["V_x"], (4, 1)), ("gain", ["x", "t"], ["K"], (1, 4)),
                          ("closed_loop", ["x", "t"], ["xdot"], (4, 1))]
    np.testing.assert_allclose(rows(policy)[:, :, 0], c(STATES, TIMES), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rows(value)[:, 0, 0], c.value(STATES, TIMES), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rows(gradient)[:, :, 0], c.value_gradient(STATES, TIMES), rtol=1e-12, atol=1e-12)
    f, u = c.ocp.system.f, c(STATES, TIMES)
    np.testing.assert_allclose(rows(loop)[:, :, 0], f(STATES.T, u.T).full().T, rtol=1e-12, atol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(4)):
        slope = (c(STATES + step, TIMES) - c(STATES - step, TIMES)) / 2e-6
        np.testing.assert_allclose(rows(gain)[:, 0, i], slope[:, 0], atol=1e-7)


def test_the_loop_closes_on_other_dynamics_too():
    x, u = ca.MX.sym("x", 4), ca.MX.sym("u")
    other = ca.Function("other", [x, u], [u * x])
    loop = CONTROLLER.closed_loop_to_casadi(other)
    np.testing.assert_allclose(rows(loop)[:, :, 0], CONTROLLER(STATES, TIMES) * STATES, rtol=1e-12)
    with pytest.raises(ValueError, match=r"needs \(x, u\) -> xdot"):
        CONTROLLER.closed_loop_to_casadi(ca.Function("wrong", [x], [x]))


@pytest.mark.parametrize("f", functions(), ids=lambda f: f.name())
def test_each_is_usable_as_any_other_function(f, tmp_path):
    expected = rows(f)
    for variant in (f.expand(), ca.Function.deserialize(f.serialize()), pickle.loads(pickle.dumps(f))):
        np.testing.assert_allclose(rows(variant), expected, rtol=1e-12, atol=1e-12)
    side_by_side = np.hstack(list(expected))
    for kind in ("serial", "openmp", "thread"):
        got = f.map(len(STATES), kind)(STATES.T, TIMES[None]).full()
        np.testing.assert_allclose(got, side_by_side, rtol=1e-12, atol=1e-12)
    x, t = ca.MX.sym("x", 4), ca.MX.sym("t")
    twice = ca.Function("twice", [x, t], [ca.hessian(ca.sumsqr(f(x, t)), x)[0]])
    H = twice(STATES[0], TIMES[0]).full()
    slope = ca.Function("slope", [x, t], [ca.gradient(ca.sumsqr(f(x, t)), x)])
    for i, step in enumerate(1e-6 * np.eye(4)):
        column = (slope(STATES[0] + step, TIMES[0]) - slope(STATES[0] - step, TIMES[0])).full().ravel() / 2e-6
        np.testing.assert_allclose(H[:, i], column, rtol=1e-5, atol=1e-4 * max(1, np.abs(H).max()))


def test_generated_code_is_the_same_function(tmp_path):
    """CasADi's own `generate`, compiled and loaded as an external."""
    f = CONTROLLER.closed_loop_to_casadi()
    generator = ca.CodeGenerator("loop.c")
    generator.add(f)
    source = generator.generate(f"{tmp_path}/")
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", source, "-o", tmp_path / "loop.so", "-lm"], check=True)
    np.testing.assert_allclose(rows(ca.external("closed_loop", str(tmp_path / "loop.so"))), rows(f), rtol=1e-12,
                               atol=1e-12)


@pytest.mark.slow
def test_a_worker_process_gets_them_whole():
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for f, got in zip(functions(), pool.map(rows, functions()), strict=True):
            np.testing.assert_array_equal(got, rows(f))


def test_the_loop_stands_in_an_integrator():
    x, t = ca.MX.sym("x", 4), ca.MX.sym("t")
    dae = {"x": x, "t": t, "ode": CONTROLLER.closed_loop_to_casadi()(x, t)}
    end = ca.integrator("end", "cvodes", dae, 0.0, 0.5, {"reltol": 1e-10, "abstol": 1e-10})(x0=STATES[0])["xf"]
    run = nocl.simulate(CONTROLLER.ocp, CONTROLLER, STATES[0], nodes=9)
    np.testing.assert_allclose(end.full().ravel(), run.x[0, 1], rtol=1e-6, atol=1e-6)
