"""Which constants of the search over states find the best known optimum on the most states for the least work.

    python benchmarks/search.py                           # DDP: 8 minutes on one core; NMPC far longer. Rows are kept
    python benchmarks/search.py --problems dubins --solvers NMPC

Work is counted in iterations of the solver for each state, which no other load of the machine changes. The best known
cost of a state is the least that any of these runs and one thorough run found.

rounds   solve with few cold starts, by DDP and by NMPC, under each set of constants of nocl.solvers.search
starts   cold starts alone, under each set of constants of nocl.solvers.starts

Results go to benchmarks/results/search.json, a provenance for each row.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType

import numpy as np
import provenance

import nocl
from nocl.data import SAME, TINY, Solution
from nocl.solvers import search, starts
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.nmpc.solver import NMPC
from nocl.support import store
from nocl.support.checks import Array

PATH = provenance.RESULTS / "search.json"
PROBLEMS = ("cartpole, wide box", "acrobot", "dubins", "pendulum")
SOLVERS = ("DDP", "NMPC")
SECTIONS = ("rounds", "starts")
INTERVALS = 40
COLD = 4  # starts before the rounds: few, so that the rounds have something to find
ALONE = 8  # ... where there are no rounds
DDP_WAS = {"MORE": 1, "PASSING": 1, "AFAR": 0, "FRESH": 1, "SURE": 0.0, "SHARE": 0.5}
NMPC_WAS = {"MORE": 0, "PASSING": 0, "AFAR": 1, "FRESH": 2, "SURE": 0.3, "SHARE": 0.0}
ROUNDS = {
    "as DDP had it": DDP_WAS,
    "as NMPC had it": NMPC_WAS,
    "DDP's, and from afar": DDP_WAS | {"AFAR": 1},
    "DDP's, none passing by": DDP_WAS | {"PASSING": 0},
    "DDP's, the same neighbours": DDP_WAS | {"MORE": 0},
    "DDP's, fresh starts of those in doubt alone": DDP_WAS | {"SHARE": 0.0, "SURE": 0.3},
    "DDP's, two fresh starts": DDP_WAS | {"FRESH": 2},
    "NMPC's, and passing by": NMPC_WAS | {"PASSING": 1},
}
STARTS = {"as DDP had it": {"WAVES": 8, "QUIETEST": 0.003}, "as NMPC had it": {"WAVES": 4, "QUIETEST": 0.05},
          "few waves": {"WAVES": 4, "QUIETEST": 0.003}, "loud": {"WAVES": 8, "QUIETEST": 0.05}}


@contextmanager
def constants(module: ModuleType, values: dict[str, float]) -> Iterator[None]:
    """A module with other constants, and back."""
    former = {name: getattr(module, name) for name in values}
    try:
        for name, value in values.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in former.items():
            setattr(module, name, value)


def problem(name: str) -> nocl.OCP:
    if name != "cartpole, wide box":
        return nocl.load_ocp(name)
    box = nocl.Uniform(lb=[-2, -3, -np.pi, -5], ub=[2, 3, np.pi, 5])
    return replace(nocl.load_ocp("cartpole"), initial_states=box)


def solved(solver: str, ocp: nocl.OCP, x0: Array, seed: int, cold: int, rounds: int) -> Solution:
    if solver == "DDP":
        ddp = DDP(ocp, intervals=INTERVALS)
        return solve_globally(ddp, x0, starts=cold, rounds=rounds, seed=seed, progress=False)
    return NMPC(ocp, INTERVALS, starts=cold, passes=rounds, seed=seed).solve(x0, workers=1, progress=False)


def runs(section: str, solver: str, ocp: nocl.OCP, x0: Array, seed: int) -> dict[str, Solution]:
    """Each set of constants, and a thorough run."""
    module, sets = (search, ROUNDS) if section == "rounds" else (starts, STARTS)
    cold, rounds = (COLD, 8 if solver == "DDP" else 4) if section == "rounds" else (ALONE, 0)
    found = {"thorough": solved(solver, ocp, x0, seed + 4711, 4 * ALONE, 8)}
    for name, values in sets.items():
        with constants(module, values):
            found[name] = solved(solver, ocp, x0, seed, cold, rounds)
    return found


def rows(found: dict[str, Solution]) -> dict[str, dict[str, float]]:
    """Share of states at the best known cost, and work, of each run."""
    best = np.min([s.cost for s in found.values()], axis=0)
    near = np.maximum(SAME * np.abs(best), TINY)
    return {name: {"share at the best known": float((s.cost <= best + near).mean()),
                   "iterations a state": float(s.iterations.mean()), "starts a state": float(s.starts.mean())}
            for name, s in found.items()}


def keep(section: str, key: str, found: dict[str, dict[str, float]], more: dict[str, int]) -> None:
    result = json.loads(PATH.read_text()) if PATH.exists() else {}
    result.setdefault(section, {})[key] = {"made": provenance.made(), **more, "rows": found}
    store.write_text(PATH, json.dumps(result, indent=1) + "\n")
    for name, row in found.items():
        print(f"  {name:45s}" + "  ".join(f"{k} {v:8.3f}" for k, v in row.items()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sections", nargs="+", default=list(SECTIONS), choices=SECTIONS)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=PROBLEMS)
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--many", type=int, default=200, help="states that DDP solves")
    parser.add_argument("--states", type=int, default=24, help="that NMPC solves")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for solver in args.solvers:
        for name in args.problems:
            ocp, n = problem(name), args.many if solver == "DDP" else args.states
            x0 = ocp.initial_states.sample(n, args.seed + 5)
            for section in args.sections:
                print(f"{section}, {solver}, {name}", flush=True)
                found = runs(section, solver, ocp, x0, args.seed)
                keep(section, f"{solver}, {name}", rows(found), {"states": n, "seed": args.seed})


if __name__ == "__main__":
    main()
