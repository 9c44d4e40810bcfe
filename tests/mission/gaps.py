"""Gaps of the controllers that come with nocl on fixed states: the numbers of tests/data/gaps.json, and how they arise.

    python tests/mission/gaps.py      # measures again and replaces the file: for controllers that were trained anew

J* of a state is the least cost known: DDP's on FINE held controls, from the best of a global search and from what the
controllers do themselves. It is kept, so that a gap tells of the controller and the judge alone.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import nocl
from nocl.solvers import DDP, solve_globally
from nocl.support.checks import Array

FILE = Path(__file__).parents[1] / "data" / "gaps.json"
PROBLEMS = ("pendulum", "cartpole", "acrobot", "quadrotor", "dubins")
DYNAMICS = ("exact", "learned")
GOALS = {"cartpole": DYNAMICS, "quadrotor": DYNAMICS}  # a controller of every goal ships, too: asked at the usual one
STATES, SEED = 10, 2024
FINE = 320  # intervals


def shipped(problem: str) -> dict[str, nocl.CND]:
    """The controllers of a problem, by a name of each."""
    found = {dynamics: nocl.pretrained(problem, dynamics) for dynamics in DYNAMICS}
    for dynamics in GOALS.get(problem, ()):
        every = nocl.pretrained(f"{problem}-goals", dynamics)
        found[f"goals, {dynamics}"] = every.at(every.ocp.nominal)
    return found


def costs(problem: str, law: nocl.CND, x0: Array) -> Array:
    """[B], the judge's cost of a controller as continuous feedback from x0 [B, nx]; inf where it failed."""
    return np.asarray(nocl.simulate(nocl.load_ocp(problem), law, x0).cost)


def searched(problem: str, x0: Array) -> Array:
    """[B], the cost that the global search finds on the usual grid."""
    return np.asarray(solve_globally(DDP(nocl.load_ocp(problem), between=False), x0, seed=0).cost)


def optimum(problem: str, x0: Array) -> Array:
    """[B], J*."""
    ocp = nocl.load_ocp(problem)
    coarse, fine = DDP(ocp), DDP(ocp, intervals=FINE, constraints="soft")
    found = solve_globally(coarse, x0, seed=0)
    guesses = [np.repeat(found.u, FINE // coarse.intervals, axis=1)]
    guesses += [nocl.simulate(ocp, law, x0, nodes=FINE + 1).u[:, :-1] for law in shipped(problem).values()]
    return np.min([fine.solve(x0, u=u).cost for u in guesses], axis=0)


def measured(problem: str) -> dict[str, object]:
    x0 = nocl.load_ocp(problem).initial_states.sample(STATES, SEED)
    best = optimum(problem, x0)
    gaps = {name: (costs(problem, law, x0) / best - 1).tolist() for name, law in shipped(problem).items()}
    return {"x0": x0.tolist(), "best": best.tolist(), "searched": searched(problem, x0).tolist(), "gap": gaps}


if __name__ == "__main__":
    FILE.write_text(json.dumps({problem: measured(problem) for problem in PROBLEMS}, indent=1) + "\n")
