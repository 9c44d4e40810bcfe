"""Trained controllers of problems with constraints, in continuous time: what they violate, and what they cost.

    python benchmarks/constrained_policies.py --problems point cartpole --runs runs/constrained

gap     (J - J*) / J* of the controller under CVODES from fresh initial states; J* the best of 8 cold starts and their
        neighbours by DDP that holds all constraints at and between nodes, on FINE intervals
hidden  the share of these runs that violate a constraint by more than 1e-3 of its scale (at 8 times in an interval, and
        at the end), and the worst
kicked  the same from states along these runs after a kick of 0.02 of each state's spread, at KICKS times. Those from
        which DDP finds no plan that holds the constraints are counted apart; so are initial states

A controller is kept in --runs and judged again from there; a training that was stopped goes on from its last round.
Results go to benchmarks/results/constrained_policies.json, problem by problem.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from constrained_problems import PROBLEMS

import nocl
from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.judge import simulate
from nocl.solvers.cnd import CND, TrainSettings
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Problems, policy_controls
from nocl.solvers.ddp.bank import SolutionBank, better, extend
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

FINE = 320  # intervals of J*
NODES = 161  # of a judged run
KICK, KICKS = 0.02, 5  # of each state's spread; times, each for a fifth of the runs
ALLOWED = 1e-3  # of a scale
# fewer labels than usual, since constrained ones take longer
SETTINGS: dict[str, dict[str, Any]] = {
    name: {"seeds": 12, "starts": 6, "states": 200, "tails": 1500, "visits": 1000, "iterations": 1000, "held_out": 48}
    for name in PROBLEMS}
SETTINGS["cartpole"] |= {"iterations": 2000}
# many rival optima (first to the left or to the right, one swing or more); plans on 80 cost 1 % more
SETTINGS["pendcart"] |= {"iterations": 8000, "hidden": (128, 128, 128), "intervals": 160, "branches": 2, "tails": 2000,
                         "starts": 8, "rounds": 2, "held_out": 32}
SETTINGS["lap"] |= {"iterations": 2000, "held_out": 96}
# rows that no map holds: margins from more held-out states
SETTINGS["dubins"] |= {"held_out": 128, "rounds": 5}
SETTINGS["planar"] |= {"held_out": 64, "branches": 2, "states": 300, "tails": 2000, "iterations": 2000}
SETTINGS["planar"] |= {"intervals": 160}  # its plans on 80 cost 0.6 % more than the optimum


def controller(name: str, ocp: OCP, seed: int, runs: Path) -> CND:
    """Trained, or as it was kept."""
    folder = runs / name
    if (folder / "cnd.safetensors").exists():
        return CND.load(folder)
    settings = TrainSettings.of("normal", **{"value": False, **SETTINGS[name]})
    cnd = nocl.train(ocp, settings=settings, seed=seed, out=folder, progress=True)
    cnd.save(folder)
    return cnd


def optimum(ocp: OCP, x0: Array, cnd: CND) -> tuple[Solution, SolutionBank]:
    """The best known from x0 on FINE intervals, constraints held between nodes too; and on the usual grid as a bank."""
    coarse, fine = DDP(ocp), DDP(ocp, intervals=FINE, between=True)
    found = solve_globally(coarse, x0, starts=8, neighbours=2, rounds=2, seed=99, progress=False)
    bank = SolutionBank.of(coarse, found)
    at = Problems(x0, np.zeros(len(x0)), np.zeros((len(x0), 0)))
    own = fine.solve(x0, u=policy_controls(cnd.policy, InTorch(ocp), at, FINE), progress=False)
    best = fine.solve(x0, u=np.repeat(found.u, FINE // coarse.intervals, axis=1), progress=False)
    return better(best, own), bank


def violations(ocp: OCP, run: Any, feasible: Array) -> dict[str, Any]:
    over = np.where(run.reached, run.violation, np.inf)[feasible]
    order = np.flatnonzero(feasible)[np.argsort(-over)][:5]
    return {"runs": int(feasible.sum()), "left out, no plan holds": int((~feasible).sum()),
            "violating": float((over > ALLOWED).mean()), "worst": float(over.max()),
            "95th percentile": float(np.quantile(over, 0.95)), "worst runs": order.tolist()}


def gaps(J: Array, best: Array) -> dict[str, float]:
    share = (J - best) / np.abs(best)
    return {"median": float(np.median(share)), "95th percentile": float(np.quantile(share, 0.95)),
            "worst": float(share.max()), "over 2 %": float((share > 0.02).mean())}


def kicked(ocp: OCP, cnd: CND, run: Any, bank: SolutionBank, rng: np.random.Generator) -> dict[str, Any]:
    """One kick each, and what is violated from there on."""
    ddp, times = DDP(ocp), np.sort(rng.choice(np.arange(8, NODES - 8), KICKS, replace=False))
    groups, fine, over = np.array_split(rng.permutation(np.flatnonzero(run.reached)), KICKS), [], []
    for k, rows in zip(times, groups, strict=True):
        t = float(run.t[k])
        x = run.x[rows, k] + KICK * bank.scale[:ocp.system.nx] * rng.standard_normal((len(rows), ocp.system.nx))
        at = Problems(x, np.full(len(rows), t), np.zeros((len(rows), 0)))
        own = ddp.solve(x, t, u=policy_controls(cnd.policy, InTorch(ocp), at, ddp.intervals), progress=False)
        fine.append(better(own, extend(ddp, bank, x, 3, t)).success)
        later = simulate(ocp, cnd, x, t0=t, nodes=81)
        over.append(np.where(later.reached, later.violation, np.inf))
    holds, worst = np.concatenate(fine), np.concatenate(over)
    return {"runs": int(holds.sum()), "left out, no plan holds": int((~holds).sum()),
            "violating": float((worst[holds] > ALLOWED).mean()), "worst": float(worst[holds].max()),
            "violating of those left out": float((worst[~holds] > ALLOWED).mean()) if (~holds).any() else None}


def judged(name: str, n: int, seed: int, runs: Path) -> dict[str, Any]:
    ocp, rng = PROBLEMS[name](), np.random.default_rng(seed + 1000)
    cnd = controller(name, ocp, seed, runs)
    x0 = ocp.initial_states.sample(n, seed + 1000)
    begin = time.perf_counter()
    best, bank = optimum(ocp, x0, cnd)
    run = simulate(ocp, cnd, x0, nodes=NODES)
    holds = best.success
    settings = asdict(TrainSettings.of("normal"))
    changed = {k: v for k, v in cnd.card["settings"].items() if list(np.ravel(v)) != list(np.ravel(settings[k]))}
    row = {"gap": gaps(run.cost[holds], best.cost[holds]), "hidden": violations(ocp, run, holds),
           "kicked": kicked(ocp, cnd, run, bank, rng), "seed": seed, "settings": changed,
           "training seconds": cnd.card["seconds"], "fitting cpu seconds": cnd.card["fitting_cpu_seconds"],
           "rounds": len(cnd.card["history"]) - 1, "margins": cnd.card["history"][cnd.card["round"]]["margin"],
           "judging seconds": round(time.perf_counter() - begin)}
    kept = run.violation[holds] <= ALLOWED
    if kept.any():
        row["gap of runs that violate nothing"] = gaps(run.cost[holds][kept], best.cost[holds][kept])
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=tuple(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=Path, default=Path("runs/constrained"))
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = provenance.kept("constrained_policies")
    for name in args.problems:
        rows[name] = judged(name, args.n, args.seed, args.runs) | {"commit": provenance.STARTED}
        print(name, json.dumps(rows[name], indent=1), flush=True)
        provenance.write("constrained_policies", rows)


if __name__ == "__main__":
    main()
