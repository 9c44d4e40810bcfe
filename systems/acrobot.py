"""Acrobot: swing two links up from hanging, here with a torque on both joints.

Equations: Sutton and Barto, "Reinforcement Learning: An Introduction", the acrobot's section (figure "the acrobot"),
after Sutton (1996), "Generalization in reinforcement learning", NIPS 8. The second torque: Yildiz, Heinonen, Lahdesmaki
(2021), "Continuous-time model-based reinforcement learning" (ENODE), whose fully actuated acrobot adds u2 to the
equation of w1 alone.
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
    m1: Constant = 1.0, m2: Constant = 1.0,  # kg
    l1: float = 1.0,  # m, length of the first link (the second one's does not enter)
    lc1: float = 0.5, lc2: float = 0.5,  # m, from a link's joint to its centre of mass
    I1: float = 1.0, I2: float = 1.0,  # kg m^2, about the centres of mass
    g: float = 9.8,  # m/s^2
    u_max: float = 5.0,  # N m, |u1|, |u2| <= u_max
    parameters: ca.SX | None = None,  # those that stand in the masses
) -> nocl.System:
    """x = [th1, th2, w1, w2]: th1 = 0 hangs down, th2 is relative to link 1; u1 turns joint 2, -u2 joint 1."""
    th1, th2, w1, w2, u1, u2 = (ca.SX.sym(name) for name in ("th1", "th2", "w1", "w2", "u1", "u2"))
    d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2) + I1 + I2 + 2 * m2 * l1 * lc2 * ca.cos(th2)
    d2 = m2 * lc2**2 + I2 + m2 * l1 * lc2 * ca.cos(th2)
    phi2 = m2 * lc2 * g * ca.sin(th1 + th2)  # the book's cos(th1 + th2 - pi/2)
    phi1 = (-m2 * l1 * lc2 * w2 * (w2 + 2 * w1) * ca.sin(th2) + (m1 * lc1 + m2 * l1) * g * ca.sin(th1) + phi2)
    dw2 = (u1 + d2 / d1 * phi1 - m2 * l1 * lc2 * w1**2 * ca.sin(th2) - phi2) / (m2 * lc2**2 + I2 - d2**2 / d1)
    dw1 = -(u2 + d2 * dw2 + phi1) / d1  # u2 against w1, and no share of it in dw2: ENODE's form
    return nocl.System(
        "acrobot", x=ca.vertcat(th1, th2, w1, w2), u=ca.vertcat(u1, u2), xdot=ca.vertcat(w1, w2, dw1, dw2),
        lbu=[-u_max] * 2, ubu=[u_max] * 2, lbx=[-6.0] * 4, ubx=[6.0] * 4, angles=["th1", "th2"], p=parameters,
        units={"th1": "rad", "th2": "rad", "w1": "rad/s", "w2": "rad/s", "u1": "N m", "u2": "N m"})


def ocp(*, horizon: float = 4.0, R: Vector = 0.01, P: Vector = 1.0, std: float = 0.1,
        **constants: Any) -> nocl.OCP:
    """Swing up from hanging at rest, x0 ~ N(0, std^2 I), within `horizon` seconds; constants: system's."""
    return nocl.OCP.quadratic(
        system(**constants), horizon=horizon, R=R, P=P, x_goal=[np.pi, 0.0, 0.0, 0.0], u_goal=[0.0, 0.0],
        initial_states=nocl.Gaussian(mean=np.zeros(4), std=[std] * 4))
