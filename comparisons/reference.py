"""The yardstick of a comparison: the optimum on a fine grid, reached from what the methods themselves found."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

from nocl.comparisons.report import results
from nocl.data import Solution
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

NAME = results.REFERENCE
EXACT = 1e-6  # DDP holds ends to hardly less than that
INSIDE = 0.99  # of the tolerance, that plans end within: at its edge rounding decides
SLOTS = 40  # kicks fall on multiples of the horizon over SLOTS


class Reference:
    """The best of DDP's descents on `intervals` held controls, or the steps of a system in discrete time, from each of
    `guesses` and from u*.

    A method's gap to the best known cost says little where that method found it: with this row beside it, no method is
    measured against itself alone. Constraints hold, at the nodes and between them; a state from which no plan was found
    that holds them has no reference.

    Parameters
    ----------
    guesses : sequence of controls [B, K, nu]
        Held on K equal intervals; NaN stands for u*.
    ends : sequence of [B], where the horizon is free
        When each guess ends.
    tolerance : share of terminal constraints' scales
        Where the horizon is free, feedback ends as soon as all ends hold within it: so does the reference.
    """

    def __init__(self, ocp: OCP, intervals: int, guesses: Sequence[Array] = (), ends: Sequence[Array] = (),
                 tolerance: float = TOLERANCE) -> None:
        self.ocp = ocp.loosened(INSIDE * tolerance) if ocp.is_free and tolerance > EXACT else ocp
        self.intervals, self.guesses, self.ends = ocp.steps or intervals, list(guesses), list(ends)

    def solve(self, x0: Array, p: Array | None = None) -> Solution:
        """The best solution of each state x0 [B, nx], p [B, np]; guesses are of the same."""
        ddp = DDP(self.ocp, intervals=self.intervals, between=not self.ocp.system.is_discrete)
        best = ddp.solve(x0, p=p)
        for u, T in zip_longest(self.guesses, self.ends):
            best = better(best, ddp.solve(x0, p=p, **held_guess(self.ocp, u, T, self.intervals, p)))
        return best


def held_guess(ocp: OCP, u: Array, T: Array | None, intervals: int, p: Array | None) -> dict[str, Array]:
    """What DDP.solve starts from: controls u [B, K, nu], u* for NaN, on so many intervals, until T [B] where the
    horizon is free."""
    held = u[:, np.arange(intervals) * u.shape[1] // intervals]
    goal = ocp.goals(np.zeros((len(u), 0)) if p is None else p)[1][:, None]
    guess = {"u": np.ascontiguousarray(np.where(np.isfinite(held), held, goal))}
    if T is None or not ocp.is_free:
        return guess
    low, high = ocp.horizon.low, ocp.horizon.high
    last = np.clip(np.where(np.isfinite(T), T, np.sqrt(low * high)), low, high)
    return guess | {"t": last[:, None] * np.linspace(0, 1, intervals + 1)}


def resolved(ocp: OCP, start: Solution, kicks: Sequence[tuple[int, Array]]) -> Array:
    """Cost [B] of the optimum that is solved anew after each kick (slot, dx [B, nx]), from the unkicked optimum;
    inf where a solve failed: also where a kick leads to a state from which no plan holds the constraints.

    Slots rise; slot k is the time k T / SLOTS. The intervals of `start` are a multiple of SLOTS.
    """
    K = start.u.shape[1]
    if K % SLOTS:
        raise ValueError(f"the optimum has {K} intervals; expected a multiple of {SLOTS}, where kicks fall")
    solution, cost, now, per_slot = start, np.zeros(len(start)), 0, K // SLOTS
    found, goal = np.array(start.success, dtype=bool), ocp.goals(start.parameters)[0]
    for slot, dx in kicks:
        node = (slot - now) * per_slot
        cost[found] += solution.V[found, 0] - solution.V[found, node]
        x = np.where(found[:, None], solution.x[:, node] + dx, goal)  # what is lost may have blown up
        u = np.ascontiguousarray(solution.u[:, node:])
        states, gain = np.ascontiguousarray(solution.x[:, node:]), np.ascontiguousarray(solution.gain[:, node:])
        ddp, t0 = DDP(ocp, intervals=K - slot * per_slot), slot * ocp.horizon / SLOTS
        solution, now = better(ddp.solve(x, t0, u=u, x=states, gain=gain, p=start.p),
                               ddp.solve(x, t0, u=u, p=start.p)), slot
        found &= solution.success
    return np.where(found, cost + solution.cost, np.inf)
