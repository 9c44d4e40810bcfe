"""HJB level sets as the independent check of V: against DDP's global optimum, Riccati, and shipped CNDs; refinement.

    python benchmarks/levelset.py [--problems pendulum,...] [--states N]

writes benchmarks/results/levelset.json. Each problem keeps its own row, with what made it, so that problems can be run
one after another. Relative errors are |V_ls(x, 0) - J| / J over initial states; J is the best of DDP's starts on 400
held controls. The order of convergence is that of the mean error, from each grid to the next.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import provenance

import nocl
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.levelset.solver import Refinement, refine
from nocl.solvers.lqr import LQR
from nocl.support.checks import Array

INTERVALS, SEED = 400, 3


@dataclass(frozen=True)
class Study:
    """Grids, coarse to fine, on a box that holds all optimal trajectories with a margin; LevelSet's options."""

    lower: list[float]
    upper: list[float]
    grids: list[tuple[int, ...]]
    stretch: list[float] | None = None
    penalty_slope: float = math.inf
    scheme: str = "weno5"

    def options(self) -> dict[str, Any]:
        return {"box": (self.lower, self.upper), "stretch": self.stretch, "penalty_slope": self.penalty_slope,
                "scheme": self.scheme}


STUDIES = {
    "double_integrator": Study([-3.0, -3.0], [3.0, 3.0], [(n, n) for n in (61, 91, 121)], scheme="weno3"),
    "pendulum": Study([-1.5, -7.0], [6.0, 7.0], [(n, n) for n in (81, 121, 161)]),
    "van_der_pol": Study([-2.7, -3.3], [2.9, 3.3], [(n, n) for n in (71, 101, 141)], [0.5, 0.5]),
    "dubins": Study([-4.05, -3.9, -4.0], [0.45, 3.9, 4.0], [(21, 41, 41), (31, 61, 61), (41, 81, 81), (51, 101, 101)],
                    [0.5, 0.5, 0.7], 0.1),
}


def errors(V: Array, J: Array) -> dict[str, float]:
    e = np.abs(V - J) / J
    return {"mean": float(e.mean()), "median": float(np.median(e)), "max": float(e.max()),
            "bias": float(((V - J) / J).mean())}


def study(name: str, n: int) -> dict[str, Any]:
    """One row: the reference, errors on each grid and of Richardson's limit, CND's value, seconds."""
    ocp, plan = nocl.load_ocp(name), STUDIES[name]
    x = ocp.initial_states.sample(n, SEED)
    found = solve_globally(DDP(ocp, intervals=INTERVALS), x, starts=8, rounds=4)
    x, J = x[found.success], found.cost[found.success]
    made = refine(ocp, plan.grids, x, max_seconds=7200.0, **plan.options())
    slope = plan.penalty_slope if math.isfinite(plan.penalty_slope) else None
    row = {"problem": name, "made": provenance.made(), "states": len(x), "mean J": float(J.mean()),
           "box": [plan.lower, plan.upper], "scheme": plan.scheme, "stretch": plan.stretch, "penalty slope": slope,
           **compared(made, plan, J)}
    if name == "double_integrator":  # no bound is active: LQR is exact
        row["against Riccati"] = errors(made.V[-1], np.asarray(LQR(ocp).value(x)))
    if name in ("dubins", "pendulum"):
        V = np.asarray(nocl.pretrained(name, "exact").value(x, 0.0)).ravel()
        row["CND against J"], row["CND against level sets"] = errors(V, J), errors(V, made.V[-1])
    return row


def compared(made: Refinement, plan: Study, J: Array) -> dict[str, Any]:
    grids = [{"grid": list(g), "seconds": float(s), **errors(V, J)}
             for g, s, V in zip(plan.grids, made.seconds, made.V, strict=True)]
    mean, nodes = (np.log(values) for values in ([g["mean"] for g in grids], [g["grid"][0] - 1 for g in grids]))
    return {"grids": grids, "order": (-np.diff(mean) / np.diff(nodes)).tolist(), "Richardson": errors(made.limit, J)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", default=",".join(STUDIES))
    parser.add_argument("--states", type=int, default=60)
    args = parser.parse_args()
    for name in args.problems.split(","):
        row = study(name, args.states)
        print(json.dumps(row, indent=1))
        path = provenance.RESULTS / "levelset.json"
        others = [r for r in json.loads(path.read_text())["rows"] if r["problem"] != name] if path.is_file() else []
        provenance.write("levelset", [*others, row])


if __name__ == "__main__":
    main()
