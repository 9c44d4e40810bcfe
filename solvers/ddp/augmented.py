"""Constraints that hold: the augmented Lagrangian of a batch, descended by the same sweeps and rollouts.

A row c >= 0 or c = 0 of a plan, in units of its scale, adds psi(c, y, rho) to the cost, which with the multiplier
a = y - rho c (not below 0 for an inequality) is (a^2 - y^2) / (2 rho). Each problem has its own y, rho and outer round:
at a minimum of the merit J + sum psi, y becomes a, and rho grows where the violation did not fall enough. What makes it
exact is a full Newton step at each such minimum: it takes most of the violation, so that rho stays small.

Sources: Hestenes (1969) and Powell (1969), the method of multipliers; Bertsekas, Constrained Optimization and Lagrange
Multiplier Methods (1982), ch. 2 and 3, the inequalities' multipliers and the update rules.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from nocl.definition.constraints import TOLERANCE
from nocl.definition.scales import usual_sizes
from nocl.solvers.between import CUTS
from nocl.solvers.ddp.batch import Rows
from nocl.solvers.ddp.work import BLEW_UP, CONVERGED, NOT_CONVEX, NOT_HELD, OUTSIDE, RUNNING, Work
from nocl.support.checks import Array

HELD = 1e-9  # of a scale: the largest violation at a node
MULTIPLIER = 1e-7  # of the cost for a scale: what multipliers may be off by
TOLD = 1e-6  # of a scale: what is less is not worth a message
TOLERATED = TOLERANCE  # of a scale: violated by more by the initial state itself, a problem has no answer
ROUNDING = 1e-13  # of the usual cost
SLACK = 0.1  # of sum rho e^2 / 2, what a round may leave of the merit: 1 is too much
ENOUGH = 0.25  # of the last round's violation: if more is left, rho grows
LEAST, MOST, LARGEST = 1.0, 10.0, 1e7  # usual costs for a violation of one scale: rho at first, and ever
SHARE = 10.0  # of the guess's cost, what rho makes of its violations at first
RHO_GROWTH = 4.0
ROUNDS = 5  # times max_iterations are the most that all rounds together take
STALLS = 2  # rounds at the largest rho in which the violation does not halve: it cannot be held
PRICE = 100.0  # usual costs for a violation of one scale over the whole horizon, or at its end, if they are elastic
BENT = 0.1  # damping, up to which second derivatives that are not convex are kept: Mayer problems have no others
STIFF = 1e7  # usual costs, the weight of active rows in the sweep for gains
KEPT = ("x", "u", "k", "gain", "J", "c", "parts", "y", "penalty", "state", "mu")  # of a plan


@dataclass
class Augmented(Work):
    """A batch with constraints while it descends."""

    y: Array = field(init=False)  # [B, rows of a plan], multipliers
    margin: Array | None = None  # [B, rows of a plan], by which each is held further inside
    kept: ClassVar[tuple[str, ...]] = KEPT
    first: ClassVar[tuple[float, float]] = (LEAST, MOST)  # usual costs: rho at first

    def __post_init__(self) -> None:
        d, B = self.ddp, len(self.x0)
        self.unit = usual_sizes(d.posed).cost
        self.y, self.c, self.new_c = (np.zeros((B, d.rows.count(d.intervals))) for _ in range(3))
        self.penalty = np.zeros((B, 5))  # rho, largest multiplier, weight in a sweep for gains, largest one at the end,
        self.penalty[:, 0], self.penalty[:, 4] = self.unit, 1.0  # and whether a sweep has second derivatives
        share = (d.posed.horizon - self.t0) / d.posed.horizon
        elastic = d.constraints == "elastic"
        self.penalty[:, 1] = PRICE * self.unit * share / d.intervals if elastic else np.inf
        self.penalty[:, 3] = PRICE * self.unit if elastic else np.inf
        self.margin = None if d.margin is None else self.with_margin(np.zeros_like(self.y))
        self.parts, self.new_parts = np.zeros((B, 3)), np.zeros((B, 3))  # cost, sum rho e^2 / 2, max |e|
        self.last, self.stalls = np.full(B, np.inf), np.zeros(B, dtype=np.int64)
        self.bent = np.ones(B, dtype=bool)  # where sweeps have second derivatives of f and of the rows
        self.cut = np.zeros(B, dtype=bool)  # where constraints are left between nodes, which were to be held there
        super().__post_init__()
        self.most *= ROUNDS
        self._first_penalty()
        if d.constraints == "hard":
            outside = self._violations()[1].max(axis=1, initial=0.0) > TOLERATED
            self.state[outside & (self.state == RUNNING)] = OUTSIDE

    def _first_penalty(self) -> None:
        """rho so that the guess's violations weigh as much as its cost, in bounds."""
        least, most = (size * self.unit for size in self.first)
        cost, violation = np.abs(self.parts[:, 0]), self.parts[:, 1] / self.penalty[:, 0]
        with np.errstate(all="ignore"):
            rho = np.clip(SHARE * cost / violation, least, most)
        rho[~np.isfinite(rho)] = most  # nothing is violated
        growth = rho / self.penalty[:, 0]
        self.J[:] = self.parts[:, 0] + growth * (self.J - self.parts[:, 0])  # with y = 0 psi is proportional to rho
        self.penalty[:, 0], self.parts[:, 1] = rho, growth * self.parts[:, 1]

    def with_margin(self, margin: Array) -> Array:
        """Margins [B, rows of a plan], and on top of them the solver's own; what x0 alone decides has none."""
        d = self.ddp
        if d.margin is None:
            return margin
        n = len(d.rows.stage)
        own = np.r_[np.tile(d.margin[:n], d.intervals), d.margin[n:]]
        own[:n][d.rows.of_x(d.posed.functions.arguments["u"])] = 0.0
        return margin + own

    def exchange(self, margin: Array) -> None:
        """Solves what converged again, held further inside by margins [B, rows]; what cannot be, stays as it was."""
        rows = np.flatnonzero(self.state == CONVERGED)
        kept = {name: getattr(self, name).copy() for name in self.kept}
        spent, before = self.iterations.copy(), self.margin
        self.margin, self.iterations[:], self.alpha[:] = margin, 0, 0.0
        self.rollout(rows, self.x, self.u, self.gain)  # the same plan, its merit with the margins
        self._take(rows)
        self.state[rows], self.last[rows], self.stalls[rows], self.mu[rows] = RUNNING, np.inf, 0, 0.0
        self.descend()
        self.iterations += spent
        back = rows[self.state[rows] != CONVERGED]
        for name, value in kept.items():
            getattr(self, name)[back] = value[back]
        margin[back] = 0.0 if before is None else before[back]

    def _sweep(self, rows: Rows) -> None:
        """Damped, by Gauss-Newton where costs about a goal weigh each control. Else with second derivatives of f and of
        the rows, damped until they are convex; where that takes more than BENT without them, Gauss-Newton, until they
        are with BENT about a trajectory to come.
        """
        if self.ddp.weighed:
            self._backward(rows, (self.mu[rows] == 0).astype(float))
            return
        damping = self.mu.copy()
        self.bent[rows] |= self.mu[rows] == 0
        again = rows[~self.bent[rows] & (self.refused[rows] < 0)]
        self.bent[again], self.mu[again] = True, BENT
        self._backward(rows[self.bent[rows]], 1.0)
        lost = rows[self.bent[rows] & (self.positive[rows] == 0) & (self.mu[rows] >= BENT)]
        self.bent[lost] = False
        self.mu[lost] = np.where(np.isin(lost, again), damping[lost], self.ddp.settings.damping)
        self._backward(rows[~self.bent[rows]], 0.0)

    def _backward(self, rows: Rows, bend: float | Array) -> None:
        self.penalty[rows, 4] = bend
        self.backward(rows)

    def _held_in(self) -> list[Array | None]:
        return [self.y, self.margin, self.penalty]

    def _held_out(self) -> list[Array]:
        return [self.new_c, self.new_parts]

    def _take(self, rows: Rows) -> None:
        super()._take(rows)
        self.c[rows], self.parts[rows] = self.new_c[rows], self.new_parts[rows]

    def _little(self, rows: Rows) -> Array:
        d = self.ddp
        return d.settings.tolerance * np.abs(self.J[rows]) + ROUNDING * self.unit + SLACK * self.parts[rows, 1]

    def _held(self, rows: Rows) -> NDArray[np.bool_]:
        """Where e is small, and with it rho e, which is what multipliers and so costates are off by; or falls no more.
        """
        worst, fine = self.parts[rows, 2], MULTIPLIER * np.abs(self.parts[rows, 0]) / self.penalty[rows, 0]
        return (worst <= HELD) & ((worst <= fine) | (worst > ENOUGH * self.last[rows]))

    def _at_minimum(self, rows: Rows) -> None:
        held = self._held(rows)
        self.state[rows[held]] = CONVERGED
        self._next_round(rows[~held], self.parts[rows[~held], 2] > ENOUGH * self.last[rows[~held]])

    def _stuck(self, rows: Rows) -> None:
        """If more damping finds nothing to gain either, it is this round's minimum: rounding or a kink hides more."""
        self._refuse(rows)
        super()._stuck(rows)

    def _at_saddle(self, rows: Rows) -> None:
        """Held, it is one of the problem; else a larger rho may bend the merit upwards. Whether it is none is for a
        sweep without damping to say, which has all second derivatives."""
        said = self.undamped[rows]
        self.refused[rows[~said]], self.mu[rows[~said]] = -1.0, 0.0
        rows = rows[said]
        done = self._held(rows) | (self.penalty[rows, 0] >= LARGEST * self.unit)
        self.state[rows[done]] = NOT_CONVEX
        rows = rows[~done]
        self.refused[rows], self.mu[rows] = -1.0, 0.0
        self._next_round(rows, np.ones(len(rows), dtype=bool))

    def _next_round(self, rows: Rows, grows: NDArray[np.bool_]) -> None:
        """y becomes a, and rho grows where it should; gives up what cannot be held."""
        d, worst, rho, most = self.ddp, self.parts[rows, 2], self.penalty[rows, 0], LARGEST * self.unit
        self.stalls[rows] += (rho >= most) & (worst > 0.5 * self.last[rows])
        self.state[rows[self.stalls[rows] >= STALLS]] = NOT_HELD
        self.last[rows] = worst
        factor = np.ones(len(self.x0))
        factor[rows] = np.where(grows, np.minimum(RHO_GROWTH, most / rho), 1.0)
        d.kernel("nocl_multipliers", rows, d.intervals, self.margin, self.c, factor, self.y, self.penalty, self.J,
                 self.parts, threads=d.threads)

    def _cost(self) -> Array:
        """J; where constraints are elastic, with the price of what is left."""
        return self.J if self.ddp.constraints == "elastic" else self.parts[:, 0]

    def promise(self) -> Array:
        """The cost, and what is violated by one price for all: each problem has a rho of its own."""
        return self.parts[:, 0] + MOST * self.unit * self.parts[:, 1] / self.penalty[:, 0]

    def _last_sweep(self, *values: Array | None) -> None:
        """Active rows are stiff in it, so that gains keep to them: V_x is the same, V_xx and gains are not."""
        self.mu[:], self.penalty[:, 4] = 0, 1.0
        self.penalty[:, 2] = np.where(self.state == CONVERGED, STIFF * self.unit, 0.0)
        every = np.arange(len(self.x0))
        self.backward(every, *values)
        again = every[(self.penalty[:, 2] > 0) & (self.positive == 0)]
        self.penalty[:, 2] = 0.0
        self.backward(again, *values)

    def _messages(self, t: Array) -> list[str]:
        message = super()._messages(t)
        (over, given), words = self._violations(), self.ddp.posed.at_p
        for i in np.flatnonzero(self.state == OUTSIDE):
            name, where = self._worst(given[i])
            message[i] = f"infeasible: the initial state itself violates {name!r}{words(self.p[i])}, {where}: move it"
        told = (over.max(axis=1, initial=0.0) > TOLD) & (self.state != OUTSIDE) & (self.state != BLEW_UP)
        for i in np.flatnonzero(told):
            name, where = self._worst(over[i])
            if self.state[i] == NOT_HELD:
                message[i] = f"infeasible: no plan holds {name!r} from here{words(self.p[i])}, {where}"
            else:
                message[i] += f"; {name!r} is left, {where}"
        for i in np.flatnonzero(self.cut):
            message[i] += CUTS
        return message

    def _violations(self) -> tuple[Array, Array]:
        """By how much of its scale each row is violated [B, rows of a plan]; apart those that x0 alone decides."""
        rows, K = self.ddp.rows, self.ddp.intervals
        equal = np.r_[np.tile(rows.stage.equal, K), rows.end.equal]
        over = np.nan_to_num(np.where(equal, np.abs(self.c), np.maximum(-self.c, 0.0)))
        fixed = rows.of_x(self.ddp.posed.functions.arguments["u"])
        given = np.zeros_like(over)
        given[:, :len(fixed)][:, fixed] = over[:, :len(fixed)][:, fixed]
        return over - given, given

    def _worst(self, over: Array) -> tuple[str, str]:
        """The name of the row that a plan violates most, and in words where and by how much."""
        name, node, scale = self.ddp.rows.names(int(over.argmax()), self.ddp.intervals)
        return name, f"worst at node {node} by {over.max() * scale:.3g}"
