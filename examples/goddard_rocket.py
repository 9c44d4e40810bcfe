"""Goddard's rocket: as high as it gets, with a drag that falls off with the air; the thrust has a singular arc.

Goddard (1919); in this form and with these numbers, all without units, COPS 3.0 (Dolan, More and Munson, 2004),
"Goddard rocket". The flight ends at the top, v = 0, which the optimum does there as well.
"""

import casadi as ca

import nocl

drag, decay = 310.0, 500.0  # D = 310 v^2 exp(-500 (h - 1))
exhaust, m_empty, thrust_max = 0.5, 0.6, 3.5

h, v, m, thrust = (ca.SX.sym(name) for name in ("h", "v", "m", "thrust"))

system = nocl.System(
    "goddard_rocket", x=ca.vertcat(h, v, m), u=thrust,
    xdot=ca.vertcat(v, (thrust - drag * v**2 * ca.exp(-decay * (h - 1))) / m - 1 / h**2, -thrust / exhaust),
    lbu=[0], ubu=[thrust_max], lbx=[0.99, -0.05, 0.55], ubx=[1.03, 0.2, 1.05])

ocp = nocl.OCP(
    system, horizon=nocl.Free(0.1, 0.4), running=0.0, terminal=-h,
    initial_states=nocl.Uniform([1.0, 0.0, 0.97], [1.001, 0.01, 1.0]),
    state_bounds={"m": (m_empty, None)}, terminal_constraints={"at the top": (0, v, 0)})
