"""Minimum time by DDP: how surely, how exactly and how fast, against analytic answers and NMPC on the same nodes.

    python benchmarks/minimum_time.py --problems integrator pendulum

cold    initial states, 8 starts each (u*, then smooth random controls; each start with another horizon): the share of
        starts and of states solved, CPU time a start
exact   the best of each state: its time beside the analytic one, where there is one (controls are held, so that a
        switch between nodes costs a little), and the largest violation of a constraint at a node
nmpc    a few of them solved by IPOPT, warm from DDP's answer: the largest relative difference of cost and costates; and
        by NMPC from starts of its own: how many it solves, and how many costs differ by more than a thousandth

Results go to benchmarks/results/minimum_time.json.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import provenance

import nocl
from nocl.data import Solution
from nocl.solvers import DDP, NMPC
from nocl.solvers.starts import random_controls, spread_horizon

STARTS = 8
LIMIT = 0.8  # of the double integrator's speed, in the variant that has one
SAME = 1e-3  # costs closer than this, relative, are one optimum


@dataclass(frozen=True, eq=False)
class Case:
    """A problem, its nodes, and the analytic least time of states x0 [B, nx], where it is known."""

    ocp: nocl.OCP
    intervals: int = 80
    limit: float | None = None
    analytic: bool = False


def integrator(**options: object) -> nocl.OCP:
    p, v, u = (ca.SX.sym(name) for name in "pvu")
    system = nocl.System("integrator", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1],
                         lbx=[-5, -5], ubx=[5, 5])
    common = {"initial_states": nocl.Uniform([-2, -1], [2, 1]), **options}
    return nocl.OCP(system, horizon=nocl.Free(0.05, 10), running=1.0, terminal=0.0, x_goal=[0, 0], u_goal=[0],
                    terminal_constraints={"at p": (0, p, 0), "at v": (0, v, 0)}, **common)


def pendulum(**options: object) -> nocl.OCP:
    theta, omega, u = (ca.SX.sym(name) for name in ("theta", "omega", "u"))
    system = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=u,
                         xdot=ca.vertcat(omega, 9.81 * ca.sin(theta) + u), lbu=[-5], ubu=[5], lbx=[-7, -8], ubx=[7, 8])
    return nocl.OCP(system, horizon=nocl.Free(0.5, 10), running=1 + 1e-3 * u**2, terminal=0.0, x_goal=[0, 0],
                    u_goal=[0], initial_states=nocl.Uniform([np.pi - 0.3, -0.3], [np.pi + 0.3, 0.3]),
                    terminal_constraints={"at theta": (0, theta, 0), "at omega": (0, omega, 0)}, **options)


CASES = {
    "integrator": lambda: Case(integrator(), analytic=True),
    "integrator, speed": lambda: Case(
        integrator(state_bounds={"v": (-LIMIT, LIMIT)}, initial_states=nocl.Uniform([-2, -LIMIT], [2, LIMIT])),
        limit=LIMIT, analytic=True),
    "pendulum": lambda: Case(pendulum(), 100),
    "pendulum, speed": lambda: Case(pendulum(state_bounds={"omega": (-6, 6)}), 100),
}


def least_time(x: np.ndarray, limit: float | None) -> np.ndarray:
    """The double integrator's: from the right of the switching curve p = -v |v| / 2 first u = -1, then +1; with a limit
    w of the speed it coasts at -w between them."""
    p, v = x.T
    side = np.where(p + v * np.abs(v) / 2 != 0, np.sign(p + v * np.abs(v) / 2), np.sign(v))
    p, v = side * p, side * v
    fastest = np.sqrt(np.maximum(p + v**2 / 2, 0))
    if limit is None:
        return v + 2 * fastest
    coast = np.maximum(p + v**2 / 2 - limit**2, 0) / limit
    return v + 2 * np.minimum(fastest, limit) + coast


def guesses(case: Case, states: int, seed: int) -> dict[str, np.ndarray]:
    """STARTS of each state, one after the other."""
    ocp, K, n = case.ocp, case.intervals, states * STARTS
    u = random_controls(ocp, K, n, np.random.default_rng(seed), np.zeros((n, 0)))
    u[::STARTS] = ocp.u_goal
    T = np.tile([spread_horizon(ocp.horizon, i) for i in range(STARTS)], states)
    return {"u": u, "t": T[:, None] * np.linspace(0, 1, K + 1)}


def cold_row(s: Solution, states: int, seconds: float) -> dict[str, object]:
    cost = s.cost.reshape(states, STARTS)
    solved = np.isfinite(cost).any(axis=1)
    best = cost.min(axis=1, keepdims=True)
    return {"states": states, "starts solved": float(s.success.mean()),
            "first starts solved": float(s.success[::STARTS].mean()), "states solved": float(solved.mean()),
            "starts at the best": float((cost <= best * (1 + SAME))[solved].mean()),
            "iterations, median": float(np.median(s.iterations)), "ms a start": 1e3 * seconds / len(s),
            "failures": dict(Counter(text.split(", worst")[0] for text in s.message[~s.success]))}


def exact_row(case: Case, s: Solution) -> dict[str, float]:
    row = {"worst violation": float(np.maximum(-s.clearance, 0).max())}
    if case.analytic:
        off = s.t[:, -1] / least_time(s.x[:, 0], case.limit) - 1
        row |= {"time over the analytic, median": float(np.median(off)), "... worst": float(off.max()),
                "... least": float(off.min())}
    return row


def nmpc_row(case: Case, s: Solution, starts: int) -> dict[str, float]:
    nmpc = NMPC(case.ocp, case.intervals, substeps=1, solver="ipopt", starts=starts, passes=0)
    warm = nmpc.solve(s.x[:, 0], replace(s, tried=None), workers=1, progress=False)
    both = warm.success & (np.abs(warm.cost / s.cost - 1) < SAME)
    size = np.abs(s.V_x).max(axis=(1, 2))
    begin = time.process_time()
    own = nmpc.solve(s.x[:, 0], workers=1, progress=False)
    seconds = time.process_time() - begin
    return {"states": len(s), "warm, the same optimum": float(both.mean()),
            "difference of cost": float(np.abs(warm.cost / s.cost - 1)[both].max()),
            "difference of costates": float((np.abs(warm.V_x - s.V_x).max(axis=(1, 2)) / size)[both].max()),
            "NMPC's own, solved": float(own.success.mean()), "ms a start": 1e3 * seconds / (len(s) * starts),
            "NMPC's cost lower": float((own.cost < s.cost * (1 - SAME)).mean()),
            "DDP's cost lower": float((s.cost < own.cost * (1 - SAME)).mean())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=tuple(CASES), default=list(CASES))
    parser.add_argument("--states", type=int, default=200)
    parser.add_argument("--beside", type=int, default=8, help="states that NMPC solves too")
    parser.add_argument("--nmpc-starts", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = {}
    for name in args.problems:
        case = CASES[name]()
        ddp = DDP(case.ocp, intervals=case.intervals, substeps=1, threads=1)
        ddp.checked = True
        x0 = np.repeat(case.ocp.initial_states.sample(args.states, args.seed), STARTS, axis=0)
        guess, begin = guesses(case, args.states, args.seed), time.process_time()
        s = ddp.solve(x0, **guess)
        seconds = time.process_time() - begin
        best = s[s.cost.reshape(-1, STARTS).argmin(axis=1) + STARTS * np.arange(args.states)]
        best = best[best.success]
        rows[name] = {"cold": cold_row(s, args.states, seconds), "exact": exact_row(case, best)}
        print(name, *(f"  {section}: {row}" for section, row in rows[name].items()), sep="\n", flush=True)
        if args.beside:
            rows[name]["nmpc"] = nmpc_row(case, best[:args.beside], args.nmpc_starts)
            print(f"  nmpc: {rows[name]['nmpc']}", flush=True)
    provenance.write("minimum_time", rows)


if __name__ == "__main__":
    main()
