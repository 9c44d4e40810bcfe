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
    cost: float  # of staying where one begins, under any control; without a goal what it differs by all over X


@lru_cache(maxsize=32)
def usual_sizes(ocp: OCP) -> Sizes:
    s = ocp.system
    costs = (_staying(ocp),) if ocp.has_goal else (_differences(ocp), _staying(ocp))
    known = (J[np.isfinite(J) & (J > 0)] for J in costs)
    cost = next((float(np.median(J)) for J in known if J.size), 1.0)
    return Sizes((s.ubx - s.lbx) / 2, (s.ubu - s.lbu) / 2, cost)


def _staying(ocp: OCP) -> Array:
    """|J| of staying where one begins [SAMPLES]."""
    rng = own_numbers(0)
    x = np.clip(ocp.initial_states.sample(SAMPLES, rng), ocp.system.lbx, ocp.system.ubx)  # far out costs are not usual
    return np.abs(np.stack(_parts(ocp, x, rng))).sum(axis=0)


def _differences(ocp: OCP) -> Array:
    """|J - J'| of staying anywhere in X, pair by pair: what is made of a state that may begin at no cost, or at a
    large one, of which all but a little stays as it is."""
    rng = own_numbers(0)
    J: Array = np.add(*_parts(ocp, rng.uniform(ocp.system.lbx, ocp.system.ubx, (SAMPLES, ocp.system.nx)), rng))
    return np.abs(J[::2] - J[1::2])


def _parts(ocp: OCP, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """T L and G of staying at x [SAMPLES, nx] under any control."""
    u = rng.uniform(ocp.system.lbu, ocp.system.ubu, (SAMPLES, ocp.system.nu))
    of, at = ocp.functions, ocp.moments(SAMPLES)
    L, G = (g(*a.columns(x=x, u=u, **at)).full().ravel() for g, a in ((of.L, of.arguments), (of.G, of.end)))
    return ocp.longest * L, G


def units(ocp: OCP) -> Sizes:
    """What solvers take for 1 of each state and control, and of the cost: a usual size, as a power of STEP."""
    usual = usual_sizes(ocp)
    return Sizes(steps(usual.x), steps(usual.u), float(steps(usual.cost)))


def steps(size: Array | float) -> Array:
    """The power of STEP that is nearest to each size > 0."""
    return np.asarray(STEP ** np.round(np.log(size) / np.log(STEP)))
