"""Initial states from which no plan holds the constraints, told apart from methods that fail. B is the batch.

A run that holds them proves that a state is none of these; of the others DDP is asked, which holds constraints itself,
from cold starts and from what the methods did. It is the word of a local solver, not a proof.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nocl.comparisons.methods import Solving, Starts
from nocl.comparisons.reference import held_guess
from nocl.data import Solution
from nocl.definition import measured
from nocl.definition.ocp import OCP
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

INTERVALS = 80  # of the plans that are looked for
STARTS = 8  # cold ones


def impossible(ocp: OCP, starts: Starts, solved: NDArray[np.bool_], controls: Sequence[Array], ends: Sequence[Array],
               tolerance: float, solving: Solving) -> tuple[str, ...]:
    """[B], why no plan holds the constraints from a state, "" where one does or nothing is known.

    solved [B]: where a method held them; controls: those of the methods' runs [B, K, nu], NaN where there are none,
    and when these end [B]; tolerance: of the constraints' scales.
    """
    message, open_rows = [""] * len(starts), np.flatnonzero(~solved)
    if not open_rows.size or not ocp.constraint_names:
        return tuple(message)
    for i, why in zip(open_rows, _outside(ocp, starts[open_rows], tolerance), strict=True):
        message[i] = why
    left = np.array([i for i in open_rows if not message[i]], dtype=np.int64)
    if left.size:
        said = _asked(ocp, starts[left], [u[left] for u in controls], [T[left] for T in ends], tolerance, solving)
        for i, why in zip(left, said, strict=True):
            message[i] = why
    return tuple(message)


def _outside(ocp: OCP, starts: Starts, tolerance: float) -> list[str]:
    """What an initial state violates by itself."""
    u, t = np.zeros((len(starts), 0, ocp.system.nu)), np.zeros(1)
    shares = measured.shares(ocp, measured.least_held(ocp, starts.x[:, None], u, t, starts.p))
    said = []
    for row in shares:
        i = int(row.argmax()) if row.size else -1
        name, much = measured.excess(ocp, i, float(row[i])) if row.size else ("", "")
        said.append(f"the initial state itself violates {name!r} by {much}" if row.size and row[i] > tolerance else "")
    return said


def _asked(ocp: OCP, starts: Starts, controls: Sequence[Array], ends: Sequence[Array], tolerance: float,
           solving: Solving) -> list[str]:
    """What DDP says of states, by the plan of all that comes nearest to holding the constraints."""
    ddp, p = DDP(ocp, intervals=ocp.steps or INTERVALS, between=False), starts.p if ocp.np else None

    def spread(what: str) -> dict[str, Any]:
        out = None if solving.out is None else solving.out / "possible" / what
        return {"p": p, "workers": solving.workers, "out": out, "progress": solving.progress}

    plans = [solve_globally(ddp, starts.x, starts=STARTS, rounds=1, seed=0, **spread("cold"))]
    for number, (u, T) in enumerate(zip(controls, ends, strict=True)):
        guess = held_guess(ocp, u, T, ddp.intervals, p)
        plans.append(ddp.solve(starts.x, **guess, **spread(f"from-{number}")))
    found = np.any([plan.success for plan in plans], axis=0)
    shares = np.array([_worst(ocp, plan) for plan in plans])  # [plans, B, K + 1, rows]
    return ["" if ok else _told(ocp, shares[:, i], tolerance) for i, ok in enumerate(found)]


def _worst(ocp: OCP, plan: Solution) -> Array:
    """By how much of its scale each row of `measured.shares` is violated at each node [B, K+1, rows]; inf where the
    plan is not finite."""
    (B, nodes, nx), m = plan.x.shape, len(ocp.functions.rows)
    x, p = plan.x.reshape(-1, 1, nx), np.repeat(plan.parameters, nodes, axis=0)
    u = np.concatenate([plan.u, plan.u[:, -1:]], axis=1).reshape(B * nodes, 1, -1)
    least = measured.least_held(ocp, x, u, plan.t.reshape(-1, 1), p)
    shares = measured.shares(ocp, least, measured.least_at_end(ocp, x[:, 0], p))
    shares = shares.reshape(B, nodes, -1)
    shares[:, :-1, m:] = -np.inf  # what holds at the end alone
    shares[:, -1, :m][:, ocp.functions.rows.of_u] = -np.inf  # no control acts there
    shares[~(np.isfinite(plan.x).all(axis=(1, 2)) & np.isfinite(plan.u).all(axis=(1, 2)))] = np.inf
    return shares


def _told(ocp: OCP, shares: Array, tolerance: float) -> str:
    """Of a state's plans [plans, K+1, rows] that hold nothing the nearest one in words; "" where it is near enough."""
    nearest = shares[int(shares.max(axis=(1, 2)).argmin())]
    node, row = np.unravel_index(int(nearest.argmax()), nearest.shape)
    if not tolerance < nearest.max() < np.inf:
        return ""
    name, much = measured.excess(ocp, int(row), float(nearest.max()))
    return f"no plan holds {name!r} from here: worst at node {node} of {len(nearest) - 1} by {much}"
