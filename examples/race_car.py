"""A miniature race car in coordinates of its track: as far as it gets in two seconds, within track and grip.

Model and constants: Kloeser et al. (2020), "NMPC for racing using a singularity-free path-parametric model with
obstacle avoidance", IFAC PapersOnLine 53(2), as in acados' example "race cars". The track's curvature is a smooth
closed form here, and progress at the end takes the place of a moving reference.
"""

import casadi as ca

import nocl

mass, C1, C2 = 0.043, 0.5, 15.5  # kg, 1, 1/m
Cm1, Cm2, Cr0, Cr2 = 0.28, 0.05, 0.011, 0.006  # N, N s/m, N, N s^2/m^2
half_width, a_max = 0.12, 4.0  # m, m/s^2

s, n, alpha, v, D, delta = (ca.SX.sym(name) for name in ("s", "n", "alpha", "v", "D", "delta"))
D_rate, delta_rate = ca.SX.sym("D_rate"), ca.SX.sym("delta_rate")


def bend(begin: float, end: float) -> ca.SX:
    """1 between two places of the track, 0 elsewhere."""
    return (ca.tanh(8 * (s - begin)) - ca.tanh(8 * (s - end))) / 2


curvature = 2.0 * bend(0.5, 1.2) - 1.5 * bend(1.6, 2.2)  # 1/m
force = (Cm1 - Cm2 * v) * D - Cr2 * v**2 - Cr0 * ca.tanh(5 * v)  # N
progress = v * ca.cos(alpha + C1 * delta) / (1 - curvature * n)
a_along = force / mass
a_across = C2 * v**2 * delta + force * ca.sin(C1 * delta) / mass

system = nocl.System(
    "race_car", x=ca.vertcat(s, n, alpha, v, D, delta), u=ca.vertcat(D_rate, delta_rate),
    xdot=ca.vertcat(progress, v * ca.sin(alpha + C1 * delta), v * C2 * delta - curvature * progress,
                    a_along * ca.cos(C1 * delta), D_rate, delta_rate),
    lbu=[-10, -2], ubu=[10, 2], lbx=[-0.5, -0.12, -0.8, 0, -1, -0.4], ubx=[7, 0.12, 0.8, 5, 1, 0.4],
    units={"s": "m", "n": "m", "alpha": "rad", "v": "m/s", "delta": "rad", "D_rate": "1/s", "delta_rate": "rad/s"})

ocp = nocl.OCP(
    system, horizon=2.0, terminal=-5 * s,
    running=1e-1 * n**2 + 1e-2 * alpha**2 + 1e-3 * D**2 + 5e-3 * delta**2 + 1e-4 * D_rate**2 + 5e-3 * delta_rate**2,
    initial_states=nocl.Gaussian(mean=[0, 0, 0, 1.0, 0.3, 0], std=[0.05, 0.02, 0.05, 0.1, 0.05, 0.02]),
    state_bounds={"n": (-half_width, half_width), "D": (-1, 1), "delta": (-0.4, 0.4)},
    constraints={"a_along": (-a_max, a_along, a_max), "a_across": (-a_max, a_across, a_max)})
