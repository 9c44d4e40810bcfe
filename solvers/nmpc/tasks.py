"""What is tried from one initial state, as plain tasks that any process can do, and what came of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nocl.data import Solution
from nocl.ocp import OCP
from nocl.solvers.nmpc.guesses import Guess
from nocl.solvers.nmpc.transcription import FEASIBLE, GIVEN_UP, INFEASIBLE, NOT_A_NUMBER, STOPPED, Answer, Transcription
from nocl.support.checks import Array


@dataclass(frozen=True, eq=False)
class Task:
    """Solves from one state: the guesses given, then `starts` built-in ones, number `begin` the first of them."""

    name: str  # unique in a run
    row: int
    x0: Array  # [nx]
    t: Array  # [N+1]
    guesses: Sequence[Guess] = ()
    warm: int = 0  # how many of these, the first ones, are solutions of problems nearby
    begin: int = 0
    starts: int = 0
    seed: int = 0
    time_limit: float | None = None  # seconds of each solve
    p: Array | None = None  # [np], where there are parameters
    size: int = 1  # states

    def outcome(self, arrays: dict[str, Any]) -> Outcome:
        """What came of this task, from its `arrays()`."""
        return Outcome(self.name, self.row, arrays["costs"], float(arrays["seconds"]), int(arrays["iterations"]),
                       _answer(arrays, "best"), _answer(arrays, "failed"))


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a task found."""

    name: str
    row: int
    costs: Array  # [n] of each solve, inf where it failed
    seconds: float
    iterations: int
    best: Answer | None
    failed: Answer | None  # of the solves that failed the one that tells most: Answer.rank
    size: int = 1

    def arrays(self) -> dict[str, Any]:
        """Its fields as plain arrays, for a file."""
        found: dict[str, Any] = {"costs": self.costs, "seconds": self.seconds, "iterations": self.iterations}
        for kind in ("best", "failed"):
            answer = getattr(self, kind)
            found |= {} if answer is None else {
                f"{kind}.{name}": value for name, value in vars(answer).items() if value is not None}
        return found


def _answer(arrays: dict[str, Any], kind: str) -> Answer | None:
    fields: dict[str, Any] = {name.removeprefix(f"{kind}."): value if value.ndim else value.item()
                              for name, value in arrays.items() if name.startswith(f"{kind}.")}
    return Answer(**fields) if fields else None


def attempt(program: Transcription, task: Task, guesses: Sequence[Guess]) -> Outcome:
    """Solve from each guess."""
    begin, answers, at = time.perf_counter(), list[Answer](), (task.x0, task.t)
    for i, (x, u) in enumerate(guesses):
        one = (*at, x, u, task.time_limit, task.p)
        warm = program.warm.solve(*one) if i < task.warm else None
        answers.append(warm if warm is not None and warm.success else program.solve(*one))
    answers += _second_opinion(program, task, answers)
    seconds = time.perf_counter() - begin
    good, bad = ([a for a in answers if bool(a.success) is ok] for ok in (True, False))
    return Outcome(task.name, task.row, np.array([a.cost for a in answers]), seconds,
                   sum(a.iterations for a in answers), min(good, key=lambda a: a.cost, default=None),
                   min(bad, key=lambda a: a.rank, default=None))


def _second_opinion(program: Transcription, task: Task, answers: Sequence[Answer]) -> list[Answer]:
    """Where fatrop got stuck, or had to be given up, from all starts: IPOPT from where it got to, to solve it or to say
    why not.

    From its most feasible point, and from its first one: the most feasible may lead to a poor optimum, and more starts
    must not end higher than one.
    """
    if program.backend != "fatrop" or any(a.success for a in answers):
        return []
    stuck = [a for a in answers if a.outcome != STOPPED and np.isfinite(a.x).all() and
             np.isfinite(a.u).all()]
    if not stuck:
        return []
    chosen = {id(a): a for a in (min(stuck, key=lambda a: a.violation), stuck[0])}
    return [_by_ipopt(program, task, a) for a in chosen.values()]


def _by_ipopt(program: Transcription, task: Task, start: Answer) -> Answer:
    answer = program.second.solve(task.x0, task.t, start.x, start.u, task.time_limit, task.p)
    return replace(answer, message=f"{answer.message}, by IPOPT after fatrop: {start.message}")


def solved_by(ocp: OCP, t: Array, outcomes: Sequence[Outcome], p: Array | None = None) -> Solution:
    """What tasks on the nodes t [N+1] found, a row each; NaN where a task found nothing. p [B, np] of all states."""
    own = None if p is None else p[[o.row for o in outcomes]]
    found = Solution.blank(np.tile(t, (len(outcomes), 1)), ocp.system.nx, ocp.system.nu, own)
    tried = np.full((len(outcomes), max((len(o.costs) for o in outcomes), default=0)), np.nan)
    for i, outcome in enumerate(outcomes):
        tried[i, :len(outcome.costs)] = outcome.costs
        if outcome.best is not None:
            found.x[i], found.u[i], found.V_x[i] = outcome.best.x, outcome.best.u, outcome.best.costate
            found.cost[i], found.success[i] = outcome.best.cost, True
            if found.V_p is not None and outcome.best.V_p is not None:
                found.V_p[i] = outcome.best.V_p
    return replace(found, tried=tried, message=np.array([o.best.message if o.best else "" for o in outcomes], np.str_),
                   seconds=np.array([o.seconds for o in outcomes]),
                   iterations=np.array([o.iterations for o in outcomes], dtype=np.int64))


def failure(program: Transcription, x0: Array, starts: int, failed: Answer | None, p: Array | None = None) -> str:
    """Why none of the starts converged, by the most feasible of them."""
    reason, outcome = ("nothing was tried", "") if failed is None else (failed.message, failed.outcome)
    return (f"no start of {starts} converged from x0 = {_text(x0)}{_at(program, p)}{outside(program, x0)}: {reason}; "
            f"try {_remedy(outcome, program)}")


def _remedy(outcome: str, program: Transcription) -> str:
    if program.ocp.kinks and outcome not in (INFEASIBLE, GIVEN_UP):
        return f"a smooth problem: {program.ocp.not_smooth}"
    if outcome == STOPPED:
        return f"more iterations (options={{'{program.backend}.max_iter': 3000}}), more starts or another guess"
    if outcome == GIVEN_UP:
        return "another solver (solver='ipopt'), more starts, another guess, or a longer time_limit"
    soft = ", or constraints='soft'" if program.n_path else ""
    if outcome == INFEASIBLE and program.n_path:
        held = " and ".join(map(repr, program.ocp.path_constraints))
        return (f"another initial state, or wider bounds of the controls, where none of them holds {held} from there; "
                f"else more starts or another guess{soft}")
    if outcome == NOT_A_NUMBER:
        return "a guess that stays where f, L and h are finite, or bounds lbu, ubu that keep the states there" + soft
    return "more starts, another guess, or more intervals" + soft


def violated_start(program: Transcription, x0: Array, t: float = 0.0, p: Array | None = None) -> str:
    """Why x0 at time t is no start at all: inside an obstacle that no control can undo."""
    if not program.n_path:
        return ""
    h = program.ocp.h(x0, *program.moment(t, p)).full().ravel()
    i = int(np.argmin(h))
    if h[i] >= -FEASIBLE:
        return ""
    return (f"infeasible: path constraint {list(program.ocp.path_constraints)[i]!r} is violated by {-h[i]:.3g} at node "
            f"0, by x0 = {_text(x0)}{_at(program, p)} itself: move x0, or use constraints='soft'")


def outside(program: Transcription, x0: Array) -> str:
    """A note where x0 is outside X: the exact equations hold there too, a model learned in X may not."""
    s = program.ocp.system
    out = [f"{name} = {v:.4g} outside [{low:g}, {high:g}]" for name, v, low, high in
           zip(s.state_names, x0, s.lbx, s.ubx, strict=True) if not low <= v <= high]
    return f" (x0 is outside X: {', '.join(out)})" if out else ""


def _at(program: Transcription, p: Array | None) -> str:
    """The parameters in words, "" where there are none."""
    if p is None or not len(p):
        return ""
    return f" at {', '.join(f'{n} = {v:.4g}' for n, v in zip(program.ocp.parameter_names, p, strict=True))}"


def _text(x: Array) -> str:
    return np.array2string(x, precision=4, separator=", ")
