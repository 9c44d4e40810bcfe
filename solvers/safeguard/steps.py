"""One step of a safeguard as a CasADi function: (x, plan) -> (u, next, status).

A plan is a column [2 + N nu]: how many of its controls are left, what it may cost, and N controls, the next one first;
after them LQR acts. Of zeros it is none. At each step two plans are rolled out for N held controls, the policy's, and
what is left of the last one. A plan is admissible where it holds all constraints on the way and ends in the terminal
set; it costs what the way does, and the terminal cost. The policy's is taken where it is admissible and costs at most
what the last one may, or does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from nocl.definition.ocp import OCP
from nocl.solvers.safeguard.motion import Motion
from nocl.solvers.safeguard.terminal import TerminalSet

TAKEN, KEPT, NONE = 0, 1, 2  # status: the policy's plan, the last plan, neither is admissible
HUGE = 1e30  # more is not finite, in single precision too


class Outcome(NamedTuple):
    """Of N held controls."""

    u: ca.MX  # [nu, N]
    first: ca.MX  # cost of the first one
    cost: ca.MX  # of all, and the terminal cost
    off: ca.MX  # the sum of what constraints and terminal set are missed by; <= 0: it is admissible


class Steps:
    """The function `step`, and what it is made of.

    margin : that the policy's plans hold constraints by, in scales, and may be used up by errors of the model
    between : that all plans do
    """

    def __init__(self, motion: Motion, policy: ca.Function, terminal: TerminalSet, steps: int, margin: float,
                 between: float) -> None:
        self.motion, self.policy, self.terminal, self.N = motion, policy, terminal, steps
        self.margin, self.between = margin, between

    @property
    def ocp(self) -> OCP:
        return self.motion.ocp

    @property
    def size(self) -> int:
        """Of a plan."""
        return 2 + self.N * self.ocp.system.nu

    def function(self) -> ca.Function:
        """step:(x [nx], plan [2 + N nu]) -> (u [nu], next [2 + N nu], status)."""
        s, N = self.ocp.system, self.N
        x, plan = ca.MX.sym("x", s.nx), ca.MX.sym("plan", self.size)
        left, budget, held = plan[0], plan[1], ca.reshape(plan[2:], s.nu, N)
        new = self._rolled(self._by_policy(), x)
        last = self._rolled(self._by_plan(), x, ca.vertcat(left > ca.DM(range(N)).T, held))
        good, kept = new.off <= 0, last.off <= 0
        cheaper = new.cost <= ca.fmax(budget, last.cost)
        nearer = ca.logic_and(ca.logic_not(kept), ca.if_else(new.off < HUGE, new.off, HUGE) < last.off)
        taken = ca.if_else(good, ca.logic_or(cheaper, ca.logic_not(kept)), nearer)
        u = ca.if_else(taken, new.u, last.u)
        may = ca.if_else(taken, new.cost - new.first, ca.fmax(budget, last.cost) - last.first)
        none = ca.logic_not(ca.logic_or(good, kept))
        more = ca.vertcat(ca.fmax(ca.if_else(taken, N, left) - 1, 0), ca.if_else(none, 0, may),
                          ca.vec(ca.horzcat(u[:, 1:], ca.MX.zeros(s.nu, 1))))
        status = ca.if_else(none, NONE, ca.if_else(taken, TAKEN, KEPT))
        return ca.Function("step", [x, plan], [u[:, 0], ca.densify(more), status], ["x", "plan"],
                           ["u", "next", "status"])

    def plan(self) -> ca.Function:
        """plan:(x [nx], held [N nu]) -> (plan, off): controls as a plan, and what it misses; <= 0: it is admissible."""
        s, N = self.ocp.system, self.N
        x, held = ca.MX.sym("x", s.nx), ca.MX.sym("held", N * s.nu)
        of = self._rolled(self._by_plan(self.margin), x, ca.vertcat(ca.DM.ones(1, N), ca.reshape(held, s.nu, N)))
        return ca.Function("plan", [x, held], [ca.vertcat(N, of.cost, held), of.off], ["x", "held"], ["plan", "off"])

    def _by_policy(self) -> ca.Function:
        """(z, _) -> (z after it, u), z = (x, cost, off)."""
        z, none = self._state, ca.MX.sym("none", 0, 1)
        u = self._clipped(self.policy(z[:-2], 0.0))
        return ca.Function("by_policy", [z, none], [self._moved(z, u, self.margin), u])

    def _by_plan(self, margin: float = 0.0) -> ca.Function:
        """(z, (whether to hold, u)) -> (z after it, u)."""
        z, given = self._state, ca.MX.sym("given", 1 + self.ocp.system.nu)
        u = ca.if_else(given[0], given[1:], self.terminal.control(z[:-2]))
        return ca.Function("by_plan", [z, given], [self._moved(z, u, margin), u])

    @property
    def _state(self) -> ca.MX:
        return ca.MX.sym("z", self.ocp.system.nx + 2)

    def _moved(self, z: ca.MX, u: ca.MX, margin: float) -> ca.MX:
        """z after a held control."""
        end, cost, held, _ = self.motion.function(z[:-2], u)
        less = margin + self.between - held
        off = ca.sum1(ca.if_else(less <= 0, 0, less)) if held.numel() else 0  # NaN stays NaN
        return ca.vertcat(end, z[-2] + cost, z[-1] + off)

    def _rolled(self, one: ca.Function, x: ca.MX, given: Any = None) -> Outcome:
        z, u = one.mapaccum("rolled", self.N)(ca.vertcat(x, 0, 0), ca.MX.zeros(0, self.N) if given is None else given)
        at_end = self.terminal.value(z[:-2, -1])
        over = ca.if_else(at_end <= self.terminal.most, 0, at_end / self.terminal.most - 1)
        cost, off = z[-2, -1] + at_end, z[-1, -1] + over
        return Outcome(u, z[-2, 0], cost, ca.if_else(ca.fabs(cost) < HUGE, off, HUGE))

    def _clipped(self, u: Any) -> Any:
        """u in U; NaN stays NaN, where fmin and fmax would hide it."""
        s = self.ocp.system
        return ca.if_else(u < s.lbu, ca.DM(s.lbu), ca.if_else(u > s.ubu, ca.DM(s.ubu), u))
