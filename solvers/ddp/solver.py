"""Batched control-limited differential dynamic programming with exact second derivatives, in C generated from CasADi.

Notation: z = (x, u); K RK4 intervals on [t0, T], u held on each, as NMPC has it; a problem of the batch is a pair
(x0, t0), with parameters p where the problem has some: data, no states. V, V_x, V_xx are the cost-to-go at the nodes
and its derivatives, u + gain (x' - x) is the locally optimal feedback.

Sources: Jacobson and Mayne, Differential Dynamic Programming (1970); Tassa, Mansard and Todorov, Control-limited
differential dynamic programming, ICRA 2014.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nocl.data import Solution
from nocl.functions import Functions
from nocl.ocp import OCP
from nocl.scales import usual_sizes
from nocl.solvers.ddp.batch import Job, Piece, Rows, assembled, pieces
from nocl.solvers.ddp.kernel import ddp_source, pack_weights
from nocl.solvers.ddp.without_compiler import ddp_kernel
from nocl.solvers.grid import fastest_at_start, firsts, followed, measured
from nocl.substeps import COARSE, Grid, settled
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.fields import Checked, count, positive
from nocl.support.fingerprint import fingerprint
from nocl.support.pool import Journal, Pool, stream

if TYPE_CHECKING:
    from nocl.sysid.identification import LearnedDynamics

ROUNDING = 1e-15  # of the usual cost
STAGES = 4  # evaluations of f in an RK4 step
TOLERATED = 0.01  # of a path constraint's scale: what the penalty may leave of a violation
GROWTH, DECAY = 4.0, 2.0  # of mu, after a failure and a success: against 8 and 8, twice as many wild starts converge


@dataclass(frozen=True)
class DDPSettings(Checked):
    """When to stop, and how steps are damped."""

    max_iterations: int = count(200, "of the descent")
    tolerance: float = positive(1e-10, "stop when the predicted decrease of J is below tolerance * |J|, or 1e-15 of "
                                "the usual cost")
    smallest_step: float = positive(2.0**-12, "of the line search", most=1)
    damping: float = positive(1e-4, "first mu added to Quu, in the solver's units, where a sweep or a line search "
                              "fails")
    largest_damping: float = positive(1e8, "give up above it")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.damping > self.largest_damping:
            raise ValueError(f"DDPSettings: damping is {self.damping:g}, largest_damping {self.largest_damping:g}; "
                             "expected the first to be at most the second: raise largest_damping")


class DDP:
    """Solve batches of an OCP's problems from any (x0, t0); path constraints enter as the OCP's penalty.

    Parameters
    ----------
    ocp : OCP
    intervals : int
        K, the number of held controls on [t0, T].
    substeps : int, optional
        RK4 steps in each interval. Default: 1, or where a few solutions from the OCP's initial states show that this is
        too coarse for the plant, as many as they ask for (nocl/substeps.py); a warning says so.
    dynamics : LearnedDynamics, optional
        f_theta in place of the exact f; its networks' derivatives are generated C too.
    constraints : "hard" or "soft"
        Path constraints enter the descent by the OCP's penalty. "hard": a solution that violates one at a node by more
        than 1 % of its scale (OCP.constraint_scales) has success False, and says which; "soft": that is not asked.
    threads : int, optional
        Default: all cores.
    cache : folder for compiled kernels, optional
        Default: the folder that NOCL_CACHE names, or else one that goes with the process.
    """

    def __init__(self, ocp: OCP, *, intervals: int = 80, substeps: int | None = None,
                 dynamics: LearnedDynamics | None = None, settings: DDPSettings | None = None,
                 constraints: str = "hard", threads: int | None = None,
                 cache: str | os.PathLike[str] | None = None) -> None:
        checks.problem(ocp, "DDP")
        ocp.refuse_constraints("DDP")
        for name, value in (("intervals", intervals), ("substeps", 1 if substeps is None else substeps),
                            ("threads", 1 if threads is None else threads)):
            checks.whole(value, name, "DDP", 1)
        checks.word(constraints, ("hard", "soft"), "constraints", "DDP")
        if settings is not None:
            checks.instance(DDPSettings, settings, "settings", "DDP", "DDPSettings(max_iterations=...)")
        self.ocp, self.intervals, self.settings = ocp, int(intervals), settings or DDPSettings()
        self.constraints, self.dynamics, self.cache = constraints, dynamics, cache
        self.checked = self.coarse = False  # whether the grid was held against the plant, and is too coarse for it
        self.left = substeps is None  # whether the grid was left to nocl
        self.threads = int(threads or os.cpu_count() or 1)
        self.evaluations: Counter[str] = Counter()  # of f in this process, one for each state: "rollout", "backward"
        net = None if dynamics is None else _fitting(ocp, dynamics)
        self._weights = np.zeros(1) if net is None else pack_weights(net)
        self.substeps = int(substeps or substeps_for(ocp, dynamics, self.intervals))
        self.kernel = ddp_kernel(ocp, dynamics, cache, self.substeps)
        self._lb, self._ub = np.ascontiguousarray(ocp.system.lbu), np.ascontiguousarray(ocp.system.ubu)

    def __getstate__(self) -> dict[str, Any]:
        return {"ocp": self.ocp, "intervals": self.intervals, "substeps": self.substeps, "dynamics": self.dynamics,
                "settings": self.settings, "constraints": self.constraints, "threads": self.threads,
                "cache": self.cache}

    def __setstate__(self, options: dict[str, Any]) -> None:
        DDP.__init__(self, **options)  # the kernel is built, or found in the cache, where it is needed

    def solve(self, x0: ArrayLike, t0: ArrayLike = 0.0, *, u: Array | None = None, x: Array | None = None,
              gain: Array | None = None, p: Any = None, curvature: bool = False,
              workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
              progress: bool | None = None) -> Solution:
        """Descend from a guess u [B, K, nu] (default u*), followed with u + gain (x' - x) where x and gain are given.

        Parameters
        ----------
        x0 : [nx] or [B, nx]
        t0 : number or [B], each < horizon
        p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
        curvature : whether to return V_xx
        workers : "auto" (this process, `threads` of it), a number of threads, or "tcp://...", a Dask scheduler
        out : a folder that gets each piece of the batch as soon as it is solved: the same call resumes what is there
        progress : a bar on stderr; default: where that is a terminal

        Raises ValueError before any work for wrong shapes, x0 that is not finite and t0 outside [0, horizon). A problem
        whose guess blows up, or that finds no minimum, has success False, cost inf and a message; the others go on.
        Rows do not depend on each other, nor on `workers`.
        """
        rows, _ = checks.states(x0, self.ocp.system.nx, self.ocp.system.name)
        rows = np.ascontiguousarray(rows)
        values = self.ocp.parameters_of(p, len(rows), "DDP")
        curvature = checks.flag(curvature, "curvature", "DDP.solve")
        times, (pool, here) = self._start_times(t0, len(rows)), self._where(workers)
        guess = self._guesses(len(rows), u=u, x=x, gain=gain)
        journal = Journal(None if out is None else Path(out),
                          self._run_key(rows, times, values, guess, curvature) if out else "", "DDP")
        show = sys.stderr.isatty() if progress is None else progress
        tasks = pieces(self, rows, times, guess, curvature, values)
        solution = assembled(len(rows), stream(Job(here), tasks, pool, journal, show, f"DDP, {self.ocp.system.name}"))
        return self._held_against_plant(solution)

    def _held_against_plant(self, solution: Solution) -> Solution:
        """Warns, once, where the first solutions show a grid that is too coarse; rows far off fail if it was nocl's."""
        functions = _functions(self.ocp, self.dynamics)
        if not self.checked and solution.success.any():
            self.checked = True
            grid = measured(self.ocp, functions, solution, self.substeps)
            self.coarse = grid is not None and grid.coarse
            if self.coarse:
                warnings.warn(f"DDP of {self.ocp.system.name}: {grid}", stacklevel=3)
        return followed(self.ocp, functions, solution, self.substeps) if self.coarse and self.left else solution

    def descend(self, batch: Piece) -> Solution:
        """Solve one piece of a batch, here."""
        given = batch.guess.get
        work = Work(self, batch.x0, batch.t0, given("u"), given("x"), given("gain"), batch.p)
        work.descend()
        return work.solution(batch.curvature)

    def rollout(self, x0: Array, p: Array | None = None, **guess: Array) -> Array:
        """The states [B, K+1, nx] from x0 [B, nx] at t0 = 0 under a guess of `solve`'s: where the descent begins.

        p [B, np], where the problem has parameters.
        """
        given = self._guesses(len(x0), **guess).get
        work = Work(self, np.ascontiguousarray(x0), np.zeros(len(x0)), given("u"), given("x"), given("gain"), p)
        return work.x

    def feedback(self, x: Array, u: Array, p: Array | None = None) -> Array:
        """Gains [B, K, nu, nx] of one sweep about x [B, K+1, nx], u [B, K, nu]: those of the OCP's cost, damped until
        it is convex there; 0 where no damping helps. p [B, np], where the problem has parameters."""
        B, s = len(x), self.settings
        work = Work(self, np.ascontiguousarray(x[:, 0]), np.zeros(B), None, None, None, p)
        work.x[:], work.u[:] = x, u
        rows = np.arange(B)
        while rows.size:
            work.backward(rows)
            rows = rows[work.positive[rows] == 0]
            work.mu[rows] = np.maximum(GROWTH * work.mu[rows], s.damping)
            work.gain[rows] = 0.0
            rows = rows[work.mu[rows] <= s.largest_damping]
        return work.gain

    def _where(self, workers: int | str) -> tuple[Pool, DDP]:
        """The pool, and the DDP that works in it: on a cluster each worker's threads have pieces of their own."""
        pool = Pool(workers)
        if isinstance(workers, str):
            return (Pool(1), self) if workers == "auto" else (pool, self._with_threads(1))
        return Pool(1), self._with_threads(int(workers))

    def _with_threads(self, threads: int) -> DDP:
        other = object.__new__(DDP)
        other.__dict__.update(vars(self), threads=threads)
        return other

    def _guesses(self, B: int, **given: Array | None) -> dict[str, Array]:
        K, nx, nu = self.intervals, self.ocp.system.nx, self.ocp.system.nu
        shapes = {"u": (B, K, nu), "x": (B, K + 1, nx), "gain": (B, K, nu, nx)}
        return {name: _shaped(value, shapes[name], name) for name, value in given.items() if value is not None}

    @cached_property
    def key(self) -> str:
        """A fingerprint of the problem, the model and the settings."""
        net = None if self.dynamics is None else self.dynamics.net
        return fingerprint(self.ocp.to_data(), ddp_source(self.ocp, net, self.substeps), self._weights,
                           self.intervals, self.settings, self.constraints, version("nocl"))

    def _run_key(self, x0: Array, t0: Array, p: Array, guess: dict[str, Array], curvature: bool) -> str:
        """A fingerprint of all that the solution depends on."""
        return fingerprint(self.key, x0, t0, *([p] if p.size else []),
                           *(part for pair in sorted(guess.items()) for part in pair), curvature)

    def _start_times(self, t0: ArrayLike, B: int) -> Array:
        given = checks.numeric(t0, "t0", "DDP.solve", f"a number, or one for each of the {B} states")
        if given.shape not in ((), (1,), (B,)):
            raise ValueError(f"t0 has shape {given.shape}; expected a number, or one for each of the {B} states")
        times = np.broadcast_to(given, (B,)).copy()
        bad = np.flatnonzero(~((times >= 0) & (times < self.ocp.horizon)))
        if bad.size:
            raise ValueError(f"t0[{bad[0]}] is {times[bad[0]]}; expected 0 <= t0 < horizon = {self.ocp.horizon}")
        return times


@lru_cache(maxsize=32)
def substeps_for(ocp: OCP, dynamics: LearnedDynamics | None, intervals: int, tolerance: float = COARSE) -> int:
    """As many as solutions from a few initial states ask for, so that they are off by `tolerance` at most."""
    functions, (x0, p) = _functions(ocp, dynamics), firsts(ocp)

    def ask(substeps: int) -> Grid | None:
        ddp = DDP(ocp, intervals=intervals, substeps=substeps, dynamics=dynamics, constraints="soft")
        ddp.checked = True
        return measured(ocp, functions, ddp.solve(x0, p=p, progress=False), substeps)

    return settled(f"DDP of {ocp.system.name}", ask, ocp.horizon / intervals, lambda: fastest_at_start(ocp, functions),
                   tolerance)


def _functions(ocp: OCP, dynamics: LearnedDynamics | None) -> Functions:
    return ocp.functions if dynamics is None else ocp.functions.on(dynamics.to_casadi())


@dataclass
class Work:
    """The state of a batch while it descends."""

    ddp: DDP
    x0: Array
    t0: Array
    guess_u: Array | None
    guess_x: Array | None
    guess_gain: Array | None
    parameters: Array | None = None  # [B, np], where the problem has some
    mu: Array = field(init=False)

    def __post_init__(self) -> None:
        self.begin = time.perf_counter()
        self.rounding = ROUNDING * usual_sizes(self.ddp.ocp).cost
        ocp, B, K = self.ddp.ocp, len(self.x0), self.ddp.intervals
        nx, nu = ocp.system.nx, ocp.system.nu
        self.p = np.zeros((B, 0)) if self.parameters is None else self.parameters
        self.h = (ocp.horizon - self.t0) / K
        self.x, self.u = np.zeros((B, K + 1, nx)), np.zeros((B, K, nu))
        self.k, self.gain = np.zeros((B, K, nu)), np.zeros((B, K, nu, nx))
        self.new_x, self.new_u, self.new_J = np.zeros_like(self.x), np.zeros_like(self.u), np.zeros(B)
        self.slope, self.curve, self.positive = np.zeros(B), np.zeros(B), np.zeros(B)
        self.mu, self.alpha, self.iterations = np.zeros(B), np.zeros(B), np.zeros(B, dtype=np.int64)
        self.state = np.zeros(B, dtype=np.int64)  # an index of MESSAGES
        self.refused = np.full(B, -1.0)  # the largest mu at which the last sweep's trajectory was not convex
        timed = [self.t0] if ocp.uses_time else []
        self.data = [np.column_stack([*timed, self.p])] if timed or ocp.np else []  # what the kernel calls d_
        u = np.repeat(ocp.goals(self.p)[1][:, None], K, axis=1) if self.guess_u is None else self.guess_u
        x = self.x if self.guess_x is None else self.guess_x
        gain = self.gain if self.guess_gain is None else self.guess_gain
        self.rollout(np.arange(B), x, u, gain)
        self.x[:], self.u[:], self.J = self.new_x, self.new_u, self.new_J.copy()
        self.state[~np.isfinite(self.J)] = BLEW_UP

    def rollout(self, rows: Rows, x_bar: Array, u_bar: Array, gain: Array) -> None:
        d = self.ddp
        d.evaluations["rollout"] += STAGES * d.substeps * d.intervals * len(rows)
        d.kernel("nocl_rollout", rows, d.intervals, d._weights, d._lb, d._ub, self.h, *self.data, self.x0, x_bar, u_bar,
                 self.k, gain, self.alpha, self.new_x, self.new_u, self.new_J, threads=d.threads)

    def backward(self, rows: Rows, V: Array | None = None, V_x: Array | None = None, V_xx: Array | None = None,
                 V_p: Array | None = None) -> None:
        d = self.ddp
        d.evaluations["backward"] += STAGES * d.substeps * d.intervals * len(rows)  # with first and second derivatives
        by_p = [V_p] if self.data else []
        d.kernel("nocl_backward", rows, d.intervals, d._weights, d._lb, d._ub, self.h, *self.data, self.x, self.u,
                 self.mu, self.k, self.gain, self.slope, self.curve, self.positive, V, V_x, V_xx, *by_p,
                 threads=d.threads)

    def descend(self) -> None:
        s = self.ddp.settings
        while (rows := np.flatnonzero(self.state == RUNNING)).size:
            self.state[rows[self.iterations[rows] >= s.max_iterations]] = OUT_OF_ITERATIONS
            rows = rows[self.state[rows] == RUNNING]
            self.iterations[rows] += 1
            self.backward(rows)
            good, bad = rows[self.positive[rows] > 0], rows[self.positive[rows] == 0]
            self.refused[bad] = np.maximum(self.refused[bad], self.mu[bad])
            self._damp(bad)
            small = -(self.slope[good] + self.curve[good]) <= s.tolerance * np.abs(self.J[good]) + self.rounding
            self._settle(good[small])
            self._line_search(good[~small])

    def _settle(self, rows: Rows) -> None:
        """Problems that predict no decrease: done without damping, else tried again with less of it."""
        done = rows[self.mu[rows] == 0]
        self.state[done] = CONVERGED
        self._last_step(done)
        damped = rows[self.mu[rows] > 0]
        self._relax(damped)
        self.state[damped[self.mu[damped] <= self.refused[damped]]] = NOT_CONVEX

    def _last_step(self, rows: Rows) -> None:
        """One more full Newton step where J does not rise: what is left of u's error is squared."""
        self.alpha[rows] = 1.0
        self.rollout(rows, self.x, self.u, self.gain)
        won = rows[self.new_J[rows] <= self.J[rows] + 4e-15 * np.abs(self.J[rows])]  # rounding decides nothing
        self._take(won)

    def _take(self, rows: Rows) -> None:
        self.x[rows], self.u[rows], self.J[rows] = self.new_x[rows], self.new_u[rows], self.new_J[rows]
        self.refused[rows] = -1.0

    def _line_search(self, rows: Rows) -> None:
        """Halve each problem's step until J falls by a share of what was predicted; damp those that never do."""
        self.alpha[rows] = 1.0
        while rows.size:
            self.rollout(rows, self.x, self.u, self.gain)
            a = self.alpha[rows]
            predicted = a * self.slope[rows] + a * a * self.curve[rows]
            done = self.new_J[rows] - self.J[rows] <= 1e-3 * np.minimum(predicted, 0.0)  # False for NaN
            won = rows[done]
            self._take(won)
            self._relax(won[self.alpha[won] > 0.2])
            rows = rows[~done]
            self.alpha[rows] /= 2
            stuck = self.alpha[rows] < self.ddp.settings.smallest_step
            self._damp(rows[stuck])
            rows = rows[~stuck]

    def _damp(self, rows: Rows) -> None:
        s = self.ddp.settings
        self.mu[rows] = np.maximum(GROWTH * self.mu[rows], s.damping)
        self.state[rows[self.mu[rows] > s.largest_damping]] = NO_DESCENT

    def _relax(self, rows: Rows) -> None:
        mu = self.mu[rows] / DECAY
        self.mu[rows] = np.where(mu < self.ddp.settings.damping, 0.0, mu)

    def solution(self, curvature: bool) -> Solution:
        B, K = len(self.x0), self.ddp.intervals
        nx = self.x.shape[2]
        V, V_x = np.zeros((B, K + 1)), np.zeros((B, K + 1, nx))
        V_xx = np.zeros((B, K + 1, nx, nx)) if curvature else None
        self.mu[:] = 0
        known = {"p": self.p, "V_p": np.zeros_like(self.p)} if self.ddp.ocp.np else {}
        self.backward(np.arange(B), V, V_x, V_xx, known.get("V_p"))
        t = self.t0[:, None] + self.h[:, None] * np.arange(K + 1)
        message = [self._words(int(state)) for state in self.state]
        for i, why in self._violations(t):
            self.state[i], message[i] = VIOLATED, why
        success = self.state == CONVERGED
        seconds = np.full(B, (time.perf_counter() - self.begin) / max(B, 1))
        clearance = self.ddp.ocp.least(self.x, t, self.p).min(axis=1, initial=np.inf)
        return Solution(t, self.x, self.u, self.gain, V, V_x, np.where(success, self.J, np.inf), success,
                        np.array(message, dtype=np.str_), seconds, self.iterations, V_xx, clearance=clearance,
                        **known)

    def _words(self, state: int) -> str:
        kinks = self.ddp.ocp.not_smooth if state in (OUT_OF_ITERATIONS, NO_DESCENT, NOT_CONVEX) else ""
        return MESSAGES[state] + (f"; {kinks}" if kinks else "")

    def _violations(self, t: Array) -> Iterator[tuple[int, str]]:
        """Rows that converged, but across a path constraint, and in words which, where and when."""
        ocp = self.ddp.ocp
        if self.ddp.constraints == "soft" or not ocp.h_titles:
            return
        over = ocp.violation(ocp.least(self.x, t, self.p)) > TOLERATED
        for i in np.flatnonzero((self.state == CONVERGED) & over):
            h = ocp.h(*ocp.functions.node.columns(x=self.x[i], t=t[i], p=self.p[i])).full()
            k, node = np.unravel_index(np.argmin(h / ocp.constraint_scales[:, None]), h.shape)
            why = "by the initial state itself: move it" if node == 0 else CROSSED
            yield int(i), (f"{ocp.h_titles[k]} is violated by {-h[k, node]:.3g} at "
                           f"node {node}, t = {t[i, node]:.4g}, {why}")


MESSAGES = ("running", "converged", "stopped at max_iterations", "no descent: the largest damping did not help",
            "the starting guess blows up: its cost is not finite",
            "stationary, but no minimum: the cost is not convex in the controls there", "a path constraint is violated")
CROSSED = ("which the penalty does not hold: raise the OCP's penalty, or ask NMPC, which tells whether any control "
           "holds it")
RUNNING, CONVERGED, OUT_OF_ITERATIONS, NO_DESCENT, BLEW_UP, NOT_CONVEX, VIOLATED = range(7)


def _fitting(ocp: OCP, dynamics: LearnedDynamics) -> Any:
    """The networks of f_theta, if its states and controls are the problem's."""
    if not hasattr(dynamics, "net"):
        raise ValueError(f"DDP: dynamics is a {type(dynamics).__name__}; expected LearnedDynamics, as "
                         "nocl.identify gives it, or None for the exact f")
    ours, theirs = ((*s.names, *s.parameter_names) for s in (ocp.system, dynamics.system))
    if ours != theirs:
        raise ValueError(f"DDP: dynamics was learned for {', '.join(theirs)}; the problem has {', '.join(ours)}")
    return dynamics.net


def _shaped(value: Array, shape: tuple[int, ...], name: str) -> Array:
    array = np.ascontiguousarray(checks.numeric(value, f"the guess {name}", "DDP", f"{list(shape)}", copy=False))
    if array.shape != shape:
        raise ValueError(f"DDP: the guess {name} has shape {array.shape}; expected {shape}, a row for each x0")
    return array
