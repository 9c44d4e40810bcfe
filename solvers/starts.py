"""Random controls that a search starts from, and when their rollouts are too wild to start from."""

from __future__ import annotations

import numpy as np

from nocl.definition.constraints import Free
from nocl.definition.ocp import OCP
from nocl.definition.sampling import Seed
from nocl.definition.system import System
from nocl.support.checks import Array

WAVES = 8  # half waves in a random control, the slow ones the largest
QUIETEST = 0.003  # its smallest amplitude, in half widths of U
PARTS = 3  # equal ones of the time, over which controls are held
FAR = 1.5  # widths of X from its middle: beyond, a rollout costs most and gives least
HALVINGS = 6  # of a control's distance to u*, until its rollout stays there


def smooth(system: System, K: int, n: int, rng: np.random.Generator) -> Array:
    """n random sums of half waves [n, K, nu], of QUIETEST to 1 half widths of U."""
    order = np.arange(WAVES)
    waves = np.cos(np.pi * order[:, None] * (np.arange(K) + 0.5) / K) / (1 + order)[:, None]
    shape = np.einsum("bmk,kt->btm", rng.standard_normal((n, system.nu, WAVES)), waves)
    size = np.exp(rng.uniform(np.log(QUIETEST), 0.0, (n, 1, 1)))
    return size * (system.ubu - system.lbu) / 2 * shape


def random_controls(ocp: OCP, K: int, n: int, seed: Seed, p: Array | None = None) -> Array:
    """n smooth random controls [n, K, nu] in U, about u* or the middle of U, small to full amplitude.

    p [n, np], where u* depends on it.
    """
    s, rng = ocp.system, np.random.default_rng(seed)
    shape = smooth(s, K, n, rng)
    goal = ocp.u_goal if p is None else ocp.goals(p)[1][:, None]
    base = np.where(rng.random((n, 1, 1)) < 0.5, np.asarray(goal), (s.lbu + s.ubu) / 2)
    return np.ascontiguousarray(np.clip(base + shape, s.lbu, s.ubu))


def levels(system: System, K: int, n: int, rng: np.random.Generator, parts: int) -> Array:
    """n random controls [n, K, nu] that are held over each of `parts` equal parts of the time: every other one at a
    bound, the others anywhere in U.
    """
    share = rng.random((n, parts, system.nu))
    at_bound = rng.random(share.shape) < 0.5
    share = np.where(at_bound, np.round(share), share)
    held = np.repeat(np.arange(parts), np.diff(np.linspace(0, K, parts + 1).astype(int)))
    return np.ascontiguousarray(system.lbu + (system.ubu - system.lbu) * share[:, held])


def random_start(ocp: OCP, K: int, n: int, seed: Seed, number: int, p: Array | None = None) -> Array:
    """Random start number 0, 1, 2, ... of n states, [n, K, nu]: smooth controls; of a problem without a goal by turns
    with such as are held over PARTS of the time.
    """
    if ocp.has_goal or number % 2:
        return random_controls(ocp, K, n, seed, p)
    return levels(ocp.system, K, n, np.random.default_rng(seed), min(PARTS, K))


def near(system: System, x: Array) -> Array:
    """Whether trajectories x [..., K+1, nx] stay near X, or as near as they began; False where they are not finite."""
    middle = (system.lbx + system.ubx) / 2
    far = FAR * np.maximum(system.ubx - system.lbx, np.abs(x[..., :1, :] - middle))
    return np.asarray((np.abs(x - middle) < far).all(axis=(-2, -1)))


def middle(horizon: Free) -> float:
    """A middling horizon."""
    return float(np.sqrt(horizon.low * horizon.high))


def spread_horizon(horizon: Free, number: int) -> float:
    """The horizon of start number 0, 1, 2, ...: evenly spread, of a logarithmic scale, a middling one first."""
    share = _spread(number)
    return float(horizon.low ** (1 - share) * horizon.high**share)


def _spread(number: int) -> float:
    """1/2, 1/4, 3/4, 1/8, 5/8, ...: the numbers from 1 on, their binary digits behind the point in reverse."""
    digits = bin(number + 1)[2:]
    return sum(2.0 ** -(i + 1) for i, digit in enumerate(reversed(digits)) if digit == "1")
