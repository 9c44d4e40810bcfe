"""Vaccination against an epidemic (SEIR), with so many doses a year at most: control times state is bounded.

Biswas, Paiva and de Pinho (2014), "A SEIR model for control of infectious diseases with constraints", Mathematical
Biosciences and Engineering 11(4), after Neilan and Lenhart (2010).
"""

import casadi as ca

import nocl

b, d, a = 0.525, 0.5, 0.2  # 1/a: births, deaths, deaths of the disease
c, e, g = 0.001, 0.5, 0.1  # 1/a: contacts, incubation, recovery
doses, weight = 125.0, 0.1  # 1/a; of the ill

S, E, I, N = (ca.SX.sym(name) for name in ("S", "E", "I", "N"))  # noqa: E741
u = ca.SX.sym("u")  # 1/a, the share of the susceptible that is vaccinated

system = nocl.System(
    "epidemic", x=ca.vertcat(S, E, I, N), u=u,
    xdot=ca.vertcat(b * N - d * S - c * S * I - u * S, c * S * I - (e + d) * E, e * E - (g + a + d) * I,
                    (b - d) * N - a * I),
    lbu=[0], ubu=[1], lbx=[0, 0, 0, 0], ubx=[3000, 500, 300, 3000])

ocp = nocl.OCP(
    system, horizon=20.0, running=weight * I + u**2, terminal=0.0,  # a
    initial_states=nocl.Gaussian(mean=[1000, 100, 50, 1165], std=[50, 10, 5, 0]),
    constraints={"doses": (None, u * S, doses)})
