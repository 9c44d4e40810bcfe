"""compare: any methods on the same initial states, one judge, one row a method and initial state. B is the batch.

Fair by construction: every method gets the same states, and its controls are run on the exact f under CVODES with the
cost as an extra state (nocl.simulate), whatever model, grid or integrator it used itself:

- feedback (a casadi.Function (x, t) -> u, or an object with `to_casadi()`, as CND and LQR): continuously, and with
  `hold=K` once more, sampled and held on K equal intervals;
- a solver (an object with `solve(x0)`, as NMPC and DDP) or its Solution: open loop, its controls held on its own grid;
- any other callable (x [B, nx], t) -> u [B, nu]: sampled and held on `hold` intervals, SAMPLED unless told.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from nocl import checks
from nocl.checks import Array
from nocl.comparisons.report import OPEN_LOOP, Judged, Report, count
from nocl.data import Solution
from nocl.ocp import OCP
from nocl.simulate import Simulation, policy_function, simulate

SAMPLED = 80  # intervals that a plain callable is held on
CALLS = 20  # control evaluations that are timed at each initial state, at most; the median counts
TIMED = 100.0  # milliseconds spent on that, about
CHUNKS = 20  # parts that the states are judged in, for the progress bar


def compare(ocp: OCP, methods: Mapping[str, Any], n: int = 100, x0: ArrayLike | None = None, seed: int = 1,
            hold: int | None = None, progress: bool | None = None) -> Report:
    """Judge `methods` (by name) on the same initial states: x0 [nx] or [B, nx], else n drawn with `seed`.

    `hold=K` judges each feedback once more, held on K intervals, as the method "NAME (K holds)". Nothing is dropped:
    where a method raises, does not converge or blows up, its row says so. Milliseconds: a solver's own `seconds` for
    that state (the whole control trajectory; without them, its wall time over the number of states); for a controller
    the median time of one control evaluation there.

    Raises ValueError for methods that are none, or are made for another problem.
    """
    states = _initial_states(ocp, n, x0, seed)
    if hold is not None and not _is_count(hold):
        raise ValueError(f"hold is {hold!r}; expected a number of intervals >= 1, or None")
    plans = [plan for name, method in _named(methods).items() for plan in _plans(ocp, name, method, states, hold)]
    names = [plan.name for plan in plans]
    if len(set(names)) < len(names):
        raise ValueError(f"the methods are named {', '.join(names)}; expected different names: rename one")
    start = time.perf_counter()
    judged = tuple(plan.run(states, progress) for plan in plans)
    settings = {"seed": seed if x0 is None else None, "n": len(states), "hold": hold,
                "initial states": "given" if x0 is not None else f"drawn with seed {seed}"}
    return Report(ocp, states, judged, settings, time.perf_counter() - start)


def _is_count(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 1)


def _initial_states(ocp: OCP, n: int, x0: ArrayLike | None, seed: int) -> Array:
    if x0 is None:
        if not _is_count(n):
            raise ValueError(f"n is {n!r}; expected a number of initial states >= 1")
        return ocp.initial_states.sample(int(n), seed)
    rows = checks.states(x0, ocp.system.nx, ocp.system.name)[0].copy()
    if not len(rows):
        raise ValueError("x0 has no rows; expected at least one initial state")
    return rows


def _named(methods: Mapping[str, Any]) -> Mapping[str, Any]:
    if not isinstance(methods, Mapping) or not methods:
        raise ValueError(f"methods is {type(methods).__name__} {methods!r}; expected a dict of methods by name, "
                         'like {"CND": cnd, "NMPC": nmpc}')
    for name in methods:
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ValueError(f"a method is named {name!r}; expected a printable name")
    return methods


@dataclass(frozen=True)
class _Plan:
    """A method that is going to be judged: `run` takes rows x0 [B, nx], and whether to show progress."""

    name: str
    run: Callable[[Array, bool | None], Judged]


def _plans(ocp: OCP, name: str, method: Any, x0: Array, hold: int | None) -> Iterator[_Plan]:
    """One plan, or two for a feedback that is to be held as well; ValueError for what is no method."""
    if isinstance(method, Solution):
        _check_solution(ocp, name, method, x0)
        yield _Plan(name, lambda x0, progress: _open_loop(ocp, [(method, np.nan)], x0, progress, name))
        return
    policy = _policy(ocp, name, method)
    if policy is not None:
        yield _Plan(name, _feedback(ocp, method, policy, None, name))
        if hold is not None:
            held = f"{name} ({count(hold, 'hold')})"
            yield _Plan(held, _feedback(ocp, method, policy, hold, held))
    elif hasattr(method, "solve"):
        yield _Plan(name, lambda x0, progress: _open_loop(ocp, _solve(method, x0, progress), x0, progress, name))
    elif callable(method):
        yield _Plan(name, _feedback(ocp, method, None, _held_on(method, hold), name))
    else:
        raise ValueError(f"method {name!r} is a {type(method).__name__}; expected a controller with to_casadi(), a "
                         "casadi.Function (x, t) -> u, a solver with solve(x0), a Solution, or a callable (x, t) -> u")


def _held_on(method: Any, hold: int | None) -> int:
    """Intervals for sampled feedback: as asked for, the controller's own (NMPC's loop has a `hold`), or SAMPLED."""
    own = getattr(method, "hold", None)
    return hold or (int(own) if own is not None and _is_count(own) else SAMPLED)


def _policy(ocp: OCP, name: str, method: Any) -> ca.Function | None:
    try:
        return policy_function(ocp, method)
    except ValueError as error:
        raise ValueError(f"method {name!r}: {error}") from error


def _check_solution(ocp: OCP, name: str, solution: Solution, x0: Array) -> None:
    B = len(x0)
    if solution.u.ndim != 3 or len(solution.u) != B or solution.u.shape[2] != ocp.system.nu:
        raise ValueError(f"method {name!r} is a Solution with controls {solution.u.shape}; expected [{B}, K, "
                         f"{ocp.system.nu}], one solution for each of the {B} initial states: pass its x0 to compare")
    same = np.isclose(solution.x[:, 0], x0, rtol=1e-6, atol=1e-6).all(axis=1)
    away = np.flatnonzero(np.asarray(solution.success, dtype=bool) & ~same)
    if away.size:
        raise ValueError(f"method {name!r} solves state {away[0]} from {solution.x[away[0], 0].tolist()}, but the "
                         f"comparison starts it at {x0[away[0]].tolist()}: pass the Solution's x0 to compare")
    if said := _off_grid(ocp, solution):
        raise ValueError(f"method {name!r}: {said}")


def _off_grid(ocp: OCP, solution: Any) -> str:
    """What is wrong with a solution's grid for running it in open loop, or ""."""
    t = np.atleast_2d(solution.t)
    if np.allclose(t, np.linspace(0.0, ocp.horizon, t.shape[1]), rtol=0, atol=1e-9 * ocp.horizon):
        return ""
    steps = np.diff(t)
    return (f"its grid goes from {t.min():g} to {t.max():g} in steps of {steps.min():.4g} to {steps.max():.4g}; "
            f"expected equal steps from 0 to the horizon {ocp.horizon:g}: compare it in closed loop, by controller()")


def _feedback(ocp: OCP, method: Any, policy: ca.Function | None, hold: int | None,
              name: str) -> Callable[[Array, bool | None], Judged]:
    controller = method if policy is None else policy
    how = "continuous feedback" if hold is None else f"feedback, held on {count(hold, 'interval')}"

    def run(x0: Array, progress: bool | None) -> Judged:
        simulation = _in_chunks(lambda x: simulate(ocp, controller, x, hold=hold), ocp, x0, progress, name)
        first, median = np.array([_milliseconds(controller, x) for x in x0]).T
        return Judged(name, how, simulation, first, median, np.ones(len(x0)), _predicted(method, x0))

    return run


def _milliseconds(controller: Any, x: Array) -> tuple[float, float]:
    """(first, median) time of a control evaluation at (x, 0): the first differs where a controller warm-starts."""
    argument = x if isinstance(controller, ca.Function) else x[None]
    times: list[float] = []
    try:
        while len(times) < CALLS and sum(times) < TIMED:
            start = time.perf_counter()
            controller(argument, 0.0)
            times.append(1e3 * (time.perf_counter() - start))
    except Exception:  # whatever a user's controller raises: the judge has its message
        return np.nan, np.nan
    median = float(np.median(times[1:] or times))
    return (median if isinstance(controller, ca.Function) else times[0]), median


def _predicted(method: Any, x0: Array) -> Array:
    """The cost that the method itself expects, V(x0, 0), where it has a value function; else NaN."""
    if hasattr(method, "value"):
        try:
            values = np.asarray(method.value(x0, 0.0), dtype=np.float64).ravel()
        except Exception:  # a prediction that cannot be had is no failure of the controller
            values = np.empty(0)
        if len(values) == len(x0):
            return values
    return np.full(len(x0), np.nan)


def _solve(solver: Any, x0: Array, progress: bool | None) -> list[tuple[Any, float] | str]:
    """(Solution, seconds a state) of all states at once; where that raises, state by state, what was raised instead."""
    takes = "progress" in inspect.signature(solver.solve).parameters
    start = time.perf_counter()
    try:
        solution = solver.solve(x0, progress=progress) if takes else solver.solve(x0)
    except Exception as error:  # a solver may raise anything: it becomes a row
        if len(x0) == 1:
            return [_said(error)]
        return [_solve(solver, x[None], progress)[0] for x in x0]
    return [(solution, (time.perf_counter() - start) / len(x0))]


def _open_loop(ocp: OCP, parts: Sequence[tuple[Any, float] | str], x0: Array, progress: bool | None,
               name: str) -> Judged:
    """Judge the controls of solutions that stand in the order of the states; a str is what a solve raised."""
    K = max((part[0].u.shape[1] for part in parts if not isinstance(part, str)), default=1)
    message: list[str] = []
    u = np.full((len(x0), K, ocp.system.nu), np.nan)
    ms, predicted, solves = np.full(len(x0), np.nan), np.full(len(x0), np.nan), np.ones(len(x0))
    for part in parts:
        i = len(message)
        if isinstance(part, str):
            message.append(part)
            continue
        solution, seconds = part
        rows = slice(i, i + len(solution.u))
        u[rows], predicted[rows] = solution.u, solution.cost
        ms[rows] = 1e3 * np.asarray(getattr(solution, "seconds", seconds))
        starts = getattr(solution, "starts", None)
        solves[rows] = 1 if starts is None else np.maximum(starts, 1)
        message += _unsolved(ocp, solution)
    solved = np.array([not m for m in message])
    simulation = _failed(ocp, message, np.linspace(0.0, ocp.horizon, K + 1))
    if solved.any():
        run = _in_chunks(lambda i: simulate(ocp, u[i], x0[i]), ocp, np.flatnonzero(solved), progress, name)
        simulation = _put(simulation, run, solved)
    how = f"{OPEN_LOOP}, held on {count(K, 'interval')}"
    return Judged(name, how, simulation, ms, np.full(len(x0), np.nan), solves, predicted)


def _unsolved(ocp: OCP, solution: Any) -> list[str]:
    """"" for each state that a solver solved, else why its answer is not judged."""
    outcome = zip(solution.success, solution.message, strict=True)
    off_grid = _off_grid(ocp, solution)
    return [off_grid if ok else f"not solved: {said}" for ok, said in outcome]


def _in_chunks(run: Callable[[Any], Simulation], ocp: OCP, rows: Any, progress: bool | None, name: str) -> Simulation:
    """Simulations of the rows, some at a time; where that raises, row by row, so that one spoils no other."""
    parts = []
    with tqdm(total=len(rows), desc=f"judging {name}", unit="state", leave=False,
              disable=None if progress is None else not progress) as bar:
        for chunk in np.array_split(rows, min(len(rows), CHUNKS)):
            parts += _each(run, ocp, chunk)
            bar.update(len(chunk))
    K = max(len(part.t) for part in parts)
    return _join([part if len(part.t) == K else _failed(ocp, part.message, np.linspace(0.0, ocp.horizon, K))
                  for part in parts])


def _each(run: Callable[[Any], Simulation], ocp: OCP, rows: Any) -> list[Simulation]:
    try:
        return [run(rows)]
    except Exception as error:  # whatever a user's controller raises becomes a row
        if len(rows) == 1:
            return [_failed(ocp, [_said(error)], np.linspace(0.0, ocp.horizon, 2))]
    return [part for i in range(len(rows)) for part in _each(run, ocp, rows[i:i + 1])]


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _failed(ocp: OCP, message: Sequence[str], t: Array) -> Simulation:
    """What the judge says of states that there was nothing to run on."""
    B, K = len(message), len(t)
    inf, nan = np.full((4, B), np.inf), np.full((3, B), np.nan)
    x, u = (np.full((B, K, n), np.nan) for n in (ocp.system.nx, ocp.system.nu))
    return Simulation(t, x, u, inf[0], inf[1], inf[2], inf[3], nan[0], nan[1], nan[2], np.zeros(B, dtype=bool),
                      list(message))


def _join(parts: Sequence[Simulation]) -> Simulation:
    values = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Simulation)
              if f.name not in ("t", "message")}
    return Simulation(t=parts[0].t, message=[m for part in parts for m in part.message], **values)


def _put(simulation: Simulation, part: Simulation, where: Array) -> Simulation:
    """`simulation` with the rows `where` taken from `part`."""
    message = list(simulation.message)
    for i, said in zip(np.flatnonzero(where), part.message, strict=True):
        message[i] = said
    for f in fields(Simulation):
        if f.name not in ("t", "message"):
            getattr(simulation, f.name)[where] = getattr(part, f.name)
    return replace(simulation, message=message)
