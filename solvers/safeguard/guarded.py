"""A policy under a safeguard: it acts where its plan is known to hold the constraints and to arrive.

Hose, Köhler, Zeilinger, Trimpe (2025), "Approximate nonlinear model predictive control with
safety-augmented neural networks", IEEE Transactions on Control Systems Technology (arXiv 2304.09575); with what happens
between samples, and a terminal set of LQR.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.exports import c_code
from nocl.judge.laws import check_made_for, policy_function
from nocl.solvers.lqr import all_images
from nocl.solvers.nmpc.solver import NMPC
from nocl.solvers.safeguard.motion import Motion
from nocl.solvers.safeguard.steps import KEPT, NONE, TAKEN, Steps
from nocl.solvers.safeguard.terminal import TerminalSet, check_goal, terminal_set
from nocl.support import checks
from nocl.support.checks import Array

LATE = 1e-6  # of dt, by which a call may be off the next sample
INNER = 0.5  # of the terminal set, where plans of the solver end, and times the margin, by which they hold constraints
Rows = NDArray[np.int64]


class Safeguard:
    """u(x, t) from a policy: at each sample its plan of N held controls is taken if it holds U, the constraints and the
    terminal set, and costs no more than the last plan may; else the last plan goes on, ended by LQR.

    While a plan is there (status TAKEN or KEPT) all of this goes on holding, and what plans may cost falls by what was
    paid, for the f that plans are made with, the exact one to the accuracy of its Runge-Kutta steps. It is asked at
    multiples of dt, one object for one run: asked again at the last time, at the same states, it answers the same; any
    other time that is not later, or another number of states, begins anew. Where neither plan is
    admissible (NONE: there is no plan yet, or the state was pushed), NMPC is asked for one, once; where it has none
    either, the plan that misses less acts, and nothing is promised.

    Parameters
    ----------
    ocp : OCP with horizon=nocl.INFINITE, with any constraints but equations
    policy : casadi.Function (x, t) -> u, or an object with `to_casadi()`; asked at t = 0
    dt : time that a control is held for
    steps : N, controls of a plan
    margin : share of their scales by which new plans hold constraints: what errors of the model may use up

    `terminal` is the terminal set and says whether it is proven; `status` [B] that of the last call; `fallbacks` and
    `lost` [B] count KEPT and NONE since the run began.
    """

    def __init__(self, ocp: OCP, policy: Any, *, dt: float, steps: int = 40, margin: float = 1e-3) -> None:
        _check(ocp, policy)
        self.control_dt = checks.number(dt, "dt", "safeguarded", positive=True)
        N = checks.whole(steps, "steps", "safeguarded", 1)
        law = policy_function(ocp, policy)
        if law is None:
            raise ValueError(f"safeguarded: the policy is a {type(policy).__name__}; expected a casadi.Function "
                             "(x, t) -> u, or an object with to_casadi(): its plans are rolled out")
        self.ocp, self.margin = ocp, checks.number(margin, "margin", "safeguarded")
        motion = Motion.of(ocp, self.control_dt)
        self.room = self.margin / INNER + motion.between  # of NMPC's plans to the constraints
        check_goal(ocp, self.room)
        self.terminal: TerminalSet = terminal_set(motion, self.margin + motion.between)
        self.steps = Steps(motion, law, self.terminal, N, self.margin, motion.between)
        self.step = self.steps.function()
        self.reset(0)

    def reset(self, B: int) -> None:
        """The next call begins anew, without a plan, with B states."""
        self.plan, self.status = np.zeros((B, self.steps.size)), np.full(B, TAKEN)
        self.fallbacks, self.lost, self.time = np.zeros(B), np.zeros(B), -np.inf
        self.asked = self.answer = np.zeros((0, 0))

    def __call__(self, x: ArrayLike, t: float) -> Array:
        """u [nu] or [B, nu] at states x [nx] or [B, nx] and the time of a sample."""
        rows, single = checks.states(x, self.ocp.system.nx, self.ocp.system.name, "x")
        if t != self.time or not np.array_equal(rows, self.asked):
            self._advance(rows, float(t))
        return self.answer[0] if single else self.answer

    def _advance(self, rows: Array, t: float) -> None:
        """The plans and the answer at the next sample."""
        self._follow(len(rows), t)
        before = self.status
        u, plan, self.status = self._stepped(rows, self.plan)
        lost = np.flatnonzero((self.status == NONE) & (before != NONE))
        if lost.size:
            given = self.plan.copy()
            given[lost] = self._solved(rows[lost], given[lost])
            u, plan, self.status = self._stepped(rows, given)
        self.plan, self.time, self.asked, self.answer = plan, t, rows.copy(), u
        self.fallbacks += self.status == KEPT
        self.lost += self.status == NONE

    def step_to_casadi(self) -> ca.Function:
        """step:(x [nx], plan [2 + N nu]) -> (u [nu], next, status); the first plan is of zeros, the next call's `next`.

        status 0: the policy's plan was taken, 1: the last plan, 2: neither is admissible, and nothing is promised.
        """
        return self.step

    def to_c(self, folder: str | os.PathLike[str]) -> Path:
        """C99 of step_to_casadi() in `folder`, as SYSTEM_safeguard: no heap, no globals, the plan is the caller's.

        In float64 alone: by single precision plans would be rolled out to less than what decides.
        """
        s, N = self.ocp.system, self.steps.N
        cost = usual_sizes(self.ocp).cost
        bounds = {"x": (s.lbx, s.ubx), "u": (s.lbu, s.ubu), "status": (0, 2),
                  "plan": (np.r_[0.0, 0.0, np.tile(s.lbu, N)], np.r_[N, cost, np.tile(s.ubu, N)])}
        held = [f"{s.unit(n)}, {k} steps ahead" for k in range(N) for n in s.control_names]
        labels = {"x": [s.unit(n) for n in s.state_names], "u": [s.unit(n) for n in s.control_names],
                  "plan": ["controls left", "what it may cost", *held],
                  "status": ["0: the policy's plan, 1: the last plan, 2: neither is admissible"]}
        return c_code.to_c(self.step, checks.folder(folder, "folder", "to_c"), f"{s.name}_safeguard", bounds=bounds,
                           labels=labels, note=f"{self!r}\nThe first plan is of zeros, that of the next "
                           "call is `next` of this one.")

    def __repr__(self) -> str:
        how = "proven" if self.terminal.proven else f"tried: at most {100 * self.terminal.share:.2g} % of it is not"
        return (f"safeguard on {self.ocp.system.name!r}: {self.steps.N} controls of {self.control_dt:g}, terminal set "
                f"V <= {self.terminal.level:.3g} ({how})")

    def _follow(self, B: int, t: float) -> None:
        """Begin anew, or go on; ValueError for a time that is no next sample."""
        if t <= self.time or len(self.plan) != B or self.time == -np.inf:
            self.reset(B)
        elif abs(t - self.time - self.control_dt) > LATE * self.control_dt:
            raise ValueError(f"the safeguard is asked at t = {t:.6g} after {self.time:.6g}, and holds controls for "
                             f"{self.control_dt:g}; expected the next sample: leave hold out of "
                             "simulate")

    def _stepped(self, x: Array, plan: Array) -> tuple[Array, Array, Rows]:
        u, following, status = (part.full().T for part in self.step(x.T, plan.T))
        return u, following, status[:, 0].astype(np.int64)

    def _solved(self, x: Array, plan: Array) -> Array:
        """The solver's plans from states [n, nx], where they are admissible; else those given."""
        with warnings.catch_warnings():  # what it finds is judged by the roll-out
            warnings.simplefilter("ignore")
            found = self._solver.solve(x, workers=1, progress=False)
        held = np.nan_to_num(np.clip(found.u, self.ocp.system.lbu, self.ocp.system.ubu)).reshape(len(x), -1)
        made, off = (part.full().T for part in self._made(x.T, held.T))
        return np.where(off <= 0, made, plan)

    @cached_property
    def _made(self) -> ca.Function:
        return self.steps.plan()

    @cached_property
    def _solver(self) -> NMPC:
        """Of plans that end inside of the terminal set, with room to the constraints."""
        P, N = self.terminal.P, self.steps.N
        V = all_images(self.ocp, P)
        end = {"terminal set": (None, V, INNER * self.terminal.level)}
        with warnings.catch_warnings():  # of its kinks the problem itself has warned
            warnings.simplefilter("ignore")
            posed = replace(self.ocp.tightened(self.room), horizon=N * self.control_dt, terminal=V,
                            terminal_constraints=end, scales={**self.ocp.scales, "terminal set": self.terminal.level})
        return NMPC(posed, N, substeps=self.steps.motion.substeps, integrator="rk4", between=bool(self.ocp.held))


def _check(ocp: OCP, policy: Any) -> None:
    """ValueError where there is nothing that a safeguard could promise."""
    checks.problem(ocp, "safeguarded", infinite=True)
    check_made_for(ocp, policy, "the policy")
    name = ocp.system.name
    if not ocp.is_infinite:
        raise ValueError(f"safeguarded: the horizon of the problem on {name!r} is {ocp.horizon!r}; expected "
                         "nocl.INFINITE: plans end in a set that LQR stays in for ever, and a law u(x) leads there")
    ocp.refuse_parameters("safeguarded")
    equations = [one.name for one in ocp.held if one.equal]
    if equations:
        raise ValueError(f"safeguarded: the problem on {name!r} has the equations {', '.join(equations)}; expected "
                         f"inequalities, which have an inside: leave them out, ocp.without("
                         f"{', '.join(map(repr, equations))})")
