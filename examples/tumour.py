"""A tumour without its blood vessels: an inhibitor of given amount, timed so that the tumour ends smallest.

Hahnfeldt et al. (1999); as a control problem Ledzewicz and Schaettler (2007), "Antiangiogenic therapy in cancer
treatment as an optimal control problem", SIAM J. Control and Optimization 46(3): bang, singular, bang. The time is
free there; here it is a week.
"""

import casadi as ca

import nocl

growth, birth, inhibition = 0.084, 5.85, 0.00873  # 1/d, 1/d, 1/(d mm^2)
loss, kill = 0.02, 0.15  # 1/d, kg/(mg d)
dose_rate, dose = 75.0, 300.0  # mg/(kg d)... and all there is, mg/kg

p, q, y = ca.SX.sym("p"), ca.SX.sym("q"), ca.SX.sym("y")  # tumour, what its vessels bear, dose so far
u = ca.SX.sym("u")

system = nocl.System(
    "tumour", x=ca.vertcat(p, q, y), u=u,
    xdot=ca.vertcat(-growth * p * ca.log(p / q),
                    birth * p - (loss + inhibition * p**(2 / 3)) * q - kill * u * q, u),
    lbu=[0], ubu=[dose_rate], lbx=[1000, 500, 0], ubx=[18_000, 18_000, 310],
    units={"p": "mm^3", "q": "mm^3", "y": "mg/kg", "u": "mg/(kg d)"})

ocp = nocl.OCP(
    system, horizon=7.0, running=0.0, terminal=p,  # d
    initial_states=nocl.Uniform([11_000, 14_000, 0], [13_000, 16_000, 0]),
    terminal_constraints={"dose": (None, y, dose)})
