"""Minimum-time laws u(x): what a network loses to the switch, and what helps.

    python benchmarks/laws.py [--problems integrator pendulum --n 200]

Each law is run by the judge from fresh initial states until all terminal constraints hold within 1e-3 of their scales.
gap : its cost over the least cost of ending as near, by DDP on 320 intervals from the bank's nearest plans, in %; inf
      where it does not arrive
analytic : the same to the double integrator's own switching law, run as the law is, where there is one

Ways: `switches`, as nocl.train does it (two labels for each switch); `blurred`, what is held in the interval of the
switch is a label as any other; `branches`, two answers that a number chooses between.
Results go to benchmarks/results/laws.json.
"""

from __future__ import annotations

import argparse
import time
import warnings
from typing import Any

import casadi as ca
import numpy as np
import provenance
from minimum_time import CASES

import nocl
from nocl.definition.sampling import own_numbers
from nocl.solvers.cnd.laws import LawTraining
from nocl.solvers.cnd.settings import TrainSettings

SMALL: dict[str, Any] = {"iterations": 1500, "rounds": 2, "states": 100, "tails": 300}  # beside effort "quick"


def spread(gap: np.ndarray) -> dict[str, float]:
    median, p95 = np.percentile(gap, [50, 95], method="higher")
    return {"median": float(median), "p95": float(p95), "worst": float(gap.max()),
            "arrive": float(np.isfinite(gap).mean())}


def switching() -> ca.Function:
    """The double integrator's analytic law, steep in place of a jump."""
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    return ca.Function("law", [x, t], [-ca.tanh((x[0] + x[1] * ca.fabs(x[1]) / 2) / 1e-4)])


def measured(name: str, way: str, effort: str, n: int) -> dict[str, Any]:
    ocp = CASES[name]().ocp
    settings = TrainSettings.of(effort, **(SMALL if effort == "quick" else {}), branches=2 if way == "branches" else 1)
    begin = time.process_time()
    training = LawTraining(ocp, settings, 0, False, None, switches=way != "blurred")
    law = training.run()
    row: dict[str, Any] = {"CPU s": round(time.process_time() - begin, 1), "n": n}
    x0 = ocp.initial_states.sample(n, own_numbers(0, 7))
    best = training.bank.solve(training.loose, x0, np.zeros((n, 0)), 4)
    for title, one in {"law": law, **({"analytic": switching()} if name == "integrator" else {})}.items():
        run = nocl.simulate(ocp, one, x0)
        cost = np.where(run.success, run.cost, np.inf)[best.success]
        row[title] = spread(100 * (cost / best.cost[best.success] - 1))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=tuple(CASES), default=["integrator", "pendulum"])
    parser.add_argument("--ways", nargs="+", default=["switches", "blurred", "branches"])
    parser.add_argument("--effort", default="quick")
    parser.add_argument("--n", type=int, default=200)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = provenance.kept("laws")
    for name in args.problems:
        for way in args.ways:
            rows[f"{name}, {way}"] = measured(name, way, args.effort, args.n) | {"commit": provenance.STARTED}
            print(name, way, rows[f"{name}, {way}"], flush=True)
            provenance.write("laws", rows)


if __name__ == "__main__":
    main()
