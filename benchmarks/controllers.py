"""Trained controllers as feedback: the gap to the optimum in continuous time, on hidden states, and under kicks.

    python benchmarks/controllers.py [PROBLEM ...] [--dynamics exact learned] [--seeds 0 1 2] [--n 200]
    python benchmarks/controllers.py "cartpole, wide box" --dynamics exact --seeds 0 --results controllers_wide
    python benchmarks/controllers.py --table pretrained controllers      # the results of those files as markdown

Every controller is judged by CVODES on the exact f, as continuous feedback, from initial states that training did not
see. J* is the continuous-time optimum: the best of DDP's cold starts, neighbours and the controller's own rollout, with
640 held controls. Under kicks (5 of N(0, sigma^2) on every state, at random times) the reference is the optimum
solved anew after each kick ("kicked_gap"). It then stands elsewhere than the controller when the next kick hits both,
and kicks that come late cost the one or the other more by chance: "kicked_loss" leaves that out. It is what the
controller loses between kicks, each stretch against the optimum from the state where the kick left the controller.

V is judged on fresh states, too: the hidden initial ones, and VALUE_STATES of the tube and of kicked rollouts each.

A controller of every goal ("cartpole-goals", "quadrotor-goals") is judged at the paper's goal, like the others.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from ddp import problem as load_problem

import nocl
from nocl.comparisons.reference import SLOTS, resolved
from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.judge import Simulation, simulate
from nocl.nets import FeatureNet
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Problems, policy_controls
from nocl.solvers.cnd.validate import kicked_optima, tube_optima, value_scores
from nocl.solvers.ddp.bank import SolutionBank, better
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.starts import random_controls
from nocl.support.checks import Array

FINE = 640  # intervals of the reference
COLD = 48  # cold starts from each of the worst states
VALUE_STATES = 2048  # of the tube, and of kicked rollouts, on which V is judged


def from_there(x: Array, t: Array) -> Problems:
    """Problems without parameters."""
    return Problems(x, t, np.zeros((len(x), 0)))


def optimum(ocp: OCP, x0: Array, policy: FeatureNet) -> tuple[Solution, SolutionBank]:
    """The best solutions known from x0, on FINE intervals; those found on the usual grid as a bank."""
    coarse, fine = DDP(ocp), DDP(ocp, intervals=FINE)
    found = solve_globally(coarse, x0, starts=8, seed=99)
    own = policy_controls(policy, InTorch(ocp), from_there(x0, np.zeros(len(x0))), FINE)
    best = better(fine.solve(x0, u=np.repeat(found.u, FINE // coarse.intervals, axis=1)), fine.solve(x0, u=own))
    return best, SolutionBank.of(coarse, found[found.success])


def value_errors(ocp: OCP, cnd: nocl.CND, bank: SolutionBank, n: int, seed: int) -> dict[str, float]:
    """Mean |V - J*| / |J*|, and V_x against costates (medians), on n states of the tube about the bank's trajectories
    and n of the controller's own kicked rollouts, solved anew; none of them is among those that training drew. States
    from which no plan holds the constraints are left out."""
    acting, rng = (cnd.policy, InTorch(ocp)), np.random.default_rng(seed)
    fine = DDP(ocp, intervals=FINE // 2)
    usual = TrainSettings()
    sets = {"tube": tube_optima(DDP(ocp), fine, bank, *acting, n, usual.width, rng),
            "tails": kicked_optima(DDP(ocp), fine, bank, *acting, n, usual.kick, rng)}
    found, row = value_scores(cnd.value_net, *acting, sets), {}
    for where, s in sets.items():
        row |= {f"value_error_{where}_%": round(100 * found[f"{where}_error"], 3),
                f"value_gradient_{where}_degrees": round(found[f"{where}_degrees"], 3),
                f"value_slope_error_{where}_%": round(100 * found[f"{where}_slope_error"], 3),
                f"value_judged_{where}": len(s)}
    return row


def cost_of_kicks(ocp: OCP, policy: FeatureNet, run: Simulation, kicks: list[tuple[int, Array]]) -> Array:
    """The sum [B] over kicks of V*(x + dx, t) - V*(x, t) at the run's own states x, which it would cost the optimum."""
    nodes = (run.x.shape[1] - 1) // SLOTS
    after = np.concatenate([run.x[:, slot * nodes] for slot, _ in kicks])
    dx = np.concatenate([dx for _, dx in kicks])
    t = np.repeat([slot * ocp.horizon / SLOTS for slot, _ in kicks], len(run.x))
    ddp, in_torch, V = DDP(ocp, intervals=FINE // 2), InTorch(ocp), []
    for x in (after - dx, after):
        V.append(ddp.solve(x, t, u=policy_controls(policy, in_torch, from_there(x, t), ddp.intervals)).cost)
    with np.errstate(invalid="ignore"):  # inf - inf where neither was solved
        total: Array = (V[1] - V[0]).reshape(len(kicks), -1).sum(axis=0)
    return total


def explained(ocp: OCP, x0: Array, gap: float, cost: float) -> dict[str, Any]:
    """One of the worst initial states: what the controller costs there beside the optima of COLD cold starts."""
    ddp = DDP(ocp)
    s = ddp.solve(np.repeat(x0[None], COLD, axis=0), u=random_controls(ocp, ddp.intervals, COLD, 5))
    found = np.sort(s.cost[s.success])
    apart = np.append(True, np.diff(found) > 1e-3 * found[:-1]) if len(found) else []
    return {"x0": [round(v, 4) for v in x0.tolist()], "gap_%": round(100 * gap, 3), "controller": round(cost, 5),
            "optima": [round(float(v), 5) for v in found[apart][:6]]}


def quantiles(gap: Array) -> dict[str, float]:
    return {"median_%": round(100 * float(np.median(gap)), 4), "p95_%": round(100 * float(np.quantile(gap, 0.95)), 4),
            "max_%": round(100 * float(gap.max()), 3)}


def score(ocp: OCP, cnd: nocl.CND, n: int, sigma: float, seed: int = 12345) -> dict[str, Any]:
    """The row of one controller."""
    rng = np.random.default_rng(seed)
    x0 = ocp.initial_states.sample(n, rng)
    best, bank = optimum(ocp, x0, cnd.policy)
    run, known = simulate(ocp, cnd, x0), best.success
    gap = np.where(known, run.cost / best.cost - 1, -np.inf)
    row = {"failed": int((~run.success).sum()), "unsolved": int((~known).sum()),
           "J*": round(float(best.cost[known].mean()), 5), "gap": quantiles(gap[known]),
           "terminal_error": round(float(np.linalg.norm(ocp.from_goal(run.x[:, -1]), axis=1).mean()), 4),
           "control": round(float(run.control_magnitude.mean()), 3), "collisions": int((run.clearance < 0).sum()),
           "worst": [explained(ocp, x0[i], float(gap[i]), float(run.cost[i])) for i in np.argsort(-gap)[:3]]}
    slots = np.sort(rng.choice(np.arange(1, SLOTS - 1), 5, replace=False))
    pushes = [(int(s), sigma * rng.standard_normal(x0.shape)) for s in slots]
    kicked = simulate(ocp, cnd, x0, kicks=[(s * ocp.horizon / SLOTS, dx) for s, dx in pushes])
    kicked_best = resolved(ocp, best, pushes)
    row["kicked_gap"] = quantiles((kicked.cost / kicked_best - 1)[known])
    lost = (kicked.cost - best.cost - cost_of_kicks(ocp, cnd.policy, kicked, pushes)) / kicked_best
    told = np.isfinite(lost)
    row["kicked_loss"] = quantiles(lost[told]) | {"left_out": int((~told).sum())}
    x0, best = x0[known], best[known]
    V = cnd.value(x0, 0.0)
    row["value_error_%"] = round(100 * float(np.mean(np.abs(V / best.cost - 1))), 3)
    cosine = _cosine(cnd.value_gradient(x0, 0.0), best.V_x[:, 0])
    row |= value_errors(ocp, cnd, bank, VALUE_STATES, seed + 1)
    row["value_gradient_degrees"] = round(float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))), 2)
    return row


def _cosine(a: Array, b: Array) -> Array:
    return (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


def trained(ocp: OCP, dynamics: str, seed: int, keep: Path | None) -> tuple[nocl.CND, dict[str, float]]:
    """A controller and the seconds of its training, of the clock and of all threads; what is kept is what is scored."""
    model = nocl.identify(ocp.system, seed=seed) if dynamics == "learned" else None
    clock, cpu = time.perf_counter(), time.process_time()
    cnd = nocl.train(ocp, model, seed=seed)
    clock, cpu = time.perf_counter() - clock, time.process_time() - cpu
    times = {"train_seconds": round(clock, 1), "train_cpu_seconds": round(cpu, 1)}
    times |= {name: cnd.card[name] for name in ("fitting_seconds", "fitting_cpu_seconds")}
    return (cnd.rounded() if keep else cnd), times


COLUMNS = {"gap: median, %": ("gap", "median_%"), "95th percentile": ("gap", "p95_%"),
           "5 kicks: median, %": ("kicked_gap", "median_%"), "95th percentile, kicked": ("kicked_gap", "p95_%"),
           "lost by kicks: median, %": ("kicked_loss", "median_%"), "V: mean error, %": ("value_error_%",),
           "in the tube": ("value_error_tube_%",), "on kicked states": ("value_error_tails_%",),
           "grad V, degrees": ("value_gradient_degrees",), "terminal error": ("terminal_error",),
           "mean control": ("control",), "collisions": ("collisions",), "failed": ("failed",),
           "training, CPU s": ("train_cpu_seconds",)}


def table(names: list[str]) -> str:
    """Results of several files as markdown: a line a problem and dynamics, each figure from its least to its largest
    over the seeds."""
    rows = [row for name in names for row in json.loads((provenance.RESULTS / f"{name}.json").read_text())["rows"]]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["problem"], row["dynamics"]), []).append(row)
    lines = ["| " + " | ".join(["problem", "dynamics", "seeds", *COLUMNS]) + " |", "| --- " * (len(COLUMNS) + 3) + "|"]
    for (problem, dynamics), group in groups.items():
        seeds = ", ".join(str(s) for s in sorted(row["seed"] for row in group))
        cells = [problem, dynamics, seeds, *(spread(group, path) for path in COLUMNS.values())]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def spread(rows: list[dict[str, Any]], path: tuple[str, ...]) -> str:
    """The least and the largest of a figure, once where they are the same."""
    values: list[Any] = list(rows)
    for key in path:
        values = [v[key] for v in values]
    least, most = min(values), max(values)
    return f"{least:g}" if least == most else f"{least:g} .. {most:g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=["cartpole", "acrobot", "quadrotor", "dubins", "pendulum",
                                                        "cartpole-goals", "quadrotor-goals"])
    parser.add_argument("--dynamics", nargs="+", default=["exact", "learned"], choices=["exact", "learned"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--sigma", type=float, default=0.05)
    parser.add_argument("--keep", type=Path, help="save the controllers of the first seed in this folder")
    parser.add_argument("--results", default="controllers", help="benchmarks/results/RESULTS.json")
    parser.add_argument("--table", nargs="+", metavar="RESULTS", help="nothing is trained; these files as markdown")
    options, rows = parser.parse_args(), []
    if options.table:
        print(table(options.table))
        return
    for seed, problem, dynamics in product(options.seeds, options.problems, options.dynamics):
        ocp, keep = load_problem(problem), options.keep if seed == options.seeds[0] else None
        cnd, seconds = trained(ocp, dynamics, seed, keep)
        here = (ocp.at(ocp.nominal), cnd.at(ocp.nominal)) if ocp.np else (ocp, cnd)
        rows.append({"problem": problem, "dynamics": dynamics, "seed": seed, **seconds,
                     **score(*here, options.n, options.sigma)})
        print(rows[-1], flush=True)
        provenance.write(options.results, rows, n=options.n, sigma=options.sigma)
        if keep:
            cnd.card["score"] = rows[-1]
            cnd.save(keep / f"{problem}-{dynamics}")


if __name__ == "__main__":
    main()
