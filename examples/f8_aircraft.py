"""The F-8 Crusader's pitch, back to trim in the least time by its tail.

Garrard and Jordan (1977), "Design of nonlinear automatic flight control systems", Automatica 13(5); least time as in
Kaya and Noakes (2003), "Computational method for time-optimal switching control", J. Optimization Theory and
Applications 117. From 26.7 degrees there; here from less, all about 10.
"""

import casadi as ca

import nocl

tail_max = 0.05236  # rad, 3 degrees

alpha, theta, q, w = (ca.SX.sym(name) for name in ("alpha", "theta", "q", "w"))

system = nocl.System(
    "f8_aircraft", x=ca.vertcat(alpha, theta, q), u=w,
    xdot=ca.vertcat(
        -0.877 * alpha + q - 0.088 * alpha * q + 0.47 * alpha**2 - 0.019 * theta**2 - alpha**2 * q + 3.846 * alpha**3
        - 0.215 * w + 0.28 * alpha**2 * w + 0.47 * alpha * w**2 + 0.63 * w**3,
        q,
        -4.208 * alpha - 0.396 * q - 0.47 * alpha**2 - 3.564 * alpha**3
        - 20.967 * w + 6.265 * alpha**2 * w + 46 * alpha * w**2 + 61.4 * w**3),
    lbu=[-tail_max], ubu=[tail_max], lbx=[-0.6, -1, -1], ubx=[0.6, 1, 1],
    units={"alpha": "rad", "theta": "rad", "q": "rad/s", "w": "rad"})

ocp = nocl.OCP(
    system, horizon=nocl.Free(0.5, 10.0), running=1.0, terminal=0.0, x_goal=[0, 0, 0], u_goal=[0],
    initial_states=nocl.Uniform([0.1, -0.05, -0.05], [0.25, 0.05, 0.05]),
    terminal_constraints={"alpha": (0, alpha, 0), "theta": (0, theta, 0), "q": (0, q, 0)})
