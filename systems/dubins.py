"""Dubins' car: drive round an obstacle to the origin, with a smallest turning radius.

Dubins (1957), "On curves of minimal length with a constraint on average curvature", Am. J. Math. 79(3); here with a
variable speed v and a steering ratio alpha, so that the curvature alpha / r is at most 1 / r.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

import nocl
from nocl.support.checks import Vector

SMOOTHING = 1e-3  # m, keeps the distance differentiable at the obstacle's centre


def system(*, r: float = 0.5) -> nocl.System:
    """x = [px, py, psi], u = [v, alpha]: psi = 0 points along px and grows counterclockwise, alpha > 0 turns left.

    r is the smallest turning radius in m. The box is [-4, 4]: every initial state of the problem lies in it.
    """
    px, py, psi, v, alpha = (ca.SX.sym(name) for name in ("px", "py", "psi", "v", "alpha"))
    return nocl.System(
        "dubins", x=ca.vertcat(px, py, psi), u=ca.vertcat(v, alpha),
        xdot=ca.vertcat(v * ca.cos(psi), v * ca.sin(psi), alpha * v / r),
        lbu=[0.0, -1.0], ubu=[1.0, 1.0], lbx=[-4.0] * 3, ubx=[4.0] * 3, angles=["psi"],
        units={"px": "m", "py": "m", "psi": "rad", "v": "m/s", "alpha": "1"})


def distance(system: nocl.System, centre: Vector | ca.SX, radius: float | ca.SX) -> ca.SX:
    """Distance to a disk, smoothed: sqrt(d^2 + e^2) - sqrt(radius^2 + e^2), zero on its edge, e^2 / (2 radius) off.

    centre [2] and radius may be expressions of parameters.
    """
    d2 = ca.sumsqr(system.x[:2] - (centre if isinstance(centre, ca.SX) else ca.DM(centre)))
    edge = ca.sqrt(radius**2 + SMOOTHING**2) if isinstance(radius, ca.SX) else np.hypot(radius, SMOOTHING)
    return ca.sqrt(d2 + SMOOTHING**2) - edge


def ocp(*, horizon: float = 8.0, R: Vector = 0.01, P: Vector = 1.0, obstacle: bool = True,
        centre: Vector = (-1.0, 0.0), radius: float = 0.5, **constants: float) -> nocl.OCP:
    """From U([-3.5, -3, -pi], [-2.5, 3, pi]) to the origin, facing along px; the obstacle's centre, radius in m."""
    car = system(**constants)
    return nocl.OCP.quadratic(
        car, horizon=horizon, R=R, P=P, x_goal=np.zeros(3), u_goal=[0.0, 0.0],
        initial_states=nocl.Uniform(lb=[-3.5, -3.0, -np.pi], ub=[-2.5, 3.0, np.pi]),
        path_constraints={"obstacle": distance(car, centre, radius)} if obstacle else {})
