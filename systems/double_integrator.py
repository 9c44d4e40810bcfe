"""Double integrator: bring a mass to rest at the origin by a force. Linear-quadratic, with its solution known."""

from __future__ import annotations

import casadi as ca
import numpy as np

import nocl
from nocl.support.checks import Vector


def system(
    *,
    mass: float = 1.0,  # kg
    u_max: float = 10.0,  # N, |u| <= u_max: never active on the problem below
) -> nocl.System:
    """x = [p, v], mass dv/dt = u."""
    p, v, u = (ca.SX.sym(name) for name in ("p", "v", "u"))
    return nocl.System("double_integrator", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u / mass),
                       lbu=[-u_max], ubu=[u_max], lbx=[-3.0, -3.0], ubx=[3.0, 3.0],
                       units={"p": "m", "v": "m/s", "u": "N"})


def ocp(*, horizon: float = 2.0, R: Vector = 0.01, P: Vector = 1.0, std: float = 0.2,
        **constants: float) -> nocl.OCP:
    """From x0 ~ N([1, 0], std^2 I) to rest at the origin within `horizon` seconds; constants: system's.

    Its Riccati equation -dS/dt = A'S + SA - SB R^-1 B'S, S(T) = P, is linear in S^-1. With s = T - t to go,
    Phi = [[1, s], [0, 1]], b = [s, 1] / mass and positive definite P (Anderson and Moore, "Optimal Control", 2.3):

        W(s) = int_0^s b b' R^-1 ds' = [[s^3/3, s^2/2], [s^2/2, s]] / (mass^2 R),
        S(t) = Phi' (P^-1 + W)^-1 Phi,   V(x, t) = x' S x,   u(x, t) = -R^-1 B' S x.
    """
    return nocl.OCP.quadratic(
        system(**constants), horizon=horizon, R=R, P=P, x_goal=np.zeros(2), u_goal=[0.0],
        initial_states=nocl.Gaussian(mean=[1.0, 0.0], std=[std] * 2))
