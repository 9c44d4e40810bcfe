"""NMPC as feedback: solved again at each call from the last plan, shifted; failures flagged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from nocl.data import Solution, Trajectory
from nocl.definition import discrete
from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array

LAST = 0.95  # largest share of what is left of the horizon that a closed loop's first interval may take
NEAR_END = 1e-6  # of the horizon: a call this late is taken as one just before the end


class Planner(Protocol):
    """What a loop solves by: NMPC."""

    @property
    def ocp(self) -> OCP: ...
    @property
    def intervals(self) -> int: ...
    @property
    def window(self) -> float: ...

    def solve(self, x0: ArrayLike, guess: Any = None, *, p: Any = None, nodes: ArrayLike | None = None,
              workers: int | str = "auto", progress: bool | None = None) -> Solution: ...


class Loop:
    """u(x, t[, p]) by solving again from the measured x, warm-started from the last plan.

    Shrinking (default): the plan reaches from t to the OCP's horizon T, or to t + `horizon` where NMPC has a shorter
    one, at most to T. Receding: it is as long at each t as at t = 0, and charges G, or the terminal cost, at its own
    end. The first interval of a plan is as long as the control will be held, `hold` times in T; the rest of it is cut
    into N - 1 equal ones. A call at an earlier time than the last, at the same time from other states, or with another
    number of states starts afresh from all starts. In discrete time a plan has the samples from t on, and a control is
    held for one.

    `stats` has an entry a call: t; and [B] success, seconds, iterations, cost, message, and source of the control:
    "solved", or where the solve failed (after one more try, from all starts) "last plan", held on, or "u*" where there
    is none yet. A failure is never silent: success is False there, and `failures` counts them.
    """

    def __init__(self, nmpc: Planner, hold: int | None = None, receding: bool = False) -> None:
        if hold is not None:
            checks.whole(hold, "hold, how many controls the horizon has,", "NMPC.controller", 1)
        if nmpc.ocp.system.is_discrete and hold not in (None, nmpc.ocp.steps):
            raise ValueError(f"NMPC.controller: hold is {hold}, and {nmpc.ocp.system.name!r} is a system in discrete "
                             f"time; expected {nmpc.ocp.steps}, a control for each step: leave it out")
        receding = checks.flag(receding, "receding", "NMPC.controller")
        if receding and nmpc.ocp.uses_time:
            raise ValueError("a receding window begins at t = 0 anew at each call, but the problem holds the time t; "
                             "expected one without, or receding=False")
        self.nmpc, self.hold, self.receding = nmpc, hold or nmpc.ocp.steps or nmpc.intervals, receding
        self.plan: Solution | None = None
        self.begin = 0.0  # the time of the plan's first node
        self.asked: Array | None = None  # the states of the last call
        self.p = np.zeros((0, nmpc.ocp.np))  # ... and their parameters [B, np]
        self.stats: list[dict[str, Any]] = []

    @property
    def failures(self) -> int:
        """Solves that failed, over all calls and states."""
        return sum(int((~step["success"]).sum()) for step in self.stats)

    @property
    def ocp(self) -> OCP:
        return self.nmpc.ocp

    def __call__(self, x: ArrayLike, t: float = 0.0, p: Any = None) -> Array:
        """u [nu] or [B, nu] at time t; p as NMPC.solve takes it, where the problem has parameters."""
        s = self.nmpc.ocp.system
        rows, single = checks.states(x, s.nx, s.name, "x")
        self.p = self.nmpc.ocp.parameters_of(p, len(rows), "NMPC as feedback")
        nodes = self.nodes(float(t))
        if self._afresh(rows, float(t)):
            self.stats, self.plan = [], None
        guess = self._guess(rows, nodes, float(t))
        self.plan = self._solve(rows, guess, nodes, float(t))
        self.begin, self.asked = float(t), rows.copy()
        return self.plan.u[0, 0] if single else self.plan.u[:, 0]

    def _afresh(self, x: Array, t: float) -> bool:
        if self.plan is None or self.asked is None or self.asked.shape != x.shape or t < self.begin:
            return True
        return t == self.begin and not np.array_equal(x, self.asked)

    def nodes(self, t: float) -> Array:
        """t, t + the time that a control is held, ..., the end of the plan [N+1]; from 0 where receding."""
        T, N = self.nmpc.ocp.horizon, self.nmpc.intervals
        if self.nmpc.ocp.system.is_discrete:
            return self._samples(t)
        t = 0.0 if self.receding else min(t, T * (1 - NEAR_END))  # some ask at the end, too
        end = min(t + self.nmpc.window, T)
        first = min(T / self.hold, LAST * (end - t))
        return np.r_[t, np.linspace(t + first, end, N)]

    def _samples(self, t: float) -> Array:
        """The samples from t to the end of the plan; from 0 where receding, and the last step's at the end."""
        system, window = self.nmpc.ocp.system, self.nmpc.window
        steps, n = (discrete.steps_in(system, time, "horizon", "NMPC") for time in (self.nmpc.ocp.horizon, window))
        first = 0 if self.receding else min(discrete.steps_in(system, t, "t", "NMPC as feedback"), steps - 1)
        return discrete.samples(system, first, min(first + n, steps))

    def _guess(self, x: Array, nodes: Array, t: float) -> tuple[Array, Array]:
        """The last plan, shifted; else x held under u*."""
        if self.plan is None:
            return (np.repeat(x[:, None], len(nodes), axis=1),
                    np.repeat(self.nmpc.ocp.goals(self.p)[1][:, None], len(nodes) - 1, axis=1))
        return shifted(self.plan, x, nodes + (t - self.begin if self.receding else 0.0))

    def _solve(self, x: Array, guess: tuple[Array, Array], nodes: Array, t: float) -> Solution:
        """The new plan: a row whose solve fails twice holds the guess instead."""
        warm = self.plan is not None
        plan = Trajectory(nodes, *guess) if warm else None
        has = bool(self.nmpc.ocp.np)
        solution = self.nmpc.solve(x, plan, p=self.p if has else None, nodes=nodes, workers=1, progress=False)
        failed = np.flatnonzero(~np.asarray(solution.success, dtype=bool))
        if warm and failed.size:
            again = self.nmpc.solve(x[failed], p=self.p[failed] if has else None, nodes=nodes, workers=1,
                                    progress=False)
            solution.put(failed, replace(again, seconds=again.seconds + solution.seconds[failed],
                                         iterations=again.iterations + solution.iterations[failed]))
        success = np.asarray(solution.success)
        source = np.where(success, "solved", "last plan" if warm else "u*")
        self.stats.append({"t": t, "success": success, "seconds": solution.seconds, "cost": solution.cost,
                           "iterations": solution.iterations, "message": solution.message, "source": source})
        ok = success[:, None, None]
        return replace(solution, x=np.where(ok, solution.x, guess[0]), u=np.where(ok, solution.u, guess[1]))


def shifted(last: Solution, x: Array, nodes: Array) -> tuple[Array, Array]:
    """The last plan on new nodes, held on past its end, its states moved to the measured x at the start."""
    t, N = last.t[0], last.u.shape[1]  # all of its rows have the same nodes
    held = np.clip(np.searchsorted(t, (nodes[:-1] + nodes[1:]) / 2, side="right") - 1, 0, N - 1)
    states = np.stack([np.stack([np.interp(nodes, t, column) for column in path.T], axis=1) for path in last.x])
    return states + np.linspace(1, 0, len(nodes))[None, :, None] * (x - states[:, 0])[:, None], last.u[:, held]
