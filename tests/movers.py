"""A problem with parameters that has a known answer, the double integrator of some mass to some goal."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import torch
from lq import lq_value

import nocl
from nocl.nets import MLP, FeatureNet


def mover(**change: object) -> nocl.OCP:
    """The double integrator of some mass, to rest at a goal."""
    x, u = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("u")
    mass, goal = nocl.parameter("mass", nominal=1.0, unit="kg"), nocl.parameter("goal", unit="m")
    s = nocl.System("mover", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], u / mass), lbu=[-20], ubu=[20], lbx=[-4, -4],
                    ubx=[4, 4])
    options: dict[str, Any] = {
        "p": goal, "horizon": 2.0, "R": 0.01, "x_goal": [goal, 0], "u_goal": [0],
        "initial_states": nocl.Gaussian([0, 0], [0.5, 0.5]), "parameters": nocl.Uniform([0.8, -1], [1.2, 1])}
    return nocl.OCP.quadratic(s, **{**options, **change})


def optimum(x0: np.ndarray, p: np.ndarray) -> np.ndarray:
    """[B], Riccati's cost d'S(0; mass) d with d = x0 - x*(p)."""
    d = x0 - np.c_[p[:, 1], np.zeros(len(p))]
    S = np.array([lq_value([0.0], mass=mass)[0][0] for mass in p[:, 0]])
    return np.einsum("bi,bij,bj->b", d, S, d)


def law_of_mass(seed: int = 0) -> nocl.CND:
    """An untrained controller and value of (x, t, p): scaling, the goal's place, time and limits inside."""
    ocp = mover()
    at = ocp.functions.feedback(ca.SX)
    x, t, p = at.inputs
    phi = ca.vertcat(x - ca.vertcat(p[1], 0), ca.sin(x[0]), t - 1, 5 * (p[0] - 1), p[1])
    features = ca.Function("features", [x, t, p], [phi], ["x", "t", "p"], ["phi"])
    y, e = ca.SX.sym("y"), ca.SX.sym("e", 3)
    limited = ca.Function("controls", [x, t, p, y], [ca.fmin(ca.fmax(4 * y / p[0], -20), 20)], ["x", "t", "p", "y"],
                          ["u"])
    squares = ca.Function("squares", [x, t, p, e], [0.1 + ca.sumsqr(e)], ["x", "t", "p", "y"], ["V"])
    torch.manual_seed(seed)
    policy = FeatureNet(features, [MLP([6, 16, 16, 1], "tanh")], limited)
    return nocl.CND(ocp, policy, FeatureNet(features, [MLP([6, 12, 3], "sine", True)], squares))
