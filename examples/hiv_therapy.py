"""Chemotherapy of HIV: healthy cells kept by a drug that stops their infection, at a price.

Butler, Kirschner and Lenhart (1997), "Optimal control of chemotherapy affecting the infectivity of HIV"; numbers as
in Lenhart and Workman (2007), "Optimal control applied to biological models", lab 7. The control there is u = 1 for
no drug, as here.
"""

import casadi as ca

import nocl

source, growth, T_max = 10.0, 0.03, 1500.0  # cells/(mm^3 d), 1/d, cells/mm^3
death, death_infected, clearance = 0.02, 0.5, 4.4  # 1/d
infection, burst, benefit = 2.4e-5, 300.0, 0.05  # mm^3/d, viruses a cell, 1

T, T_i, V = ca.SX.sym("T"), ca.SX.sym("T_i"), ca.SX.sym("V")
u = ca.SX.sym("u")  # the share of infectivity that the drug leaves
infected = u * infection * V * T

system = nocl.System(
    "hiv_therapy", x=ca.vertcat(T, T_i, V), u=u,
    xdot=ca.vertcat(source / (1 + V) - death * T + growth * T * (1 - (T + T_i) / T_max) - infected,
                    infected - death_infected * T_i, burst * death_infected * T_i - clearance * V),
    lbu=[0], ubu=[1], lbx=[0, 0, 0], ubx=[1500, 50, 2000],
    units={"T": "1/mm^3", "T_i": "1/mm^3", "V": "1/mm^3"})

ocp = nocl.OCP(
    system, horizon=20.0, running=-benefit * T + (1 - u)**2, terminal=0.0,  # d
    initial_states=nocl.Uniform([700, 0.02, 0.5], [900, 0.06, 2.5]))
