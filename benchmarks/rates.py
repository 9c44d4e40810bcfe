"""One policy u(x, t, dt) at several control rates, against the optimum of each rate and a policy that knows none.

    python benchmarks/rates.py [PROBLEM ...] [--n 100] [--seed 0]

Every row is judged by CVODES on the exact f from hidden initial states: K controls a horizon, each held, or continuous
feedback. J* of K held controls is the least cost that is known: DDP's best of many starts on K intervals, under the
judge, or what either policy reached; in continuous time the same on FINE intervals.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance

import nocl
from nocl.definition.ocp import OCP
from nocl.judge import simulate
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

RATES = (40, 80, 160, None)  # held controls a horizon; None: continuous feedback
FINE = 640


def optimal_controls(ocp: OCP, x0: Array, K: int) -> Array:
    """The best controls known [B, K, nu], held over K intervals."""
    best = solve_globally(DDP(ocp), x0, starts=8, seed=99)
    ddp, nearest = DDP(ocp, intervals=K), ((np.arange(K) + 0.5) * best.u.shape[1] / K).astype(int)
    controls: Array = ddp.solve(x0, u=best.u[:, nearest]).u
    return controls


def scored(ocp: OCP, x0: Array, controllers: dict[str, Any], K: int | None) -> dict[str, Any]:
    """The gaps of each controller at one rate."""
    best = simulate(ocp, optimal_controls(ocp, x0, K or FINE), x0).cost
    runs = {name: simulate(ocp, c, x0, hold=K) for name, c in controllers.items()}
    least = np.min([best, *(run.cost for run in runs.values())], axis=0)
    row: dict[str, Any] = {"rate": K or "continuous", "J*": round(float(least.mean()), 5),
                           "open loop, median gap_%": round(100 * float(np.median(best / least - 1)), 4)}
    for name, run in runs.items():
        gap = run.cost / least - 1
        row[name] = {"median_%": round(100 * float(np.median(gap)), 4),
                     "p95_%": round(100 * float(np.quantile(gap, 0.95)), 4), "failed": int((~run.success).sum())}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=["cartpole", "acrobot", "quadrotor", "dubins"])
    parser.add_argument("--n", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options, rows = parser.parse_args(), []
    for problem in options.problems:
        ocp = nocl.load_ocp(problem)
        x0 = ocp.initial_states.sample(options.n, 4711)
        cnd = nocl.train(ocp, settings=TrainSettings(control_dt=True, value=False), seed=options.seed)
        for K in RATES:
            own = cnd if K is None else cnd.at_rate(ocp.horizon / K)
            both = {"u(x, t, dt)": own, "u(x, t), as shipped": nocl.pretrained(problem)}
            rows.append({"problem": problem, "train_seconds": cnd.card["seconds"], **scored(ocp, x0, both, K)})
            print(rows[-1], flush=True)
            provenance.write("rates", rows, n=options.n, seed=options.seed)


if __name__ == "__main__":
    main()
