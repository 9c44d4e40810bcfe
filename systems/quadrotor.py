"""Quadrotor: fly to a point and stop there, with the attitude as a double integrator.

Garcia Carrillo, Dzul, Lozano, Pegard (2013), "Quad Rotorcraft Control", chapter 2, in the form of Onken et al. (2022),
"A neural network approach for real-time high-dimensional optimal control" (IEEE Trans. Control Syst. Technol.).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

import nocl
from nocl.support.checks import Vector

STATES = ("px", "py", "pz", "psi", "theta", "phi", "vx", "vy", "vz", "w_psi", "w_theta", "w_phi")


def system(
    *,
    mass: float = 1.0,  # kg
    g: float = 9.81,  # m/s^2
    u_max: float = 100.0,  # N for the thrust, rad/s^2 for the angular accelerations
) -> nocl.System:
    """x = [position, angles, velocities, angle rates]: z points up; yaw psi, pitch theta, roll phi, 0 is level.

    u1 is the thrust along the body's own z, u2, u3, u4 are the angular accelerations of psi, theta, phi.
    """
    x = ca.vertcat(*(ca.SX.sym(name) for name in STATES))
    u = ca.vertcat(*(ca.SX.sym(name) for name in ("u1", "u2", "u3", "u4")))
    psi, theta, phi = x[3], x[4], x[5]
    s_psi, s_theta, s_phi = ca.sin(psi), ca.sin(theta), ca.sin(phi)
    c_psi, c_theta, c_phi = ca.cos(psi), ca.cos(theta), ca.cos(phi)
    thrust = u[0] / mass
    acceleration = ca.vertcat(thrust * (s_psi * s_phi + c_psi * s_theta * c_phi),
                              thrust * (-c_psi * s_phi + s_psi * s_theta * c_phi),
                              thrust * c_theta * c_phi - g)
    units = ["m"] * 3 + ["rad"] * 3 + ["m/s"] * 3 + ["rad/s"] * 3
    return nocl.System(
        "quadrotor", x=x, u=u, xdot=ca.vertcat(x[6:9], x[9:12], acceleration, u[1:4]),
        lbu=[-u_max] * 4, ubu=[u_max] * 4, lbx=[-5.0] * 12, ubx=[5.0] * 12, angles=["psi", "theta", "phi"],
        units=dict(zip(STATES, units, strict=True)) | {"u1": "N"} | dict.fromkeys(("u2", "u3", "u4"), "rad/s^2"))


def ocp(*, horizon: float = 4.0, R: Vector = 0.01, P: Vector = 1.0, std: float = 1.0,
        target: Vector = (3.0, 3.0, 3.0), goals: float | None = None, **constants: float) -> nocl.OCP:
    """From rest at a position ~ N(0, std^2 I) to rest at `target` [3] m; u* holds the weight; constants: system's.

    With goals=3.5 it is for every goal: the target is a parameter, anywhere within 3.5 m of 0 along each axis.
    """
    quadrotor = system(**constants)
    level, idle = np.zeros(12), np.zeros(4)
    weight, per_thrust = -quadrotor.f(level, idle)[8], quadrotor.linearize(level, idle)[1][8, 0]  # g and 1 / mass
    goal = ca.vertcat(*(nocl.parameter(f"goal_{axis}", at, "m") for axis, at in zip("xyz", target, strict=True)))
    free = {} if goals is None else {"p": goal, "parameters": nocl.Uniform([-goals] * 3, [goals] * 3)}
    return nocl.OCP.quadratic(
        quadrotor, horizon=horizon, R=R, P=P, x_goal=ca.vertcat(goal, level[3:]) if free else [*target, *level[3:]],
        u_goal=[float(weight / per_thrust), 0.0, 0.0, 0.0],
        initial_states=nocl.Gaussian(mean=level, std=[std] * 3 + [0.0] * 9), **free)
