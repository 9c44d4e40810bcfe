"""A plant that is not the nominal one: what is lost by a policy that does not know, and by one that estimates.

    python benchmarks/wrong_models.py [--effort normal --n 200]

A cart-pole's length, both masses, gain and friction lie anywhere within 30 % (friction: 0 to 0.5), drawn for each
initial state; the goal is fixed. One policy u(x, t, p), trained over all of them, is told the truth, the nominal p, or
what ParameterEstimator makes of the states that it has seen so far. All are sampled 80 times and judged under CVODES,
against the optimum of many starts at the true p. Results go to benchmarks/results/wrong_models.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import provenance

import nocl
from nocl.comparisons.reproduce.goals import CART, POLE, cartpole_problem
from nocl.definition.sampling import own_numbers
from nocl.solvers import DDP, solve_globally
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.estimation import Adaptive, ParameterEstimator
from nocl.support.checks import Array

HOLD = 80


def policies(ocp: nocl.OCP, cnd: nocl.CND, noise: Array) -> dict[str, Callable[..., Array]]:
    """What is told the truth, what is not, and what estimates, from states that are measured without and with noise."""
    known = ocp.nominal[:ocp.system.np]
    rng = np.random.default_rng(5)

    def nominal(x: Array, t: float, p: Array) -> Array:
        return cnd(x, t, np.c_[np.tile(known, (len(p), 1)), p[:, len(known):]])

    def of(scale: float) -> Adaptive:
        return Adaptive(cnd, ParameterEstimator(ocp, ocp.horizon / HOLD, noise=scale * noise + 1e-5 * noise))

    clean, noisy = of(0.01), of(1.0)
    return {"told": cnd, "nominal": nominal, "estimated": clean,
            "estimated from noisy states": lambda x, t, p: noisy(x + noise * rng.standard_normal(x.shape), t, p)}


def trained(ocp: nocl.OCP, effort: str) -> nocl.CND:
    return nocl.train(ocp, settings=TrainSettings.of(effort, parameters=ocp.np, value=False), progress=False)


def lost(cost: Array, best: Array) -> dict[str, float]:
    gap = 100 * (cost - best) / np.abs(best)
    median, p95 = np.percentile(gap, [50, 95], method="higher")
    return {"median": float(median), "mean": float(gap.mean()), "p95": float(p95), "worst": float(gap.max())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--law", help="the folder of a controller of this problem, in place of training one")
    args = parser.parse_args()
    ocp = cartpole_problem(**POLE, **CART)
    cnd = nocl.CND.load(args.law) if args.law else trained(ocp, args.effort)
    x0, p = ocp.initial_states.sample(args.n, own_numbers(0, 7)), ocp.sample_parameters(args.n, own_numbers(0, 8))
    best = solve_globally(DDP(ocp, intervals=HOLD), x0, p=p, starts=16, progress=False)
    optimum = nocl.simulate(ocp, best.u, x0, p=p).cost
    noise = np.array([1e-3, 1e-2, 1e-3, 1e-2])  # m, m/s, rad, rad/s
    costs = {name: nocl.simulate(ocp, law, x0, p=p, hold=HOLD).cost for name, law in policies(ocp, cnd, noise).items()}
    least = np.minimum.reduce([optimum, *costs.values()])
    rows: dict[str, Any] = {name: lost(cost, least) for name, cost in costs.items()}
    provenance.write("wrong_models", rows, n=args.n, noise=noise.tolist(), parameters=list(ocp.parameter_names))
    for name, row in rows.items():
        print(f"{name}: " + ", ".join(f"{what} {value:.3g} %" for what, value in row.items()))


if __name__ == "__main__":
    main()
