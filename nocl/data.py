"""What flows between the parts: labels, trajectories, solutions. B is the batch dimension, K the intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nocl.checks import Array
from nocl.sampling import Seed
from nocl.system import System


class Controller(Protocol):
    """u = pi(x, t): numpy rows x [B, nx] at one time t give u [B, nu]."""

    def __call__(self, x: Array, t: float = 0.0) -> Array: ...


@dataclass(frozen=True, eq=False)
class Dataset:
    """Labels of the dynamics: xdot = f(x, u) with its Jacobians, or without (logged data)."""

    x: Array  # [N, nx]
    u: Array  # [N, nu]
    xdot: Array  # [N, nx]
    A: Array | None = None  # [N, nx, nx], df/dx
    B: Array | None = None  # [N, nx, nu], df/du

    def __len__(self) -> int:
        return len(self.x)

    @staticmethod
    def sample(system: System, n: int, seed: Seed = 0) -> Dataset:
        """n uniform samples of the box X x U with exact labels."""
        rng = np.random.default_rng(seed)
        x = rng.uniform(system.lbx, system.ubx, (n, system.nx))
        return Dataset.label(system, x, rng.uniform(system.lbu, system.ubu, (n, system.nu)))

    @staticmethod
    def label(system: System, x: Array, u: Array) -> Dataset:
        """Exact labels at given rows x [N, nx], u [N, nu]."""
        n = len(x)
        A, B = (j.full() for j in system.jacobian(x.T, u.T))
        return Dataset(x, u, system.f(x.T, u.T).full().T, _blocks(A, n), _blocks(B, n))


def _blocks(side_by_side: Array, n: int) -> Array:
    """CasADi's [r, n * c] as rows [n, r, c]."""
    return side_by_side.reshape(side_by_side.shape[0], n, -1).transpose(1, 0, 2)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States at nodes, controls held between them."""

    t: Array  # [K+1]
    x: Array  # [B, K+1, nx]
    u: Array  # [B, K, nu], held over [t_k, t_{k+1})


@dataclass(frozen=True, eq=False)
class Solution:
    """Solutions of B optimal control problems; a failed one has success False and says why."""

    trajectory: Trajectory
    cost: Array  # [B], inf where the solve failed
    costate: Array  # [B, K+1, nx], lambda = dJ*/dx at each node
    success: Array  # [B] bool
    message: Sequence[str]  # [B]
    seconds: Array  # [B]
    iterations: Array  # [B]
    starts: Array | None = None  # [B], how many starts were tried
    hits: Array | None = None  # [B], how many of them reached the best cost (within 0.1 %)

    @property
    def t(self) -> Array:
        return self.trajectory.t

    @property
    def x(self) -> Array:
        return self.trajectory.x

    @property
    def u(self) -> Array:
        return self.trajectory.u
