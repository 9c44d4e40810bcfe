"""A synchronous generator after a fault, kept in step with the grid by its excitation.

The one-axis model on an infinite bus (Kundur, 1994, "Power system stability and control", chapter 12; saliency left
out); constants of our own choice, of usual sizes.
"""

import casadi as ca
import numpy as np

import nocl

inertia, damping, omega_0 = 5.0, 0.02, 2 * np.pi * 50  # s; 1/s, of the speed; rad/s
X_d, X_transient, X_line, T_field = 1.8, 0.3, 0.4, 6.0  # per unit, ..., s
P_turbine, V_bus, E_max = 0.8, 1.0, 5.0  # per unit
X = X_transient + X_line

delta, omega, E_q = (ca.SX.sym(name) for name in ("delta", "omega", "E_q"))  # omega: above the grid's
E_field = ca.SX.sym("E_field")
P_electric, i_d = E_q * V_bus * ca.sin(delta) / X, (E_q - V_bus * ca.cos(delta)) / X

system = nocl.System(
    "generator", x=ca.vertcat(delta, omega, E_q), u=E_field,
    xdot=ca.vertcat(omega, omega_0 / (2 * inertia) * (P_turbine - P_electric) - damping * omega,
                    (E_field - E_q - (X_d - X_transient) * i_d) / T_field),
    lbu=[0], ubu=[E_max], lbx=[-1, -10, 0.3], ubx=[3, 10, 2], units={"delta": "rad", "omega": "rad/s"})

E_goal = 1.1
delta_goal = np.arcsin(P_turbine * X / (E_goal * V_bus))
E_field_goal = E_goal + (X_d - X_transient) * (E_goal - V_bus * np.cos(delta_goal)) / X

error = 10 * (delta - delta_goal)**2 + 0.5 * omega**2 + 5 * (E_q - E_goal)**2
ocp = nocl.OCP(
    system, horizon=5.0, running=error + 0.05 * (E_field - E_field_goal)**2, terminal=error,
    x_goal=[delta_goal, 0, E_goal], u_goal=[E_field_goal],
    initial_states=nocl.Uniform([0.5, 0.0, 0.9], [1.2, 3.0, 1.1]))
