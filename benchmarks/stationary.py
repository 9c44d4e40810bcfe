"""Laws for ever: what they cost more than the optimum, and whether every run arrives.

    python benchmarks/stationary.py [--problems pendulum vanderpol ... --effort normal --n 200]

gap : the cost of a run under CVODES over 10 T, T that of training, to the least cost known: the best of solutions from
      the bank's nearest nodes, of global search from cold starts and of the run itself, on 4 times as many intervals
Results: benchmarks/results/stationary.json.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import provenance

import nocl
from nocl.definition.sampling import own_numbers
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.stationary import StationaryTraining
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.stationary_bank import pruned
from nocl.systems import cartpole, quadrotor

NODES = 160  # of a run, in each T


def pendulum(wide: bool) -> nocl.OCP:
    theta, omega, u = (ca.SX.sym(name) for name in ("theta", "omega", "u"))
    s = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=u, xdot=ca.vertcat(omega, 9.81 * ca.sin(theta) + u),
                    lbu=[-5], ubu=[5], lbx=[-7, -8], ubx=[7, 8], angles=["theta"])
    away = 2 * (1 - ca.cos(theta)) if wide else theta**2
    states = nocl.Uniform([-np.pi, -6], [np.pi, 6]) if wide else nocl.Gaussian([np.pi, 0], [0.3, 0.5])
    return forever(s, away + 0.1 * omega**2 + 0.1 * u**2, [0, 0], [0], states)


def vanderpol() -> nocl.OCP:
    a, b, u = (ca.SX.sym(name) for name in ("a", "b", "u"))
    s = nocl.System("vanderpol", x=ca.vertcat(a, b), u=u, xdot=ca.vertcat(b, (1 - a**2) * b - a + u), lbu=[-1],
                    ubu=[1], lbx=[-4, -6], ubx=[4, 6])
    return forever(s, a**2 + b**2 + 0.1 * u**2, [0, 0], [0], nocl.Uniform([-2.5, -2.5], [2.5, 2.5]))


def swing(wide: bool) -> nocl.OCP:
    s = cartpole.system()
    p, v, theta, omega = ca.vertsplit(s.x)
    away = 2 * (1 - ca.cos(theta)) if wide else theta**2
    half = np.array([1, 1.5, np.pi, 3])
    states = nocl.Uniform(-half, half) if wide else nocl.Gaussian([0, 0, np.pi, 0], [0.3] * 4)
    return forever(s, p**2 + 0.1 * v**2 + away + 0.1 * omega**2 + 0.1 * ca.sumsqr(s.u), [0] * 4, [0], states)


def hover() -> nocl.OCP:
    s, usual = quadrotor.system(), quadrotor.ocp()
    weights, spread = np.repeat([1, 0.1, 0.1, 0.01], 3), np.repeat([1.5, 0.2, 0.5, 0.3], 3)
    away = ca.dot(ca.DM(weights), s.x**2) + 0.01 * ca.sumsqr(s.u - ca.DM(usual.u_goal))
    return forever(s, away, [0] * 12, usual.u_goal, nocl.Gaussian([0] * 12, spread))


def forever(system: nocl.System, running: ca.SX, x_goal: Any, u_goal: Any, states: Any) -> nocl.OCP:
    return nocl.OCP(system, horizon=nocl.INFINITE, running=running, x_goal=x_goal, u_goal=u_goal, initial_states=states)


PROBLEMS: dict[str, Callable[[], nocl.OCP]] = {
    "pendulum": lambda: pendulum(False), "pendulum, wide": lambda: pendulum(True), "vanderpol": vanderpol,
    "cartpole": lambda: swing(False), "cartpole, wide": lambda: swing(True), "quadrotor": hover}


def measured(name: str, effort: str, n: int) -> dict[str, Any]:
    ocp, begin = PROBLEMS[name](), time.process_time()
    training = StationaryTraining(ocp, TrainSettings.of(effort), 0, False, None)
    law = training.run()
    seconds = time.process_time() - begin
    x0, T = ocp.initial_states.sample(n, own_numbers(0, 7)), float(training.posed.horizon)
    run = nocl.simulate(ocp, law, x0, duration=10 * T, nodes=10 * NODES + 1)
    best = known(training, x0, run)
    gap = 100 * (np.where(run.success, run.cost, np.inf) / best - 1)
    order = np.argsort(-gap)[:5]
    median, p95 = np.percentile(gap, [50, 95], method="higher")
    away = np.full(n, np.inf)
    away[run.reached] = training.lqr.value(run.x[run.reached, -1])
    gaps = {"median": float(median), "p95": float(p95), "worst": float(gap.max())}
    return {"CPU s": round(seconds, 1), "T": T, "n": n, "gap %": gaps,
            "arrive": float((away < training.level).mean()), "worst states": x0[order].tolist(),
            "rounds": len(training.history) - 1}


def known(training: StationaryTraining, x0: np.ndarray, run: Any) -> np.ndarray:
    """[n], the least cost known."""
    def cut(found: Any) -> Any:
        return pruned(training.loose, found, training.lqr, training.level)

    none, K = np.zeros((len(x0), 0)), training.loose.intervals
    best = training.bank.solve(training.loose, x0, none, 4)
    cold = solve_globally(training.ddp, x0, starts=16, seed=5, progress=False)
    finer = np.repeat(cold.u, K // training.ddp.intervals, axis=1)
    best = better(best, cut(training.loose.solve(x0, u=finer, progress=False)))
    part = ((np.arange(K) + 0.5) * NODES / K).astype(int)  # of the first T
    own = np.where(np.isfinite(run.u[:, part]), run.u[:, part], training.ocp.u_goal)
    best = better(best, cut(training.loose.solve(x0, u=np.ascontiguousarray(own), progress=False)))
    return np.asarray(best.cost)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=tuple(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--n", type=int, default=200)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = provenance.kept("stationary")
    for name in args.problems:
        rows[name] = measured(name, args.effort, args.n) | {"commit": provenance.STARTED}
        print(name, rows[name], flush=True)
        provenance.write("stationary", rows)


if __name__ == "__main__":
    main()
