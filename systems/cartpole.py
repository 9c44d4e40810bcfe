"""Cart-pole: swing a pole up from hanging and balance it, by pushing the cart.

Barto, Sutton, Anderson (1983), "Neuronlike adaptive elements that can solve difficult learning control problems",
IEEE Trans. SMC 13(5), appendix, without friction: a uniform pole (inertia m l^2 / 3 about its centre) on a cart.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

import nocl
from nocl.support.checks import Vector

Constant = float | ca.SX  # a number, or an expression of parameters


def system(
    *,
    m_cart: Constant = 1.0,  # kg
    m_pole: Constant = 0.1,  # kg
    l: Constant = 1.0,  # m, half the pole's length: from the pivot to its centre of mass  # noqa: E741
    g: float = 9.8,  # m/s^2
    gain: Constant = 3.0,  # N, the force that u = 1 stands for
    friction: Constant = 0.0,  # N s/m, of the cart against v
    u_max: float = 3.0,  # 1, |u| <= u_max
    parameters: ca.SX | None = None,  # those that stand in the constants
) -> nocl.System:
    """x = [p, v, theta, omega]: theta = 0 is upright and grows clockwise, towards positive p; u pushes towards it."""
    p, v, theta, omega, u = (ca.SX.sym(name) for name in ("p", "v", "theta", "omega", "u"))
    sin, cos, m_total = ca.sin(theta), ca.cos(theta), m_cart + m_pole
    push = gain * u if isinstance(friction, float) and not friction else gain * u - friction * v
    temp = (push + m_pole * l * omega**2 * sin) / m_total
    alpha = (g * sin - cos * temp) / (l * (4 / 3 - m_pole * cos**2 / m_total))
    acceleration = temp - m_pole * l * alpha * cos / m_total
    return nocl.System(
        "cartpole", x=ca.vertcat(p, v, theta, omega), u=u, xdot=ca.vertcat(v, acceleration, omega, alpha),
        lbu=[-u_max], ubu=[u_max], lbx=[-5.0] * 4, ubx=[5.0] * 4, angles=["theta"], p=parameters,
        units={"p": "m", "v": "m/s", "theta": "rad", "omega": "rad/s",
               "u": f"{gain} N" if isinstance(gain, ca.SX) else f"{gain:g} N"})


def ocp(*, horizon: float = 4.0, R: Vector = 0.01, P: Vector = 1.0, std: float = 0.1, goals: float | None = None,
        **constants: Any) -> nocl.OCP:
    """Swing up from hanging at rest, x0 ~ N([0, 0, pi, 0], std^2 I), within `horizon` seconds; constants: system's.

    With goals=2 it is for every goal: where the cart is to stop is a parameter, anywhere within 2 m.
    """
    goal = nocl.parameter("goal", 0.0, "m")
    free = {} if goals is None else {"p": goal, "parameters": nocl.Uniform([-goals], [goals])}
    return nocl.OCP.quadratic(
        system(**constants), horizon=horizon, R=R, P=P, x_goal=[goal if free else 0.0, 0, 0, 0], u_goal=[0.0],
        initial_states=nocl.Gaussian(mean=[0.0, 0.0, np.pi, 0.0], std=[std] * 4), **free)
