"""Pendulum: swing a point mass on a rod up from hanging, with a limited torque. A teaching example."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

import nocl
from nocl.support.checks import Vector

Constant = float | ca.SX  # a number, or an expression of parameters


def system(
    *,
    mass: Constant = 1.0,  # kg
    length: Constant = 1.0,  # m, from the pivot to the point mass
    damping: Constant = 0.0,  # N m s, torque against omega
    g: float = 9.81,  # m/s^2
    u_max: float = 5.0,  # N m, |tau| <= u_max: too little to lift the mass without swinging
    parameters: ca.SX | None = None,  # those that stand in the constants
) -> nocl.System:
    """x = [theta, omega], theta = 0 is upright; with I = mass length^2,

    I domega/dt = mass g length sin(theta) - damping omega + tau.
    """
    theta, omega, tau = (ca.SX.sym(name) for name in ("theta", "omega", "tau"))
    return nocl.System(
        "pendulum", x=ca.vertcat(theta, omega), u=tau,
        xdot=ca.vertcat(omega, g / length * ca.sin(theta) + (tau - damping * omega) / (mass * length**2)),
        lbu=[-u_max], ubu=[u_max], lbx=[-6.3, -8.0], ubx=[6.3, 8.0], angles=["theta"],
        p=parameters, units={"theta": "rad", "omega": "rad/s", "tau": "N m"})


def ocp(*, horizon: float = 3.0, R: Vector = 0.01, P: Vector = 1.0, std: float = 0.1,
        **constants: Any) -> nocl.OCP:
    """Swing up from hanging at rest, x0 ~ N([pi, 0], std^2 I), within `horizon` seconds; constants: system's."""
    return nocl.OCP.quadratic(
        system(**constants), horizon=horizon, R=R, P=P, x_goal=[0.0, 0.0], u_goal=[0.0],
        initial_states=nocl.Gaussian(mean=[np.pi, 0.0], std=[std] * 2))
