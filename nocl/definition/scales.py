"""The sizes that a problem's states, controls and costs usually have: solvers scale by them, since their tolerances are
numbers, and the unit of a state or a cost is anybody's choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.support.checks import Array

SAMPLES = 256
STEP = 1024.0  # scales are powers of it: exact in binary, and ordinary problems are left as they are


@dataclass(frozen=True, eq=False)
class Sizes:
    """Usual sizes, all > 0."""

    x: Array  # [nx], half the widths of X
    u: Array  # [nu], of U
    cost: float  # of staying where one begins, under any control


@lru_cache(maxsize=32)
def usual_sizes(ocp: OCP) -> Sizes:
    s, rng = ocp.system, own_numbers(0)
    x = np.clip(ocp.initial_states.sample(SAMPLES, rng), s.lbx, s.ubx)  # far outside X costs are not usual
    u = rng.uniform(s.lbu, s.ubu, (SAMPLES, s.nu))
    of, at = ocp.functions, ocp.moments(SAMPLES)
    L, G = (g(*a.columns(x=x, u=u, **at)).full() for g, a in ((of.L, of.arguments), (of.G, of.end)))
    J = np.abs(ocp.longest * L) + np.abs(G)
    J = J[np.isfinite(J) & (J > 0)]
    return Sizes((s.ubx - s.lbx) / 2, (s.ubu - s.lbu) / 2, float(np.median(J)) if J.size else 1.0)


def units(ocp: OCP) -> Sizes:
    """What solvers take for 1 of each state and control, and of the cost: a usual size, as a power of STEP."""
    usual = usual_sizes(ocp)
    return Sizes(steps(usual.x), steps(usual.u), float(steps(usual.cost)))


def steps(size: Array | float) -> Array:
    """The power of STEP that is nearest to each size > 0."""
    return np.asarray(STEP ** np.round(np.log(size) / np.log(STEP)))
