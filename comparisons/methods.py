"""What a method is, and the runs that it is judged by. B is the batch, K the intervals.

- feedback (a casadi.Function (x, t) -> u, or an object with `to_casadi()`, as CND and LQR): at each of the rates asked
  for, None meaning continuously;
- a solver (an object with `solve(x0)`, as NMPC and DDP) or its Solution: open loop, its controls held on its own grid;
- NMPC's closed loop, and any other callable (x [B, nx], t) -> u [B, nu]: sampled and held, at the rates asked for, else
  at its own, else SAMPLED.

On a problem with parameters feedback is a function of (x, t, p), and solvers have solve(x0, p=); what was made for a
problem without, as LQR(ocp.at(p)), is run as it is. What knows no p is made at each by `at_each`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nocl.comparisons.each import Laws, is_plan
from nocl.comparisons.report.results import Planned, count
from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.definition.scales import usual_sizes
from nocl.judge.laws import check_made_for, check_takes_p, own_holds, policy_function, takes_p
from nocl.solvers.nmpc.loop import Loop
from nocl.support.checks import LARGEST, Array, shown

SAMPLED = 80  # intervals that a plain callable is held on
STAGES = 4  # evaluations of f in an RK4 step
SAME_STATE = 1e-6  # of usual sizes: closer states are the same
Rates = tuple[int | None, ...]


@dataclass(frozen=True, eq=False)
class MethodRun:
    """One method at one rate."""

    name: str
    how: str  # in words
    method: Any  # as it was given
    controller: Any  # what the judge runs: a casadi.Function, a callable, or controls [B, K, nu], NaN where unsolved
    hold: int | None = None
    solved: Solved | None = None
    horizon: Array | None = None  # [B], of plans whose horizon is free

    @property
    def held(self) -> bool:
        """Whether its controls are held between nodes: of plans they always are."""
        return self.hold is not None or self.solved is not None

    @property
    def identity(self) -> Any:
        """What outcomes depend on; of a plain callable its name alone is known."""
        if isinstance(self.controller, ca.Function):
            what: Any = self.controller
        elif isinstance(self.controller, Loop):
            what = f"{self.controller.nmpc.key} {self.controller.receding}"
        elif isinstance(self.controller, np.ndarray):
            what = self.controller
        elif isinstance(self.controller, Laws):
            what = self.controller.identity
        else:
            what = getattr(self.controller, "__qualname__", type(self.controller).__qualname__)
        return [self.name, self.hold, what, *([] if self.horizon is None else [self.horizon])]


@dataclass(frozen=True, eq=False)
class Solved:
    """What solvers said of B states."""

    ms: Array  # [B]
    solves: Array  # [B]
    predicted: Array  # [B]
    evaluations: Array  # [B]
    plan: Planned
    message: list[str]  # [B], "" or why there is nothing to judge


@dataclass(frozen=True)
class Solving:
    """How solvers are called."""

    workers: int | str = 1
    out: Path | None = None
    progress: bool | None = None


def checked(methods: Mapping[str, Any]) -> Mapping[str, Any]:
    """Methods by name, or ValueError."""
    if not isinstance(methods, Mapping) or not methods:
        raise ValueError(f"methods is {type(methods).__name__} {shown(methods)}; expected a dict of methods by name, "
                         'like {"CND": cnd, "NMPC": nmpc}')
    for name in methods:
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ValueError(f"a method is named {name!r}; expected a printable name")
    return methods


def rates_of(hold: int | Sequence[int | None] | None, steps: int | None = None) -> Rates:
    """None: continuous. K: continuous, and held on K intervals. A list: these, None standing for continuous.

    steps : of a problem in discrete time, whose feedback has one rate
    """
    if steps is not None and hold is not None:
        raise ValueError(f"hold is {shown(hold)}, and the problem is one in discrete time, with {steps} steps; "
                         "expected None: feedback is asked at every sample")
    given = (None,) if hold is None else (None, hold) if isinstance(hold, (int, np.integer)) else hold
    if isinstance(given, str) or not isinstance(given, Sequence) or not given or \
            not all(rate is None or is_count(rate) for rate in given):
        raise ValueError(f"hold is {shown(hold)}; expected a number of intervals >= 1, None for continuous "
                         "feedback, or a list of these")
    return tuple(dict.fromkeys(None if rate is None else int(rate) for rate in given))


def is_count(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and 1 <= int(value) <= LARGEST


@dataclass(frozen=True, eq=False)
class Starts:
    """Where runs begin, and the parameters of each."""

    x: Array  # [B, nx]
    p: Array  # [B, np]

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, rows: Any) -> Starts:
        return Starts(self.x[rows], self.p[rows])

    @staticmethod
    def drawn(ocp: OCP, n: int, seed: int) -> Starts:
        """n of the problem's own; the states are the same whether there are parameters or not."""
        return Starts(ocp.initial_states.sample(n, seed), ocp.sample_parameters(n, own_numbers(seed, 0, 1)))

    def given(self, ocp: OCP, method: Any) -> list[Array]:
        """The parameters as a further argument of a method, [p] or []."""
        return [self.p] if takes_p(ocp, method) else []


@dataclass(frozen=True, eq=False)
class Value:
    """A method's own value function V(x, t), at the parameters of each state where it is one of them."""

    ocp: OCP
    method: Any

    @property
    def takes_p(self) -> bool:
        return takes_p(self.ocp, self.method)

    def __call__(self, x: Array, t: float, p: Array) -> Any:
        return self.method.value(x, t, *Starts(x, p).given(self.ocp, self.method))


def runs_of(ocp: OCP, methods: Mapping[str, Any], x0: Starts, rates: Rates, solving: Solving) -> list[MethodRun]:
    """The runs of all methods, in order; ValueError for what is no method, before anything is solved."""
    for name, method in methods.items():
        _check(ocp, name, method, x0)
    names = [run for name, method in methods.items() for run in _names(ocp, name, method, rates)]
    if len(set(names)) < len(names):
        raise ValueError(f"the methods are named {', '.join(names)}; expected different names: rename one")
    return [run for name, method in methods.items() for run in _runs(ocp, name, method, x0, rates, solving)]


def _check(ocp: OCP, name: str, method: Any, x0: Starts) -> None:
    check_made_for(ocp, method, f"method {name!r}")
    if isinstance(method, Solution):
        _check_solution(ocp, name, method, x0)
    elif _policy(ocp, name, method) is None:
        _check_called(ocp, name, method)


def _check_called(ocp: OCP, name: str, method: Any) -> None:
    """Solvers and callables."""
    if not hasattr(method, "solve") and not callable(method):
        raise ValueError(f"method {name!r} is a {type(method).__name__}; expected a controller with to_casadi(), a "
                         "casadi.Function (x, t) -> u, a solver with solve(x0), a Solution, or a callable (x, t) -> u")
    if not is_plan(method):
        _named(name, check_takes_p, ocp, method)
    elif takes_p(ocp, method) and not _accepts(method.solve, "p"):
        raise ValueError(f"method {name!r} is a {type(method).__name__}, whose solve takes no p, and the problem has "
                         f"the parameters {', '.join(ocp.parameter_names)}; expected solve(x0, p=): let it be made "
                         "anew at each p, nocl.comparisons.at_each(ocp, make)")


def _names(ocp: OCP, name: str, method: Any, rates: Rates) -> list[str]:
    if is_plan(method):
        return [name]
    if _policy(ocp, name, method) is not None or _continuous(method):
        return [_held_name(name, rate) for rate in rates]
    held = _sampled(ocp, method, rates)
    return [name] if len(held) == 1 else [_held_name(name, rate) for rate in held]


def _held_name(name: str, rate: int | None) -> str:
    return name if rate is None else f"{name} ({count(rate, 'hold')})"


def _runs(ocp: OCP, name: str, method: Any, x0: Starts, rates: Rates, solving: Solving) -> list[MethodRun]:
    names = _names(ocp, name, method, rates)
    if is_plan(method):
        parts = [method] if isinstance(method, Solution) else solve(ocp, method, name, x0, solving)
        return [planned(ocp, name, method, parts, len(x0))]
    policy = _policy(ocp, name, method)
    if policy is not None:
        return [MethodRun(n, how(rate or ocp.steps), method, policy, rate)
                for n, rate in zip(names, rates, strict=True)]
    each = ", made anew at each p" if isinstance(method, Laws) else ""
    return [MethodRun(n, how(rate or ocp.steps) + each, method, at_rate(method, rate), rate)
            for n, rate in zip(names, rates if _continuous(method) else _sampled(ocp, method, rates), strict=True)]


def how(hold: int | None, delay: float = 0.0) -> str:
    """How feedback was run, in words."""
    text = "continuous feedback" if hold is None else f"feedback, held on {count(hold, 'interval')}"
    return text + (f", {1e3 * delay:.3g} ms late" if delay else "")


def _continuous(method: Any) -> bool:
    """Whether it is made at each p, and continuous there."""
    return isinstance(method, Laws) and method.continuous


def at_rate(method: Any, hold: int | None) -> Any:
    """NMPC's loop plans for the rate that it is run at; other callables need not know it."""
    return Loop(method.nmpc, hold, method.receding) if isinstance(method, Loop) else method


def _sampled(ocp: OCP, method: Any, rates: Rates) -> list[int]:
    """Intervals for sampled feedback: as asked for, the method's own (NMPC's loop has a `hold`), or SAMPLED; in
    discrete time one a step."""
    if ocp.steps is not None:
        return [ocp.steps]
    own = getattr(method, "hold", None) or own_holds(method, ocp.longest)
    return [rate for rate in rates if rate is not None] or [int(own) if is_count(own) else SAMPLED]  # type: ignore[arg-type]


def own_rate(ocp: OCP, method: Any) -> int | None:
    """Intervals that feedback is held on where no rate is asked for; None: continuous."""
    return None if policy_function(ocp, method) is not None else _sampled(ocp, method, (None,))[0]


def _policy(ocp: OCP, name: str, method: Any) -> ca.Function | None:
    found: ca.Function | None = _named(name, policy_function, ocp, method)
    return found


def _named(name: str, check: Callable[[OCP, Any], Any], ocp: OCP, method: Any) -> Any:
    """check(ocp, method), its error with the method's name before it."""
    try:
        return check(ocp, method)
    except ValueError as error:
        raise ValueError(f"method {name!r}: {error}") from error


def _check_solution(ocp: OCP, name: str, solution: Solution, starts: Starts) -> None:
    x0, B = starts.x, len(starts)
    if solution.u.ndim != 3 or len(solution.u) != B or solution.u.shape[2] != ocp.system.nu:
        raise ValueError(f"method {name!r} is a Solution with controls {solution.u.shape}; expected [{B}, K, "
                         f"{ocp.system.nu}], one solution for each of the {B} initial states: pass its x0 to compare")
    size = np.abs(x0) + usual_sizes(ocp).x
    same = (np.abs(solution.x[:, 0] - x0) <= SAME_STATE * size).all(axis=1)
    away = np.flatnonzero(np.asarray(solution.success, dtype=bool) & ~same)
    if away.size:
        raise ValueError(f"method {name!r} solves state {away[0]} from {solution.x[away[0], 0].tolist()}, but the "
                         f"comparison starts it at {x0[away[0]].tolist()}: pass the Solution's x0 to compare")
    low, high = ocp.parameter_box
    near = SAME_STATE * (np.abs(starts.p) + high - low)
    if solution.p is not None and not (solution.p.shape == starts.p.shape
                                       and (np.abs(solution.p - starts.p) <= near).all()):
        raise ValueError(f"method {name!r} solves other parameters than those of the comparison: pass the Solution's "
                         "x0 and p to compare")
    if wrong := _off_grid(ocp, solution):
        raise ValueError(f"method {name!r}: {wrong}")


def _off_grid(ocp: OCP, solution: Solution) -> str:
    """What is wrong with a solution's grid for running it in open loop, or ""."""
    t = solution.t
    end = t[:, -1:] if ocp.is_free else ocp.horizon
    if np.allclose(t, end * np.linspace(0.0, 1.0, t.shape[1]), rtol=0, atol=1e-9 * ocp.longest):
        return ""
    steps = np.diff(t)
    return (f"its grid goes from {t.min():g} to {t.max():g} in steps of {steps.min():.4g} to {steps.max():.4g}; "
            f"expected equal steps from 0 to the horizon {ocp.longest:g}: compare it in closed loop, by controller()")


def solve(ocp: OCP, solver: Any, name: str, x0: Starts, solving: Solving) -> list[Solution | str]:
    """The Solution of all states at once; where that raises, state by state, what was raised instead."""
    out = None if solving.out is None else solving.out / "solves" / folder_name(name)
    given: dict[str, Any] = {"workers": solving.workers, "out": out, "progress": solving.progress}
    if takes_p(ocp, solver):
        given["p"] = x0.p
    options = {key: value for key, value in given.items() if _accepts(solver.solve, key)}
    try:
        solution = solver.solve(x0.x, **options)
    except Exception as error:  # a solver may raise anything: it becomes a row
        if len(x0) == 1:
            return [said(error)]
        alone = Solving(1, None, solving.progress)
        return [solve(ocp, solver, name, x0[[i]], alone)[0] for i in range(len(x0))]
    return [solution]


def _accepts(function: Callable[..., Any], name: str) -> bool:
    """Whether it takes a keyword of that name."""
    takes = inspect.signature(function).parameters
    return name in takes or any(one.kind is one.VAR_KEYWORD for one in takes.values())


def planned(ocp: OCP, name: str, method: Any, parts: Sequence[Solution | str], B: int) -> MethodRun:
    """The run of solutions that stand in the order of the states; a str is what a solve raised."""
    K = max((part.u.shape[1] for part in parts if not isinstance(part, str)), default=1)
    nx, nu = ocp.system.nx, ocp.system.nu
    message, u = list[str](), np.full((B, K, nu), np.nan)
    plan = Planned(np.full((B, K + 1, nx), np.nan), np.full((B, K + 1, nx), np.nan))
    ms, predicted, evaluations, solves = *np.full((3, B), np.nan), np.ones(B)
    T = np.full(B, ocp.longest)
    for s in parts:
        i = len(message)
        if isinstance(s, str):
            message.append(s)
            continue
        if s.u.shape[1] != K:
            why = f"its plan has {s.u.shape[1]} intervals, those of other parameters {K}: plan on as many"
            message += [why] * len(s)
            continue
        rows = slice(i, i + len(s.u))
        u[rows], predicted[rows], plan.x[rows] = s.u, s.cost, s.x
        plan.costate[rows], T[rows] = s.costate, s.t[:, -1]
        ms[rows] = 1e3 * s.seconds
        evaluations[rows] = s.iterations * K * stages_of(ocp) * substeps_of(method)
        solves[rows] = np.maximum(s.starts, 1)
        message += _unsolved(ocp, s)
    u[[bool(m) for m in message]] = np.nan
    solved = Solved(ms, solves, predicted, evaluations, plan, message)
    return MethodRun(name, f"open loop, held on {count(K, 'interval')}", method, u, solved=solved,
                     horizon=T if ocp.is_free else None)


def stages_of(ocp: OCP) -> int:
    """Evaluations of f in a step."""
    return 1 if ocp.system.is_discrete else STAGES


def substeps_of(solver: Any) -> int:
    """Runge-Kutta steps in each of its intervals."""
    return int(getattr(getattr(solver, "settled", solver), "substeps", 1))


def _unsolved(ocp: OCP, solution: Solution) -> list[str]:
    """"" for each state that a solver solved, else why its answer is not judged."""
    outcome = zip(solution.success, solution.message, strict=True)
    off_grid = _off_grid(ocp, solution)
    return [off_grid if ok else f"not solved: {why}" for ok, why in outcome]


def folder_name(name: str) -> str:
    """A name as a folder's; different names give different ones."""
    return "".join(c if c.isascii() and c.isalnum() else f"_{ord(c):x}_" for c in name)


def said(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
