#!/usr/bin/env bash
# do-mpc 5.1.2, a penalty of control changes beside a scaling of the control. x+ = 0.9 x + 0.1 u, five steps of (x - 5)^2
# and 1e-3 (u - u_prev)^2, from x = 0, u_prev = 20: the first control is 42.8, which the condensed quadratic program says
# too. A scaling is to change numbers inside the solver alone. But with mpc.scaling["_u", "u"] = 10 the first control is
# 46.0, with 100 it is 46.1, where the penalty is given as an expression of u and mpc.u_prev: there u is the physical
# control and u_prev the scaled one. Where it is given as a weight, set_rterm(u=1e-3), it is 49.9 and 50.0: that weight is
# of the scaled change. So who scales a controller that works, retunes it without a word.
# Guessed before: the same control to the solver's tolerance, for any scaling, in both forms.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check do-mpc==5.1.2 casadi==3.8.2 numpy==2.4.6 scipy==1.17.1
cat > "$folder/see.py" <<'P'
import warnings

import numpy as np
from scipy.optimize import lsq_linear

warnings.simplefilter("ignore")
import do_mpc


def first_control(scale, weight_alone):
    model = do_mpc.model.Model("discrete")
    x, u = model.set_variable("_x", "x"), model.set_variable("_u", "u")
    model.set_rhs("x", 0.9 * x + 0.1 * u)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.set_param(n_horizon=5, t_step=1.0, store_full_solution=False)
    mpc.settings.supress_ipopt_output()
    mpc.set_objective(mterm=(x - 5) ** 2, lterm=(x - 5) ** 2)
    if weight_alone:
        mpc.set_rterm(u=1e-3)
    else:
        mpc.set_rterm(rterm=1e-3 * (u - mpc.u_prev["u"]) ** 2)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = -100, 100
    mpc.scaling["_u", "u"] = scale
    mpc.setup()
    mpc.x0, mpc.u0 = np.array([0.0]), np.array([20.0])
    mpc.set_initial_guess()
    return mpc.make_step(np.array([[0.0]])).item()


def right():
    """The same program as least squares in the five controls."""
    states = np.array([[0.1 * 0.9 ** (k - j) if j <= k else 0.0 for j in range(5)] for k in range(5)])
    changes = np.sqrt(1e-3) * (np.eye(5) - np.eye(5, k=-1))
    wanted = np.r_[np.full(5, 5.0), np.sqrt(1e-3) * np.array([20.0, 0, 0, 0, 0])]
    return lsq_linear(np.r_[states, changes], wanted, bounds=(-100, 100), tol=1e-14).x[0]


off = {}
for weight_alone in (False, True):
    for scale in (1.0, 10.0, 100.0):
        off[weight_alone, scale] = abs(first_control(scale, weight_alone) - right())
        print("weight" if weight_alone else "expression", scale, f"off by {off[weight_alone, scale]:.3g} of {right():.4g}")
unscaled = max(off[False, 1.0], off[True, 1.0])
scaled = min(error for (_, scale), error in off.items() if scale > 1)
raise SystemExit(0 if unscaled < 1e-3 and scaled > 1 else "this has changed")
P
"$folder/venv/bin/python" "$folder/see.py"
