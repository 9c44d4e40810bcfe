"""What is tried from one initial state, as plain tasks that any process can do, and what came of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nocl.data import Solution
from nocl.definition.constraints import PATH, TOLERANCE
from nocl.definition.ocp import OCP
from nocl.solvers.between import CUTS, EXCHANGES, MOST, SAME
from nocl.solvers.nmpc.guesses import Guess
from nocl.solvers.nmpc.transcription import (
    FEASIBLE,
    GIVEN_UP,
    INFEASIBLE,
    NOT_A_NUMBER,
    NOT_HELD,
    STOPPED,
    Answer,
    Transcription,
)
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
    between: bool = False  # whether constraints are held between nodes too
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
    begin, answers = time.perf_counter(), list[Answer]()
    for i, (x, u, *nodes) in enumerate(guesses):
        one = (task.x0, nodes[0] if nodes else task.t, x, u, task.time_limit, task.p)
        warm = program.warm.solve(*one) if i < task.warm else None
        answers.append(warm if warm is not None and warm.success else program.solve(*one))
    answers += _second_opinion(program, task, answers)
    answers += _third_opinion(program, task, answers)
    if task.between:
        answers = [_between(program, task, a) if a.success else a for a in answers]
    seconds = time.perf_counter() - begin
    good, bad = ([a for a in answers if bool(a.success) is ok] for ok in (True, False))
    costs = np.array([np.inf if a.cut else a.cost for a in answers])
    return Outcome(task.name, task.row, costs, seconds,
                   sum(a.iterations for a in answers), min(good, key=lambda a: (a.cut, a.cost), default=None),
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
    t = task.t if start.t is None else start.t
    answer = program.second.solve(task.x0, t, start.x, start.u, task.time_limit, task.p)
    return replace(answer, message=f"{answer.message}, by IPOPT after fatrop: {start.message}")


def _third_opinion(program: Transcription, task: Task, answers: Sequence[Answer]) -> list[Answer]:
    """Where nothing was solved: the plan that comes nearest to holding all constraints, which is a start if it holds
    them, and else says what cannot be held, where and by how much.

    Problems with path constraints alone are told without it.
    """
    if not program.ocp.in_scales or not program.held.hard or any(a.success for a in answers):
        return []
    stuck = [a for a in answers if np.isfinite(a.x).all() and np.isfinite(a.u).all()]
    if not stuck:
        return []
    start = min(stuck, key=lambda a: a.violation)
    t = task.t if start.t is None else start.t
    near = program.elastic.solve(task.x0, t, start.x, start.u, task.time_limit, task.p)
    if not near.success:
        return []
    t = t if near.t is None else near.t
    most, where = program.elastic.worst_slack(t, near.x, near.u, task.p)
    if most <= FEASIBLE:
        return [program.second.solve(task.x0, t, near.x, near.u, task.time_limit, task.p)]
    why = f"infeasible: no plan was found that holds all constraints; of the one that comes nearest, {where}"
    return [replace(near, success=False, cost=np.inf, outcome=NOT_HELD, violation=most, message=why)]


def _between(program: Transcription, task: Task, answer: Answer) -> Answer:
    """The answer, solved again with the margins that it needs between nodes; as it was where they cannot be held."""
    iterations, left = answer.iterations, np.inf
    for number in range(MOST):
        again = _inside(program, task, answer)
        iterations += again.iterations
        if not again.success:
            break
        answer, former, left = again, left, program.dips.left(*_plan(task, again))[0]
        if number + 1 >= EXCHANGES and (left <= TOLERANCE or abs(left - former) <= SAME * former):
            break
    cut = bool(program.dips.cut(*_plan(task, answer))[0])
    return replace(answer, iterations=iterations, cut=cut, message=answer.message + (CUTS if cut else ""))


def _plan(task: Task, answer: Answer) -> tuple[Array, Array, Array, Array]:
    """(t, x, u, p) of an answer, as a batch of one."""
    t = task.t if answer.t is None else answer.t
    return t[None], answer.x[None], answer.u[None], np.zeros((1, 0)) if task.p is None else task.p[None]


def _inside(program: Transcription, task: Task, start: Answer) -> Answer:
    """Solved with the margins of a solution, from it: with a small barrier, else with the usual one, else by IPOPT."""
    plan = _plan(task, start)
    one = (task.x0, plan[0][0], start.x, start.u, task.time_limit, task.p, program.dips.margins(*plan)[0])
    others = (program.warm, program, *([program.second] if program.backend == "fatrop" else []))
    for way in others:
        answer = way.solve(*one)
        if answer.success:
            break
    return answer


def solved_by(ocp: OCP, t: Array, outcomes: Sequence[Outcome], p: Array | None = None,
              between: bool = False) -> Solution:
    """What tasks on the nodes t [N+1] found, a row each; NaN where a task found nothing. p [B, np] of all states.

    between : whether constraints were held between nodes too
    """
    own = None if p is None else p[[o.row for o in outcomes]]
    found = Solution.blank(np.tile(t, (len(outcomes), 1)), ocp.system.nx, ocp.system.nu, own)
    tried = np.full((len(outcomes), max((len(o.costs) for o in outcomes), default=0)), np.nan)
    for i, outcome in enumerate(outcomes):
        tried[i, :len(outcome.costs)] = outcome.costs
        if outcome.best is not None:
            found.x[i], found.u[i], found.V_x[i] = outcome.best.x, outcome.best.u, outcome.best.costate
            found.cost[i], found.success[i] = outcome.best.cost, True
            if outcome.best.t is not None:
                found.t[i] = outcome.best.t
            if found.V_p is not None and outcome.best.V_p is not None:
                found.V_p[i] = outcome.best.V_p
    cut = np.array([o.best is not None and o.best.cut for o in outcomes], dtype=bool)
    message = np.array([o.best.message if o.best else "" for o in outcomes], np.str_)
    return replace(found, tried=tried, cut=cut if between else None, message=message,
                   seconds=np.array([o.seconds for o in outcomes]),
                   iterations=np.array([o.iterations for o in outcomes], dtype=np.int64))


def failure(program: Transcription, x0: Array, starts: int, failed: Answer | None, p: Array | None = None) -> str:
    """Why none of the starts converged, by the most feasible of them."""
    reason, outcome = ("nothing was tried", "") if failed is None else (failed.message, failed.outcome)
    where = f"x0 = {_text(x0)}{program.ocp.at_p(p)}{outside(program, x0)}"
    return (f"no start of {starts} converged from {where}: {reason}; "
            f"try {_remedy(outcome, program)}")


def _remedy(outcome: str, program: Transcription) -> str:
    if program.ocp.kinks and outcome not in (INFEASIBLE, NOT_HELD, GIVEN_UP):
        return f"a smooth problem: {program.ocp.not_smooth}"
    if outcome == STOPPED:
        return f"more iterations (options={{'{program.backend}.max_iter': 3000}}), more starts or another guess"
    if outcome == GIVEN_UP:
        return "another solver (solver='ipopt'), more starts, another guess, or a longer time_limit"
    hard = program.held.hard
    soft = f", or soft={list(hard)}" if hard and program.ocp.in_scales else ", or constraints='soft'" if hard else ""
    if outcome in (INFEASIBLE, NOT_HELD) and hard:
        held = " and ".join(map(repr, hard))
        return (f"another initial state, or wider bounds of the controls, where none of them holds {held} from there; "
                f"else more starts or another guess{soft}")
    if outcome == NOT_A_NUMBER:
        return "a guess that stays where f, L and h are finite, or bounds lbu, ubu that keep the states there" + soft
    return "more starts, another guess, or more intervals" + soft


def violated_start(program: Transcription, x0: Array, t: float = 0.0, p: Array | None = None) -> str:
    """Why x0 at time t is no start at all: inside an obstacle that no control can undo."""
    block, of = program.held.x, program.functions
    if not len(block):
        return ""
    c = of.c_of_x(x0, *program.moment(t, p)).full()
    c = np.where(block.slack.any(axis=1), np.inf, block.rows.signed(c)[:, 0])  # what is soft has a slack for it
    unit = np.where([one.kind == PATH for one in block.rows.of], 1.0, block.scales)
    i = int(np.argmin(c / unit))
    if c[i] >= -FEASIBLE * unit[i]:
        return ""
    remedy = f"soft=[{block.rows.names[i]!r}]" if program.ocp.in_scales else "constraints='soft'"
    return (f"infeasible: {block.rows.title(i)} is violated by {-c[i]:.3g} at node 0, by x0 = {_text(x0)}"
            f"{program.ocp.at_p(p)} itself: move x0, or use {remedy}")


def outside(program: Transcription, x0: Array) -> str:
    """A note where x0 is outside X: the exact equations hold there too, a model learned in X may not."""
    s = program.ocp.system
    out = [f"{name} = {v:.4g} outside [{low:g}, {high:g}]" for name, v, low, high in
           zip(s.state_names, x0, s.lbx, s.ubx, strict=True) if not low <= v <= high]
    return f" (x0 is outside X: {', '.join(out)})" if out else ""


def _text(x: Array) -> str:
    return np.array2string(x, precision=4, separator=", ")
