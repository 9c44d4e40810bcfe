"""A batch of problems while it descends: sweeps and rollouts of the kernel, line searches, damping, what came of each.

Rows are problems: each has a step, a damping mu and an end of its own.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from nocl.data import Solution
from nocl.definition import measured
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.definition.substeps import MAP, RADAU, RK4
from nocl.solvers.ddp.batch import Rows
from nocl.solvers.ddp.constraints import ConstraintRows
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.support.checks import Array
from nocl.support.fields import Checked, count, positive
from nocl.translate import radau
from nocl.translate.kernels import Kernel

ROUNDING = 1e-15  # of the usual cost
# of a step: evaluations of f, in an implicit one for each Newton iteration
STAGES = {MAP: 1, RK4: 4, RADAU: radau.STAGES}
GROWTH, DECAY = 4.0, 2.0  # of mu, after a failure and a success: against 8 and 8, twice as many wild starts converge


@dataclass(frozen=True)
class DDPSettings(Checked):
    """When to stop, and how steps are damped."""

    max_iterations: int = count(200, "of the descent; 5 times as many where constraints are held")
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


class Kernels(Protocol):
    """What a batch descends by; the DDP."""

    posed: OCP  # what the kernel solves
    intervals: int
    substeps: int
    integrator: str
    settings: DDPSettings
    constraints: str
    rows: ConstraintRows
    margin: Array | None  # [rows of a stage, then of the end], by which each is held further inside
    threads: int
    kernel: Kernel | NumpyKernel
    evaluations: Counter[str]
    _weights: Array
    _lb: Array
    _ub: Array


@dataclass
class Work:
    """The state of a batch while it descends."""

    ddp: Kernels
    x0: Array
    t0: Array
    guess_u: Array | None
    guess_x: Array | None
    guess_gain: Array | None
    parameters: Array | None = None  # [B, np], where the problem has some
    mu: Array = field(init=False)
    J: Array = field(init=False)  # [B], what is descended

    def __post_init__(self) -> None:
        self.begin = time.perf_counter()
        self.rounding = ROUNDING * usual_sizes(self.ddp.posed).cost
        ocp, B, K = self.ddp.posed, len(self.x0), self.ddp.intervals
        nx, nu = ocp.system.nx, ocp.system.nu
        self.p = np.zeros((B, 0)) if self.parameters is None else self.parameters
        self.h = (ocp.horizon - self.t0) / K if ocp.system.dt is None else np.full(B, ocp.system.dt)
        self.x, self.u = np.zeros((B, K + 1, nx)), np.zeros((B, K, nu))
        self.k, self.gain = np.zeros((B, K, nu)), np.zeros((B, K, nu, nx))
        self.new_x, self.new_u = np.zeros_like(self.x), np.zeros_like(self.u)
        self.J = np.zeros(B)
        self.new_J = np.zeros(B)
        self.slope, self.curve, self.positive = np.zeros(B), np.zeros(B), np.zeros(B)
        self.mu, self.alpha, self.iterations = np.zeros(B), np.zeros(B), np.zeros(B, dtype=np.int64)
        self.most = np.full(B, self.ddp.settings.max_iterations)
        self.state = np.zeros(B, dtype=np.int64)  # an index of MESSAGES
        self.refused = np.full(B, -1.0)  # the largest mu at which the last sweep's trajectory was not convex
        self.undamped = np.zeros(B, dtype=bool)  # whether that was so without damping, too
        timed = [self.t0] if ocp.uses_time else []
        self.data = [np.column_stack([*timed, self.p])] if timed or ocp.np else []  # what the kernel calls d_
        u = np.repeat(ocp.goals(self.p)[1][:, None], K, axis=1) if self.guess_u is None else self.guess_u
        x = self.x if self.guess_x is None else self.guess_x
        gain = self.gain if self.guess_gain is None else self.guess_gain
        self.rollout(np.arange(B), x, u, gain)
        self._take(np.arange(B))
        self.state[~np.isfinite(self.J)] = BLEW_UP

    def rollout(self, rows: Rows, x_bar: Array, u_bar: Array, gain: Array) -> None:
        d = self.ddp
        d.evaluations["rollout"] += STAGES[d.integrator] * d.substeps * d.intervals * len(rows)
        d.kernel("nocl_rollout", rows, d.intervals, d._weights, d._lb, d._ub, self.h, *self.data, self._start(), x_bar,
                 u_bar, self.k, gain, self.alpha, self.new_x, self.new_u, self.new_J, *self._held_in(),
                 *self._held_out(), threads=d.threads)

    def _start(self) -> Array:
        """The states [B, nx] that rollouts begin at."""
        return self.x0

    def _sweep(self, rows: Rows) -> None:
        self.backward(rows)

    def backward(self, rows: Rows, V: Array | None = None, V_x: Array | None = None, V_xx: Array | None = None,
                 V_p: Array | None = None) -> None:
        d = self.ddp
        each = STAGES[d.integrator] * d.substeps * d.intervals  # with first and second derivatives
        d.evaluations["backward"] += each * len(rows)
        by_p = [V_p] if self.data else []
        d.kernel("nocl_backward", rows, d.intervals, d._weights, d._lb, d._ub, self.h, *self.data, self.x, self.u,
                 self.mu, self.k, self.gain, self.slope, self.curve, self.positive, V, V_x, V_xx, *by_p,
                 *self._held_in(), threads=d.threads)

    def _held_in(self) -> list[Array | None]:
        """What a kernel takes of constraints that are held by multipliers."""
        return []

    def _held_out(self) -> list[Array]:
        """What a rollout tells of them."""
        return []

    def descend(self) -> None:
        while (rows := np.flatnonzero(self.state == RUNNING)).size:
            self.state[rows[self.iterations[rows] >= self.most[rows]]] = OUT_OF_ITERATIONS
            rows = rows[self.state[rows] == RUNNING]
            self.iterations[rows] += 1
            self._sweep(rows)
            good, bad = rows[self.positive[rows] > 0], rows[self.positive[rows] == 0]
            if bad.size:
                self._refuse(bad)
                self._damp(bad)
            small = -(self.slope[good] + self.curve[good]) <= self._little(good)
            if small.any():
                self._settle(good[small])
            self._line_search(good[~small])

    def _refuse(self, rows: Rows) -> None:
        """No step with this damping, about these trajectories."""
        self.refused[rows] = np.maximum(self.refused[rows], self.mu[rows])
        self.undamped[rows] |= self.mu[rows] == 0

    def _little(self, rows: Rows) -> Array:
        """A predicted decrease of J that counts as none."""
        return self.ddp.settings.tolerance * np.abs(self.J[rows]) + self.rounding

    def _settle(self, rows: Rows) -> None:
        """Problems that predict no decrease: done without damping, else tried again with less of it."""
        done = rows[self.mu[rows] == 0]
        self._last_step(done)
        self._at_minimum(done)
        damped = rows[self.mu[rows] > 0]
        if damped.size:
            self._relax(damped)
            self._at_saddle(damped[self.mu[damped] <= self.refused[damped]])

    def _at_minimum(self, rows: Rows) -> None:
        self.state[rows] = CONVERGED

    def _at_saddle(self, rows: Rows) -> None:
        """Where J is stationary, but no minimum."""
        self.state[rows] = NOT_CONVEX

    def _last_step(self, rows: Rows) -> None:
        """One more full Newton step where J does not rise: what is left of u's error is squared."""
        self.alpha[rows] = 1.0
        self.rollout(rows, self.x, self.u, self.gain)
        won = rows[self.new_J[rows] <= self.J[rows] + 4e-15 * np.abs(self.J[rows])]  # rounding decides nothing
        self._take(won)

    def _take(self, rows: Rows) -> None:
        self.x[rows], self.u[rows], self.J[rows] = self.new_x[rows], self.new_u[rows], self.new_J[rows]
        self.refused[rows], self.undamped[rows] = -1.0, False

    def _line_search(self, rows: Rows) -> None:
        """Halve each problem's step until J falls by a share of what was predicted; damp those that never do."""
        self.alpha[rows] = 1.0
        while rows.size:
            self.rollout(rows, self.x, self.u, self.gain)
            a = self.alpha[rows]
            predicted = a * self.slope[rows] + a * a * self.curve[rows]
            done = self.new_J[rows] - self.J[rows] <= 1e-3 * np.minimum(predicted, 0.0)  # False for NaN
            if done.any():
                won = rows[done]
                self._take(won)
                self._relax(won[self.alpha[won] > 0.2])
            rows = rows[~done]
            self.alpha[rows] /= 2
            stuck = self.alpha[rows] < self.ddp.settings.smallest_step
            if stuck.any():
                self._stuck(rows[stuck])
                rows = rows[~stuck]

    def _stuck(self, rows: Rows) -> None:
        """No step along what the sweep says lowers J."""
        self._damp(rows)

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
        known: dict[str, Any] = {"p": self.p, "V_p": np.zeros_like(self.p)} if self.ddp.posed.np else {}
        self._last_sweep(V, V_x, V_xx, known.get("V_p"))
        t = self.t0[:, None] + self.h[:, None] * np.arange(K + 1)
        message = self._messages(t)
        success = self.state == CONVERGED
        seconds = np.full(B, (time.perf_counter() - self.begin) / max(B, 1))
        clearance = measured.least(self.ddp.posed, self.x, t, self.p).min(axis=1, initial=np.inf)
        return Solution(t, self.x, self.u, self.gain, V, V_x, np.where(success, self._cost(), np.inf), success,
                        np.array(message, dtype=np.str_), seconds, self.iterations, V_xx, clearance=clearance,
                        **known)

    def _cost(self) -> Array:
        return self.J

    def promise(self) -> Array:
        """What plans that are not at their ends yet are compared by [B]."""
        return self.J

    def _last_sweep(self, *values: Array | None) -> None:
        """One more sweep about what was found, for its gains and V, V_x, V_xx, V_p."""
        self.mu[:] = 0
        self.backward(np.arange(len(self.x0)), *values)

    def _messages(self, t: Array) -> list[str]:
        """What came of each problem, in words; t [B, K+1]."""
        return [self._where_lost(row) if state == BLEW_UP and self.ddp.integrator == RADAU else self._words(int(state))
                for row, state in enumerate(self.state)]

    def _where_lost(self, row: int) -> str:
        """Of a starting guess that implicit steps cannot follow."""
        lost = np.flatnonzero(~np.isfinite(self.x[row]).all(axis=1))
        if not lost.size:
            return MESSAGES[BLEW_UP]
        return f"{MESSAGES[BLEW_UP]}: the implicit step did not converge at node {lost[0] - 1}; give more substeps"

    def _words(self, state: int) -> str:
        kinks = self.ddp.posed.not_smooth if state in (OUT_OF_ITERATIONS, NO_DESCENT, NOT_CONVEX) else ""
        return MESSAGES[state] + (f"; {kinks}" if kinks else "")


MESSAGES = ("running", "converged", "stopped at max_iterations", "no descent: the largest damping did not help",
            "the starting guess blows up: its cost is not finite",
            "stationary, but no minimum: the cost is not convex in the controls there", "a constraint is not held",
            "a constraint is violated by the initial state")
RUNNING, CONVERGED, OUT_OF_ITERATIONS, NO_DESCENT, BLEW_UP, NOT_CONVEX, NOT_HELD, OUTSIDE = range(8)
