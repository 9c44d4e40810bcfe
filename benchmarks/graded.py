"""Do grids pay that are finer where solutions bend? What plans on 80 intervals cost, uniform and graded.

    python benchmarks/graded.py [PROBLEM ...]

A graded grid is a uniform one in another time: t = T (exp(a s / T) - 1) / (exp(a) - 1), s in [0, T], whose first
interval is about a / (exp(a) - 1) of a uniform one and whose last exp(a) times as long as the first. a < 0: fine at the
end. For each a in GRADES, the floor is what training asks for when it chooses intervals (solvers/cnd/fineness.py): the
median over 8 initial states of what a plan costs more, followed as feedback in continuous time, than one on 320
intervals of the same grading. "uniform" has 80, 160, 320 uniform ones beside: twice as many cost twice the time.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca

sys.path.insert(0, str(Path(__file__).parent))
import provenance

import nocl
from nocl.definition.ocp import OCP
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.fineness import MOST, USUAL, WORTH, _floor
from nocl.solvers.cnd.training import _steps

GRADES = (-2.0, -1.0, 1.0, 2.0, 3.0)
PROBLEMS = ("van_der_vusse", "exothermic_reactor", "ph_neutralisation", "quadruple_tank", "cartpole", "acrobot")


def graded(ocp: OCP, a: float) -> OCP:
    """The same problem in the other time; for f, L and constraints that do not know it."""
    T, s = ocp.horizon, nocl.time()
    speed = a * ca.exp(a * s / T) / (ca.exp(ca.SX(a)) - 1)
    system = replace(ocp.system, xdot=speed * ocp.system.xdot)
    return replace(ocp, system=system, running=speed * ocp.running)


def floor(ocp: OCP, intervals: int) -> float:
    return _floor(ocp, None, intervals, _steps(ocp, None, TrainSettings(), intervals))


def row(name: str) -> dict[str, Any]:
    path = provenance.ROOT / "examples" / f"{name}.py"
    ocp = nocl.load_ocp(path if path.exists() else name)
    found: dict[str, Any] = {"uniform": {}, "graded": {}}
    for intervals in (USUAL, 2 * USUAL, MOST * USUAL):
        found["uniform"][intervals] = floor(ocp, intervals)
        print(f"{name}: {intervals} uniform intervals: {100 * found['uniform'][intervals]:.4f} %", flush=True)
        if found["uniform"][intervals] <= WORTH / 10:
            break
    for a in GRADES:
        found["graded"][a] = floor(graded(ocp, a), USUAL)
        print(f"{name}: {USUAL} intervals, a = {a:g}: {100 * found['graded'][a]:.4f} %", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=PROBLEMS)
    warnings.simplefilter("ignore")
    rows = provenance.kept("graded")
    for name in parser.parse_args().problems:
        rows[name] = row(name)
        provenance.write("graded", rows)


if __name__ == "__main__":
    main()
