"""nocl.train: from an optimal control problem to a checked feedback controller.

The default method regresses the controller on optimal answers, and never differentiates through a rollout:

1. a few global optima (cold starts), and from them those of many initial states;
2. optimal tails from a tube about these trajectories, all by batched DDP on the dynamics that training uses;
3. regression of u(x, t) on the middle of every interval, so that the controller is feedback in continuous time;
4. rounds: the states that the controller visits under kicks are solved too and added (DAgger, Ross et al. 2011), until
   it meets the wanted gap on held-out initial states (after two rounds at least), or two rounds in a row did not pay,
   or rounds or time are used up (nocl.solvers.cnd.plan);
5. V(x, t) by regression on the costs-to-go and their gradients, the costates.
"""

from __future__ import annotations

import copy
import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import torch

from nocl.data import Solution
from nocl.definition import discrete
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.definition.substeps import FINE, RADAU, RK4, Steps
from nocl.exports import parity
from nocl.nets import FeatureNet
from nocl.solvers.cnd.controller import CND
from nocl.solvers.cnd.fineness import few_plans, intervals_for
from nocl.solvers.cnd.held import Held
from nocl.solvers.cnd.laws import LawTraining, check_law
from nocl.solvers.cnd.paper import PaperSettings, train_paper
from nocl.solvers.cnd.plan import KICKED, PAYS, VALUE_HELD_OUT, Costs, Kind, Plan, measured, missed_by, stalled
from nocl.solvers.cnd.plan import iterations as planned_iterations
from nocl.solvers.cnd.regression import barrier
from nocl.solvers.cnd.regression.features import at_rate, own_features, policy_net
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import (
    KEPT,
    NEIGHBOURS,
    Labels,
    Problems,
    answered,
    at_other_rates,
    rivals,
    tube,
    visited,
)
from nocl.solvers.cnd.regression.regress import fit_net, policy_loss
from nocl.solvers.cnd.regression.rolled import Rolled
from nocl.solvers.cnd.settings import AUTO, TrainSettings, identity
from nocl.solvers.cnd.stationary import StationaryTraining, check_stationary
from nocl.solvers.cnd.validate import (
    Finer,
    advice,
    cannot_hold,
    floored_by,
    gap,
    held_gap,
    held_out,
    held_out_optima,
    kicked_optima,
    labels_gap,
    solved_again,
    summary,
    tube_optima,
    value_scores,
)
from nocl.solvers.cnd.value import ValueLabels, on_fine_grid, value_loss, value_net, value_tails
from nocl.solvers.ddp.bank import SolutionBank, better, extend
from nocl.solvers.ddp.global_search import OnMessage, solve_globally
from nocl.solvers.ddp.opinion import second_opinion
from nocl.solvers.ddp.solver import DDP, steps_for
from nocl.support import checks, store
from nocl.support.budget import ENDLESS, Budget
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.support.progress import Bar, say, shown, within
from nocl.support.progress import bar as progress_bar
from nocl.support.threads import one_thread

if TYPE_CHECKING:
    from nocl.solvers.cnd.paper import PaperSettings
    from nocl.sysid.identification import LearnedDynamics

__all__ = ["TrainSettings", "train"]
CHECKPOINT = "training.safetensors"
VALUE_LARGE = 0.05  # mean error of V (validate.value_scores) that a warning is given above
MARGINS = 3  # rounds that begin with new margins, where there are constraints
LOSSES = 40  # of each regression that the card keeps
REHEARSED = (16, 16)  # points inside the box, and corners, at which an export is tried before training


def train(ocp: OCP, dynamics: LearnedDynamics | None = None, *, method: str = "default",
          settings: TrainSettings | PaperSettings | None = None, seed: int = 0, minutes: float | None = None,
          out: str | os.PathLike[str] | None = None, progress: bool | None = None, features: Any = None) -> CND:
    """Train a controller and a value function for all of an OCP's initial states.

    Parameters
    ----------
    ocp : OCP
    dynamics : LearnedDynamics, optional
        f_theta in place of the exact f; the exact one is then not used anywhere.
    method : "default" or "paper"
        "paper" is CND as published: HJB losses through ODE rollouts, see nocl.solvers.cnd.paper.
    settings : TrainSettings, or PaperSettings with method="paper"
        Default: TrainSettings.of("normal", parameters=ocp.np).
    seed : int
        The same seed gives the same controller on the same machine, where there is no limit of minutes.
    minutes : float, optional
        Of wall-clock time, in place of settings.minutes: labels, rounds and fits are planned within it, and the best
        controller so far is returned; card["minutes"] and card["stopped"] say so. The default method alone has it.
    out : folder, optional
        Where checkpoints go: a call with the same arguments goes on from the last one. A law of a problem whose horizon
        is free is trained anew.
    progress : bool, optional
        Whether to show an estimate of the time, and progress: a bar on a terminal, elsewhere a line at least every 10
        s. Default: True.
    features : SX expressions in states, parameters and nocl.time(), optional
        What the networks see beside nocl's own features, where the user knows what matters: the angle to an obstacle,
        the energy. Finite all over X.
    """
    begin = time.monotonic()
    _check(ocp, dynamics, seed, out)
    checks.word(method, ("default", "paper"), "method", "train")
    if method == "paper":
        checks.problem(ocp, "train with method='paper'")
        if minutes is not None:
            raise ValueError("train: minutes are for the default method; 'paper' has PaperSettings(patience=...) and "
                             "iterations: leave them out")
        ocp.refuse_constraints(f"train with method={method!r}",
                               "train by the default method, or solve it by NMPC or DDP")
        chosen = _expect(settings, PaperSettings)
        checkpoint = None if out is None else Path(out) / CHECKPOINT
        if features is not None:
            raise ValueError("train: features are for the default method; 'paper' has the paper's own: leave them out")
        policy, value, card = train_paper(ocp, dynamics, chosen, seed=seed, progress=progress, checkpoint=checkpoint)
        return CND(ocp, policy, value, card)
    own = own_features(ocp, features)
    usual = TrainSettings.of("normal", parameters=ocp.np)
    chosen = usual if settings is None else _expect(settings, TrainSettings)
    chosen = chosen if minutes is None else replace(chosen, minutes=minutes)
    if ocp.system.is_discrete:
        chosen = _in_steps(ocp, dynamics, chosen)
    if ocp.is_infinite:
        check_stationary(ocp, dynamics, chosen)
        return StationaryTraining(ocp, chosen, seed, progress, own).run()
    if ocp.is_free:
        check_law(ocp, dynamics, chosen)
        return LawTraining(ocp, chosen, seed, progress, own).run()
    return Training(ocp, dynamics, _gridded(ocp, dynamics, chosen), seed, out, progress, own, begin).run()


def _in_steps(ocp: OCP, dynamics: LearnedDynamics | None, s: TrainSettings) -> TrainSettings:
    """The settings in discrete time, where the steps are given; ValueError for what is about continuous time."""
    if dynamics is not None:
        ocp.system.refuse_discrete("training on learned dynamics", "no dynamics: it is trained on F itself")
    if ocp.is_infinite:
        ocp.system.refuse_discrete("training on an INFINITE horizon", "a horizon of many steps, or "
                                   "nocl.solvers.LQR(ocp), whose gain is the same for ever")
    if s.control_dt:
        ocp.system.refuse_discrete("training with control_dt", "control_dt=False: a control is held for a step")
    discrete.check_steps(ocp.system, s.substeps, None if s.integrator == AUTO else s.integrator, "train")
    return replace(s, intervals=discrete.intervals_of(ocp, s.intervals, "train"))


def estimate(ocp: OCP, settings: TrainSettings, seed: int = 0) -> str:
    """How long a training on the exact f takes on this machine, in words, from a few solves and iterations.

    Raises ValueError for problems that training refuses.
    """
    checks.problem(ocp, "an estimate of training")
    ocp.refuse_free("an estimate of training")
    with one_thread(), within(False):
        run = Training(ocp, None, _gridded(ocp, None, settings), seed, None, False)
        costs = measured(ocp, run.ddp, run.fine, run.in_torch, run.settings)
    return str(run.planned(costs))


def _gridded(ocp: OCP, dynamics: LearnedDynamics | None, s: TrainSettings) -> TrainSettings:
    """The settings with as many intervals as plans need, where they do not say; held controls are judged as held."""
    if s.intervals is not None or s.control_dt:
        return s
    return replace(s, intervals=intervals_for(ocp, dynamics, lambda K: _steps(ocp, dynamics, s, K)))


def _check(ocp: OCP, dynamics: LearnedDynamics | None, seed: int, out: str | os.PathLike[str] | None) -> None:
    checks.instance(OCP, ocp, "ocp", "train", "nocl.load_ocp(name)")
    checks.whole(seed, "seed", "train", most=2**62 - 1)
    if out is not None and Path(out).exists() and not Path(out).is_dir():
        raise ValueError(f"train: out is the file {out}; expected a folder for checkpoints")
    if dynamics is not None and not hasattr(dynamics, "system"):
        raise ValueError(f"train: dynamics is a {type(dynamics).__name__}; expected what nocl.identify returns, or "
                         "None for the exact f")
    if dynamics is not None and (dynamics.system.nx, dynamics.system.nu) != (ocp.system.nx, ocp.system.nu):
        raise ValueError(f"train: dynamics has {dynamics.system.nx} states and {dynamics.system.nu} controls, "
                         f"{ocp.system.name} has {ocp.system.nx} and {ocp.system.nu}: identify that system")


def _expect(settings: Any, kind: Any) -> Any:
    if settings is not None and not isinstance(settings, kind):
        raise ValueError(f"train: settings is a {type(settings).__name__}; this method takes {kind.__name__}")
    return settings or kind()


def _steps(ocp: OCP, dynamics: LearnedDynamics | None, s: TrainSettings, intervals: int) -> Steps:
    """Those of an interval; chosen by a few solutions, of f_theta where dynamics are learned."""
    if ocp.system.is_discrete:
        return discrete.check_steps(ocp.system, s.substeps, None, "train")
    integrator = None if s.integrator == AUTO else s.integrator
    if s.substeps:
        return Steps(integrator or RK4, s.substeps)
    return steps_for(ocp, dynamics, intervals, FINE, integrator)


class Training:
    """One run of the default method; its state between rounds is what a checkpoint holds."""

    def __init__(self, ocp: OCP, dynamics: LearnedDynamics | None, settings: TrainSettings, seed: int,
                 out: str | os.PathLike[str] | None, progress: bool | None, own: ca.Function | None = None,
                 begin: float | None = None) -> None:
        self.own, self.progress = own, progress
        self.begin = time.monotonic() if begin is None else begin  # what the budget counts from
        self.ocp, self.settings, self.seed = ocp, settings, seed
        self.learned = dynamics is not None
        self.integrator, self.substeps = _steps(ocp, dynamics, settings, settings.grid)
        self.in_torch = InTorch(ocp, dynamics, self.integrator)
        same: dict[str, Any] = {"dynamics": dynamics, "integrator": self.integrator}
        self.plain = DDP(ocp, intervals=settings.grid, substeps=self.substeps,
                         constraints="elastic" if ocp.is_held else "hard", **same)
        plans = few_plans(self.plain) if ocp.is_held and not self.learned else None
        self.held = Held(ocp, self.learned, plans) if ocp.is_held else None
        finer = self.substeps if self.integrator == RADAU else -(-self.substeps // 4)  # layers are as thin as they were
        finest = settings.grid if ocp.system.is_discrete else 4 * settings.grid
        self.fine = DDP(ocp, intervals=finest, substeps=finer, **same)
        self.solved: list[Solution] = []  # what the labels are of, where constraints have margins that may change
        self._inside(None if self.held is None else self.held.first)
        self.checkpoint = None if out is None else Path(out) / CHECKPOINT
        self.round, self.seconds, self.fitting, self.fitting_cpu, self.evaluations = 0, 0.0, 0.0, 0.0, 0
        self.history: list[dict[str, Any]] = []
        self.losses: list[float] = []
        self.judged: tuple[SolutionBank, Solution] | None = None  # the last check's bank and optima of held-out states
        self.value_card: dict[str, Any] = {}
        self.opinion: dict[str, Any] = {}  # of NMPC, where it was asked for one
        self.plan = self.planned(None)
        self.best: tuple[float, int, dict[str, Any]] | None = None  # how far from the goals, the round, the weights
        self.stopped = "the goals are met"

    def _inside(self, margin: Array | None) -> None:
        """Labels keep these margins from now on."""
        self.margin = margin
        self.ddp = self.plain if margin is None or self.held is None else self.held.solver(self.plain, margin)
        self.finer = Finer(self.fine, self.plain if margin is not None and margin.any() else None)

    @property
    def margins_move(self) -> bool:
        """Whether rows have margins that the rounds move."""
        return self.held is not None and bool((self.held.inward & ~self.held.guarded).any())

    def planned(self, costs: Costs | None, budget: Budget = ENDLESS) -> Plan:
        return Plan(self.settings, costs, budget, Kind(self.ocp.np > 0, self.held is not None, self.margins_move))

    @cached_property
    def steps(self) -> int:
        """Of what the policy is judged by, for each interval of the fine grid."""
        quick = 0 if self.held is None else barrier.steps(self.ocp, self.ocp.longest, self.held.guarded)
        return max(self.fine.substeps, -(-quick // self.fine.intervals))

    def run(self) -> CND:
        with one_thread(), within(self.progress):
            return self._run()

    def _run(self) -> CND:
        s, there = self.settings, self._resume()
        self._plan()
        if not there:
            self._first_labels()
            self._network()
            self._rehearse_export()
        while self._goes_on():
            if self.round:
                self._move_margins()
                self._visit()
            self._regress()
            self._validate()
            self.round += 1
            self._save()
        self._end_rounds()
        value = self._value() if s.value else None
        cnd = CND(self.ocp, self.net, value, self._card())
        if cnd.continuous_angles:
            say(f"{self.ocp.system.name}: the controller expects {', '.join(cnd.continuous_angles)} as a "
                "continuous angle, since the problem tells turns apart; cnd.unwrapped() takes it in (-pi, pi]",
                self.progress)
        return cnd

    def _plan(self) -> None:
        """How long it takes, where someone wants to know, and what there is time for."""
        s = self.settings
        budget = ENDLESS if s.minutes is None else \
            Budget(60 * s.minutes, spent_before=self.seconds + time.monotonic() - self.begin)
        costs = None
        if budget.limited or (shown(self.progress) and not self.round):
            costs = measured(self.ocp, self.ddp, self.fine, self.in_torch, s, self.own)
        self.plan = self.planned(costs, budget)
        if not self.round:
            say(f"{self.ocp.system.name}: training takes {self.plan}", self.progress)

    def _goes_on(self) -> bool:
        """Whether there is another round, and if not why."""
        s = self.settings
        if self._good_enough():
            return False
        if self.round > s.rounds:
            self.stopped = f"{s.rounds} rounds are used up"
        elif self.round and not self.plan.another(self.round):
            self.stopped = f"no time for a further round within {s.minutes:g} minutes"
        elif not self.margins_move and stalled(self.history, s):
            self.stopped = "the last two rounds did not pay"
        else:
            return True
        return False

    def _end_rounds(self) -> None:
        """Takes the best round's controller where time or gain ended them, or the last ones violate more than others,
        and says what is missing and why."""
        s, row, floor = self.settings, self.history[-1], ""
        if not self._meets(row):
            used_up = self.round > s.rounds and self.held is None  # then the last one was fitted for the longest
            if self.best is not None and self.best[1] != row["round"] and not used_up:
                self.net.load_state_dict(self.best[2])
                row = self.history[self.best[1]]
            floor = self._floor(row)
            say(f"{self.ocp.system.name}: {self.stopped}; gap {100 * row['gap_median']:.3g} %, 95th percentile "
                f"{100 * row['gap_p95']:.3g} %, wanted {100 * s.gap_median:g} and {100 * s.gap_p95:g} %: {floor}",
                self.progress)
        self.chosen = row
        if (remark := advice(row, self.round - 1, s.held_out, s.violating, floor)) is not None:
            warnings.warn(f"{self.ocp.system.name}: {remark}", stacklevel=5)

    def _floor(self, row: dict[str, Any]) -> str:
        """What keeps the gap where it is, from the labels' own plans as feedback on held-out states; kept in `row`."""
        s = self.settings
        fresh = Problems.initial(self.ocp, s.held_out, self._rng(1_000_000))
        labels = extend(self.ddp, self.bank, fresh.x, p=fresh.given_p)
        labels = labels[labels.success]
        best = solved_again(self.finer, labels)
        labels, best = labels[best.success], best[best.success]
        if not len(best):
            return "no held-out state was solved"
        lost, bare = self._lost(labels, best), None
        if self.finer.plain is not None:
            bare = self._lost(self.finer.without_margins(labels), best)
        row["floor"] = {"labels_median": lost, "by": floored_by(row, lost, s.grid, s.gap_median, bare)}
        return str(row["floor"]["by"])

    def _lost(self, plans: Solution, best: Solution) -> float:
        """The median of what plans on the labels' grid cost more than the best, as feedback; none in discrete time."""
        if self.ocp.system.is_discrete:
            return 0.0
        return summary(labels_gap(self.in_torch, plans, best, self.fine.substeps), "labels")["labels_median"]

    def _first_labels(self) -> None:
        s, rng = self.plan.within("labels"), self._rng(0)
        with self._solving("labels", 0, s, "labels", s.starts + 6) as bar:
            def report(what: str) -> None:
                bar.set_postfix_str(what, refresh=False)
                bar.update()

            first = Problems.initial(self.ocp, s.seeds, rng)
            seeds = self._second_opinion(self._seeds(first, s.starts, rng, report))
            self.bank = SolutionBank.of(self.ddp, self._held(seeds))
            if s.states:
                further = Problems.initial(self.ocp, s.states, rng)
                several = {"neighbours": NEIGHBOURS, "kept": KEPT} if self.ocp.np or self.held is not None else {}
                more = extend(self.ddp, self.bank, further.x, p=further.given_p, **several)
                known = type(more).join([seeds, more])
                if self.held is not None:  # about walls the nearest solution often leads to a worse optimum
                    known = self._cleaned(known[known.success], rng)
                self.bank = SolutionBank.of(self.ddp, self._held(known))
            if self.ocp.np and rivals(self.ddp, self.bank, self._rng(5_000_000)):
                self.bank = replace(self.bank, several=NEIGHBOURS)
            parts = [self.bank.solution] + ([tube(self.ddp, self.bank, s.tails, s.width, rng)] if s.tails else [])
            self.labels = Labels.join([self._labels(p, rng) for p in parts])
            self.first = len(self.labels)

    def _seeds(self, first: Problems, starts: int, rng: np.random.Generator, report: OnMessage) -> Solution:
        """Optima from cold starts. Where there are constraints they hold them, and labels go on from there: cold starts
        that may pay for a violation end in worse optima, that pay."""
        search = {"p": first.given_p, "seed": rng}
        if self.held is None:
            return solve_globally(self.ddp, first.x, starts=starts, report=report, **search)
        hard = DDP(self.ocp, intervals=self.plain.intervals, substeps=self.substeps, dynamics=self.plain.dynamics,
                   integrator=self.integrator, between=False)
        found = solve_globally(hard, first.x, starts=starts, report=report, **search)
        if not found.success.any():
            return solve_globally(self.ddp, first.x, starts=starts, **search)
        return solve_globally(self.ddp, first.x, starts=0, known=found, **search)

    def _cleaned(self, known: Solution, rng: np.random.Generator) -> Solution:
        """Solutions from t = 0, solved again from each other's until nothing improves, for three rounds at most; what
        got cheaper by leaving constraints stays as it was."""
        found = solve_globally(self.ddp, known.x[:, 0], p=known.p, starts=0, known=known, seed=rng,
                               neighbours=2, rounds=3)
        lost = self._held(known).success & ~self._held(found).success
        found.put(lost, known[lost])
        return found

    def _second_opinion(self, seeds: Solution) -> Solution:
        """The seeds, better ones where NMPC knows some, and then all of them solved from these: where a quadratic term
        was added, or no goal says where to look for optima."""
        if self.ocp.has_goal and not self.ddp.smoothed:
            return seeds
        said = second_opinion(self.ddp, seeds)
        self.opinion = said.card
        if said.text:
            say(f"{self.ocp.system.name}: {said.text}", self.progress)
        if not said.improved:
            return seeds
        return solve_globally(self.ddp, seeds.x[:, 0], p=seeds.p, starts=0, known=said.solution, seed=self.seed)

    def _held(self, solution: Solution) -> Solution:
        """Without success where constraints are lost."""
        return solution if self.held is None else self.held.labels(solution)

    def _labels(self, solution: Solution, rng: np.random.Generator) -> Labels:
        """Labels of the continuous controls, and with control_dt of held ones."""
        if self.held is not None:
            solution = self._held(solution)
            self.solved += [solution[solution.success]] if solution.success.any() else []
        parts = [Labels.of(solution, self.in_torch, self._unit(), self.substeps)]
        if self.settings.control_dt:
            parts += [Labels.held(solution, self._unit()), at_other_rates(self.ddp, solution, self._unit(), rng)]
        return Labels.join(parts)

    def _unit(self) -> float:
        """A usual cost from an initial state."""
        return float(np.median(np.abs(self.bank.solution.cost)))

    def _network(self) -> None:
        """The policy's networks, scaled by the first labels."""
        with _seeded(self.seed):
            self.net, self.inverse = policy_net(self.ocp, self.labels[: self.first], self.settings.hidden,
                                                self.settings.control_dt, self.own, self.settings.branches,
                                                None if self.held is None else self.held.guarded)
        acting = at_rate(self.net, 0.0) if self.settings.control_dt else self.net  # in continuous time
        self.policy = Rolled(acting, self.in_torch)

    def _rehearse_export(self) -> None:
        """Warns, before the long part, where CasADi does not answer as the policy does."""
        part = CND(self.ocp, self.net, None, {}).export_parts()[0]
        z = parity.samples(part, *REHEARSED)
        found = parity.findings(part, "native CasADi", "float64", z, *parity.of_casadi(part.column))
        if bad := [finding for finding in found if not finding.ok]:
            warnings.warn(f"{self.ocp.system.name}: {bad[0]}, before it is trained: what leaves nocl would not be what "
                          "is trained here: write the problem without branches that rounding decides", stacklevel=5)

    def _move_margins(self) -> None:
        """New margins by what the policy violated, and all labels solved again with them."""
        if self.held is None or self.round > MARGINS:
            return
        margin = np.array(self.history[-1]["next_margin"])
        if margin.tolist() == self.history[-1]["margin"]:
            return
        self._inside(margin)
        rng, former, self.solved = self._rng(4_000_000 + self.round), self.solved, []
        with self._stage(f"round {self.round}: labels with other margins", len(former)) as bar:
            parts = []
            for s in former:
                again = self.ddp.solve(s.x[:, 0], s.t[:, 0], p=s.p, u=s.u, x=s.x, gain=s.gain)
                parts.append(self._labels(again, rng))
                bar.update()
            self.labels = Labels.join(parts)
            self.bank = replace(SolutionBank.of(self.ddp, self.solved[0]), several=self.bank.several)

    def _visit(self) -> None:
        s, rng = self.plan.within("visits", self.round), self._rng(self.round)
        with self._solving("visits", self.round, s, f"round {self.round}: visited states", 1) as bar:
            around = self._hardest(rng) if self.ocp.np else None
            solved = visited(self.ddp, self.bank, self.policy, self.in_torch, s.visits, s.kick, rng, around)
            self.labels = Labels.join([self.labels, self._labels(solved, rng)])
            bar.update()

    def _hardest(self, rng: np.random.Generator) -> Problems:
        """Of as many fresh problems as states are visited those that the controller is worst at, these solved from cold
        starts too; what all of them tell joins the labels and the bank."""
        s = self.settings
        fresh = Problems.initial(self.ocp, s.visits, rng)
        best = answered(self.ddp, self.bank, self.policy, self.in_torch, fresh)
        lost = np.nan_to_num(gap(self.policy, self.in_torch, best, substeps=self.substeps), nan=np.inf)
        worst = np.argsort(-np.abs(lost), kind="stable")[:s.held_out // 2]
        hard = fresh[worst]
        cold = solve_globally(self.ddp, hard.x, p=hard.given_p, starts=s.starts, seed=rng)
        best.put(worst, better(best[worst], cold))
        self.bank = self.bank.add(best)
        self.labels = Labels.join([self.labels, self._labels(best, rng)])
        return hard

    def _regress(self) -> None:
        s, iterations = self.settings, planned_iterations(("controller", self.round), self.settings)
        loss = policy_loss(self.ocp, self.net, self.inverse, self.labels)
        with self._stage(f"round {self.round}: controller", iterations, fits=True) as bar:
            report = _Reporter(bar, iterations)
            fit_net(self.net, loss, len(self.labels), iterations=iterations, batch=s.batch, lr=s.lr,
                    seed=self.seed + self.round, report=report, budget=self.plan.time("controller", self.round))
        self.losses = report.kept

    def _validate(self) -> None:
        """The gap to the optimum as continuous-time feedback, on initial states that no label starts from, and
        on states of kicked rollouts."""
        s, rng = self.plan.within("check", self.round), self._rng(1_000_000)
        with self._solving("check", self.round, s, "held-out states", 1) as bar:
            solvers, acting = (self.ddp, self.finer, self.bank), (self.policy, self.in_torch)
            at = Problems.initial(self.ocp, s.held_out, rng)
            if self.judged is None or self.judged[0] is not self.bank:
                self.judged = self.bank, held_out(*solvers, at)  # rounds share what does not hang on the policy
            fresh = self.judged[1]
            starts = fresh[fresh.success]
            tails = kicked_optima(*solvers, *acting, KICKED * s.held_out, s.kick, rng)
            row = {"round": self.round, "labels": len(self.labels), "loss": self.losses,
                   "unsolved": s.held_out - len(starts) - cannot_hold(fresh),
                   **summary(gap(*acting, starts, substeps=self.steps), "gap"),
                   **summary(gap(*acting, tails, self._unit(), self.steps), "kicked")}
            if self.held is not None:
                row |= self._violations(starts, tails) | {"infeasible": cannot_hold(fresh)}
            if s.control_dt:
                best = extend(self.plain, self.bank, starts.x[:, 0], p=starts.p)  # without margins
                held = at_rate(self.net, self.ocp.horizon / s.grid)
                row |= summary(held_gap(held, self.in_torch, best, self.substeps), "held")
            bar.set_postfix_str(f"gap {100 * row['gap_median']:.3f} %, p95 {100 * row['gap_p95']:.3f} %, "
                                f"kicked {100 * row['kicked_median']:.3f} %")
            bar.update()
        self.history.append(row)
        missed = missed_by(row, s)
        if self.best is None or missed < self.best[0]:
            self.best = missed, row["round"], copy.deepcopy(self.net.state_dict())

    def _violations(self, starts: Solution, tails: Solution) -> dict[str, Any]:
        """What the policy violates on held-out states, and the margins that follow from it."""
        assert self.held is not None
        assert self.margin is not None
        over = []
        for s in (starts, tails):
            at = Problems(s.x[:, 0], s.t[:, 0], s.parameters)
            over.append(self.held.exceeded(self.policy, self.in_torch, at, self.steps * self.fine.intervals))
        return {**self.held.summary(over[0], "gap"), **self.held.summary(over[1], "kicked"),
                "margin": self.margin.tolist(), "next_margin": self.held.next(self.margin, *over).tolist()}

    def _good_enough(self) -> bool:
        if self.round <= self.settings.least_rounds:
            return False
        return self._meets(self.history[-1])

    def _meets(self, last: dict[str, Any]) -> bool:
        s = self.settings
        met = bool(last["gap_median"] <= s.gap_median and last["gap_p95"] <= s.gap_p95)
        return met and (self.held is None or last["gap_violating"] <= s.violating)

    def _value(self) -> FeatureNet:
        """V, fitted again on more labels where the held-out states ask for it; the best fit is kept."""
        s, rng, losses, tried = self.settings, self._rng(2_000_000), list[float](), list[float]()
        labels, optima = ValueLabels.of(on_fine_grid(self.finer, self.bank.solution)), self._value_optima()
        for attempt in range(s.value_rounds):
            labels = ValueLabels.join([labels, self._value_labels(rng, attempt)])
            if attempt == 0:
                with _seeded(self.seed + 1):
                    net = value_net(self.ocp, labels, s.hidden, self.own)
            losses += self._fit_value(net, labels, attempt)
            scores = value_scores(net, self.policy, self.in_torch, optima)
            worst = float(np.max([scores[f"{name}_error"] for name in optima]))
            tried.append(worst if np.isfinite(worst) else np.inf)
            if len(tried) == 1 or tried[-1] < min(tried[:-1]):
                best, weights = scores, copy.deepcopy(net.state_dict())
            if tried[-1] <= s.value_error or not self.plan.another_value(attempt + 1):
                break
            if attempt and tried[-1] > (1 - PAYS) * tried[-2]:  # more labels do not pay
                break
        net.load_state_dict(weights)
        if not min(tried) <= VALUE_LARGE:
            warnings.warn(f"{self.ocp.system.name}: V is {100 * min(tried):.2g} % off in the mean on held-out states; "
                          "expected less than 5 %: try TrainSettings with more value_tails or value_iterations, wider "
                          "layers, or a narrower tube (width)", stacklevel=5)
        judged = {f"{name}_judged": len(held) for name, held in optima.items()}
        self.value_card = {"loss": losses, "labels": len(labels), "tried": tried, **judged, **best}
        return net

    def _value_optima(self) -> dict[str, Solution]:
        """What V is judged on: initial states, states of the tube, and states of kicked rollouts, solved anew."""
        s, rng = self.plan.within("value check"), self._rng(3_000_000)
        solvers, n = (self.ddp, self.finer, self.bank), VALUE_HELD_OUT * s.held_out
        acting = (self.policy, self.in_torch)
        with self._solving("value check", 0, s, "held-out states for V", 3) as bar:
            sets = {"initial": held_out_optima(*solvers, Problems.initial(self.ocp, n, rng))}
            bar.update()
            sets["tube"] = tube_optima(*solvers, *acting, n, s.width, rng)
            bar.update()
            sets["tails"] = kicked_optima(*solvers, *acting, n, s.kick, rng)
            bar.update()
        return {name: optima for name, optima in sets.items() if len(optima)} or sets

    def _value_labels(self, rng: np.random.Generator, attempt: int) -> ValueLabels:
        s = self.plan.within("value labels", attempt)
        with self._solving("value labels", attempt, s, "value labels", 1) as bar:
            found = value_tails(self.ddp, self.bank, self.policy, self.in_torch, initial=s.value_initial,
                                tails=s.value_tails, visits=s.value_visits, width=s.width, kick=s.kick, rng=rng)
            labels = ValueLabels.of(on_fine_grid(self.finer, found))
            bar.update()
        return labels

    def _fit_value(self, net: FeatureNet, labels: ValueLabels, attempt: int) -> list[float]:
        s = self.settings
        iterations = planned_iterations(("value fit", attempt), s)
        loss = value_loss(net.float(), labels, self.bank.scale[:self.ocp.system.nx])
        with self._stage("value function" + (", once more" if attempt else ""), iterations, fits=True) as bar:
            report = _Reporter(bar, iterations)
            fit_net(net, loss, len(labels), iterations=iterations, batch=s.batch, lr=s.lr, seed=self.seed + attempt,
                    report=report, budget=self.plan.time("value fit", attempt))
        return report.kept

    def _card(self) -> dict[str, Any]:
        last, own = self.chosen, {} if self.own is None else {"features": self.own.numel_out(0)}
        return {"method": "default", "dynamics": "learned" if self.learned else "exact", "seed": self.seed,
                **{name: last[name] for name in ("gap_median", "gap_p95", "kicked_median", "kicked_p95", "unsolved")},
                **{name: last[name] for name in ("gap_violating", "kicked_violating", "infeasible") if name in last},
                "round": last["round"], "stopped": self.stopped, "seconds": round(self.seconds, 1),
                "fitting_seconds": round(self.fitting, 1),  # of these, fits of networks; the others solve problems
                "fitting_cpu_seconds": round(self.fitting_cpu, 1),
                "dynamics_evaluations": self._evaluations(), "substeps": self.substeps,
                "integrator": self.integrator,
                **({"second_opinion": self.opinion} if self.opinion else {}),
                "settings": asdict(self.settings), **own, **self._time_card(), "history": self.history,
                "value": self.value_card}

    def _time_card(self) -> dict[str, Any]:
        """The minutes that were asked for, and those since `train` was called, with those before a checkpoint."""
        if not self.plan.budget.limited:
            return {}
        return {"minutes": self.settings.minutes, "minutes_taken": round(self.plan.budget.spent / 60, 2)}

    def _evaluations(self) -> int:
        """Of f, in rollouts of DDP, one for each state; those before a checkpoint included."""
        return self.evaluations + sum(ddp.evaluations["rollout"] for ddp in (self.ddp, self.fine))

    @contextmanager
    def _solving(self, stage: str, number: int, settings: TrainSettings, name: str, total: int) -> Iterator[Bar]:
        """A stage of solves, with the settings that the plan gave it."""
        start = time.perf_counter()
        with self._stage(name, total) as bar:
            yield bar
        self.plan.took(stage, number, settings, time.perf_counter() - start)

    @contextmanager
    def _stage(self, name: str, total: int, fits: bool = False) -> Iterator[Bar]:
        start, cpu = time.perf_counter(), time.process_time()
        with progress_bar(total, f"{self.ocp.system.name}: {name}", self.progress) as bar:
            yield bar
        took = time.perf_counter() - start
        self.seconds, self.fitting = self.seconds + took, self.fitting + took * fits
        self.fitting_cpu += (time.process_time() - cpu) * fits

    def _rng(self, stage: int) -> np.random.Generator:
        return own_numbers(self.seed, stage)

    def _identity(self) -> str:
        known = identity(self.ocp, self.settings, self.seed, self.in_torch.function["f"],
                         **({} if self.held is None else {"held": str(self.held.guarded.tolist())}))
        return known if self.own is None else fingerprint(known, self.own)

    def _save(self) -> None:
        if self.checkpoint is None:
            return
        state = {"policy": self.net.state_dict(), "labels": _tensors(vars(self.labels)),
                 "bank": _tensors({k: v for k, v in vars(self.bank.solution).items() if k != "message"})}
        if self.best is not None:
            state["best"] = self.best[2]
        for i, s in enumerate(self.solved):
            state[f"solved-{i}"] = _tensors({k: v for k, v in s.arrays().items() if k != "message"})
        meta = {"identity": self._identity(), "solved": len(self.solved),
                "margin": None if self.margin is None else self.margin.tolist(),
                "opinion": self.opinion, "round": self.round, "history": self.history, "seconds": self.seconds,
                "fitting": self.fitting, "fitting_cpu": self.fitting_cpu,
                "first": self.first, "several": self.bank.several, "scale": self.bank.scale.tolist(),
                "evaluations": self._evaluations(),
                "best": None if self.best is None else self.best[:2]}
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        store.save_checkpoint(self.checkpoint, state, meta)

    def _resume(self) -> bool:
        """Take up the checkpoint of the same run, where there is one; others are left aside and overwritten."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return False
        state, meta = store.load_checkpoint(self.checkpoint)
        if meta["identity"] != self._identity():
            return False
        arrays = _arrays(state["labels"])
        self.labels = Labels(**{"p": np.zeros((len(arrays["t"]), 0)), **arrays})  # no empty arrays are in files
        bank = SolutionBank.from_arrays(self.ddp, _arrays(state["bank"]))
        self.bank = replace(bank, several=meta.get("several", 1), scale=np.array(meta.get("scale", bank.scale)))
        if meta["margin"] is not None:
            self._inside(np.array(meta["margin"]))
        self.solved = [_converged(_arrays(state[f"solved-{i}"])) for i in range(meta["solved"])]
        self.round, self.history, self.first = meta["round"], meta["history"], meta["first"]
        self.seconds, self.fitting, self.fitting_cpu = meta["seconds"], meta["fitting"], meta["fitting_cpu"]
        self.evaluations, self.opinion = meta.get("evaluations", 0), meta.get("opinion", {})
        if meta.get("best") is not None:
            self.best = *meta["best"], state["best"]
        self._network()
        self.net.double().load_state_dict(state["policy"])
        self.net.eval().requires_grad_(False)
        return True


def _converged(arrays: dict[str, Array]) -> Solution:
    """Solutions that all succeeded, from their arrays without messages."""
    return Solution.of_arrays({**arrays, "message": np.full(len(arrays["cost"]), "converged")})


class _Reporter:
    """Told the loss of each iteration: moves the bar, and keeps LOSSES means over as many stretches."""

    def __init__(self, bar: Bar, iterations: int) -> None:
        self.bar, self.every, self.kept = bar, max(iterations // LOSSES, 1), list[float]()
        self.recent: list[float] = []

    def __call__(self, loss: float) -> None:
        self.bar.update()
        self.recent.append(loss)
        if len(self.recent) == self.every:
            self.kept.append(float(f"{np.mean(self.recent):.3g}"))
            self.recent = []
            self.bar.set_postfix_str(f"loss {self.kept[-1]:.2e}", refresh=False)


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """torch's own generator at a seed, and back to where it was afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def _tensors(arrays: dict[str, Any]) -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items() if v is not None and v.size}


def _arrays(tensors: dict[str, torch.Tensor]) -> dict[str, Array]:
    return {k: v.numpy() for k, v in tensors.items()}
