"""Tracking by one policy u(x, t, p) on a cart-pole: a reference with p in it, one of samples, and a preview window.

    python benchmarks/references.py [--kinds expression samples preview --effort normal]

- expression: r(t) = A sin(w t + phi) with p = (A, w, phi), on a horizon of 4 s
- samples: r(t) a spline through p = (r_0 ... r_6) on the same horizon
- preview: the policy of `samples` on 2.4 s, asked at t = 0 all the time, p the window r(now ... now + 2.4 s) of a long
  reference; against DDP solved anew for every step from the same window

Gaps are to the optimum of many starts, under CVODES, on fresh (x0, p). Results: benchmarks/results/references.json.
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
from nocl.comparisons.comparison import compare
from nocl.comparisons.studies import FINE, with_reference
from nocl.definition.sampling import own_numbers
from nocl.solvers import DDP
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.ddp.global_search import GlobalDDP
from nocl.support.checks import Array
from nocl.systems import cartpole

SAMPLES, STEP = 7, 0.04  # s
LONG = 12.0  # s of the reference that windows are taken from


def tracking(reference: ca.SX, p: ca.SX, parameters: nocl.Uniform, horizon: float) -> nocl.OCP:
    """A cart-pole that holds its pole up while the cart follows a reference, from where it can: its force is bounded,
    and a pole that leans by 0.3 rad and falls at 0.6 rad/s is not caught any more."""
    system = cartpole.system()
    x, u = system.x, system.u
    off = ca.vertcat(x[0] - reference, 0.3 * x[1], x[2], 0.3 * x[3])
    return nocl.OCP(system, p=p, horizon=horizon, running=ca.sumsqr(off) + 0.01 * ca.sumsqr(u),
                    terminal=ca.sumsqr(off), x_goal=[0, 0, 0, 0], u_goal=[0], parameters=parameters,
                    initial_states=nocl.Uniform([-0.4, -0.4, -0.15, -0.3], [0.4, 0.4, 0.15, 0.3]))


def expression() -> nocl.OCP:
    A, w, phi = nocl.parameter("A", unit="m"), nocl.parameter("w", unit="rad/s"), nocl.parameter("phi", unit="rad")
    r = A * ca.sin(w * nocl.time() + phi)
    return tracking(r, ca.vertcat(A, w, phi), nocl.Uniform([0, 0.5, -np.pi], [0.8, 2, np.pi]), 4.0)


def samples(horizon: float = 4.0) -> nocl.OCP:
    p = ca.vertcat(*(nocl.parameter(f"r{i}", unit="m") for i in range(SAMPLES)))
    r = nocl.spline(nocl.time(), np.linspace(0, horizon, SAMPLES), p)
    return tracking(r, p, nocl.Uniform([-0.8] * SAMPLES, [0.8] * SAMPLES), horizon)


KINDS: dict[str, Callable[[], nocl.OCP]] = {"expression": expression, "samples": samples,
                                            "preview": lambda: samples(2.4)}


def gaps(ocp: nocl.OCP, cnd: nocl.CND, n: int) -> Array:
    """(J - J*) / J* [n] in %."""
    x0, p = ocp.initial_states.sample(n, own_numbers(0, 7)), ocp.sample_parameters(n, own_numbers(0, 8))
    methods = {"CND": cnd, "optimum": GlobalDDP(DDP(ocp), starts=8)}
    report = with_reference(compare(ocp, methods, x0=x0, p=p, progress=False), FINE)
    return np.where(report.judged[0].simulation.success, report.gap[0], np.inf)


def long_references(n: int, seed: int) -> Callable[[float], Array]:
    """A function of time that gives n references [n]: sums of three sines, in [-0.8, 0.8]."""
    rng = np.random.default_rng(seed)
    A, w, phi = rng.uniform(0.1, 0.27, (n, 3)), rng.uniform(0.3, 1.8, (n, 3)), rng.uniform(-np.pi, np.pi, (n, 3))
    return lambda t: np.asarray((A * np.sin(w * t + phi)).sum(axis=1))


def windows(ocp: nocl.OCP, act: Callable[[Array, Array], Array], n: int) -> Array:
    """The cost [n] of running the plant for LONG, with a control held for STEP: act(x, p) -> u, p the window."""
    r, nodes = long_references(n, 3), np.linspace(0, ocp.horizon, SAMPLES)
    step, cost = ocp.functions.step(substeps=2), np.zeros(n)
    x = np.column_stack([r(0.0), np.zeros((n, 3))])
    for k in range(round(LONG / STEP)):
        p = np.stack([r(k * STEP + node) for node in nodes], axis=1)
        end, part = step(*step_columns(ocp, x, act(x, p), p), STEP)
        x, cost = end.full().T, cost + part.full()[0]
    return cost


def step_columns(ocp: nocl.OCP, x: Array, u: Array, p: Array) -> list[Any]:
    """What the step's function is given; the window begins now, at its own time 0."""
    return list(ocp.functions.arguments.columns(x=x, u=u, t=np.zeros(len(x)), p=p))


def previewed(ocp: nocl.OCP, cnd: nocl.CND, n: int) -> dict[str, Any]:
    """The policy in a receding window beside DDP in it."""
    ddp, last = DDP(ocp), dict[str, Array]()

    def solved(x: Array, p: Array) -> Array:
        last["u"] = ddp.solve(x, p=p, progress=False, **last).u
        return last["u"][:, 0]

    begin = time.perf_counter()
    optimal = windows(ocp, solved, n)
    between = time.perf_counter()
    own = windows(ocp, lambda x, p: cnd(x, 0.0, p), n)
    took = time.perf_counter() - between
    lost = 100 * (own - optimal) / optimal
    return {"receding": spread(lost), "times faster than DDP": (between - begin) / took}


def spread(gap: Array) -> dict[str, float]:
    median, p95 = np.percentile(gap, [50, 95], method="higher")
    return {"median": float(median), "p95": float(p95), "worst": float(gap.max())}


def measured(kind: str, effort: str, n: int) -> dict[str, Any]:
    ocp = KINDS[kind]()
    begin = time.process_time()
    cnd = nocl.train(ocp, settings=TrainSettings.of(effort, parameters=ocp.np, value=False), progress=False)
    row = {"parameters": list(ocp.parameter_names), "CPU s": round(time.process_time() - begin, 1),
           "gap %": spread(gaps(ocp, cnd, n)), "n": n}
    return row | (previewed(ocp, cnd, 20) if kind == "preview" else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--n", type=int, default=100)
    args = parser.parse_args()
    rows = provenance.kept("references")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*extrapolation")
        for kind in args.kinds:
            rows[kind] = measured(kind, args.effort, args.n) | {"commit": provenance.STARTED}
            print(kind, rows[kind], flush=True)
            provenance.write("references", rows)


if __name__ == "__main__":
    main()
