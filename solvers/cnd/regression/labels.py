"""Optimal answers to learn from: DDP solutions in a tube about the optimal trajectories and where the policy goes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nocl.data import Solution
from nocl.definition.discrete import samples
from nocl.definition.ocp import OCP
from nocl.definition.sampling import Uniform, box
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.rolled import Rolled
from nocl.solvers.ddp.bank import Rows, SolutionBank, better, extend
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.translate.rk4 import rk4

Policy = Callable[..., Tensor]  # (x, t[, p]) -> u
NEIGHBOURS = 10  # starts where the nearest one's optimum may be of another kind: with parameters, or about walls
PROBED, RARE, SAME = 300, 0.003, 1e-4  # states by which it is found out whether there are such; costs so close are one
KEPT = 2  # of them are followed to the end: those cheapest after one iteration
KEEPS = 1e-6  # of X: how far beyond its bound is not beyond
NEAR = 0.1  # how near hard problems more are drawn
SMALL = 0.1  # of a usual cost: what is added to costs before anything is divided by them
COARSE = (2, 5, 10, 20, 40, 160, 640)  # intervals of tails that are solved for other control rates than the labels'
AT_START = 10.0  # what a solution's start counts, of the middle of an interval: one stands for all of them
LONGEST = 40  # a control is held for the horizon over LONGEST at most


@dataclass(frozen=True, eq=False)
class Labels:
    """Optimal controls: continuous ones (dt = 0), and ones that are held for dt from t on."""

    x: Array  # [n, nx]
    t: Array  # [n]
    p: Array  # [n, np]
    u: Array  # [n, nu]
    weight: Array  # [n], the length of the interval over the cost from the solution's start: relative costs count
    dt: Array  # [n]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: slice | Rows | NDArray[np.bool_]) -> Labels:
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
        every = Labels(s.x[:, :-1].reshape(len(h), -1), s.t[:, :-1].ravel(), np.repeat(s.parameters, K, axis=0),
                       s.u.reshape(-1, nu), h / cost, h)
        lasts = np.diff(s.t, axis=1).ravel() > 0  # behind the end, in discrete time, nothing does
        return every if lasts.all() else every[lasts]

    @staticmethod
    def of(solution: Solution, torch_ocp: InTorch, unit: float, substeps: int = 1) -> Labels:
        """The same as continuous controls: at the middle of its interval a held one equals them to second order.

        f in torch gives the states between nodes, by half of the interval's `substeps`, or one more. Where steps are
        implicit, what is fast is at rest there: then the starts of solutions are labels too. In discrete time controls
        stand at the samples where they act.
        """
        start = Labels.held(solution, unit)
        if torch_ocp.ocp.system.is_discrete:
            return replace(start, dt=np.zeros(len(start)))
        with torch.no_grad():
            half, t = torch.from_numpy(start.dt / 2)[:, None], torch.from_numpy(start.t)[:, None]
            at = (torch.from_numpy(start.x), torch.from_numpy(start.u), t, half)
            middle = torch_ocp.at(start.p).after(*at, (substeps + 1) // 2).numpy()
        labels = replace(start, x=middle, t=start.t + start.dt / 2, dt=np.zeros(len(start)))
        if torch_ocp.implicit is None:
            return labels
        return Labels.join([labels, _starts(start, solution.u.shape[1], torch_ocp)])

    @staticmethod
    def join(parts: list[Labels]) -> Labels:
        return Labels(*(np.concatenate([getattr(p, name) for p in parts]) for name in Labels.__dataclass_fields__))


def _starts(held: Labels, K: int, torch_ocp: InTorch) -> Labels:
    """The continuous control where each solution starts, on a line through those of its first two intervals' middles;
    each counts as AT_START of an interval's."""
    first, second, s = held[::K], held[1::K], torch_ocp.ocp.system
    u = np.clip(1.5 * first.u - 0.5 * second.u, s.lbu, s.ubu)
    return replace(first, u=u, weight=AT_START * first.weight, dt=np.zeros(len(first)))


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
        solved = other.solve(done.x[rows, 0], done.t[rows, 0], u=done.u[rows][:, nearest], p=done[rows].p)
        parts.append(Labels.held(solved, unit))
    return Labels.join(parts)


def tube(ddp: DDP, bank: SolutionBank, n: int, width: float, rng: np.random.Generator) -> Solution:
    """Tails from n random states near the bank's trajectories, each from the solution it is near; where several are
    worth a look, the best of that and of starts from the nearest others.
    """
    rows, at = tube_states(ddp.ocp, bank, n, width, rng)
    own = ddp.solve(at.x, at.t, p=at.given_p, **bank.guess(rows, at.t, at.x))
    several = bank.several > 1
    return better(own, extend(ddp, bank, at.x, bank.several, at.t, at.given_p, KEPT)) if several else own


def rivals(ddp: DDP, bank: SolutionBank, rng: np.random.Generator) -> bool:
    """Whether of PROBED initial states more than RARE have a better optimum than the nearest solution leads to: near
    another of NEIGHBOURS.
    """
    at = Problems.initial(ddp.ocp, PROBED, rng)
    one = extend(ddp, bank, at.x, 1, p=at.given_p).cost
    others = extend(ddp, bank, at.x, NEIGHBOURS, p=at.given_p, kept=KEPT).cost
    least = np.where(np.isfinite(one), one - SAME * np.abs(np.nan_to_num(one, posinf=0.0)), np.inf)
    return float((others < least).mean()) > RARE


@dataclass(frozen=True, eq=False)
class Problems:
    """Where solutions are asked for: states, times, parameters."""

    x: Array  # [n, nx]
    t: Array  # [n]
    p: Array  # [n, np]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, rows: Rows) -> Problems:
        return Problems(self.x[rows], self.t[rows], self.p[rows])

    @property
    def given_p(self) -> Array | None:
        """As solvers take p."""
        return self.p if self.p.shape[1] else None

    @staticmethod
    def initial(ocp: OCP, n: int, rng: np.random.Generator) -> Problems:
        """n fresh initial states and parameters."""
        return Problems(ocp.initial_states.sample(n, rng), np.zeros(n), ocp.sample_parameters(n, rng))

    @staticmethod
    def join(parts: Sequence[Problems]) -> Problems:
        return Problems(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "t", "p")))


def tube_states(ocp: OCP, bank: SolutionBank, n: int, width: float,
                rng: np.random.Generator) -> tuple[NDArray[np.int64], Problems]:
    """(rows of the bank, n problems): x = x_row(t0) + width * exp(U(-1.5, 0)) * scale * N(0, I), within `limits`, and p
    likewise, inside of where they lie."""
    rows = rng.integers(0, len(bank), n)
    t0 = rng.uniform(0, 0.97 * ocp.horizon, n) if ocp.steps is None else \
        samples(ocp.system, 0, ocp.steps)[rng.integers(0, ocp.steps, n)]
    x, p = bank.states(rows, t0[:, None])[:, 0], bank.solution.parameters[rows]
    nx = x.shape[1]
    x += width * np.exp(rng.uniform(-1.5, 0, (n, 1))) * bank.scale[:nx] * rng.standard_normal(x.shape)
    x = folded_into(x, *limits(ocp, bank))
    if ocp.np:
        away = width * np.exp(rng.uniform(-1.5, 0, (n, 1))) * bank.scale[nx:] * rng.standard_normal(p.shape)
        p = np.clip(p + away, *ocp.parameter_box)
    return rows, Problems(x, t0, p)


def limits(ocp: OCP, bank: SolutionBank) -> tuple[Array, Array]:
    """(low, high) [nx]: bounds of X that no solution of the bank leaves, as those of concentrations or of numbers of
    cells, +-inf for others. Beyond them equations often mean nothing, and costs may have no bounds."""
    s, x = ocp.system, bank.solution.x
    once, slack = ~np.isin(np.arange(s.nx), list(ocp.periodic)), KEEPS * (s.ubx - s.lbx)
    low = np.where(once & (x.min(axis=(0, 1)) >= s.lbx - slack), s.lbx, -np.inf)
    return low, np.where(once & (x.max(axis=(0, 1)) <= s.ubx + slack), s.ubx, np.inf)


def folded_into(x: Array, low: Array | float, high: Array | float) -> Array:
    """x [B, n], mirrored at the bounds that it lies beyond; what is too far beyond for that stands at the other one."""
    mirrored = np.where(x < low, 2 * low - x, np.where(x > high, 2 * high - x, x))
    return np.asarray(np.clip(mirrored, low, high))


def near(ocp: OCP, at: Problems, n: int, rng: np.random.Generator) -> Problems:
    """n problems near some of initial states, NEAR of half the width of where x0 and p lie away."""
    rows = rng.integers(0, len(at), n)

    def about(values: Array, low: Array, high: Array) -> Array:
        return values[rows] + NEAR * (high - low) / 2 * rng.standard_normal((n, len(low)))

    x, p = about(at.x, *box(ocp.initial_states)), about(at.p, *ocp.parameter_box)
    if isinstance(ocp.initial_states, Uniform):
        x = np.clip(x, *box(ocp.initial_states))
    return Problems(x, at.t[rows], np.clip(p, *ocp.parameter_box))


def visited(ddp: DDP, bank: SolutionBank, policy: Policy, torch_ocp: InTorch, n: int, kick: float,
            rng: np.random.Generator, around: Problems | None = None) -> Solution:
    """Tails from n states that the policy visits under kicks; `around` as in kicked_states."""
    return answered(ddp, bank, policy, torch_ocp,
                    kicked_states(bank, policy, torch_ocp, n, kick, rng, ddp.substeps, around))


def kicked_states(bank: SolutionBank, policy: Policy, torch_ocp: InTorch, n: int, kick: float,
                  rng: np.random.Generator, substeps: int = 1, around: Problems | None = None) -> Problems:
    """n states, or fewer, that the policy visits under kicks, at any time: those not far out of the box.

    around : problems near which half of the starts are drawn
    """
    ocp = torch_ocp.ocp
    start = Problems.initial(ocp, max(n // (2 if ocp.np else 8), 1), rng)
    if around is not None:
        start = Problems.join([start, near(ocp, around, len(start), rng)])
    t, x = kicked_rollout(torch_ocp, policy, start, kick * bank.scale[:ocp.system.nx], rng, substeps=substeps,
                          within=limits(ocp, bank))
    rows, k = rng.integers(0, len(x), n), rng.integers(0, len(t) - 1, n)
    found = Problems(x[rows, k], t[k], start.p[rows])
    far = 10 * np.maximum(np.abs(ocp.system.lbx), np.abs(ocp.system.ubx))
    fine = (np.abs(found.x) < far).all(axis=1)  # False for NaN
    if not fine.any():
        raise ValueError(f"the controller of {ocp.system.name} drives every state far out of the box: train for more "
                         "iterations, in a narrower tube (TrainSettings.width) or with smaller pushes (.kick)")
    return Problems(found.x[fine], found.t[fine], found.p[fine])


def answered(ddp: DDP, bank: SolutionBank, policy: Policy, torch_ocp: InTorch, at: Problems) -> Solution:
    """Tails from there: the best of a start from the policy's own answer and of one from the nearest solution, or from
    several of them.
    """
    p = at.given_p
    own = ddp.solve(at.x, at.t, u=policy_controls(policy, torch_ocp, at, ddp.intervals, ddp.substeps), p=p)
    return better(own, extend(ddp, bank, at.x, bank.several, at.t, p, KEPT))


def kicked_rollout(torch_ocp: InTorch, policy: Policy, start: Problems, kick: Array, rng: np.random.Generator,
                   steps: int = 160, kicks: int = 6, substeps: int = 1,
                   within: tuple[Array | float, Array | float] = (-np.inf, np.inf)) -> tuple[Array, Array]:
    """The policy's states (t [steps+1], x [B, steps+1, nx]) from the start, pushed by N(0, kick^2) at `kicks` random
    times, not beyond the bounds `within`."""
    ocp, here = torch_ocp.ocp, torch_ocp.at(start.p)
    steps = ocp.steps or steps
    h = ocp.system.dt or ocp.horizon / steps
    asked = 0.0 if ocp.system.is_discrete else h / 2  # after the start of a step
    x, path = torch.from_numpy(start.x), [start.x]
    times = rng.integers(0, steps, (kicks, len(start)))
    with torch.no_grad():
        for k in range(steps):
            push = (times == k).sum(axis=0)[:, None] * kick * rng.standard_normal(start.x.shape)
            x = torch.from_numpy(np.where(push == 0, x.numpy(), folded_into(x.numpy() + push, *within)))
            t = torch.full((len(x), 1), k * h, dtype=x.dtype)
            x = here.after(x, policy(x, t + asked, *here.p), t, h, substeps)
            path.append(x.numpy())
    return h * np.arange(steps + 1), np.stack(path, axis=1)


def policy_controls(policy: Policy, torch_ocp: InTorch, at: Problems, K: int, substeps: int = 1) -> Array:
    """The controls [B, K, nu] that the policy gives from there, each held over an interval of [t, T]."""
    state, start, here = torch.from_numpy(at.x), torch.from_numpy(at.t)[:, None], torch_ocp.at(at.p)
    controls, asked = [], 0.0 if torch_ocp.ocp.system.is_discrete else 0.5
    with torch.no_grad():
        for k in range(K):
            t, h = interval(torch_ocp.ocp, start, k, K)
            controls.append(policy(state, t + asked * h, *here.p))
            state = here.after(state, controls[-1], t, h, substeps)
    return torch.stack(controls, dim=1).numpy()


def interval(ocp: OCP, start: Tensor, k: int, K: int) -> tuple[Tensor, Tensor]:
    """(when interval k of K from `start` [B, 1] to the end begins, its length); in discrete time steps, and behind the
    end what lasts no time."""
    if ocp.system.dt is None:
        h = (ocp.horizon - start) / K
        return start + k * h, h
    t = torch.clamp(start + k * ocp.system.dt, max=ocp.horizon)
    return t, ocp.system.dt * (t < ocp.horizon - ocp.system.dt / 2).to(t.dtype)


def stepped_run(policy: Policy, torch_ocp: InTorch, at: Problems) -> tuple[Array, Array, Array]:
    """The policy as feedback in discrete time, asked at every sample: J [B], x [B, K+1, nx], t [B, K+1], which stand at
    the end."""
    ocp, here, start = torch_ocp.ocp, torch_ocp.at(at.p), torch.from_numpy(at.t)[:, None]
    assert ocp.steps is not None
    x, J, K = torch.from_numpy(at.x), torch.zeros_like(start), ocp.steps
    path, times = [x], [start]
    with torch.no_grad():
        for k in range(K):
            t, h = interval(ocp, start, k, K)
            x, cost = here.interval(x, policy(x, t, *here.p), t, h)
            J = J + cost
            path.append(x)
            times.append(interval(ocp, start, k + 1, K)[0])
        J = J + here.G(x)
    return J[:, 0].numpy(), torch.stack(path, dim=1).numpy(), torch.cat(times, dim=1).numpy()


def continuous_cost(policy: Policy, torch_ocp: InTorch, at: Problems, steps: int) -> Array:
    """J [B] of the policy as continuous feedback from there."""
    return continuous_run(policy, torch_ocp, at, steps)[0]


def continuous_run(policy: Policy, torch_ocp: InTorch, at: Problems, steps: int) -> tuple[Array, Array, Array]:
    """The policy as continuous feedback from there, by RK4 on (x, t, cost), or implicit steps: J [B],
    x [B, steps+1, nx], t [B, steps+1]. In discrete time at its own steps.
    """
    if torch_ocp.ocp.system.is_discrete:
        return stepped_run(policy, torch_ocp, at)
    if isinstance(policy, Rolled) and policy.loop is not None and policy.loop.of is torch_ocp:
        return policy.loop(at.x, at.t, at.p, steps)
    n, here, steps_of = at.x.shape[1], torch_ocp.at(at.p), torch_ocp.implicit

    def closed_loop(z: Tensor, _: None) -> Tensor:
        x, t = z[:, :n], z[:, n:n + 1]
        u = policy(x, t, *here.p)
        return torch.cat([here.f(x, u, t), torch.ones_like(t), here.L(x, u, t)], dim=1)

    def after(z: Tensor) -> Tensor:
        if steps_of is None:
            return rk4(closed_loop, z, None, h)
        x, t, J = z[:, :n], z[:, n:n + 1], z[:, n + 1:]
        end, cost = steps_of.fed_back(here, x, policy, t, h)
        return torch.cat([end, t + h, J + cost], dim=1)

    z = torch.from_numpy(np.column_stack([at.x, at.t, np.zeros(len(at))]))
    h = torch.from_numpy((torch_ocp.ocp.horizon - at.t) / steps)[:, None]
    path = [z]
    with torch.no_grad():
        for _ in range(steps):
            path.append(after(path[-1]))
        J = (path[-1][:, n + 1] + here.G(path[-1][:, :n])[:, 0]).numpy()
    way = torch.stack(path, dim=1).numpy()
    return J, np.ascontiguousarray(way[..., :n]), np.ascontiguousarray(way[..., n])
