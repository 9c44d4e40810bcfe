"""Constraints in training: which plans are labels, what a policy violates, and the margins that make up for it.

Labels hold the problem's constraints by margins more than they ask for, since a policy's own errors lie about the
boundary: half of them outside. A margin is what all but SELDOM of held-out runs exceed the boundary by, and all but
SHAKEN of those from kicked states, measured under the margins before, row by row. Equations and what the output map
holds (projection.py, barrier.py) have none, or, where the map fails, only then.

Plans are elastic: where a state lies between the margin and the boundary, or a little outside, the label goes back in
as fast as pays. Where no plan stays within LOST of what is held, the state is lost, and no label.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from nocl.data import Solution
from nocl.definition import measured
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.solvers.cnd.regression.barrier import guarded
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Policy, Problems, continuous_run
from nocl.solvers.cnd.regression.projection import projected
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

FIRST = 1e-3  # of a scale, the first margin of each row
LARGEST = 0.05  # of a scale, the largest
SELDOM = 0.01  # of held-out runs may exceed what a margin makes up for, but at least one
SHAKEN = 0.05  # of those from kicked states
LOST = 0.01  # of a scale: a plan that leaves more is no label


@dataclass(frozen=True, eq=False)
class Held:
    """A problem's constraints: rows along the trajectory, then those at its end.

    learned : whether the policy is trained on learned dynamics; the output map holds no rows of states alone then
    plans : a few solutions, which say where constraints are touched
    """

    ocp: OCP
    learned: bool = False
    plans: Solution | None = None

    @property
    def first(self) -> Array:
        """The first margins [m + those at the end]."""
        return np.where(self.inward & ~self.guarded, FIRST, 0.0)

    @cached_property
    def inward(self) -> Any:
        """Which rows may have a margin."""
        of = self.ocp.functions
        return np.r_[~of.rows.equal & ~projected(self.ocp), ~of.end_rows.equal]

    @cached_property
    def guarded(self) -> Any:
        """Which rows of states the output map holds."""
        return guarded(self.ocp, self.plans, self.learned)

    @cached_property
    def scales(self) -> Array:
        of = self.ocp.functions
        return np.r_[of.scales, of.end_scales]

    @property
    def names(self) -> tuple[str, ...]:
        of = self.ocp.functions
        return (*of.rows.names, *of.end_rows.names)

    def solver(self, ddp: DDP, margin: Array) -> DDP:
        """A DDP whose plans keep these margins."""
        m, of_x = len(self.ocp.functions.rows), self.ocp.functions.rows.n_x
        return ddp.inside(np.r_[margin[:m], margin[:of_x], margin[m:]])

    def labels(self, solution: Solution) -> Solution:
        """The same, without success where a plan leaves by more than LOST what x0 alone does not decide."""
        s, later, n = solution, slice(1, None), self.ocp.functions.rows.n_x
        least = measured.least_held(self.ocp, s.x, s.u, s.t, s.parameters)
        least[:, :n] = measured.least_held(self.ocp, s.x[:, later], s.u[:, later], s.t[:, later], s.parameters)[:, :n]
        over = measured.violation(self.ocp, least, measured.least_at_end(self.ocp, s.x[:, -1], s.parameters))
        return replace(s, success=s.success & (over <= LOST))

    def exceeded(self, policy: Policy, torch_ocp: InTorch, at: Problems, steps: int) -> Array:
        """What the policy exceeds each row by as continuous feedback from there, in scales [B, m + those at the end];
        less than 0 where it stays inside.
        """
        _, x, t = continuous_run(policy, torch_ocp, at, steps)
        B, nodes = t.shape
        here, flat = torch_ocp.at(np.repeat(at.p, nodes, axis=0)), torch.from_numpy(x.reshape(B * nodes, x.shape[2]))
        with torch.no_grad():
            u = policy(flat, torch.from_numpy(t.reshape(-1, 1)), *here.p).numpy().reshape(B, nodes, self.ocp.system.nu)
        along, at_end = measured.least_held(self.ocp, x, u, t, at.p), measured.least_at_end(self.ocp, x[:, -1], at.p)
        least = np.hstack([along, at_end])
        lost = ~np.isfinite(x[:, -1]).all(axis=1)
        return np.where(lost[:, None], np.inf, -least / self.scales)

    def next(self, margin: Array, exceeded: Array, kicked: Array) -> Array:
        """The margins for labels of the next round; those of rows that the map holds stay, unless it fails."""
        runs = [(over, share) for over, share in ((exceeded, SELDOM), (kicked, SHAKEN)) if len(over)]
        if not runs:
            return margin
        most = np.max([_all_but(share, over) for over, share in runs], axis=0)
        more = np.where(self.guarded & (most <= TOLERANCE), 0.0, most - TOLERANCE / 2)
        more[more < 0] /= 2  # what one fit did not need the next one may
        return np.where(self.inward, np.clip(margin + more, 0.0, LARGEST), 0.0)

    def summary(self, exceeded: Array, name: str) -> dict[str, Any]:
        """The share of runs that violate a constraint, and the worst of each, in scales."""
        worst = np.maximum(exceeded, 0.0)
        each: dict[str, float] = {}
        for row, title in enumerate(self.names):
            each[title] = max(each.get(title, 0.0), float(worst[:, row].max(initial=0.0)))
        share = float((worst.max(axis=1, initial=0.0) > TOLERANCE).mean()) if len(worst) else float("nan")
        return {f"{name}_violating": share, f"{name}_worst": each}


def _all_but(share: float, over: Array) -> Array:
    """What all but a share of the runs [B, rows] stay below, or all but one, row by row."""
    out = max(int(share * len(over)), 1)
    return np.asarray(np.sort(over, axis=0)[max(len(over) - 1 - out, 0)])
