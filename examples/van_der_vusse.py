"""Van der Vusse's reactor: hold the product's concentration by feed and cooling, below 140 degC.

Constants: Klatt and Engell (1998), "Gain-scheduling trajectory control of a continuous stirred tank reactor",
Computers and Chemical Engineering 22(4/5), as in do-mpc's example "CSTR". Its penalty on moves of the controls is
left out: here a small one on their distance from the steady state, in do-mpc's scalings.
"""

import casadi as ca

import nocl

k0_ab, k0_bc, k0_ad = 1.287e12, 1.287e12, 9.043e9  # 1/h, 1/h, l/(mol h)
E_ab, E_bc, E_ad = 9758.3, 9758.3, 8560.0  # K, activation energies over the gas constant
dH_ab, dH_bc, dH_ad = 4.2, -11.0, -41.85  # kJ/mol
rho, cp, cp_jacket = 0.9342, 3.01, 2.0  # kg/l, kJ/(kg K), kJ/(kg K)
area, volume, m_jacket, k_wall = 0.215, 10.01, 5.0, 4032.0  # m^2, l, kg, kJ/(h m^2 K)
T_in, C_in = 130.0, 5.1  # degC, mol/l

C_a, C_b, T_R, T_K = (ca.SX.sym(name) for name in ("C_a", "C_b", "T_R", "T_K"))
F, Q_dot = ca.SX.sym("F"), ca.SX.sym("Q_dot")
k_ab, k_bc, k_ad = (k0 * ca.exp(-E / (T_R + 273.15)) for k0, E in ((k0_ab, E_ab), (k0_bc, E_bc), (k0_ad, E_ad)))
heat = k_ab * C_a * dH_ab + k_bc * C_b * dH_bc + k_ad * C_a**2 * dH_ad
wall = k_wall * area * (T_K - T_R)

system = nocl.System(
    "van_der_vusse", x=ca.vertcat(C_a, C_b, T_R, T_K), u=ca.vertcat(F, Q_dot),
    xdot=ca.vertcat(
        F * (C_in - C_a) - k_ab * C_a - k_ad * C_a**2,
        -F * C_b + k_ab * C_a - k_bc * C_b,
        -heat / (rho * cp) + F * (T_in - T_R) + wall / (rho * cp * volume),
        (Q_dot - wall) / (m_jacket * cp_jacket)),
    lbu=[5, -8500], ubu=[100, 0], lbx=[0.1, 0.1, 50, 50], ubx=[2, 2, 150, 150],
    units={"C_a": "mol/l", "C_b": "mol/l", "T_R": "degC", "T_K": "degC", "F": "1/h", "Q_dot": "kJ/h"})

# the steady state with 0.6 mol/l of product at 134.14 degC, where do-mpc starts
C_b_goal, T_R_goal = 0.6, 134.14
free = ca.vertcat(C_a, T_K, F, Q_dot)
balance = ca.Function("balance", [free], [ca.substitute(system.xdot, ca.vertcat(C_b, T_R), [C_b_goal, T_R_goal])])
C_a_goal, T_K_goal, F_goal, Q_goal = ca.rootfinder("steady", "newton", balance)([0.8, 130, 18, -1000]).full().ravel()

ocp = nocl.OCP(
    system, horizon=0.1,  # h
    running=(C_b - C_b_goal)**2 + 1e-3 * (((F - F_goal) / 100)**2 + ((Q_dot - Q_goal) / 2000)**2),
    terminal=(C_b - C_b_goal)**2,
    x_goal=[C_a_goal, C_b_goal, T_R_goal, T_K_goal], u_goal=[F_goal, Q_goal],
    initial_states=nocl.Uniform([0.7, 0.4, 130.0, 126.0], [0.9, 0.6, 138.0, 134.0]),
    state_bounds={"T_R": (None, 140), "T_K": (None, 140)})
