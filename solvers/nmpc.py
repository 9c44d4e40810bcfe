"""NMPC: the reference. Multiple shooting from several starts for each initial state, the best kept, failures told."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from nocl import checks
from nocl.checks import Array
from nocl.data import Solution, Trajectory
from nocl.ocp import OCP
from nocl.simulate import dynamics_function
from nocl.solvers import guesses as starting
from nocl.solvers.guesses import Guess
from nocl.solvers.lqr import LQR
from nocl.solvers.transcription import BACKENDS, FEASIBLE, Answer, Transcription

SAME = 1e-3  # costs closer than this, relative, count as the same optimum
BETTER = 1e-6  # relative improvement that makes a neighbour's solution worth passing on
TINY = 1e-10  # ... and absolute: costs below it are equal
LAST = 0.95  # largest share of what is left of the horizon that a closed loop's first interval may take


@dataclass(frozen=True, eq=False)
class NMPC:
    """min over u_0 ... u_{N-1}, held, of the OCP's cost under RK4 steps, for each initial state.

    Parameters
    ----------
    ocp : OCP
    intervals : N
    dynamics : casadi.Function (x, u) -> xdot, or an object with `to_casadi()`; default: the exact f
    solver : "fatrop" (fast) or "ipopt" (reference); another nlpsol of CasADi's by its name
    substeps : RK4 steps in each interval
    starts : guesses tried for each state, beyond those that `solve` is given
    passes : rounds in which states of one batch are solved again from their neighbours' solutions
    neighbours : how many in each round
    constraints : "hard": path constraints at the nodes; "soft": the penalty of ocp.L_soft in the cost instead
    seed : of the random starts
    options : of the nlpsol, like {"ipopt.tol": 1e-6}
    """

    ocp: OCP
    intervals: int = 80
    dynamics: Any = field(default=None, kw_only=True)
    solver: str = field(default="fatrop", kw_only=True)
    substeps: int = field(default=1, kw_only=True)
    starts: int = field(default=8, kw_only=True)
    passes: int = field(default=3, kw_only=True)
    neighbours: int = field(default=3, kw_only=True)
    constraints: str = field(default="hard", kw_only=True)
    seed: int = field(default=0, kw_only=True)
    options: Mapping[str, Any] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for name, least in (("intervals", 2), ("substeps", 1), ("starts", 1), ("passes", 0), ("neighbours", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
                raise ValueError(f"NMPC: {name} is {value!r}; expected an integer >= {least}")
        if self.constraints not in ("hard", "soft"):
            raise ValueError(f"NMPC: constraints is {self.constraints!r}; expected 'hard' or 'soft'")
        if self.solver not in BACKENDS and not ca.has_nlpsol(self.solver):
            raise ValueError(f"NMPC: solver is {self.solver!r}; expected {' or '.join(BACKENDS)}, or an nlpsol "
                             "that this CasADi has")
        dynamics_function(self.ocp, self.dynamics)

    @property
    def program(self) -> Transcription:
        """The nonlinear program, built once for each problem and settings."""
        options = tuple(sorted((self.options or {}).items()))
        return _program(self.ocp, self.dynamics, int(self.intervals), int(self.substeps), self.constraints == "soft",
                        self.solver, options)

    def solve(self, x0: ArrayLike, guesses: Any = None, *, t0: float = 0.0, nodes: ArrayLike | None = None,
              starts: int | None = None, progress: bool | None = None) -> Solution:
        """The best solution found from each state x0 [nx] or [B, nx] at time t0.

        Parameters
        ----------
        guesses : tried first: a Solution or Trajectory, controls u [B, N, nu], (x [B, N+1, nx], u), or a list of them
        nodes : times of the nodes [N+1] up to the horizon; default: from t0, all intervals equal
        starts : built-in starts for each state; default: self.starts, or none where guesses are given
        progress : a bar on stderr; default: where that is a terminal

        Returns a Solution with a row for each state. Its `seconds`, `iterations` and `starts` count all that was tried.
        A state without a solution has success False, cost inf, and the message of its most feasible start.
        Raises ValueError before any solve where shapes do not fit or numbers are not finite.
        """
        s = self.ocp.system
        rows, _ = checks.states(x0, s.nx, s.name)
        t = self._nodes(t0, nodes)
        given = _given(guesses, len(rows), self.intervals, s.nx, s.nu)
        n = starts if starts is not None else (0 if given else self.starts)
        if n < 1 and not given:
            raise ValueError(f"starts is {n}; expected at least 1, or guesses")
        searches = [_Search(self.program, row, t) for row in rows]
        show = sys.stderr.isatty() if progress is None else progress
        for i, search in enumerate(_bar(searches, show, "NMPC")):
            search.run(given_guess(self.program, search.x0, x[i] if x is not None else None, u[i], t) for x, u in given)
            if n:
                search.run(starting.starts(self.program, _lqr(self.ocp), search.x0, t, n, self.seed))
        if n:
            self._exchange(searches, show)
        return _collect(searches, t)

    def _nodes(self, t0: float, nodes: ArrayLike | None) -> Array:
        T, N = self.ocp.horizon, self.intervals
        if not 0 <= t0 < T:
            raise ValueError(f"t0 is {t0!r}; expected 0 <= t0 < {T:g}, the horizon")
        t = np.linspace(t0, T, N + 1) if nodes is None else np.asarray(nodes, dtype=np.float64)
        if t.shape != (N + 1,) or not (np.diff(t) > 0).all() or t[0] < 0 or abs(t[-1] - T) > 1e-9 * T:
            raise ValueError(f"nodes have shape {t.shape}; expected N + 1 = {N + 1} rising times in [0, {T:g}], "
                             "the last at the horizon")
        return t

    def _exchange(self, searches: list[_Search], show: bool) -> None:
        """Solve each state again from its nearest neighbours' solutions, until nothing improves or `passes` rounds."""
        x0 = np.array([search.x0 for search in searches])
        scale = np.where(np.ptp(x0, axis=0) > 0, np.ptp(x0, axis=0), 1.0)
        tried: set[tuple[int, int, float]] = set()
        for round_ in range(self.passes):
            improved = False
            for i, search in enumerate(_bar(searches, show, f"neighbours, round {round_ + 1}")):
                distance = np.linalg.norm((x0 - x0[i]) / scale, axis=1)
                others = [j for j in np.argsort(distance, kind="stable") if j != i and searches[j].best is not None]
                before = search.cost
                for j in others[: self.neighbours]:
                    answer = searches[j].best
                    assert answer is not None
                    if (i, j, answer.cost) not in tried:
                        tried.add((i, j, answer.cost))
                        search.run([starting.from_neighbour(search.x0, answer.x, answer.u)])
                improved |= search.cost < before - max(BETTER * abs(search.cost), TINY)
            if not improved:
                return

    def controller(self, hold: int | None = None) -> Loop:
        """Closed loop u(x, t), solved again at each call; hold: how many controls the horizon has (default N)."""
        return Loop(self, hold)


@lru_cache(maxsize=32)
def _program(ocp: OCP, dynamics: Any, N: int, substeps: int, soft: bool, solver: str,
             options: tuple[tuple[str, Any], ...]) -> Transcription:
    return Transcription(ocp, dynamics_function(ocp, dynamics), N, substeps, soft, solver, options)


@lru_cache(maxsize=32)
def _lqr(ocp: OCP) -> LQR | None:
    return starting.lqr_of(ocp)


class _Search:
    """All that was tried from one state."""

    def __init__(self, program: Transcription, x0: Array, t: Array) -> None:
        self.program, self.x0, self.t = program, x0, t
        self.best: Answer | None = None
        self.failed: Answer | None = None
        self.costs: list[float] = []
        self.seconds, self.iterations = 0.0, 0
        self.refusal = _violated_start(program, x0)

    @property
    def cost(self) -> float:
        return np.inf if self.best is None else self.best.cost

    def run(self, guesses: Iterable[Guess]) -> None:
        for x, u in guesses if not self.refusal else ():
            begin = time.perf_counter()
            answer = self.program.solve(self.x0, self.t, x, u)
            self.seconds += time.perf_counter() - begin
            self.iterations += answer.iterations
            self.costs.append(answer.cost)
            if answer.success and answer.cost < self.cost:
                self.best = answer
            elif not answer.success and (self.failed is None or answer.violation < self.failed.violation):
                self.failed = answer

    @property
    def hits(self) -> int:
        if self.best is None:
            return 0
        near = np.array(self.costs) - self.cost <= max(SAME * abs(self.cost), TINY)
        return int(near.sum())

    @property
    def message(self) -> str:
        if self.refusal:
            return self.refusal
        if self.best is not None:
            return self.best.message
        assert self.failed is not None
        return (f"no start of {len(self.costs)} converged from x0 = {_text(self.x0)}: {self.failed.message}; "
                "try more starts, another guess, or constraints='soft'")


def _violated_start(program: Transcription, x0: Array) -> str:
    """Why x0 is no start at all: inside an obstacle that no control can undo."""
    if not program.n_path:
        return ""
    h = program.ocp.h(x0).full().ravel()
    i = int(np.argmin(h))
    if h[i] >= -FEASIBLE:
        return ""
    return (f"infeasible: path constraint {list(program.ocp.path_constraints)[i]!r} is violated by {-h[i]:.3g} at node "
            f"0, by x0 = {_text(x0)} itself: move x0, or use constraints='soft'")


def _text(x: Array) -> str:
    return np.array2string(x, precision=4, separator=", ")


def _collect(searches: list[_Search], t: Array) -> Solution:
    """One row for each search; NaN where there is no solution."""
    p = searches[0].program
    s, N, B = p.ocp.system, p.N, len(searches)
    x, u = np.full((B, N + 1, s.nx), np.nan), np.full((B, N, s.nu), np.nan)
    costate = np.full((B, N + 1, s.nx), np.nan)
    for i, search in enumerate(searches):
        if search.best is not None:
            x[i], u[i], costate[i] = search.best.x, search.best.u, search.best.costate
    return Solution(
        Trajectory(t, x, u), cost=np.array([e.cost for e in searches]), costate=costate,
        success=np.array([e.best is not None for e in searches]), message=[e.message for e in searches],
        seconds=np.array([e.seconds for e in searches]), iterations=np.array([e.iterations for e in searches]),
        starts=np.array([len(e.costs) for e in searches]), hits=np.array([e.hits for e in searches]))


Rows = tuple[Array | None, Array]  # states [B, N+1, nx] or None, controls [B, N, nu]


def _given(guesses: Any, B: int, N: int, nx: int, nu: int) -> list[Rows]:
    """The user's guesses as rows, checked."""
    if guesses is None:
        return []
    if isinstance(guesses, list):
        return [row for one in guesses for row in _given(one, B, N, nx, nu)]
    x, u = (guesses.x, guesses.u) if isinstance(guesses, (Solution, Trajectory)) else \
        guesses if isinstance(guesses, tuple) else (None, guesses)
    u = _shaped(u, (B, N, nu), "the guess's u", "[B, N, nu]")
    return [(x if x is None else _shaped(x, (B, N + 1, nx), "the guess's x", "[B, N+1, nx]"), u)]


def _shaped(value: ArrayLike, shape: tuple[int, ...], what: str, form: str) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 2 and shape[0] == 1:
        array = array[None]
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}; expected {form} = {list(shape)}, a row for each x0")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=(1, 2)))[0])
        raise ValueError(f"{what} is not finite in row {row}; expected numbers: leave out rows without a solution")
    return array


def given_guess(program: Transcription, x0: Array, x: Array | None, u: Array, t: Array) -> Guess:
    """A user's guess; without states, the rollout of its controls."""
    if x is not None:
        return x, u
    rolled = np.vstack([x0, program.rollout(x0, u.T, np.diff(t)[None]).full().T])
    return (rolled if np.isfinite(rolled).all() else np.tile(x0, (len(u) + 1, 1))), u


def _bar(items: Sequence[Any], show: bool, what: str) -> Iterable[Any]:
    return tqdm(items, desc=what, delay=3.0, leave=False, disable=not show or len(items) < 2)


class Loop:
    """NMPC as feedback u(x, t) on a shrinking horizon: at each call solved again from the last solution, shifted.

    The first interval of each plan is as long as the control will be held, `hold` times within the horizon; the rest of
    the horizon is cut into N - 1 equal ones. A call at an earlier time than the last, or with another number of states,
    starts afresh from all starts. `stats` has an entry a call: t, success, seconds, message. A state whose solve fails
    keeps its last plan, or u* where it has none yet: flagged by success False and the message there.
    """

    def __init__(self, nmpc: NMPC, hold: int | None = None) -> None:
        self.nmpc, self.hold = nmpc, hold or nmpc.intervals
        self.plan: Solution | None = None
        self.stats: list[dict[str, Any]] = []

    def __call__(self, x: ArrayLike, t: float = 0.0) -> Array:
        """u [nu] or [B, nu] at time t."""
        s = self.nmpc.ocp.system
        rows, single = checks.states(x, s.nx, s.name, "x")
        nodes = self.nodes(float(t))
        last = self.plan
        if last is None or len(last.x) != len(rows) or last.t[0] > nodes[0]:
            self.stats, guess = [], (np.repeat(rows[:, None], len(nodes), axis=1),
                                     np.tile(self.nmpc.ocp.u_goal, (len(rows), len(nodes) - 1, 1)))
            solution = self.nmpc.solve(rows, nodes=nodes, progress=False)
        else:
            guess = _shift(last, rows, nodes)
            solution = self.nmpc.solve(rows, guess, nodes=nodes, progress=False)
        self.stats.append({"t": float(t), "success": solution.success, "seconds": solution.seconds,
                           "message": solution.message})
        self.plan = _patched(solution, guess)
        return self.plan.u[0, 0] if single else self.plan.u[:, 0]

    def nodes(self, t: float) -> Array:
        """t, t + the time that a control is held, ..., the horizon [N+1]."""
        T, N = self.nmpc.ocp.horizon, self.nmpc.intervals
        t = min(t, T * (1 - 1e-6))  # some ask at the end, too
        first = min(T / self.hold, LAST * (T - t))
        return np.r_[t, np.linspace(t + first, T, N)]


def _shift(last: Solution, x: Array, nodes: Array) -> tuple[Array, Array]:
    """The last plan on new nodes, its states moved to the measured x at the start."""
    N = last.u.shape[1]
    held = np.clip(np.searchsorted(last.t, (nodes[:-1] + nodes[1:]) / 2, side="right") - 1, 0, N - 1)
    states = np.stack([np.stack([np.interp(nodes, last.t, column) for column in path.T], axis=1) for path in last.x])
    return states + np.linspace(1, 0, N + 1)[None, :, None] * (x - states[:, 0])[:, None], last.u[:, held]


def _patched(solution: Solution, guess: tuple[Array, Array]) -> Solution:
    """Rows whose solve failed hold the guess instead; their success stays False."""
    ok = np.asarray(solution.success)[:, None, None]
    x, u = np.where(ok, solution.x, guess[0]), np.where(ok, solution.u, guess[1])
    return replace(solution, trajectory=Trajectory(solution.t, x, u))
