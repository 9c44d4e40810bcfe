"""Trained networks inside NMPC: four examples that can be read and run, and what they bring.

    python benchmarks/inside_nmpc.py [PROBLEM ...] [--n 100] [--loops 8]

warm       the controller's rollout as NMPC's start: iterations, time and share of best known optima, with and without
terminal   the value function as the terminal cost of an NMPC with a quarter of the horizon, in closed loop
learned    learned dynamics inside NMPC: its plans, judged on the exact f
integrator the policy as a CasADi Function inside a CVODES loop that a user writes

Controllers are the pretrained ones. A best known optimum: the best of 8 starts, 4 passes over neighbours, and the
controller's rollout, to 0.1 %. Times are of one process on a shared machine.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance

import nocl
from nocl.data import Solution
from nocl.judge import simulate
from nocl.solvers import NMPC
from nocl.solvers.cnd import CND, pretrained
from nocl.solvers.nmpc import guesses
from nocl.support.checks import Array

SAME = 1e-3  # relative: costs closer than this are of one optimum


def warm(cnd: CND, n: int) -> dict[str, Any]:
    """NMPC from the controller's rollout, beside each of NMPC's own single starts and all of its starts."""
    ocp = cnd.ocp
    x0, nmpc = ocp.initial_states.sample(n, 4242), NMPC(ocp)
    nmpc.solve(x0[:1], starts=1)  # builds the program
    found: dict[str, Solution] = {"CND rollout": nmpc.solve(x0, cnd, workers=1)}
    lqr, t = guesses.lqr_of(ocp), np.linspace(0, ocp.horizon, nmpc.intervals + 1)
    kinds = [guesses.starts(nmpc.program, lqr, x, t, 4, 0) for x in x0]
    for k in range(min(map(len, kinds))):
        start = tuple(np.stack([kind[k][i] for kind in kinds]) for i in (0, 1))
        found[f"own start {k + 1}"] = nmpc.solve(x0, start, workers=1)
    everything = nmpc.solve(x0, workers=1)
    best = np.min([everything.cost, *(s.cost for s in found.values())], axis=0)
    rows = {name: _start(s, best) for name, s in found.items()}
    own = max((name for name in rows if name != "CND rollout"), key=lambda name: rows[name]["best_known_%"])
    return {"starts": rows | {"8 starts, 4 passes": _start(everything, best)}, "own_best_single": own,
            "iterations_ratio": round(rows["CND rollout"]["iterations"] / rows[own]["iterations"], 3)}


def _start(solution: Solution, best: Array) -> dict[str, Any]:
    return {"best_known_%": round(100 * float((solution.cost <= best * (1 + SAME)).mean()), 1),
            "iterations": round(float(np.mean(solution.iterations)), 1),
            "iterations_median": float(np.median(solution.iterations)),
            "ms": round(1e3 * float(np.median(solution.seconds)), 2), "failed": int((~solution.success).sum())}


def terminal(cnd: CND, n: int) -> dict[str, Any]:
    """Closed loops, 80 controls, programs compiled: the full horizon, a quarter of it with V at its end, or with G."""
    ocp = cnd.ocp
    x0, T = ocp.initial_states.sample(n, 4243), ocp.horizon
    full, quarter = NMPC(ocp, compiled=True), NMPC(ocp, intervals=20, horizon=T / 4, terminal=cnd, compiled=True)
    myopic = NMPC(ocp, intervals=20, horizon=T / 4, compiled=True)
    plan = full.solve(x0, cnd)
    reference = simulate(ocp, plan.u, x0).cost
    return {"full horizon": _loop(full, cnd, x0, reference), "quarter with V": _loop(quarter, cnd, x0, reference),
            "quarter with G": _loop(myopic, cnd, x0, reference)}


def _loop(nmpc: NMPC, cnd: CND, x0: Array, reference: Array) -> dict[str, Any]:
    """Costs against the open-loop optimum's, and the time of a solve; each starts at the controller's rollout.

    From the last plan, shifted, a quarter with V falls into worse basins for 4 states of 10: past the plan's end
    there is nothing to shift, and V is only good where the controller goes.
    """
    gaps, seconds, failures, nodes = [], [], 0, nmpc.controller(hold=80).nodes

    def control(x: Array, t: float) -> Array:
        nonlocal failures
        plan = nmpc.solve(x, cnd, nodes=nodes(t), workers=1, progress=False)
        seconds.append(float(plan.seconds[0]))
        failures += int((~plan.success).sum())
        return plan.u[:, 0]

    for x, J in zip(x0, reference, strict=True):
        gaps.append(simulate(nmpc.ocp, control, x, hold=80).cost[0] / J - 1)
    return {"gap_median_%": round(100 * float(np.median(gaps)), 3), "gap_max_%": round(100 * float(np.max(gaps)), 3),
            "within_1_%": round(100 * float(np.mean(np.array(gaps) < 0.01)), 1),
            "ms_a_solve": round(1e3 * float(np.median(seconds)), 2), "failures": failures}


def learned(cnd: CND, n: int) -> dict[str, Any]:
    """Plans on learned dynamics as MX inside the NLP, then on the exact f: open loop, and in closed loop."""
    ocp = cnd.ocp
    model = nocl.identify(ocp.system, seed=0, progress=False)
    x0 = ocp.initial_states.sample(n, 4244)
    rows = {}
    for name, nmpc in (("exact f", NMPC(ocp)), ("learned f", NMPC(ocp, dynamics=model)),
                       ("learned f, compiled", NMPC(ocp, dynamics=model, compiled=True))):
        nmpc.solve(x0[:1], cnd)
        plan = nmpc.solve(x0, cnd, workers=1)
        rows[name] = {"cost_on_exact_f": round(float(simulate(ocp, plan.u, x0).cost.mean()), 6),
                      "iterations": float(np.median(plan.iterations)),
                      "ms": round(1e3 * float(np.median(plan.seconds)), 2), "failed": int((~plan.success).sum())}
    return rows | {"model": str(model.card["score"])}


def integrator(cnd: CND, n: int) -> dict[str, Any]:
    """x' = f(x, pi(x, t)), L as one more state: ten lines with the exported Functions, and the judge's answer."""
    ocp = cnd.ocp
    x, t, cost = ca.MX.sym("x", ocp.system.nx), ca.MX.sym("t"), ca.MX.sym("cost")
    ode = ca.vertcat(cnd.closed_loop_to_casadi()(x, t), ocp.L(x, cnd.to_casadi()(x, t)))
    dae = {"x": ca.vertcat(x, cost), "t": t, "ode": ode}
    end = ca.integrator("end", "cvodes", dae, 0.0, ocp.horizon, {"reltol": 1e-9, "abstol": 1e-10})
    x0 = ocp.initial_states.sample(n, 4245)
    seconds, final = _timed(lambda: [end(x0=np.r_[row, 0])["xf"].full().ravel() for row in x0])
    J = np.array([z[-1] + float(ocp.G(z[:-1])) for z in final])
    judged = simulate(ocp, cnd, x0).cost
    return {"ms_a_simulation": round(1e3 * seconds / n, 2),
            "largest_difference_from_judge": float(np.abs(J - judged).max())}


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=["cartpole"])
    parser.add_argument("--n", type=int, default=100, help="initial states")
    parser.add_argument("--loops", type=int, default=8, help="closed loops of NMPC")
    options, rows = parser.parse_args(), []
    for problem in options.problems:
        cnd, row = pretrained(problem), {"problem": problem}
        for example, n in ((warm, options.n), (terminal, options.loops), (learned, options.n // 4),
                           (integrator, options.n)):
            row[example.__name__] = example(cnd, n)
            print(problem, example.__name__, row[example.__name__], flush=True)
            provenance.write("inside_nmpc", [*rows, row], n=options.n, loops=options.loops)
        rows.append(row)


if __name__ == "__main__":
    main()
