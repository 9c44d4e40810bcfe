"""What flows between the parts: labels, trajectories, solutions. B is the batch dimension, K the intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from nocl.sampling import Seed
from nocl.support.checks import Array
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
    """Solutions of B optimal control problems; a failed one has success False and says why.

    `solution(t)` is (x, u, costate) at any time, by cubic Hermite polynomials between the nodes: [B, n], or
    [B, len(t), n] for several times.
    """

    trajectory: Trajectory
    cost: Array  # [B], inf where the solve failed
    costate: Array  # [B, K+1, nx], lambda = dJ*/dx at each node
    success: Array  # [B] bool
    message: Sequence[str]  # [B]
    seconds: Array  # [B]
    iterations: Array  # [B]
    starts: Array | None = None  # [B], how many starts were tried
    hits: Array | None = None  # [B], how many of them reached the best cost (within 0.1 %)
    optima: Sequence[Array] | None = None  # [B] of [n, 2]: the costs of the local optima found, rising, starts at each
    gains: Array | None = None  # [B, K, nu, nx], du_k = -gains dx_k stays optimal; NaN: no strict optimum
    hessian: Array | None = None  # [B, K+1, nx, nx], d2J*/dx2 at each node; NaN as in gains
    dense: Array | None = None  # [B, K, 4, 2 nx]: (x, costate) at both ends of intervals, their time derivatives

    @property
    def t(self) -> Array:
        return self.trajectory.t

    @property
    def x(self) -> Array:
        return self.trajectory.x

    @property
    def u(self) -> Array:
        return self.trajectory.u

    @property
    def value_gradient(self) -> Array:
        """dJ*/dx0 [B, nx]."""
        return self.costate[:, 0]

    def __call__(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """(x, u, costate) at the time(s) t; ValueError outside the nodes' times, or where `dense` is missing."""
        times = np.asarray(t, dtype=np.float64)
        if self.dense is None:
            raise ValueError("this Solution has no `dense`, which solution(t) interpolates: NMPC.solve gives it")
        if times.ndim > 1 or not ((times >= self.t[0]) & (times <= self.t[-1])).all():
            raise ValueError(f"t is {t!r}; expected a time or a list of times in [{self.t[0]:g}, {self.t[-1]:g}]")
        k = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        h = np.diff(self.t)[k]
        s = (times - self.t[k]) / h
        ends, slopes = [(1 + 2 * s) * (1 - s) ** 2, s**2 * (3 - 2 * s)], [h * s * (1 - s) ** 2, h * s**2 * (s - 1)]
        z = np.einsum("b...en,...e->b...n", self.dense[:, k], np.stack([*ends, *slopes], axis=-1))
        nx = self.x.shape[2]
        return z[..., :nx], self.u[:, k], z[..., nx:]
