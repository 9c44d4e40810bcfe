"""Predators and prey brought to their equilibrium by fishing, which takes both: bang, singular.

Lotka and Volterra's equations; Sager, Bock, Diehl, Reinelt and Schloeder (2006), "Numerical methods for optimal
control with binary control functions applied to a Lotka-Volterra type fishing problem". There the fleet sails or it
does not; here any part of it may.
"""

import casadi as ca

import nocl

caught_prey, caught_predators = 0.4, 0.2

prey, predators, fishing = ca.SX.sym("prey"), ca.SX.sym("predators"), ca.SX.sym("fishing")

system = nocl.System(
    "fishing", x=ca.vertcat(prey, predators), u=fishing,
    xdot=ca.vertcat(prey - prey * predators - caught_prey * prey * fishing,
                    -predators + prey * predators - caught_predators * predators * fishing),
    lbu=[0], ubu=[1], lbx=[0, 0], ubx=[3, 3])

ocp = nocl.OCP(
    system, horizon=12.0, running=(prey - 1)**2 + (predators - 1)**2, terminal=0.0, x_goal=[1, 1], u_goal=[0],
    initial_states=nocl.Uniform([0.3, 0.5], [0.7, 0.9]))
