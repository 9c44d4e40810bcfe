"""Laws for problems whose horizon is free: u(x[, p]), from any state to where the terminal constraints hold.

Without a clock what is left of a solution from any of its nodes is a solution from there, so that every node is a
label. Rounds of states that the law visits under pushes are solved too, as in the default training.
"""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray

from nocl.data import Solution
from nocl.definition import measured
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.definition.substeps import FINE, RADAU
from nocl.judge.simulation import simulate
from nocl.nets import FeatureNet
from nocl.solvers.cnd.controller import CND
from nocl.solvers.cnd.regression.barrier import guarded
from nocl.solvers.cnd.regression.features import net_on, without_clock
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Labels, Problems
from nocl.solvers.cnd.regression.regress import fit_net, policy_loss
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.validate import over, summary
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.nodes import NodeBank
from nocl.solvers.ddp.solver import DDP, substeps_for
from nocl.support.checks import Array
from nocl.support.progress import Bar, within
from nocl.support.progress import bar as progress_bar
from nocl.support.threads import one_thread

AT_BOUND = 1e-3  # of the width of U: closer controls are at a bound
LONGER = 1.5  # times the longest solution, that a law is followed for
STEPS = 240  # of that
KICKS = 4  # in it
FAR = 10  # times X: states that a law drives out that far are not asked for


def check_law(ocp: OCP, dynamics: Any, settings: TrainSettings) -> None:
    """ValueError where a law without a clock is not what a problem asks for, or not to be had."""
    name = ocp.system.name
    if dynamics is not None:
        ocp.refuse_free("train on learned dynamics")
    if ocp.uses_time:
        raise ValueError(f"train: the problem on {name!r} has a free horizon and holds the time, so that no u(x) is "
                         "best; expected one without nocl.time(), or a number as horizon")
    if not ocp.held_at_end:
        raise ValueError(f"train: the problem on {name!r} has a free horizon and no terminal constraints, so that a "
                         "law would not know where it ends; expected terminal_constraints, or a number as horizon")
    if settings.integrator == RADAU:
        raise ValueError(f"train: the problem on {name!r} has a free horizon, and its law is trained by Runge-Kutta "
                         "steps; expected integrator='auto' or 'rk4'")
    if settings.minutes is not None:
        raise ValueError(f"train: minutes are for problems whose horizon is a number, and that of {name!r} is free; "
                         "expected none: fewer iterations, tails and visits take less time")
    if settings.control_dt:
        raise ValueError("train: control_dt=True is for problems whose horizon is a number; expected False: hold the "
                         "law's answers, simulate(..., hold=K)")


@dataclass(frozen=True, eq=False)
class Switches:
    """Intervals of solutions in which one control goes from a bound to the other: what is held there, between the
    bounds, stands for a switch on the way, before and after which a law is at the bounds."""

    blurred: NDArray[np.bool_]  # [B K], intervals with such a control
    share: Array  # [n], of the interval before the switch, for each of them with one such control alone
    rows: NDArray[np.int64]  # [n], which these are
    before: Array  # [n, nu]
    after: Array  # [n, nu]

    @staticmethod
    def of(s: Solution, ocp: OCP) -> Switches:
        low, high = ocp.system.lbu, ocp.system.ubu
        u, near = s.u, AT_BOUND * (high - low)
        first, last = np.concatenate([u[:, :1], u[:, :-1]], axis=1), np.concatenate([u[:, 1:], u[:, -1:]], axis=1)
        at = [(v <= low + near, v >= high - near) for v in (first, u, last)]
        between = ~(at[1][0] | at[1][1]) & (at[0][0] & at[2][1] | at[0][1] & at[2][0])
        flat = between.reshape(-1, u.shape[2])
        rows = np.flatnonzero(flat.sum(axis=1) == 1)
        of = flat[rows]
        held, first, last = (v.reshape(len(flat), -1)[rows] for v in (u, first, last))
        share = (held - last)[of] / (first - last)[of]
        return Switches(flat.any(axis=1), share, rows, np.where(of, first, held), np.where(of, last, held))

    def labels(self, held: Labels, torch_ocp: InTorch) -> Labels:
        """In the middle of the time before each switch, and of that after it; `held` are the intervals as they begin.
        """
        start = held[self.rows]
        here, t = torch_ocp.at(start.p), torch.from_numpy(start.t)[:, None]
        u, then = torch.from_numpy(self.before), torch.from_numpy(self.after)
        h, part = torch.from_numpy(start.dt)[:, None], torch.from_numpy(self.share)[:, None]
        with torch.no_grad():
            x = torch.from_numpy(start.x)
            early = here.after(x, u, t, part * h / 2)
            late = here.after(here.after(x, u, t, part * h), then, t + part * h, (1 - part) * h / 2)
        none = np.zeros(len(start))
        return Labels.join([
            replace(start, x=early.numpy(), u=self.before, weight=start.weight * self.share, dt=none),
            replace(start, x=late.numpy(), u=self.after, weight=start.weight * (1 - self.share), dt=none)])


def law_advice(row: dict[str, Any], held_out: int) -> str | None:
    """What to say, and to try, where held-out runs do not arrive, or take long; None where it is well."""
    tries = "try TrainSettings with more tails or visits, more iterations, wider layers, or branches=2"
    if row["unsolved"] > 0.1 * held_out:
        return (f"{row['unsolved']} of {held_out} held-out initial states were not solved, the gap is that of the "
                "others: try TrainSettings with more seeds and starts")
    if row["arrived"] < 1:
        return (f"{100 * (1 - row['arrived']):.2g} % of runs from held-out initial states do not arrive within the "
                f"longest horizon; {tries}")
    if row["gap_median"] > 0.01 or row["gap_p95"] > 0.2:
        return (f"the law costs {100 * row['gap_median']:.2g} % more than the optimum (median; 95th percentile "
                f"{100 * row['gap_p95']:.2g} %) on held-out initial states; {tries}")
    return None


class LawTraining:
    """One run; without `switches` every interval is a label as any other."""

    def __init__(self, ocp: OCP, settings: TrainSettings, seed: int, progress: bool | None,
                 own: ca.Function | None, switches: bool = True) -> None:
        self.ocp, self.settings, self.seed, self.own, self.switches = ocp, settings, seed, own, switches
        self.progress = progress
        substeps = settings.substeps or substeps_for(ocp, None, settings.grid, FINE)
        self.ddp = DDP(ocp, intervals=settings.grid, substeps=substeps)
        self.loose = DDP(ocp.loosened(TOLERANCE), intervals=4 * settings.grid, substeps=-(-substeps // 4))
        self.in_torch = InTorch(ocp)
        self.round, self.seconds, self.history = 0, 0.0, list[dict[str, Any]]()

    def run(self) -> CND:
        with one_thread(), within(self.progress):
            return self._run()

    def _run(self) -> CND:
        s, begin = self.settings, time.perf_counter()
        self._first_labels()
        self._network()
        while self.round <= s.rounds and not self._good_enough():
            if self.round:
                self._visit()
            self._regress(s.iterations * (2 if self.round >= max(s.least_rounds, 1) else 1))
            self._validate()
            self._keep_best()
            self.round += 1
        self.net.load_state_dict(self.weights)
        if (remark := law_advice(self._best(), s.held_out)) is not None:
            warnings.warn(f"{self.ocp.system.name}: {remark}", stacklevel=4)
        self.seconds = time.perf_counter() - begin
        return CND(self.ocp, self._finished(), None, self._card())

    def _finished(self) -> FeatureNet:
        """The law as it is handed out."""
        return self.net

    def _first_labels(self) -> None:
        s, rng = self.settings, own_numbers(self.seed, 0)
        with self._stage("labels", 3) as bar:
            first = Problems.initial(self.ocp, s.seeds, rng)
            seeds = solve_globally(self.ddp, first.x, p=first.given_p, starts=s.starts, seed=rng)
            self.bank = NodeBank(self.ocp, seeds)
            bar.update()
            if s.states:
                further = Problems.initial(self.ocp, s.states, rng)
                self.bank = self.bank.add(self.bank.solve(self.ddp, further.x, further.p))
            bar.update()
            self.labels = self._labels(self.bank.solution)
            if s.tails:
                near = self.bank.solve(self.ddp, *self.bank.around(s.tails, s.width, rng))
                self._learn(near)
            bar.update()

    def _labels(self, solution: Solution) -> Labels:
        """Of solutions that end on time: those of the least horizon wait for it."""
        s = solution[solution.success & (solution.t[:, -1] > self.ocp.horizon.low * (1 + 1e-3))]
        plain = Labels.of(s, self.in_torch, self._unit(), self.ddp.substeps)
        if not self.switches:
            return plain
        where = Switches.of(s, self.ocp)
        return Labels.join([plain[~where.blurred], where.labels(Labels.held(s, self._unit()), self.in_torch)])

    def _unit(self) -> float:
        return float(np.median(np.abs(self.bank.solution.cost)))

    def _learn(self, solution: Solution) -> None:
        self.bank = self.bank.add(solution)
        self.labels = Labels.join([self.labels, self._labels(solution)])

    def _network(self) -> None:
        s = self.settings
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            phi = without_clock(self.ocp, self.labels, self.own)
            self.net, self.inverse = net_on(self.ocp, phi, self.labels, s.hidden, s.branches, guarded(self.ocp),
                                            float(np.median(self.bank.solution.t[:, -1])))

    def _visit(self) -> None:
        s, rng = self.settings, own_numbers(self.seed, self.round)
        with self._stage(f"round {self.round}: visited states", 1) as bar:
            x, p = self._visited(s.visits, rng)
            self._learn(self.bank.solve(self.ddp, x, p))
            bar.update()

    def _visited(self, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """States [n, nx] and parameters on the law's ways, under pushes, before it arrives."""
        start = Problems.initial(self.ocp, max(n // 8, 1), rng)
        here, h = self.in_torch.at(start.p), LONGER * self.bank.solution.t[:, -1].max() / STEPS
        pushed = rng.integers(0, STEPS, (KICKS, len(start)))
        x, path = torch.from_numpy(start.x), [start.x]
        with torch.no_grad():
            for k in range(STEPS):
                kick = (pushed == k).sum(axis=0)[:, None] * self.settings.kick * self.bank.scale
                x = x + torch.from_numpy(kick * rng.standard_normal(start.x.shape))
                t = torch.zeros(len(x), 1, dtype=x.dtype)
                x = here.after(x, self.net(x, t, *here.p), t, h, self.ddp.substeps)
                path.append(x.numpy())
        states = np.stack(path, axis=1)
        rows, nodes = np.nonzero(self._under_way(states, start.p))
        chosen = rng.choice(len(rows), min(n, len(rows)), replace=False)
        return states[rows[chosen], nodes[chosen]], start.p[rows[chosen]]

    def _under_way(self, states: Array, p: Array) -> Array:
        """[B, steps+1], whether states are not yet where it ends, and not far out of X."""
        B, n, nx = states.shape
        flat = states.reshape(-1, nx)
        at_end = measured.least_at_end(self.ocp, flat, np.repeat(p, n, axis=0)) / self.ocp.functions.end_scales
        far = FAR * np.maximum(np.abs(self.ocp.system.lbx), np.abs(self.ocp.system.ubx))
        arrived = (at_end >= -TOLERANCE).all(axis=1).reshape(B, n)
        before = ~np.maximum.accumulate(arrived, axis=1)
        return before & (np.abs(flat) < far).all(axis=1).reshape(B, n)

    def _regress(self, iterations: int) -> None:
        s = self.settings
        loss = policy_loss(self.ocp, self.net, self.inverse, self.labels)
        with self._stage(f"round {self.round}: law", iterations) as bar:
            fit_net(self.net, loss, len(self.labels), iterations=iterations, batch=s.batch, lr=s.lr,
                    seed=self.seed + self.round, report=lambda _: bar.update())

    def _validate(self) -> None:
        """The gap of runs, as the judge sees them, to the least cost of arriving as near."""
        s, rng = self.settings, own_numbers(self.seed, 1_000_000)
        with self._stage("held-out states", 1) as bar:
            fresh = Problems.initial(self.ocp, s.held_out, rng)
            best = self.bank.solve(self.loose, fresh.x, fresh.p, 4)
            run = simulate(self.ocp, CND(self.ocp, self.net, None, {}), fresh.x, p=fresh.given_p)
            gap = over(np.where(run.success, run.cost, np.inf), best)
            bar.update()
        self.history.append({"round": self.round, "labels": len(self.labels), "unsolved": int((~best.success).sum()),
                             "arrived": float(run.reached.mean()), **summary(gap, "gap")})

    def _keep_best(self) -> None:
        """Of the rounds the best law: where it switches, a fit is a little better or worse than the last one."""
        last = self.history[-1]
        if last is self._best():
            self.weights = copy.deepcopy(self.net.state_dict())

    def _best(self) -> dict[str, Any]:
        return min(self.history, key=lambda row: (-row["arrived"], row["gap_p95"], row["gap_median"]))

    def _good_enough(self) -> bool:
        if self.round <= self.settings.least_rounds:
            return False
        last, s = self._best(), self.settings
        return bool(last["gap_median"] <= s.gap_median and last["gap_p95"] <= s.gap_p95)

    def _card(self) -> dict[str, Any]:
        last = self._best()
        return {"method": "default", "dynamics": "exact", "seed": self.seed, "seconds": round(self.seconds, 1),
                **{name: last[name] for name in ("gap_median", "gap_p95", "arrived", "unsolved")},
                "settings": asdict(self.settings), "history": self.history}

    @contextmanager
    def _stage(self, name: str, total: int) -> Iterator[Bar]:
        with progress_bar(total, name, self.progress) as bar:
            yield bar
