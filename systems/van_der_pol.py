"""Van der Pol's oscillator with a control: leave the limit cycle for the unstable rest. A teaching example.

Van der Pol (1926), "On relaxation-oscillations", Phil. Mag. 2(11); dimensionless, the control in the second equation.
"""

from __future__ import annotations

import casadi as ca

import nocl
from nocl.support.checks import Vector


def system(
    *,
    mu: float = 1.0,  # damping: negative inside |y| < 1, positive outside
    u_max: float = 1.0,  # |u| <= u_max
) -> nocl.System:
    """x = [y, z]: y'' = mu (1 - y^2) y' - y + u, z = y'."""
    y, z, u = (ca.SX.sym(name) for name in ("y", "z", "u"))
    return nocl.System("van_der_pol", x=ca.vertcat(y, z), u=u, xdot=ca.vertcat(z, mu * (1 - y**2) * z - y + u),
                       lbu=[-u_max], ubu=[u_max], lbx=[-4.0, -4.0], ubx=[4.0, 4.0])


def ocp(*, horizon: float = 5.0, R: Vector = 0.01, P: Vector = 1.0, std: float = 0.2,
        **constants: float) -> nocl.OCP:
    """From a tip of the limit cycle, x0 ~ N([2, 0], std^2 I), to the origin within `horizon`; constants: system's."""
    return nocl.OCP.quadratic(
        system(**constants), horizon=horizon, R=R, P=P, x_goal=[0.0, 0.0], u_goal=[0.0],
        initial_states=nocl.Gaussian(mean=[2.0, 0.0], std=[std] * 2))
