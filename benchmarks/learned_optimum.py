"""What the optimum of f_theta loses when it is run as feedback on the exact f.

    python benchmarks/learned_optimum.py [PROBLEM ...] [--networks] [--n 40]

For each initial state: the optimum of the learned dynamics (DDP, global search from cold starts on 80 intervals, then
320), run as u_k + K_k (x - x_k) on the exact f under CVODES; beside it the optimum of the exact f, found and run in the
same way. Lost: (J - J*) / |J*| in per cent. "default" is nocl.identify's own recipe; with --networks also its structure
without closed forms (features=False), before and after `model.refine` on the learned optima; the results are then
learned_optimum_PROBLEM_networks.json.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance

import nocl
from nocl.data import Solution
from nocl.judge import simulate
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.sysid.identification import LearnedDynamics, Settings, identify

PROBLEMS = ("cartpole", "acrobot", "quadrotor", "dubins")
COARSE, FINE, STARTS = 80, 320, 16


def optimum(ocp: nocl.OCP, model: LearnedDynamics | None, x0: Array) -> Solution:
    """The best of STARTS cold starts for each state, on the fine grid; model None: the exact f."""
    best = solve_globally(DDP(ocp, intervals=COARSE, dynamics=model), x0, starts=STARTS, seed=0)
    return DDP(ocp, intervals=FINE, dynamics=model).solve(x0, u=np.repeat(best.u, FINE // COARSE, axis=1))


def models(problem: str, ocp: nocl.OCP, x0: Array, networks: bool) -> Iterator[tuple[str, LearnedDynamics]]:
    yield "default", identify(ocp.system, seed=0)
    if networks:
        model = identify(ocp.system, seed=0, settings=Settings(features=False))
        yield "networks", model
        tube = optimum(ocp, model, x0)
        states, controls = tube.x[tube.success, :-1], tube.u[tube.success]
        yield "networks, refined", model.refine(states.reshape(-1, ocp.system.nx), controls.reshape(-1, ocp.system.nu))


def lost(ocp: nocl.OCP, model: LearnedDynamics | None, x0: Array, J: Array) -> dict[str, Any]:
    """Per cent lost against the costs J, as feedback, of the optimum of a model."""
    solution = optimum(ocp, model, x0)
    run = simulate(ocp, solution.feedback, x0, hold=FINE)
    gap = 100 * (run.cost - J) / np.abs(J)
    good = np.isfinite(gap)
    q = np.quantile(gap[good], [0.5, 0.95, 1.0]) if good.any() else np.full(3, np.nan)
    return {"median": q[0], "p95": q[1], "worst": q[2], "failed": int((~good).sum())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=list(PROBLEMS))
    parser.add_argument("--networks", action="store_true", help="also networks where there is a closed form, refined")
    parser.add_argument("--n", type=int, default=40, help="initial states; default: 40")
    options, rows = parser.parse_args(), []
    for problem in options.problems:
        ocp = nocl.load_ocp(problem)
        x0 = ocp.initial_states.sample(options.n, 1)
        exact = optimum(ocp, None, x0)
        J = simulate(ocp, exact.feedback, x0, hold=FINE).cost
        for name, model in models(problem, ocp, ocp.initial_states.sample(options.n, 2), options.networks):
            start = time.perf_counter()
            row = {"problem": problem, "model": name, "n": options.n, "error": model.score().mean,
                   "seconds_identify": model.card["seconds"], **lost(ocp, model, x0, J)}
            row["seconds_optimum"] = round(time.perf_counter() - start, 1)
            rows.append({k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in row.items()})
            print(rows[-1], flush=True)
            kept = f"learned_optimum_{problem}" + ("_networks" if options.networks else "")
            provenance.write(kept, [r for r in rows if r["problem"] == problem])


if __name__ == "__main__":
    main()
