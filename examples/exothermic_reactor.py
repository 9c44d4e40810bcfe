"""An exothermic stirred tank, held at its unstable steady state by the coolant's temperature.

Constants: Henson and Seborg (1997), "Nonlinear process control", chapter 1. Weights, bounds and horizon are our own
choice.
"""

import casadi as ca

import nocl

q, V = 100.0, 100.0  # l/min, l
C_feed, T_feed = 1.0, 350.0  # mol/l, K
k0, E_over_R = 7.2e10, 8750.0  # 1/min, K
heat, rho_cp, UA = 5e4, 239.0, 5e4  # J/mol that the reaction gives off, J/(l K), J/(min K)
T_goal = 350.0  # K

C, T, T_c = ca.SX.sym("C"), ca.SX.sym("T"), ca.SX.sym("T_c")
rate = k0 * ca.exp(-E_over_R / T) * C

system = nocl.System(
    "exothermic_reactor", x=ca.vertcat(C, T), u=T_c,
    xdot=ca.vertcat(q / V * (C_feed - C) - rate,
                    q / V * (T_feed - T) + heat / rho_cp * rate + UA / (V * rho_cp) * (T_c - T)),
    lbu=[250], ubu=[350], lbx=[0, 280], ubx=[1, 480], units={"C": "mol/l", "T": "K", "T_c": "K"})

# the equilibrium, near 0.5 mol/l and 300 K
steady = ca.Function("steady", [ca.vertcat(C, T_c)], [ca.substitute(system.xdot, T, T_goal)])
C_goal, T_coolant_goal = ca.rootfinder("find", "newton", steady)([0.5, 300.0]).full().ravel()

error = 100 * (C - C_goal)**2 + 0.01 * (T - T_goal)**2
ocp = nocl.OCP(
    system, horizon=5.0, running=error + 0.002 * (T_c - T_coolant_goal)**2, terminal=10 * error,  # min
    x_goal=[C_goal, T_goal], u_goal=[T_coolant_goal],
    initial_states=nocl.Uniform([0.3, 335.0], [0.8, 365.0]))
