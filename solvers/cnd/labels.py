"""Optimal answers to learn from: DDP solutions in a tube about the optimal trajectories and where the policy goes."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nocl.data import Solution
from nocl.ocp import OCP
from nocl.solvers.ddp.bank import SolutionBank, better
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.translate.rk4 import rk4, rk4_interval
from nocl.translate.torch_functions import to_torch

Field = Callable[[Tensor, Tensor], Tensor]
SMALL = 0.1  # of a usual cost: what is added to costs before anything is divided by them
COARSE = (2, 5, 10, 20, 40, 160, 640)  # intervals of tails that are solved for other control rates than the labels'
LONGEST = 40  # a control is held for the horizon over LONGEST at most


@dataclass(frozen=True, eq=False)
class Labels:
    """Optimal controls: continuous ones (dt = 0), and ones that are held for dt from t on."""

    x: Array  # [n, nx]
    t: Array  # [n]
    u: Array  # [n, nu]
    weight: Array  # [n], the length of the interval over the cost from the solution's start: relative costs count
    dt: Array  # [n]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice) -> Labels:
        return Labels(*(getattr(self, name)[rows] for name in Labels.__dataclass_fields__))

    @staticmethod
    def held(solution: Solution, unit: float) -> Labels:
        """Every interval of every solution that succeeded, at its start, as controls held for its length.

        unit: a usual cost; those far below it count as SMALL times it.
        """
        s = solution[solution.success]
        K, nu = s.u.shape[1:]
        h = np.repeat(np.diff(s.t[:, :2], axis=1), K)
        cost = np.repeat(np.abs(s.V[:, 0]), K) + SMALL * unit
        return Labels(s.x[:, :-1].reshape(len(h), -1), s.t[:, :-1].ravel(), s.u.reshape(-1, nu), h / cost, h)

    @staticmethod
    def of(solution: Solution, f: Field, unit: float, substeps: int = 1) -> Labels:
        """The same as continuous controls: at the middle of its interval a held one equals them to second order.

        f in torch gives the states between nodes, by half of the interval's `substeps`, or one more.
        """
        start = Labels.held(solution, unit)
        with torch.no_grad():
            half = torch.from_numpy(start.dt / 2)[:, None]
            at = (torch.from_numpy(start.x), torch.from_numpy(start.u), half)
            middle = rk4_interval(f, *at, (substeps + 1) // 2).numpy()
        return Labels(middle, start.t + start.dt / 2, start.u, start.weight, np.zeros(len(start)))

    @staticmethod
    def join(parts: list[Labels]) -> Labels:
        return Labels(*(np.concatenate([getattr(p, name) for p in parts]) for name in Labels.__dataclass_fields__))


def at_other_rates(ddp: DDP, solution: Solution, unit: float, rng: np.random.Generator) -> Labels:
    """Held controls from the same states as a solution's, each solved on another number of intervals, from its own."""
    done = solution[solution.success]
    left, most = ddp.ocp.horizon - done.t[:, 0], ddp.ocp.horizon / LONGEST * (1 + 1e-9)
    allowed = left[:, None] / np.array(COARSE) <= most
    chosen = (rng.random(allowed.shape) * allowed).argmax(axis=1)
    parts = []
    for k in np.unique(chosen):
        rows, N, K = np.flatnonzero(chosen == k), COARSE[k], ddp.intervals
        nearest = ((np.arange(N) + 0.5) * K / N).astype(int)
        other = copy.copy(ddp)  # the same compiled kernel
        other.intervals = N
        parts.append(Labels.held(other.solve(done.x[rows, 0], done.t[rows, 0], u=done.u[rows][:, nearest]), unit))
    return Labels.join(parts)


def tube(ddp: DDP, bank: SolutionBank, n: int, width: float, rng: np.random.Generator) -> Solution:
    """Tails from n random states near the bank's trajectories, each from the solution it is near."""
    rows, t0, x = tube_states(bank, n, width, ddp.ocp.horizon, rng)
    return ddp.solve(x, t0, **bank.guess(rows, t0, x))


def tube_states(bank: SolutionBank, n: int, width: float, horizon: float,
                rng: np.random.Generator) -> tuple[NDArray[np.int64], Array, Array]:
    """(rows of the bank, t0, x): n states x = x_row(t0) + width * exp(U(-1.5, 0)) * scale * N(0, I)."""
    rows = rng.integers(0, len(bank), n)
    t0 = rng.uniform(0, 0.97 * horizon, n)
    x = bank.states(rows, t0[:, None])[:, 0]
    x += width * np.exp(rng.uniform(-1.5, 0, (n, 1))) * bank.scale * rng.standard_normal(x.shape)
    return rows, t0, x


def visited(ddp: DDP, bank: SolutionBank, policy: torch.nn.Module, f: Field, n: int, kick: float,
            rng: np.random.Generator) -> Solution:
    """Tails from n states that the policy visits under kicks."""
    x, t0 = kicked_states(ddp.ocp, bank, policy, f, n, kick, rng, ddp.substeps)
    return answered(ddp, bank, policy, f, x, t0)


def kicked_states(ocp: OCP, bank: SolutionBank, policy: torch.nn.Module, f: Field, n: int, kick: float,
                  rng: np.random.Generator, substeps: int = 1) -> tuple[Array, Array]:
    """(x, t0) of n states, or fewer, that the policy visits under kicks, at any time: those not far out of the box."""
    x0 = ocp.initial_states.sample(max(n // 8, 1), rng)
    t, x = kicked_rollout(ocp, policy, f, x0, kick * bank.scale, rng, substeps=substeps)
    rows, k = rng.integers(0, len(x), n), rng.integers(0, len(t) - 1, n)
    x, t0 = x[rows, k], t[k]
    far = 10 * np.maximum(np.abs(ocp.system.lbx), np.abs(ocp.system.ubx))
    fine = (np.abs(x) < far).all(axis=1)  # False for NaN
    if not fine.any():
        raise ValueError(f"the controller of {ocp.system.name} drives every state far out of the box: train for more "
                         "iterations, in a narrower tube (TrainSettings.width) or with smaller pushes (.kick)")
    return x[fine], t0[fine]


def answered(ddp: DDP, bank: SolutionBank, policy: torch.nn.Module, f: Field, x: Array, t0: Array) -> Solution:
    """Tails from (x, t0): the better of a start from the policy's own answer and one from the nearest solution."""
    own = ddp.solve(x, t0, u=policy_controls(policy, f, x, t0, ddp.ocp.horizon, ddp.intervals, ddp.substeps))
    near = ddp.solve(x, t0, **bank.guess(bank.nearest(x, t0)[:, 0], t0, x))
    return better(own, near)


def kicked_rollout(ocp: OCP, policy: torch.nn.Module, f: Field, x0: Array, kick: Array, rng: np.random.Generator,
                   steps: int = 160, kicks: int = 6, substeps: int = 1) -> tuple[Array, Array]:
    """The policy's states (t [steps+1], x [B, steps+1, nx]) from x0, pushed by N(0, kick^2) at `kicks` random times."""
    h = ocp.horizon / steps
    x, path = torch.from_numpy(x0), [x0]
    times = rng.integers(0, steps, (kicks, len(x0)))
    with torch.no_grad():
        for k in range(steps):
            push = (times == k).sum(axis=0)[:, None] * kick * rng.standard_normal(x0.shape)
            x = x + torch.from_numpy(push)
            u = policy(x, torch.full((len(x), 1), (k + 0.5) * h, dtype=x.dtype))
            x = rk4_interval(f, x, u, h, substeps)
            path.append(x.numpy())
    return np.linspace(0, ocp.horizon, steps + 1), np.stack(path, axis=1)


def policy_controls(policy: torch.nn.Module, f: Field, x: Array, t0: Array, horizon: float, K: int,
                    substeps: int = 1) -> Array:
    """The controls [B, K, nu] that the policy gives from (x, t0), each held over an interval of [t0, T]."""
    state, start = torch.from_numpy(x), torch.from_numpy(t0)[:, None]
    h = (horizon - start) / K
    controls = []
    with torch.no_grad():
        for k in range(K):
            controls.append(policy(state, start + (k + 0.5) * h))
            state = rk4_interval(f, state, controls[-1], h, substeps)
    return torch.stack(controls, dim=1).numpy()


def continuous_cost(ocp: OCP, policy: torch.nn.Module, f: Field, x0: Array, steps: int,
                    t0: float | Array = 0.0) -> Array:
    """J [B] of the policy as continuous feedback from (x0, t0), t0 a number or [B], by RK4 on (x, t, cost).

    Soft path constraints included.
    """
    n, L = x0.shape[1], to_torch(ocp.L_soft)

    def closed_loop(z: Tensor, _: None) -> Tensor:
        x, t = z[:, :n], z[:, n:n + 1]
        u = policy(x, t)
        return torch.cat([f(x, u), torch.ones_like(t), L(x, u)], dim=1)

    start = np.broadcast_to(np.asarray(t0, dtype=np.float64), len(x0))
    z = torch.from_numpy(np.column_stack([x0, start, np.zeros(len(x0))]))
    h = torch.from_numpy((ocp.horizon - start) / steps)[:, None]
    with torch.no_grad():
        for _ in range(steps):
            z = rk4(closed_loop, z, None, h)
        return (z[:, n + 1] + to_torch(ocp.G)(z[:, :n])[:, 0]).numpy()
