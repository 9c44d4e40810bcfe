"""How long training takes on this machine, from a few solves and iterations that are timed, and how it fits a budget.

Under a budget every stage gets the share of the time that is left which it has of the work that is left: solves become
fewer, fits end sooner (their rate falls with the time), rounds that would get less than WORTH of their work are left
out. How long stages really take corrects the plan.
"""

from __future__ import annotations

import copy
import math
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import casadi as ca
import numpy as np
import torch

from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.solvers.cnd.regression.features import at_rate, policy_net
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import NEIGHBOURS, PROBED, Labels, Problems, continuous_cost, tube
from nocl.solvers.cnd.regression.regress import LossFunction, fit_net, policy_loss
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.validate import refined
from nocl.solvers.cnd.value import ValueLabels, value_loss, value_net
from nocl.solvers.ddp.bank import SolutionBank
from nocl.solvers.ddp.solver import DDP
from nocl.support.budget import ENDLESS, Budget
from nocl.support.progress import in_words

T = TypeVar("T")
Stage = tuple[str, int]  # its name, and the number of the round or of the fit of V
STATES, TAILS, STEPS, TIMED = 16, 64, 8, 20  # that are timed: cold starts, tails, steps of a rollout, iterations
IMPROVING = 6  # cold starts' worth that a global search spends on neighbours
AGAIN = 4  # solves of an answer: from the policy, and from three neighbours
CLEANING = 12  # solves of each of the first solutions about walls, until they know of each other
KICKED = 4  # kicked states that a controller is held against for each initial one
VALUE_HELD_OUT = 16  # times held_out: a mean of relative errors hangs on the few states that are hard
WORTH = 0.5  # of the work of what is left, that a further round must leave time for
TARGET = 0.95  # of a budget: what is planned for
PAYS = 0.1  # a round pays that goes this share of the way to the goal, or this share of the goal
SCALED = {"labels": ("seeds", "starts", "states", "tails"), "visits": ("visits",), "check": ("held_out",),
          "value check": ("held_out",), "value labels": ("value_initial", "value_tails", "value_visits")}
LEAST = {"seeds": 4, "starts": 2, "states": 20, "tails": 100, "visits": 50, "held_out": 8, "value_initial": 20,
         "value_tails": 100, "value_visits": 50}


@dataclass(frozen=True)
class Kind:
    """What makes a problem's training longer."""

    parameters: bool = False
    walls: bool = False  # constraints that labels hold
    margins: bool = False  # of these, that the first rounds move: all labels are solved anew


@dataclass(frozen=True)
class Costs:
    """Seconds on this machine."""

    cold: float  # of one initial state from one cold start
    tail: float  # of one tail, from a guess that is near
    fine: float  # of one on the fine grid
    roll: float  # of one run of the policy over the horizon
    step: float  # of one iteration of the controller's regression
    value_step: float  # of V's

    def of(self, stage: Stage, s: TrainSettings, kind: Kind) -> float:
        """Seconds of a stage."""
        (name, number), several = stage, NEIGHBOURS if kind.parameters else 1
        answer = (AGAIN + (several - 1) / 2) * self.tail
        search = (s.starts + IMPROVING) * self.cold
        if name == "labels":
            probes = 2 * PROBED * self.tail if kind.parameters else 0.0
            cleaned = CLEANING * (s.seeds + s.states) * self.tail if kind.walls and s.states else 0.0
            return s.seeds * search + (3 * s.states + s.tails) * (1 + several) / 2 * self.tail + probes + cleaned
        if name == "visits":
            former = s.seeds + s.states + s.tails + (number - 1) * s.visits if kind.margins else 0
            hardest = s.visits * answer + s.held_out / 2 * search if kind.parameters else 0.0
            return s.visits * answer + former * self.tail + hardest
        if name == "check":
            near = (3 + KICKED * AGAIN) * self.tail + (1 + KICKED) * (self.fine + self.roll)
            return s.held_out * near
        if name == "value check":
            return 3 * VALUE_HELD_OUT * s.held_out * (answer + self.fine)
        if name == "value labels":
            return (s.value_initial + s.value_tails + s.value_visits) * (answer + self.fine)
        return iterations(stage, s) * (self.step if name == "controller" else self.value_step)


def iterations(stage: Stage, s: TrainSettings) -> int:
    """Of a fit: twice as many of the controller's from the round on that may be the last."""
    name, number = stage
    if name == "controller":
        return s.iterations * (2 if number >= max(s.least_rounds, 1) else 1)
    return s.value_iterations


def stages(s: TrainSettings, rounds: int, fits: int) -> Iterator[Stage]:
    """What training does, in its order, with so many rounds and fits of V."""
    yield "labels", 0
    for number in range(rounds + 1):
        if number:
            yield "visits", number
        yield "controller", number
        yield "check", number
    if s.value:
        yield "value check", 0
        for fit in range(fits):
            yield "value labels", fit
            yield "value fit", fit


class Plan:
    """What the settings ask for, made to fit a budget.

    costs : None where nothing could be measured: then a budget has the fewest seeds and starts, and equal shares
    """

    def __init__(self, settings: TrainSettings, costs: Costs | None, budget: Budget = ENDLESS,
                 kind: Kind = Kind()) -> None:
        self.settings, self.costs, self.budget, self.kind, self.pace = settings, costs, budget, kind, 1.0
        self.held_out: int | None = None

    def cost(self, stage: Stage, settings: TrainSettings | None = None) -> float:
        """Seconds of a stage with these settings; solves at the pace that was seen."""
        if self.costs is None:
            return 1.0
        pace = self.pace if stage[0] in SCALED else 1.0
        return pace * self.costs.of(stage, settings or self.settings, self.kind)

    def ahead(self, stage: Stage) -> float:
        """Seconds from the beginning of a stage to the end of training, with as many more rounds as there is time for,
        V fitted once."""
        number = 0 if stage[0].startswith("value") else stage[1]
        for rounds in range(self.settings.rounds, number, -1):
            if self._left >= WORTH * (seconds := self._from(stage, rounds)):
                return seconds
        return self._from(stage, number)

    def _from(self, stage: Stage, rounds: int) -> float:
        fits = stage[1] + 1 if stage[0] in ("value labels", "value fit") else 1
        way = list(stages(self.settings, rounds, fits))
        return sum(self.cost(one) for one in way[way.index(stage):])

    def another(self, number: int) -> bool:
        """Whether there is time for round `number`."""
        return not self.budget.limited or self._left >= WORTH * self._from(("visits", number), number)

    def another_value(self, fit: int) -> bool:
        """Whether there is time for a further fit of V."""
        return not self.budget.limited or self._left >= WORTH * self._from(("value labels", fit), 0)

    def within(self, name: str, number: int = 0) -> TrainSettings:
        """The settings for a stage of solves: as many as there is time for."""
        s = self.settings
        if not self.budget.limited:
            return s
        share = min(self._left / max(self.ahead((name, number)), 1e-9), 1.0) if self.costs else 0.0
        if name == "check":
            self.held_out = self.held_out or _fewer(s.held_out, "held_out", share)
            return replace(s, held_out=self.held_out)
        power = {"seeds": share**0.5, "starts": share**0.5}
        return replace(s, **{field: _fewer(getattr(s, field), field, power.get(field, share))
                             for field in SCALED[name]})

    def time(self, name: str, number: int) -> Budget:
        """The time of a fit."""
        if not self.budget.limited:
            return ENDLESS
        share = self.cost((name, number)) / max(self.ahead((name, number)), 1e-9)
        return Budget(self._left * min(share, 1.0), self.budget.clock)

    def took(self, name: str, number: int, settings: TrainSettings, seconds: float) -> None:
        """How long a stage of solves took: half of what is wrong with the pace is put right."""
        expected = self.cost((name, number), settings)
        if self.costs is not None and expected > 0 and seconds > 0:
            self.pace *= (seconds / expected) ** 0.5

    @property
    def _left(self) -> float:
        return max(TARGET * self.budget.seconds - self.budget.spent, 0.0)

    @property
    def seconds(self) -> tuple[float, float] | None:
        """As the settings ask for, where the goals are met as soon as they may be, and where never."""
        if self.costs is None:
            return None
        s = self.settings
        soon, late = (sum(self.cost(stage) for stage in stages(s, rounds, fits))
                      for rounds, fits in ((min(s.least_rounds, s.rounds), 1), (s.rounds, s.value_rounds)))
        return soon, late

    def __str__(self) -> str:
        if self.seconds is None:
            return "no estimate of the time: no initial state is solved from its first start"
        soon, late = self.seconds
        until = "" if in_words(late) == in_words(soon) else f", up to {in_words(late)} where the wanted gap is not met"
        held = f"; to end within {in_words(self.budget.seconds)}" if self.budget.limited else ""
        return f"about {in_words(soon)} on this machine{until}{held}"


def _fewer(number: int, field: str, share: float) -> int:
    return min(number, max(LEAST[field], math.floor(number * share)))


# Where more rounds no longer pay


def stalled(history: list[dict[str, Any]], s: TrainSettings) -> bool:
    """Whether the last two rounds brought nothing that misses its goal nearer to it, by PAYS each."""
    return len(history) > 2 and not any(_paid(*pair, s) for pair in zip(history[-3:-1], history[-2:], strict=True))


def _paid(before: dict[str, Any], after: dict[str, Any], s: TrainSettings) -> bool:
    missed = {name: goal for name, goal in goals(s).items() if after.get(name, 0.0) > goal}
    for name, goal in missed.items():
        gain = before[name] - after[name]
        if not math.isfinite(gain) or gain >= PAYS * max(goal, before[name] - goal):
            return True
    return not missed


def goals(s: TrainSettings) -> dict[str, float]:
    """Of held-out states, by the names that the history has them."""
    return {"gap_median": s.gap_median, "gap_p95": s.gap_p95, "gap_violating": s.violating}


def missed_by(row: dict[str, Any], s: TrainSettings) -> float:
    """How far a round is from its goals: the worst as a multiple of its goal, violations first."""
    gap = max(_ratio(row[name], goal) for name, goal in goals(s).items() if name != "gap_violating")
    violating = row.get("gap_violating", 0.0)
    if not math.isfinite(violating):
        return math.inf
    few = violating <= max(s.violating, 1 / s.held_out)  # one run is none: the gap says more
    return gap if few else 1e6 * (1 + violating) + min(gap, 1e6)


def _ratio(value: float, goal: float) -> float:
    return value / goal if math.isfinite(value) else math.inf


# What is measured


def measured(ocp: OCP, ddp: DDP, fine: DDP, torch_ocp: InTorch, s: TrainSettings,
             own: ca.Function | None = None) -> Costs | None:
    """What a few solves and iterations cost here; None where no initial state is solved from u*.

    Nothing that training draws or counts is touched.
    """
    ddp, fine, rng = _apart(ddp), _apart(fine), own_numbers(0, 3)
    with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
        warnings.simplefilter("ignore")  # what training meets, it tells itself
        at = Problems.initial(ocp, STATES, rng)
        ddp.solve(at.x[:1], p=at[:1].given_p, progress=False)  # builds what is compiled
        cold, solved = _timed(lambda: ddp.solve(at.x, p=at.given_p, progress=False))
        if not solved.success.any():
            return None
        bank = SolutionBank.of(ddp, solved)
        tail, tails = _timed(lambda: tube(ddp, bank, TAILS, s.width, rng))
        refined(fine, bank.solution[:1])
        again, finer = _timed(lambda: refined(fine, bank.solution))
        labels = Labels.of(bank.solution, torch_ocp, float(np.median(np.abs(bank.solution.cost))), ddp.substeps)
        net, inverse = policy_net(ocp, labels, s.hidden, s.control_dt, own, s.branches)
        step = _iteration(net, policy_loss(ocp, net, inverse, labels), len(labels), s)
        value_step = _value_iteration(ocp, ValueLabels.of([tails, bank.solution]), bank, s, own) if s.value else 0.0
        rows = Problems(*(np.resize(z, ((1 + KICKED) * s.held_out, *z.shape[1:])) for z in (at.x, at.t, at.p)))
        policy = at_rate(net, 0.0) if s.control_dt else net
        steps = fine.substeps * fine.intervals
        roll, _ = _timed(lambda: continuous_cost(policy, torch_ocp, rows, STEPS))
    return Costs(cold / STATES, tail / TAILS, again / max(len(bank), 1) if len(finer) else 4 * tail / TAILS,
                 roll / len(rows) * steps / STEPS, step, value_step)


def _apart(ddp: DDP) -> DDP:
    """The same compiled kernel, with a count of its own."""
    other = copy.copy(ddp)
    other.evaluations = copy.copy(ddp.evaluations)
    return other


def _timed(work: Callable[[], T]) -> tuple[float, T]:
    begin = time.perf_counter()
    done = work()
    return time.perf_counter() - begin, done


def _iteration(net: Any, loss: LossFunction, rows: int, s: TrainSettings) -> float:
    """Seconds of an iteration, after what the first ones build."""
    for _ in range(2):
        seconds, _ = _timed(lambda: fit_net(net, loss, rows, iterations=TIMED, batch=s.batch, lr=s.lr, seed=0))
    return seconds / TIMED


def _value_iteration(ocp: OCP, labels: ValueLabels, bank: SolutionBank, s: TrainSettings,
                     own: ca.Function | None) -> float:
    net = value_net(ocp, labels, s.hidden, own)
    return _iteration(net, value_loss(net.float(), labels, bank.scale[:ocp.system.nx]), len(labels), s)
