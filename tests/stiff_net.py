"""A stiff plant as a network has learned it, made by hand."""

from __future__ import annotations

import casadi as ca
import torch

import nocl
from nocl.nets import MLP, FeatureNet
from nocl.sysid import LearnedDynamics


def problem(rate: float = 60.0, p: ca.SX | None = None) -> nocl.OCP:
    """An integrator behind an actuator that lags by 1 / rate; p: a parameter that the plant has beside."""
    x, z, u = ca.SX.sym("x"), ca.SX.sym("z"), ca.SX.sym("u")
    given = {} if p is None else {"p": p}
    system = nocl.System("lag", x=ca.vertcat(x, z), u=u, xdot=ca.vertcat(z, rate * (u - z)), lbu=[-1], ubu=[1],
                         lbx=[-3, -2], ubx=[3, 2], **given)
    more = {} if p is None else {"parameters": nocl.Uniform([0.5], [1.5])}
    return nocl.OCP(system, horizon=4.0, running=0.1 * u**2, terminal=5 * x**2 + z**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian(mean=[1.0, 0.0], std=[0.1, 0.1]), **more)


def model(system: nocl.System, rate: float = 60.0) -> LearnedDynamics:
    """x' = z, z' = p times a sine network of (x, z, u): about rate (u - z), bent by further units."""
    x, u, y = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("y")
    p = ca.SX.sym("p", system.np)
    net = MLP((3, 4, 1), "sine").double()
    first, last = net.body[0], net.body[2]
    with torch.no_grad():
        first.weight.copy_(torch.tensor([[0.0, -0.5, 0.5], [0.7, 0.4, 0.2], [-0.3, 0.9, -0.6], [0.5, -0.2, 0.8]]))
        first.bias.copy_(torch.tensor([0.0, 0.3, -0.2, 0.9]))
        last.weight.copy_(torch.tensor([[2 * rate, 0.3, -0.2, 0.1]]))
        last.bias.copy_(torch.tensor([-0.2]))
    given = [x, u, *([p] if system.np else [])]
    weighted = p[0] * y if system.np else y
    return LearnedDynamics(system, FeatureNet(ca.Function("inputs", given, [ca.vertcat(x, u)]), [net],
                                              ca.Function("outputs", [*given, y], [ca.vertcat(x[1], weighted)])).eval(),
                           "a network by hand")
