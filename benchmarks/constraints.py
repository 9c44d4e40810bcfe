"""Constraints held in DDP: how surely, how exactly and how fast, on four problems with active ones.

    python benchmarks/constraints.py --problems cartpole point

cold   24 initial states, 8 starts each (smooth random controls): the share of starts and of states solved, the largest
       violation at a node in units of the constraint's scale
exact  the best of each of a few states, against IPOPT on the same nodes: the largest relative difference of cost,
       costates and gains (these at every eighth node, where the problem that begins there has neighbours at all)
warm   400 tails, from kicked states along the solutions, with active constraints: CPU time a tail on one core; then
       on the system without constraints (terminal equalities as weights of its terminal cost), and for some of the
       same tails fatrop from the same guesses, through CasADi's virtual machine

Results go to benchmarks/results/constraints.json.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from dataclasses import replace

import casadi as ca
import numpy as np
import provenance

from nocl.data import Solution
from nocl.solvers.ddp.bank import SolutionBank
from nocl.solvers.ddp.constraints import ConstraintRows
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.starts import random_controls

sys.path.insert(0, str(provenance.ROOT / "tests"))
from constrained import PROBLEMS, Problem, Shooting

STATES, STARTS, TAILS, KICK = 24, 8, 400, 0.02
LAST = 0.75  # of the horizon, where the last tails begin
ACTIVE = 1e-6  # of a scale: closer rows are active


def solver(problem: Problem, rows: ConstraintRows, intervals: int) -> DDP:
    ddp = DDP(problem.ocp, intervals=intervals, substeps=1, rows=rows, threads=1)
    ddp.checked = True  # the grid is the same for all that are compared
    return ddp


def unconstrained(problem: Problem) -> Problem:
    ocp = problem.ocp
    pull = sum((c**2 for _, c, _ in problem.equal), ca.SX(0))
    return Problem(replace(ocp, terminal=ocp.terminal + pull, path_constraints={}), [])


def cold(ddp: DDP, seed: int) -> tuple[Solution, float]:
    """Every start of every state, and the CPU seconds."""
    ocp, K = ddp.ocp, ddp.intervals
    x0 = np.repeat(ocp.initial_states.sample(STATES, seed), STARTS, axis=0)
    u = random_controls(ocp, K, len(x0), np.random.default_rng(seed), np.zeros((len(x0), 0)))
    begin = time.process_time()
    return ddp.solve(x0, u=u), time.process_time() - begin


def violation(problem: Problem, s: Solution) -> np.ndarray:
    """The largest at a node of each plan, in scales; of what its controls can change."""
    K = s.u.shape[1]
    program = Shooting(problem, K)
    worst = np.zeros(len(s))
    for i, (x, u) in enumerate(zip(s.x, s.u, strict=True)):
        held = [program.first(x[0], u[0]), program.stage(x[1:K].T, u[1:].T), program.end(x[K])]
        worst[i] = max([0.0, *(-c.full().min(initial=0.0) for c in held),
                        np.abs(program.equal(x[K]).full()).max(initial=0.0)])
    return worst


def cold_row(problem: Problem, ddp: DDP, s: Solution, seconds: float) -> dict:
    cost = s.cost.reshape(STATES, STARTS)
    solved = np.isfinite(cost).any(axis=1)
    best = cost.min(axis=1, keepdims=True)
    return {"starts solved": float(s.success.mean()), "states solved": float(solved.mean()),
            "starts at the best": float((cost <= best * (1 + 1e-3))[solved].mean()),
            "worst violation": float(violation(problem, s[s.success]).max()),
            "iterations, median": float(np.median(s.iterations)), "ms a start": 1e3 * seconds / len(s),
            "failures": dict(Counter(text.split(", worst")[0] for text in s.message[~s.success]))}


def best_of(s: Solution, count: int) -> Solution:
    rows = s.cost.reshape(STATES, STARTS).argmin(axis=1) + STARTS * np.arange(STATES)
    rows = rows[s.success[rows]]
    return s[rows[:count]]


def exact_row(problem: Problem, s: Solution) -> dict:
    K = s.u.shape[1]
    program, worst = Shooting(problem, K), Counter()
    for i in range(len(s)):
        other = program.solve(s.x[i, 0], s.t[i, 1] - s.t[i, 0], s.x[i], s.u[i] + 1e-4)
        costate = other.costate()
        worst["cost"] = max(worst["cost"], abs(s.cost[i] / other.cost - 1))
        worst["costates"] = max(worst["costates"], np.abs(s.V_x[i, 1:] - costate).max() / np.abs(costate).max())
        gains = {k: other.gain(k) for k in range(1, K, 8)}
        known = {k: gain for k, gain in gains.items() if np.isfinite(gain).all()}
        size = max(np.abs(gain).max() for gain in known.values())
        off = max(np.abs(s.gain[i, k] - gain).max() for k, gain in known.items())
        worst["gains"] = max(worst["gains"], off / size)
    return {"states": len(s), **{f"difference of {name}": float(value) for name, value in worst.items()}}


def tails(ddp: DDP, s: Solution, seed: int) -> tuple[np.ndarray, np.ndarray, dict]:
    """(x0, t0, guess) of tails from kicked states along solutions."""
    bank, rng = SolutionBank.of(ddp, s), np.random.default_rng([seed, 1])
    K, many = ddp.intervals, 4 * TAILS
    row, k = rng.integers(0, len(bank), many), rng.integers(0, int(LAST * K), many)
    t0 = bank.solution.t[row, k]
    x0 = bank.solution.x[row, k] + KICK * rng.standard_normal((many, ddp.ocp.system.nx))
    return x0, t0, bank.guess(row, t0, x0)


def warm_row(problem: Problem, ddp: DDP, s: Solution, seed: int, beside: int) -> dict:
    x0, t0, guess = tails(ddp, s, seed)
    kept = active(problem, ddp.solve(x0, t0, **guess))
    x0, t0, guess = x0[kept], t0[kept], {name: value[kept] for name, value in guess.items()}
    held, seconds = timed(lambda: ddp.solve(x0, t0, **guess))
    free = unconstrained(problem)
    other = solver(free, ConstraintRows(), ddp.intervals)
    x1, t1, guess1 = tails(other, cold(other, seed)[0], seed)
    loose, quick = timed(lambda: other.solve(x1[:TAILS], t1[:TAILS], **{n: v[:TAILS] for n, v in guess1.items()}))
    row = {"tails": len(x0), "solved": float(held.success.mean()), "ms a tail": 1e3 * seconds / len(x0),
           "iterations": float(held.iterations.mean()), "without constraints, ms a tail": 1e3 * quick / len(loose),
           "without constraints, iterations": float(loose.iterations.mean())}
    row["times the unconstrained"] = row["ms a tail"] / row["without constraints, ms a tail"]
    if ca.has_nlpsol("fatrop"):
        row |= fatrop_row(problem, ddp, held, {n: v[:beside] for n, v in guess.items()}, beside)
        row["fatrop's time over ours"] = row["fatrop, ms a tail"] / row["ms a tail"]
    return row


def active(problem: Problem, s: Solution) -> np.ndarray:
    """The first TAILS rows that are infeasible at no start, and have an active row along their plan."""
    program, K = Shooting(problem, s.u.shape[1]), s.u.shape[1]
    near = np.array([min(program.stage(x[1:K].T, u[1:].T).full().min(initial=np.inf),
                         program.end(x[K]).full().min(initial=np.inf)) for x, u in zip(s.x, s.u, strict=True)])
    outside = np.char.find(s.message, "the initial state itself") >= 0
    return np.flatnonzero(~outside & (near < ACTIVE))[:TAILS]


def timed(run, repeat: int = 3):
    """(result, least CPU seconds)."""
    least = np.inf
    for _ in range(repeat):
        begin = time.process_time()
        result = run()
        least = min(least, time.process_time() - begin)
    return result, least


class Fatrop:
    """The same program with x_0 a variable, in the order that fatrop's recursion needs."""

    def __init__(self, problem: Problem, intervals: int) -> None:
        of, K = Shooting(problem, intervals), intervals
        x, u = ([ca.MX.sym(f"{name}{k}", n) for k in range(K + 1)] for name, n in (("x", of.n), ("u", of.m)))
        start, h = ca.MX.sym("start", of.n), ca.MX.sym("h")
        cost, g, equal, upper = problem.ocp.G(x[K]), [], [], []
        s = problem.ocp.system

        def add(c: ca.MX, equality: bool, top: float = np.inf) -> None:
            g.append(c)
            equal.extend([equality] * c.numel())
            upper.extend([0.0 if equality else top] * c.numel())

        for k in range(K):
            after, part = of.step(x[k], u[k], h)
            cost += part
            add(x[k + 1] - after, True)
            if k == 0:
                add(x[0] - start, True)
            add((of.first if k == 0 else of.stage)(x[k], u[k]), False)
        add(of.end(x[K]), False)
        add(of.equal(x[K]), True)
        z = [part for k in range(K) for part in (x[k], u[k])] + [x[K]]
        options = {"structure_detection": "auto", "equality": equal, "expand": True, "print_time": False,
                   "fatrop.print_level": 0, "fatrop.tol": 1e-8, "fatrop.mu_init": 1e-3, "error_on_fail": False}
        nlp = {"x": ca.vertcat(*z), "f": cost, "g": ca.vertcat(*g), "p": ca.vertcat(start, h)}
        self.solve = ca.nlpsol("tail", "fatrop", nlp, options)
        free = np.full(of.n, np.inf)
        self.low, self.high = (np.r_[np.tile(np.r_[sign * free, limit], K), sign * free]
                               for sign, limit in ((-1, s.lbu), (1, s.ubu)))
        self.upper = np.array(upper)

    def __call__(self, x: np.ndarray, u: np.ndarray, h: float) -> tuple[float, bool]:
        guess = np.r_[np.c_[x[:-1], u].ravel(), x[-1]]
        got = self.solve(x0=guess, p=np.r_[x[0], h], lbx=self.low, ubx=self.high, lbg=0, ubg=self.upper)
        return float(got["f"]), bool(self.solve.stats()["success"])


def fatrop_row(problem: Problem, ddp: DDP, s: Solution, guess: dict, count: int) -> dict:
    """Guesses are rolled out under their feedback, as DDP's are."""
    program = Fatrop(problem, ddp.intervals)
    begin, same, done = time.process_time(), 0, 0
    for i in range(min(count, len(s))):
        x = guess["x"][i].copy()
        x[0] = s.x[i, 0]
        cost, success = program(x, guess["u"][i], s.t[i, 1] - s.t[i, 0])
        done += success
        same += success and abs(cost / s.cost[i] - 1) < 1e-5
    n = min(count, len(s))
    return {"fatrop, ms a tail": 1e3 * (time.process_time() - begin) / n, "fatrop, solved": done / n,
            "fatrop, the same cost": same / n}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=tuple(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--intervals", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exact", type=int, default=4, help="states that IPOPT solves too")
    parser.add_argument("--beside", type=int, default=40, help="tails that fatrop solves too")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = {}
    for name in args.problems:
        problem = PROBLEMS[name]()
        ddp = solver(problem, problem.rows, args.intervals)
        s, seconds = cold(ddp, args.seed)
        rows[name] = {"cold": cold_row(problem, ddp, s, seconds), "exact": exact_row(problem, best_of(s, args.exact)),
                      "warm": warm_row(problem, ddp, best_of(s, STATES), args.seed, args.beside)}
        print(name, *(f"  {section}: {row}" for section, row in rows[name].items()), sep="\n", flush=True)
    provenance.write("constraints", rows)


if __name__ == "__main__":
    main()
