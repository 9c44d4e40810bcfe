#!/usr/bin/env bash
# CasADi 3.8.2, nlpsol "fatrop", structure_detection="manual", a multiple-shooting program whose stages are
# c (x_{k+1} - F(x_k, u_k)) = 0. All c != 0 state the same problem, and IPOPT solves each. fatrop solves it for c = 1 and
# raises for every other c, also for the number after 1 (1 + 2^-52), which is what scaling a gap by s and 1/s leaves where
# s is no power of two. The error says "An exception was raised in the solver", and not that the slope of a gap in the
# next state has to be exactly 1. So gaps are scaled by powers of two alone, or not at all.
# Guessed before: that a very small scale (1e-9) makes NaN somewhere. Scales have nothing to do with it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check casadi==3.8.2 numpy==2.2.6
cat > "$folder/see.py" <<'P'
import casadi as ca


def outcome(solver, c, N=5):
    X = [ca.MX.sym(f"x{k}", 2) for k in range(N + 1)]
    U = [ca.MX.sym(f"u{k}") for k in range(N)]
    w, g, J = [], [], ca.sumsqr(X[N])
    for k in range(N):
        after = ca.vertcat(X[k][0] + 0.1 * X[k][1], X[k][1] + 0.1 * U[k])
        w += [X[k], U[k]]
        g += [c * (X[k + 1] - after)] + ([X[0] - ca.DM([1, 0])] if k == 0 else [])
        J += U[k] ** 2
    options = {"print_time": False}
    if solver == "fatrop":
        options |= {"structure_detection": "manual", "N": N, "nx": [2] * (N + 1), "nu": [1] * N + [0],
                    "ng": [2] + [0] * N, "fatrop.print_level": 0}
    else:
        options |= {"ipopt.print_level": 0, "ipopt.sb": "yes"}
    nlp = {"x": ca.vertcat(*w, X[N]), "f": J, "g": ca.vertcat(*g)}
    try:
        return round(float(ca.nlpsol("s", solver, nlp, options)(x0=0, lbg=0, ubg=0)["f"]), 4)
    except RuntimeError as error:
        return str(error).strip().splitlines()[-1].partition(": ")[2]


raised = "An exception was raised in the solver."
seen = {(s, c): outcome(s, c) for s in ("ipopt", "fatrop") for c in (1.0, 1.0 + 2.0**-52, -1.0, 2.0)}
for (solver, c), what in seen.items():
    print(f"{solver:7s} c = {c!r:20s} {what}")
expected = {k: 0.9971 if k[0] == "ipopt" or k[1] == 1.0 else raised for k in seen}
raise SystemExit(0 if seen == expected else "this has changed")
P
"$folder/venv/bin/python" "$folder/see.py"
