#!/usr/bin/env bash
# CasADi 3.8.2, integrators of a semi-explicit DAE of index 1: x' = 2 (z - x), 0 = u - z - 2 (z - x), so that
# d z(1) / d x(0) = exp(-2/3) / 1.5 = 0.342278. In forward mode "idas" has that to 7 digits. In reverse mode, which a
# gradient of a scalar takes by itself, its derivative of zf is off by half a percent to a percent, and no tolerance helps:
# 0.5 % at 1e-10, 0.7 % at 1e-13. Its derivatives of xf and of quadratures are right in both modes, and so are all of
# "collocation". So a fit of measured algebraic variables (pressures, voltages), or a cost of their last values, descends
# along a gradient that is wrong, where the same cost as an output x, or as a quadrature, is not. The thread that this
# belongs to, casadi/casadi#2806 (there the derivative was 0), is closed; #3104 leaves the rest open.
# Guessed before: that both modes agree to the tolerance, as they do for xf.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check casadi==3.8.2 numpy==2.2.6
cat > "$folder/see.py" <<'P'
import casadi as ca
import numpy as np

x, z, u, x0 = ca.SX.sym("x"), ca.SX.sym("z"), ca.SX.sym("u"), ca.MX.sym("x0")
dae = {"x": x, "z": z, "p": u, "ode": 2 * (z - x), "alg": u - z - 2 * (z - x)}
truth = {"xf": np.exp(-2 / 3), "zf": np.exp(-2 / 3) / 1.5}
off = {}
for plugin, tolerance in (("idas", 1e-10), ("idas", 1e-13), ("collocation", 0)):
    options = {"abstol": tolerance, "reltol": tolerance} if tolerance else {"number_of_finite_elements": 40}
    end = ca.integrator("end", plugin, dae, 0, [1.0], options)(x0=x0, p=1.0, z0=0.5)
    for name in truth:
        for mode, reverse in (("forward", False), ("reverse", True)):
            slope = float(ca.Function("slope", [x0], [ca.jtimes(end[name], x0, 1, reverse)])(0.5))
            off[plugin, tolerance, name, mode] = abs(slope / truth[name] - 1)
            print(plugin, tolerance, name, mode, f"off by {off[plugin, tolerance, name, mode]:.1e}")
wrong = [error for (plugin, _, name, mode), error in off.items() if (plugin, name, mode) == ("idas", "zf", "reverse")]
right = [error for (plugin, _, name, mode), error in off.items() if (plugin, name, mode) != ("idas", "zf", "reverse")]
raise SystemExit(0 if min(wrong) > 1e-3 and max(right) < 1e-5 else "this has changed")
P
"$folder/venv/bin/python" "$folder/see.py"
