#!/usr/bin/env bash
# CasADi 3.8.2, interpolant of a look-up table, "linear" and "bspline", default options, the same nine samples of a positive
# drag curve. Beyond the grid "linear" goes on along its last chord; "bspline" is 0 there, value and slope, from the first
# number after the last sample on: at 1 it is 1.49, at 1 + 2^-52 it is 0, and nothing is said. So an optimiser that starts
# or steps outside sees the least value there is, with a gradient of 0: IPOPT ends with Solve_Succeeded at its guess of 1.5,
# cost 0, where the samples are nowhere below 1. With "linear" it comes back to the least sample, and stops at that kink.
# Where a state may leave a table it has to be bounded, or drawn into the grid before it is looked up.
# Guessed before: that "bspline" goes on with its last polynomial, as "linear" does with its last chord.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check casadi==3.8.2 numpy==2.2.6
cat > "$folder/see.py" <<'P'
import casadi as ca
import numpy as np

grid = np.linspace(0, 1, 9)
x = ca.MX.sym("x")
seen = {}
for kind in ("linear", "bspline"):
    table = ca.interpolant("drag", kind, [grid], 1 + (grid - 0.3)**2)
    both = ca.Function("both", [x], [table(x), ca.jacobian(table(x), x)])
    inside, outside = ([round(float(v), 3) for v in both(at)] for at in (1.0, 1.0 + 2.0**-52))
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("least", "ipopt", {"x": x, "f": table(x)}, options)
    found = solver(x0=1.5)
    seen[kind] = {"at 1": inside, "at 1 + 2^-52": outside, "least": round(float(found["f"]), 3),
                  "there": round(float(found["x"]), 3), "status": solver.stats()["return_status"]}
    print(kind, seen[kind])
edge = seen["bspline"]
same = (edge["at 1"] == [1.49, 1.4] and edge["at 1 + 2^-52"] == [0, 0] and edge["status"] == "Solve_Succeeded"
        and edge["least"] == 0 and edge["there"] == 1.5 and seen["linear"]["at 1 + 2^-52"] == seen["linear"]["at 1"]
        and 1 <= seen["linear"]["least"] < 1.01)
raise SystemExit(0 if same else "this has changed")
P
"$folder/venv/bin/python" "$folder/see.py"
