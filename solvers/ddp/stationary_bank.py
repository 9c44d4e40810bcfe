"""Solutions of a problem without an end: nodes are starts, and what comes after the last one is LQR's."""

from __future__ import annotations

from typing import Self

import numpy as np

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.nodes import NodeBank, Rows
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.lqr import LQR
from nocl.support.checks import Array

SAME = 1e-4  # of a cost: less is no other optimum
RARE = 0.01  # of solutions, that get better: few enough


class StationaryBank(NodeBank):
    """Solutions over one time T, found by the nearest of all their nodes; a guess goes on by LQR.

    ocp : the problem over T, with LQR's cost to go at its end
    level : of V_lqr, below which LQR is as good as the optimum
    """

    def __init__(self, ocp: OCP, solution: Solution, lqr: LQR, level: float) -> None:
        self.lqr, self.level = lqr, level
        super().__init__(ocp, solution)

    def holding(self, solution: Solution) -> Self:
        """The same of other solutions."""
        return type(self)(self.ocp, solution, self.lqr, self.level)

    def tails(self, rows: Rows, nodes: Rows, intervals: int) -> dict[str, Array]:
        """What DDP.solve starts from: solutions `rows` [n] from their nodes `nodes` [n] on, and LQR after their end."""
        s, K = self.solution, self.solution.u.shape[1]
        place = nodes[:, None] + K * np.arange(intervals + 1) / intervals  # in nodes
        node, row = np.minimum(place.astype(np.int64), K - 1), rows[:, None]
        share = (place - node)[..., None]
        x = (1 - share) * s.x[row, node] + share * s.x[row, node + 1]
        held, over = node[:, :-1], place >= K
        goal = self.image(s.x[rows, -1])[:, None]
        return {"u": np.where(over[:, :-1, None], self.ocp.u_goal, s.u[row, held]),
                "x": np.where(over[..., None], goal, x),
                "gain": np.where(over[:, :-1, None, None], -self.lqr.K(), s.gain[row, held])}

    def image(self, x: Array) -> Array:
        """x* as it is nearest to each of x [n, nx]."""
        return np.asarray(x - self.ocp.from_goal(x))

    def solve(self, ddp: DDP, x: Array, p: Array, count: int = 2) -> Solution:
        """The best of descents from the nearest tails, pruned."""
        return pruned(ddp, super().solve(ddp, x, p, count), self.lqr, self.level)

    def cleaned(self, ddp: DDP, rounds: int) -> Self:
        """Each solution tried again from its nearest neighbours, until hardly any gets better."""
        bank = self
        for _ in range(rounds):
            s = bank.solution
            found = better(s, bank.solve(ddp, s.x[:, 0], s.parameters, 4))
            gained = (found.cost < s.cost * (1 - SAME)).mean()
            bank = self.holding(found)
            if gained < RARE:
                break
        return bank


def pruned(ddp: DDP, s: Solution, lqr: LQR, level: float) -> Solution:
    """Solutions tried again from where LQR is cheaper than what they do: plans arrive, wait, and leave again, where the
    end is worth little to them."""
    V = lqr.value(s.x.reshape(-1, s.x.shape[2])).reshape(s.x.shape[:2])
    total = s.V[:, :1] - s.V + V  # of LQR from each node on
    total = np.where((level > V) & np.isfinite(total), total, np.inf)[:, :-1]
    node = total.argmin(axis=1)
    found = np.flatnonzero(s.success & (total.min(axis=1) < s.cost * (1 - SAME)))
    if not len(found):
        return s
    part, node = s[found], node[found]
    later = np.arange(s.u.shape[1])[None] >= node[:, None]
    at = part.x[np.arange(len(found)), node]
    goal = (at - lqr.ocp.from_goal(at))[:, None]
    u = np.where(later[..., None], lqr.ocp.u_goal, part.u)
    x = np.concatenate([np.where(later[..., None], goal, part.x[:, :-1]), goal], axis=1)
    gain = np.where(later[..., None, None], -lqr.K(), part.gain)
    tried = ddp.solve(part.x[:, 0], u=u, x=x, gain=gain, progress=False)
    return _put(s, better(part, tried), found)


def _put(s: Solution, part: Solution, rows: Rows) -> Solution:
    """The solutions with some of them replaced."""
    order = np.arange(len(s))
    order[rows] = len(s) + np.arange(len(rows))
    return type(s).join([s, part])[order]
