"""A policy's runs in C: what they are in torch, on the exact f and a learned one, with parameters and time."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Problems, continuous_run
from nocl.solvers.cnd.regression.rolled import Rolled

x, v, u, k, t = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("u"), nocl.parameter("k"), nocl.time()


def spring() -> nocl.OCP:
    """x'' = u - k x + sin t."""
    system = nocl.System("spring", x=ca.vertcat(x, v), u=u, p=k, xdot=ca.vertcat(v, u - k * x + ca.sin(t)), lbu=[-2],
                         ubu=[2], lbx=[-2, -2], ubx=[2, 2])
    return nocl.OCP(system, horizon=3.0, running=k * x**2 + u**2 + t * v**2, terminal=k * x**2,
                    initial_states=nocl.Uniform([-1, -1], [1, 1]), parameters=nocl.Uniform([0.5], [2.0]))


def policy(ocp: nocl.OCP, seed: int = 0) -> FeatureNet:
    torch.manual_seed(seed)
    at, y = ocp.functions.feedback(), ca.SX.sym("y", ocp.system.nu)
    phi = at.function("phi", {"phi": ca.vertcat(*at.inputs)})
    out = at.function("u", {"u": ca.fmin(ca.fmax(2 * y, ca.DM(ocp.system.lbu)), ca.DM(ocp.system.ubu))}, y=y)
    return FeatureNet(phi, [MLP([phi.numel_out(0), 24, 16, ocp.system.nu])], out).double()


def learned(ocp: nocl.OCP) -> FeatureNet:
    """A network with a skip in place of the exact f."""
    torch.manual_seed(7)
    at, y = ocp.system.arguments, ca.SX.sym("y", ocp.system.nx)
    z = ca.vertcat(*at.inputs)
    phi, out = at.function("phi", {"phi": ca.vertcat(ca.sin(z), z)}), at.function("f", {"xdot": y - at["x"]}, y=y)
    return FeatureNet(phi, [MLP([phi.numel_out(0), 20, ocp.system.nx], "sine", skip=True)], out).double()


def both(ocp: nocl.OCP, dynamics: FeatureNet | None, net: FeatureNet, n: int = 13, steps: int = 50):
    """The runs in C, and those in torch; from times all over the horizon."""
    of, rng = InTorch(ocp, dynamics), np.random.default_rng(1)
    at = Problems(ocp.initial_states.sample(n, 3), rng.uniform(0, 0.9 * ocp.horizon, n), ocp.sample_parameters(n, 4))
    acting = Rolled(net, of)
    assert acting.loop is not None
    return continuous_run(acting, of, at, steps), continuous_run(lambda *args: net(*args), of, at, steps)


@pytest.mark.parametrize("on_network", [False, True])
@pytest.mark.parametrize("problem", [spring, lambda: nocl.load_ocp("cartpole")])
def test_runs_are_those_in_torch(problem, on_network):
    ocp = problem()
    net = policy(ocp)
    with torch.no_grad():
        for in_c, in_torch in zip(*both(ocp, learned(ocp) if on_network else None, net), strict=True):
            np.testing.assert_allclose(in_c, in_torch, rtol=1e-9, atol=1e-9)


def test_weights_are_those_of_now():
    ocp = spring()
    net, of = policy(ocp), InTorch(ocp)
    acting, at = Rolled(net, of), Problems(np.ones((1, 2)), np.zeros(1), np.ones((1, 1)))
    before = continuous_run(acting, of, at, 20)[0]
    with torch.no_grad():
        net.nets[0].body[-1].bias += 0.5
        after, said = continuous_run(acting, of, at, 20)[0], continuous_run(lambda *args: net(*args), of, at, 20)[0]
    assert abs(after[0] - before[0]) > 1e-3
    np.testing.assert_allclose(after, said, rtol=1e-10)


def test_a_problem_of_another_kind_is_run_in_torch():
    ocp = spring()
    assert Rolled(policy(ocp), InTorch(ocp, lambda *args: args[0])).loop is None
    assert Rolled(policy(ocp), InTorch(ocp, integrator="radau")).loop is None
