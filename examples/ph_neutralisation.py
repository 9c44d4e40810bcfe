"""The pH of a tank in which acid is neutralised: an algebraic equation, steep where it matters.

Henson and Seborg's process (IEEE Trans. Control Systems Technology 2, 1994, "Adaptive nonlinear control of a pH
neutralization process"): reaction invariants Wa and Wb as states, pH from the equilibrium of ions; their constants and
usual flows. The weights and where it starts are our own choice.
"""

import casadi as ca

import nocl

area, valve = 207.0, 8.75  # cm^2; cm^2.5/s
acid, buffer = 16.6, 0.55  # ml/s, flows that are given
a1, a2, a3 = 3.0e-3, -3.0e-2, -3.05e-3  # mol/l, Wa of acid, buffer and base
b1, b2, b3 = 0.0, 3.0e-2, 5.0e-5  # mol/l, Wb of them
pK1, pK2 = 6.35, 10.25

Wa, Wb, level, base, pH = (ca.SX.sym(name) for name in ("Wa", "Wb", "level", "base", "pH"))  # mmol/l, cm, ml/s


def ten(e):
    return 10.0**e


volume = area * level
share = (1 + 2 * ten(pH - pK2)) / (1 + ten(pK1 - pH) + ten(pH - pK2))
charge = Wa + Wb * share + 1000 * (ten(pH - 14) - ten(-pH))

system = nocl.System(
    "ph_neutralisation", x=ca.vertcat(Wa, Wb, level), u=base, z=pH, alg=charge, z_guess=[7.0],
    xdot=ca.vertcat((acid * (1000 * a1 - Wa) + buffer * (1000 * a2 - Wa) + base * (1000 * a3 - Wa)) / volume,
                    (acid * (1000 * b1 - Wb) + buffer * (1000 * b2 - Wb) + base * (1000 * b3 - Wb)) / volume,
                    (acid + buffer + base - valve * ca.sqrt(level)) / area),
    lbu=[0], ubu=[30], lbx=[-1.2, 0.3, 8], ubx=[0.4, 0.8, 22],
    units={"Wa": "mmol/l", "Wb": "mmol/l", "level": "cm", "base": "ml/s"})

usual = 15.55  # ml/s of base: pH 7
total = acid + buffer + usual
rest = [1000 * (acid * a1 + buffer * a2 + usual * a3) / total, 1000 * (acid * b1 + buffer * b2 + usual * b3) / total,
        (total / valve) ** 2]

ocp = nocl.OCP(
    system, horizon=300.0, running=(pH - 7) ** 2 + 1e-3 * (base - usual) ** 2, terminal=100 * (pH - 7) ** 2,
    x_goal=rest, u_goal=[usual],
    initial_states=nocl.Uniform([-0.9, 0.45, 12], [0.1, 0.6, 16]))
