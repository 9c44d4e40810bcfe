"""Held-out problems that training is judged on: no label starts there, and they are solved anew on a fine grid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator
from torch import Tensor

from nocl.data import Solution
from nocl.definition.scales import usual_sizes
from nocl.hjb import hjb_residual
from nocl.nets import FeatureNet
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import (
    SMALL,
    Policy,
    Problems,
    answered,
    continuous_cost,
    kicked_states,
    tube_states,
)
from nocl.solvers.ddp.bank import SolutionBank, extend
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

FLOOR = 0.5  # of the gap, that explains it
COLD = 4  # starts of held-out states that the bank's solutions do not lead to
NODES = 16  # of each solution at which the HJB residual is taken


@dataclass(frozen=True)
class Finer:
    """A solver on a fine grid, and where plans keep margins inside their constraints one on theirs that keeps none: to
    get to the boundary takes many more iterations than to change the grid."""

    ddp: DDP
    plain: DDP | None = None

    def without_margins(self, s: Solution) -> Solution:
        """The solutions without the margins; as they are where that fails."""
        if self.plain is None:
            return s
        found = self.plain.solve(s.x[:, 0], s.t[:, 0], p=s.p, u=s.u, x=s.x, gain=s.gain)
        s = replace(s, tried=None)[np.arange(len(s))]  # a copy
        s.put(np.flatnonzero(found.success), found[found.success])
        return s


Fine: TypeAlias = DDP | Finer


def refined(fine: Fine, coarse: Solution) -> Solution:
    """The solutions that succeeded, solved again on the fine grid: those that succeed there."""
    finer = solved_again(fine, coarse)
    return finer[finer.success]


def solved_again(fine: Fine, coarse: Solution) -> Solution:
    """The solutions that succeeded, solved again on the fine grid, from them as feedback: open loops may run away."""
    finer = fine if isinstance(fine, Finer) else Finer(fine)
    s = finer.without_margins(coarse[coarse.success])
    times = finer.ddp.intervals // s.u.shape[1]
    u, gain = (np.repeat(of, times, axis=1) for of in (s.u, s.gain))
    return finer.ddp.solve(s.x[:, 0], s.t[:, 0], p=s.p, u=u, x=_between(s.x, times), gain=gain)


def _between(x: Array, times: int) -> Array:
    """[B, times K + 1, nx], on cubic splines through the nodes x [B, K+1, nx]."""
    K = x.shape[1] - 1
    finer: Array = CubicSpline(np.arange(K + 1), x, axis=1)(np.arange(times * K + 1) / times)
    return finer


def held_out(ddp: DDP, fine: Fine, bank: SolutionBank, fresh: Problems) -> Solution:
    """Fresh initial states, solved from the bank's nearest; where that fails, from cold starts."""
    found = extend(ddp, bank, fresh.x, p=fresh.given_p)
    lost = np.flatnonzero(~found.success & ~_infeasible(found))
    if len(lost):
        p = None if fresh.given_p is None else fresh.given_p[lost]
        again = solve_globally(ddp, fresh.x[lost], p=p, starts=COLD, rounds=1, progress=False)
        found = replace(found, tried=None)
        found.put(lost[again.success], again[again.success])
    return solved_again(fine, found)


def held_out_optima(ddp: DDP, fine: Fine, bank: SolutionBank, fresh: Problems) -> Solution:
    """The optima of fresh initial states."""
    solved = held_out(ddp, fine, bank, fresh)
    return solved[solved.success]


def cannot_hold(s: Solution) -> int:
    """How many were not solved because nothing was found that holds their constraints."""
    return int(_infeasible(s).sum())


def _infeasible(s: Solution) -> NDArray[np.bool_]:
    return ~s.success & np.char.startswith(s.message, "infeasible")


def kicked_optima(ddp: DDP, fine: Fine, bank: SolutionBank, policy: Policy, torch_ocp: InTorch, n: int, kick: float,
                  rng: np.random.Generator) -> Solution:
    """The optima from n states that the policy visits under kicks, at times all over the horizon."""
    at = kicked_states(bank, policy, torch_ocp, n, kick, rng, ddp.substeps)
    return refined(fine, answered(ddp, bank, policy, torch_ocp, at))


def tube_optima(ddp: DDP, fine: Fine, bank: SolutionBank, policy: Policy, torch_ocp: InTorch, n: int, width: float,
                rng: np.random.Generator) -> Solution:
    """The optima from n states of the tube."""
    _, at = tube_states(ddp.ocp, bank, n, width, rng)
    return refined(fine, answered(ddp, bank, policy, torch_ocp, at))


def gap(policy: Policy, torch_ocp: InTorch, best: Solution, unit: float = 0.0, substeps: int = 1) -> Array:
    """(J - J*) / (|J*| + SMALL unit) [B] of the policy as continuous feedback, from where the solutions start."""
    start = Problems(best.x[:, 0], best.t[:, 0], best.parameters)
    J = continuous_cost(policy, torch_ocp, start, substeps * best.u.shape[1])
    with np.errstate(invalid="ignore"):  # inf - inf where neither is known
        shares: Array = (J - best.cost) / (np.abs(best.cost) + SMALL * unit)
    return shares


def over(J: Array, best: Solution) -> Array:
    """(J - J*) / |J*| of the optima that were solved; J [B] of all, J* < 0 where something is gained."""
    found = best[best.success]
    shares: Array = (J[best.success] - found.cost) / np.abs(found.cost)
    return shares


def own_feedback(plans: Solution, steps: int) -> Policy:
    """Each plan itself as feedback in continuous time, for `steps` steps from where the plans start, row by row; each
    row as often as the stages of an implicit step ask for it.

    Controls by monotone cubics through the middles of the intervals, where labels stand, the plan's states by cubic
    splines through its nodes, its gains held: what a network would be that had learned the labels, and no more.
    """
    K = plans.u.shape[1]
    share = np.linspace(0.0, 1.0, 2 * steps + 1)
    controls = PchipInterpolator((np.arange(K) + 0.5) / K, plans.u, axis=1, extrapolate=True)(share)
    states = CubicSpline(np.arange(K + 1) / K, plans.x, axis=1)(share)
    gains = plans.gain[:, np.minimum((share * K + 1e-9).astype(int), K - 1)]
    u, x, gain = (torch.from_numpy(np.ascontiguousarray(z)) for z in (controls, states, gains))
    t0, left = (torch.from_numpy(z.copy()) for z in (plans.t[:, 0], plans.t[:, -1] - plans.t[:, 0]))

    def policy(state: Tensor, t: Tensor, *_: Tensor) -> Tensor:
        rows = torch.arange(len(u)).repeat_interleave(len(state) // len(u))
        place = ((t[:, 0] - t0[rows]) / left[rows] * 2 * steps).clamp(0, 2 * steps)
        k = torch.round(place).long()
        on = (k - place).abs() < 1e-6  # Runge and Kutta's stages are
        below = torch.where(on, k, place.long())
        share = torch.where(on, 0.0, place - below)[:, None]
        above = (below + 1).clamp(max=2 * steps)

        def between(z: Tensor) -> Tensor:
            return z[rows, below] + share * (z[rows, above] - z[rows, below])

        return between(u) + torch.einsum("bij,bj->bi", gain[rows, below], state - between(x))

    return policy


def labels_gap(torch_ocp: InTorch, labels: Solution, best: Solution, substeps: int = 1) -> Array:
    """(J - J*) / |J*| [B] of labels' plans, on their own grid, as feedback, where `best` are the optima from there."""
    s, steps = torch_ocp.ocp.system, substeps * best.u.shape[1]
    follow = own_feedback(labels, steps)
    low, high = (torch.from_numpy(np.array(b, dtype=np.float64)) for b in (s.lbu, s.ubu))
    return gap(lambda x, t, *p: torch.clamp(follow(x, t, *p), low, high), torch_ocp, best, substeps=substeps)


def floored_by(row: dict[str, Any], labels: float, intervals: int, goal: float, bare: float | None = None) -> str:
    """What keeps the last round's gap where it is, with what to try.

    labels : the median gap of the labels' own plans as feedback
    bare : the same of plans without the margins that labels keep; None where they keep none
    """
    median = row["gap_median"]
    if labels > max(goal, FLOOR * median):
        if bare is not None and bare <= FLOOR * labels:
            return (f"its labels keep margins inside the constraints, which cost {100 * (labels - bare):.2g} %: rounds "
                    "that violate nothing make them smaller, TrainSettings(rounds=...)")
        return (f"its labels' own plans, on {intervals} intervals, cost {100 * labels:.2g} % more than the optimum "
                f"when followed: the grid floors the gap, more intervals lower it (--intervals {2 * intervals}, "
                f"TrainSettings(intervals={2 * intervals}))")
    if median > goal and row["loss"] and row["loss"][-1] > FLOOR * median:
        return ("the network misses its own labels by as much: wider layers (hidden=(128, 128, 128)) or more "
                "iterations lower the gap")
    if median > goal:
        return "states that the labels do not cover: more visits, tails or states lower the gap"
    return "a few states, as where optima of several kinds meet: more seeds and states, or branches=2, lower their gap"


def held_gap(policy: Policy, torch_ocp: InTorch, best: Solution, substeps: int = 1) -> Array:
    """The same of a policy that is asked at the solutions' nodes and held; they start at t = 0."""
    here, K = torch_ocp.at(best.parameters), best.u.shape[1]
    x, h, running = torch.from_numpy(best.x[:, 0]), torch_ocp.ocp.horizon / K, torch.zeros(len(best), 1)
    with torch.no_grad():
        for k in range(K):
            t = torch.full((len(x), 1), k * h, dtype=x.dtype)
            x, cost = here.interval(x, policy(x, t, *here.p), t, h, substeps)
            running = running + cost
        J = (running + here.G(x))[:, 0].numpy()
    shares: Array = (J - best.cost) / np.abs(best.cost)
    return shares


def summary(shares: Array, name: str) -> dict[str, float]:
    """Median and 95th percentile, NaN where there is none; a policy that blows up counts as infinitely bad."""
    known = np.nan_to_num(shares, nan=np.inf)
    median, p95 = np.quantile(known, [0.5, 0.95], method="higher") if len(known) else (np.nan, np.nan)
    return {f"{name}_median": float(median), f"{name}_p95": float(p95)}


def value_scores(value: FeatureNet, policy: Policy, torch_ocp: InTorch,
                 optima: dict[str, Solution]) -> dict[str, float]:
    """|V - J*| / (|J*| + J_small) (mean and median), V_x against costates (medians) of each set of optima; the HJB
    residual.

    J_small is SMALL of the mean |J*| of the first set: a tail that costs next to nothing is no measure. Slopes are by
    usual states, so that units change nothing. The residual V_t + L + V_x' f is taken at the policy's u along the last
    set, in units of its mean running cost; there is none in discrete time.
    """
    row: dict[str, float] = {}
    usual, small = usual_sizes(torch_ocp.ocp).x, SMALL * np.abs(next(iter(optima.values())).cost).mean()
    for name, s in optima.items():
        V, V_x = _value_and_slope(value, s.x[:, 0], s.t[:, 0], torch_ocp.at(s.parameters).p)
        error = np.abs(V - s.cost) / (np.abs(s.cost) + small)
        row |= {f"{name}_error": float(error.mean()), f"{name}_error_median": float(np.median(error))}
        slope, costate = V_x * usual, s.V_x[:, 0] * usual
        size, true = np.linalg.norm(slope, axis=1), np.linalg.norm(costate, axis=1)
        cosine = np.clip((slope * costate).sum(axis=1) / (size * true), -1, 1)
        row[f"{name}_degrees"] = float(np.degrees(np.median(np.arccos(cosine))))
        row[f"{name}_slope_error"] = float(np.median(np.abs(size / true - 1)))
    return row if torch_ocp.ocp.system.is_discrete else row | _hjb(value, policy, torch_ocp, list(optima.values())[-1])


def _value_and_slope(value: FeatureNet, x: Array, t: Array, p: list[Tensor]) -> tuple[Array, Array]:
    states = torch.from_numpy(x).clone().requires_grad_(True)
    with torch.enable_grad():
        V = value(states, torch.from_numpy(t)[:, None], *p)
        (slope,) = torch.autograd.grad(V.sum(), states)
    return V.detach().numpy()[:, 0], slope.numpy()


def _hjb(value: FeatureNet, policy: Policy, torch_ocp: InTorch, tails: Solution) -> dict[str, float]:
    """The HJB residual along tails, in units of their mean running cost; where L = 0, of |V| over the horizon."""
    every = slice(0, -1, max(tails.u.shape[1] // NODES, 1))
    x = torch.from_numpy(np.ascontiguousarray(tails.x[:, every].reshape(-1, tails.x.shape[2])))
    t = torch.from_numpy(np.ascontiguousarray(tails.t[:, every].reshape(-1, 1)))
    here = torch_ocp.at(np.repeat(tails.parameters, len(x) // len(tails), axis=0))
    with torch.no_grad():
        u = policy(x, t, *here.p)
        usual = float(here.L(x, u, t).abs().mean()) or float(value(x, t, *here.p).abs().mean()) / torch_ocp.ocp.horizon
    residual = hjb_residual(lambda x, t: value(x, t, *here.p), lambda x, u: here.f(x, u, t),
                            lambda x, u: here.L(x, u, t), x, u, t).detach().abs().numpy()
    return {"hjb_median": float(np.median(residual)) / usual, "hjb_mean": float(residual.mean()) / usual}


def advice(row: dict[str, Any], rounds: int, held_out: int, violating: float = 1.0, floor: str = "") -> str | None:
    """What to say, and to try, where the last round's gap is large or few states tell it; None where it is well.

    floor : what is known to keep the gap where it is, said in place of what may help
    """
    if row["unsolved"] > 0.1 * held_out:
        return (f"{row['unsolved']} of {held_out} held-out initial states could not be solved, the gap is that of the "
                "others: try TrainSettings with more seeds and starts, or more intervals where the dynamics are fast")
    if row.get("gap_violating", 0.0) > violating:
        name, worst = max(row["gap_worst"].items(), key=lambda item: item[1])
        return (f"{100 * row['gap_violating']:.2g} % of runs from held-out initial states violate a constraint after "
                f"{rounds} rounds, {name!r} by {worst:.2g} of its scale at worst; expected {100 * violating:g} %: "
                "try TrainSettings with more rounds, visits or states, or wider layers (hidden=(128, 128, 128))")
    if row["gap_median"] <= 0.01 and row["gap_p95"] <= 0.2:
        return None
    tries = ("more rounds or visits, wider layers (hidden=(128, 128, 128)) or more iterations"
             if row["gap_median"] > 0.01 else
             "more seeds and states, where basins of different optima meet, or wider layers")
    return (f"the controller costs {100 * row['gap_median']:.2g} % more than the optimum (median; 95th percentile "
            f"{100 * row['gap_p95']:.2g} %) on held-out initial states after {rounds} rounds; expected less than 1 %: "
            f"{floor or 'try TrainSettings with ' + tries}")
