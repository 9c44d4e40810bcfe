"""A second opinion on DDP's plans, by NMPC on the same grid: from these plans and from starts of its own.

NMPC solves the problem itself, where DDP has a quadratic term in controls that the Hamiltonian is linear in
(smoothing.py): what that costs is measured here. Where NMPC's plan is better, DDP starts from it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nocl.data import Solution
from nocl.definition.scales import usual_sizes
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.smoothing import without_kinks
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.nmpc.solver import NMPC
from nocl.support.checks import Array

STATES, STARTS = 2, 2  # that are asked for, and NMPC's own starts of each, beside DDP's plan
PATIENCE = 20.0  # seconds for each start of NMPC's
SMALL = 1e-3  # of a usual cost: costs are not divided by less
AGREE = 1e-2  # of the cost: methods that differ by more disagree


@dataclass(frozen=True, eq=False)
class Opinion:
    """What NMPC says of a few plans."""

    solution: Solution  # the plans that were asked about, better ones in their place where there were any
    asked: int  # of how many states
    solved: int  # by NMPC
    apart: float  # the largest share of the cost by which the methods differed; NaN where NMPC solved none
    price: float  # the median share by which DDP's best costs more than NMPC's, once it has followed
    improved: bool  # whether any plan is better now
    smoothed: tuple[str, ...]  # controls with a quadratic term
    weight: float  # of that, 0 for none

    @property
    def text(self) -> str:
        """In one line."""
        term = f"a quadratic term of {self.weight:g} of the usual cost was added in {', '.join(self.smoothed)}" \
            if self.smoothed else ""
        if not self.solved:
            return f"{term and term + '; '}NMPC, asked for a second opinion, solved none of {self.asked} states"
        what = [f"{term}: it costs {100 * max(self.price, 0.0):.2g} % here" if term else "",
                f"two methods disagree by {100 * self.apart:.2g} % here (DDP and NMPC, {self.solved} states); the "
                "better plans are used" if self.apart > AGREE else ""]
        return "; ".join(filter(None, what))

    @property
    def card(self) -> dict[str, Any]:
        """As plain data."""
        return {"text": self.text, "states": self.solved, "apart": self.apart, "price": self.price,
                "controls": list(self.smoothed), "weight": self.weight}


def second_opinion(ddp: DDP, plans: Solution, states: int = STATES, starts: int = STARTS) -> Opinion:
    """NMPC's opinion on the first `states` plans that succeeded, of a fixed horizon; DDP follows where it is better."""
    rows = np.flatnonzero(plans.success)[:states]
    some = plans[rows]
    theirs = _nmpc(ddp, some, starts)
    solved = theirs.success
    off = _shares(ddp, some, theirs)
    won = np.flatnonzero(solved & (off > AGREE * AGREE))
    after, found = some, _copy(plans)
    if won.size:
        after = better(_untried(some), _untried(_following(ddp, some, theirs, won)))
        found.put(rows, after)
    price = _shares(ddp, after, theirs)[solved]
    return Opinion(found, len(rows), int(solved.sum()), float(np.abs(off[solved]).max(initial=0.0)),
                   float(np.median(price)) if price.size else np.nan, bool((after.cost < some.cost).any()),
                   ddp.ocp.flat_controls if ddp.smoothed else (), float(ddp.weights[-1]) if ddp.smoothed else 0.0)


def _nmpc(ddp: DDP, some: Solution, starts: int) -> Solution:
    """The best of NMPC from DDP's plans and from starts of its own, on DDP's grid."""
    held = "soft" if ddp.constraints == "soft" else "hard"
    nmpc = NMPC(without_kinks(ddp.ocp), ddp.intervals, dynamics=ddp.dynamics, substeps=ddp.substeps,
                integrator=ddp.integrator, passes=0, constraints=held, between=bool(ddp.between), time_limit=PATIENCE)
    with warnings.catch_warnings():  # of the grid DDP has told
        warnings.simplefilter("ignore")
        return nmpc.solve(some.x[:, 0], [some], p=some.p, starts=starts, workers=1, progress=False)


def _following(ddp: DDP, some: Solution, theirs: Solution, rows: NDArray[np.int64]) -> Solution:
    """DDP from NMPC's plans in these rows; the others as they are."""
    x, u, p = (None if v is None else np.ascontiguousarray(v[rows]) for v in (theirs.x, theirs.u, some.p))
    assert x is not None
    assert u is not None
    after = _copy(some)
    after.put(rows, ddp.solve(x[:, 0], p=p, x=x, u=u, gain=ddp.feedback(x, u, p), progress=False))
    return after


def _shares(ddp: DDP, ours: Solution, theirs: Solution) -> Array:
    """By what share of the cost ours is above theirs [B]; NaN where theirs failed."""
    floor = SMALL * usual_sizes(ddp.ocp).cost
    with np.errstate(invalid="ignore"):
        return np.where(theirs.success, (ours.cost - theirs.cost) / np.maximum(np.abs(theirs.cost), floor), np.nan)


def _copy(s: Solution) -> Solution:
    return Solution.of_arrays({name: value.copy() for name, value in s.arrays().items()})


def _untried(s: Solution) -> Solution:
    return Solution.of_arrays({name: value for name, value in s.arrays().items() if name != "tried"})
