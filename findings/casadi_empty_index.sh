#!/usr/bin/env bash
# CasADi 3.8.2, an empty list as index. x[[]] of a column with two or more rows is 0x1, of a scalar 1x0. Stacked, the
# 1x0 counts as a row: vertcat(x[[]], x) of a scalar SX or DM is 2x1, its first row a structural zero, without a word; of
# MX the same raises "dimension mismatch". So code that picks some states of a vector by a list that may be empty, and
# stacks what it picked, gets a zero more where the system has one state. x[[], :] is 0x1 for all of them.
# Guessed before: to pick nothing adds no row, whatever it is picked from, and SX and MX agree.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check casadi==3.8.2 numpy==2.4.6
cat > "$folder/see.py" <<'P'
import casadi as ca

found = {}
for kind in (ca.SX, ca.MX):
    for n in (1, 2, 3):
        x = kind.sym("x", n)
        try:
            stacked = ca.vertcat(x[[]], x).shape
        except RuntimeError as error:
            stacked = "dimension mismatch" if "dimension mismatch" in str(error) else str(error)
        found[kind.__name__, n] = x[[]].shape, stacked, x[[], :].shape
for (kind, n), (picked, stacked, rows) in found.items():
    print(f"{kind} of {n}: x[[]] is {picked}, vertcat(x[[]], x) {stacked}, x[[], :] {rows}")
column = {(kind, n): ((0, 1), (n, 1), (0, 1)) for kind in ("SX", "MX") for n in (2, 3)}
scalar = {("SX", 1): ((1, 0), (2, 1), (0, 1)), ("MX", 1): ((1, 0), "dimension mismatch", (0, 1))}
x = ca.SX.sym("x")
said = ca.Function("f", [x], [ca.vertcat(x[[]], x)])(7)
print(f"vertcat(x[[]], x) at x = 7: {said}")
zero = said.nnz() == 1 and float(said[0]) == 0 and float(said[1]) == 7
raise SystemExit(0 if found == column | scalar and zero else "this has changed")
P
"$folder/venv/bin/python" "$folder/see.py"
