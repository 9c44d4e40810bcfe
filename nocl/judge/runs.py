"""Runs under CVODES on one problem and plant, and what is told of them. B is the batch, K the intervals."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition import measured
from nocl.definition.ocp import OCP
from nocl.definition.scales import units
from nocl.definition.smoothness import kinks
from nocl.support import interrupt
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

MULTISTEP = ("adams", "bdf")  # the second, for stiff loops, where the first gives up; same tolerances
BETWEEN = 8  # times in an interval that constraints are judged at
AT_BOUND = 1e-9  # of the width of U: closer than this counts as saturated
Ask = Callable[[Array, float, int], Array]  # (x [B, nx], t, interval) -> u [B, nu]


@dataclass(frozen=True, eq=False)
class Simulation:
    """B closed or open loops from t0 to the horizon; one that fails has success False and says why.

    A run fails that does not get to the horizon (`reached` False, the cost infinite), or that violates a constraint by
    more than the tolerance: what it cost is told, and counts in no comparison.
    """

    t: Array  # [K+1] nodes; [B, K+1], each run's own, where the horizon is free
    x: Array  # [B, K+1, nx], NaN after a failure; a kick at a node is included
    u: Array  # [B, K+1, nu], clipped to U; a held control stands for [t_k, t_{k+1}), the last one twice
    cost: Array  # [B], running + terminal, inf where the horizon was not reached
    running_cost: Array  # [B], integral of L, exact (no penalty)
    terminal_cost: Array  # [B], G(x(T))
    terminal_error: Array  # [B], max_i |x_i(T) - x*_i| as a share of half the width of X_i: states have units of
    # their own; x* is the nearest image of the goal (OCP.from_goal); NaN without a goal
    control_magnitude: Array  # [B], mean of ||u||_2 over time
    saturation: Array  # [B], share of time with a control at a bound
    clearance: Array  # [B], min of all constraints, at and between nodes, and at the end, in units of their scales; of
    # a problem with path constraints alone in their own units; inf if there are none
    violation: Array  # [B], the largest of any, as a share of that constraint's own scale; 0: none
    success: NDArray[np.bool_]  # [B], whether it reached the horizon with all constraints held
    message: Sequence[str]  # [B], "" or what failed, at which time and state; or what is violated, and by how much
    reached: NDArray[np.bool_]  # [B], whether it reached the horizon
    worst: NDArray[np.int64]  # [B], which row of `measured.shares` is violated most; -1: none is
    fallbacks: Array  # [B], at how many samples a safeguard went on with its last plan; NaN of other controllers
    lost: Array  # [B], at how many it had none that is admissible; NaN of other controllers

    @property
    def times(self) -> Array:
        """[B, K+1], the nodes of each run."""
        return np.broadcast_to(self.t, self.x.shape[:2])


class Judge:
    """CVODES on one problem and plant; z = [x, integral of L]. p [B, np] are the parameters of each row."""

    def __init__(self, ocp: OCP, f: ca.Function, p: Array, rtol: float, atol: float, tolerance: float) -> None:
        self.ocp, self.f, self.p, self.tolerance = ocp, f, p, tolerance
        self.options = {"reltol": rtol, "abstol": atol, "quad_err_con": True, "disable_internal_warnings": True,
                        "show_eval_warnings": False, "max_num_steps": 20000}

    def of(self, row: int) -> Judge:
        """The judge of one run alone."""
        one = copy.copy(self)
        one.p = self.p[row:row + 1]
        return one

    @cached_property
    def jumps(self) -> str:
        """Where f jumps in X x U, in words; "" where it does not, or is no SX."""
        at, box = self.ocp.functions.on(self.f).stage, self.ocp.stage_box
        if not isinstance(at.x, ca.SX):
            return ""
        found = [kink for row in ca.vertsplit(at.xdot) for kink in kinks(row, ca.vertcat(*at.inputs), *box)]
        return ", ".join(dict.fromkeys(f"{kink.where} = 0" for kink in found if kink.what == "jump"))

    def blow_up(self, t: float, x: Array, until: float, what: str = "the state blows up") -> str:
        """Why CVODES did not get from x at t to `until`: beside a jump of f a state that stays in X did not blow up."""
        s = self.ocp.system
        if self.jumps and (np.abs(x - (s.lbx + s.ubx) / 2) <= s.ubx - s.lbx).all():
            what = f"the integrator gave up, chattering where f jumps ({self.jumps}; try tanh(e / width) for sign(e)),"
        return failure(what, t, x, until)

    def integrator(self, dae: dict[str, Any], grid: Array, method: str) -> ca.Function:
        """From 0 to the times in `grid`, in steps that are no longer than theirs: a policy that jumps, and jumps back,
        would be stepped over."""
        options: dict[str, Any] = {**self.options, "linear_multistep_method": method,
                                   "max_step_size": float(np.diff(grid, prepend=0.0).max())}
        return ca.integrator("judge", "cvodes", dae, 0.0, list(grid), options)

    def feedback_dae(self, policy: ca.Function) -> dict[str, Any]:
        """dz/dtau = scale * (f, L)(x, clip(policy(x, t))), t = start + scale * tau; the quadrature is of ||u||.

        Its parameters are (start, scale, p).
        """
        nx, n = self.ocp.system.nx, self.ocp.np
        z, tau, p = ca.MX.sym("z", nx + 1), ca.MX.sym("tau"), ca.MX.sym("p", 2 + n)
        x, t = self.sized(z)[:nx], p[0] + p[1] * tau
        u = self.clip(policy(x, t, *([p[2:]] if n else [])))
        ode = self.rates(x, u, t, p[2:])
        return {"x": z, "t": tau, "p": p, "ode": p[1] * self.scaled(ode), "quad": p[1] * ca.norm_2(u)}

    def held_dae(self) -> dict[str, Any]:
        """dz/dtau = scale * (f, L)(x, u), u held: an interval of any length is tau in [0, 1].

        Its parameters are (u, p, start, scale), `start` where the problem holds the time.
        """
        s, n, timed = self.ocp.system, self.ocp.np, self.ocp.uses_time
        sym: Any = ca.SX if self.f.is_a("SXFunction") else ca.MX
        z, p = sym.sym("z", s.nx + 1), sym.sym("p", s.nu + n + timed + 1)
        x, u, scale = self.sized(z)[:-1], p[:s.nu], p[-1]
        if not timed:
            return {"x": z, "p": p, "ode": scale * self.scaled(self.rates(x, u, 0.0, p[s.nu:-1]))}
        tau = sym.sym("tau")
        ode = self.rates(x, u, p[-2] + scale * tau, p[s.nu:-2])
        return {"x": z, "t": tau, "p": p, "ode": scale * self.scaled(ode)}

    def rates(self, x: Any, u: Any, t: Any, p: Any) -> Any:
        """(f, L) at one moment."""
        at = Arguments({"x": x, "u": u, "t": t, "p": p})
        return ca.vertcat(at.call(self.f), at.call(self.ocp.L))

    @cached_property
    def unit(self) -> Array:
        """What 1 stands for in each of z, for CVODES' absolute tolerance; 1 in ordinary problems."""
        of = units(self.ocp)
        return np.r_[of.x, of.cost]

    def sized(self, z: Any) -> Any:
        return z if (self.unit == 1).all() else z * self.unit

    def scaled(self, z: Any) -> Any:
        return z if (self.unit == 1).all() else z / self.unit

    def integrate(self, solver: ca.Function, z: Array, p: Any) -> tuple[Array | None, float]:
        """(states at the solver's times, last quadrature), or None where CVODES fails or yields NaN."""
        try:
            with interrupt.kept():
                result = solver(x0=z / self.unit, p=p)
        except RuntimeError:
            return None, np.nan
        end, quad = result["xf"].full() * self.unit[:, None], result["qf"].full()
        if not np.isfinite(end).all():
            return None, np.nan
        return end, float(quad[0, -1]) if quad.size else 0.0

    def clip(self, u: Any) -> Any:
        """u in U; written so that NaN stays NaN (fmin and fmax would hide it)."""
        s = self.ocp.system
        return u - ca.fmax(u - s.ubu, 0) + ca.fmax(s.lbu - u, 0)

    def continuous(self, policy: ca.Function, x0: Array, t: Array, jumps: list[tuple[float, Array]]) -> Simulation:
        dae, B, nx, nodes, m = self.feedback_dae(policy), len(x0), x0.shape[1], t, self.between
        t = np.interp(np.arange((len(nodes) - 1) * m + 1) / m, np.arange(len(nodes)), nodes)  # m times an interval
        x = np.full((B, len(t), nx), np.nan)
        z, magnitude, message = np.c_[x0, np.zeros(B)], np.zeros(B), [""] * B
        edges = np.unique(np.r_[t[0], [time for time, _ in jumps], t[-1]])
        for a, b in pairwise(edges):
            z[:, :nx] += sum(dx for time, dx in jumps if time == a)
            x[:, t == a] = z[:, None, :nx]
            inside = (t > a) & (t < b)
            segment = Segment(self, dae, a, np.r_[t[inside], b])
            for i in range(B):
                if not message[i]:
                    path, magnitude_i, message[i] = segment.run(z[i], self.p[i])
                    x[i, inside], z[i] = path[:-1, :nx], path[-1]
                    magnitude[i] += magnitude_i
        z[:, :nx] += sum(dx for time, dx in jumps if time == t[-1])
        x[:, -1] = z[:, :nx]
        if self.ocp.states_only:
            least = measured.least(self.ocp, x, t, self.p)
        else:
            least = measured.least_held(self.ocp, x, self.answers(policy, x, t), t, self.p)
        x, t = x[:, ::m].copy(), nodes
        u = self.answers(policy, x, t)
        weight = np.gradient(t) * np.r_[0.5, np.ones(len(t) - 2), 0.5] if len(t) > 2 else np.diff(t).repeat(2) / 2
        saturation = self.at_bound(u) @ (weight / weight.sum())
        return self.score(t, x, u, z[:, -1], magnitude / (t[-1] - t[0]), saturation, least, message)

    def answers(self, policy: ca.Function, x: Array, t: Array) -> Array:
        """The policy's controls [B, n, nu] at states x [B, n, nx] of times t [n], in U."""
        B, s = len(x), self.ocp.system
        p = [np.repeat(self.p, len(t), axis=0).T] if self.ocp.np else []
        u = policy(x.reshape(-1, s.nx).T, np.tile(t, B)[None], *p).full().T.reshape(B, len(t), -1)
        return np.clip(u, s.lbu, s.ubu)

    def held(self, ask: Ask, x0: Array, t: Array, jumps: list[tuple[float, Array]], delay: float = 0.0) -> Simulation:
        B, nx, K, nu = len(x0), x0.shape[1], len(t) - 1, self.ocp.system.nu
        step = Mapped(self) if self.ocp.system.is_discrete else Step(self)
        least = np.full((B, len(self.ocp.functions.rows)), np.inf)
        x, u = np.full((B, K + 1, nx), np.nan), np.full((B, K + 1, nu), np.nan)
        z, message = np.c_[x0, np.zeros(B)], [""] * B
        for k in range(K):
            z[:, :nx] += sum(dx for time, dx in jumps if time == t[k])
            u[:, k] = np.clip(ask(z[:, :nx].copy(), float(t[k]), k), self.ocp.system.lbu, self.ocp.system.ubu)
            alive = np.array([not m for m in message])
            x[alive, k] = z[alive, :nx]
            for i in np.flatnonzero(alive & ~np.isfinite(u[:, k]).all(axis=1)):
                message[i] = failure("the control is NaN", t[k], z[i, :nx])
            middle = [jump for jump in jumps if t[k] < jump[0] < t[k + 1]]
            late = t[k] + (delay if k else 0.0)
            edges = np.unique(np.r_[t[k], [time for time, _ in middle], min(late, t[k + 1]), t[k + 1]])
            for a, b in pairwise(edges):
                z[:, :nx] += sum(dx for time, dx in middle if time == a)
                acts, start = u[:, k - 1] if a < late else u[:, k], z[:, None, :nx].copy()
                path = step.run(z, acts, a, b, message)
                least = np.minimum(least, self.under(acts, start, path, a + (b - a) * np.r_[0.0, step.grid]))
        z[:, :nx] += sum(dx for time, dx in jumps if time == t[-1])
        x[:, -1], u[:, -1] = z[:, :nx], u[:, -2]
        share = np.diff(t) / (t[-1] - t[0])
        magnitude, saturation = np.linalg.norm(u[:, :-1], axis=2) @ share, self.at_bound(u[:, :-1]) @ share
        least = np.minimum(least, self.at_nodes(x, u, t))
        return self.score(t, x, u, z[:, -1], magnitude, saturation, least, message)

    def under(self, u: Array, start: Array, path: Array, t: Array) -> Array:
        """Least values of the constraints on the way from `start` [B, 1, nx] along `path` [B, m, nx] under u [B, nu];
        t [m + 1] are the times of both."""
        if self.ocp.states_only:
            return measured.least(self.ocp, path, t[1:], self.p)
        if self.ocp.system.is_discrete:  # at the next sample another control acts
            return measured.least_held(self.ocp, start, u[:, None], t[:1], self.p)
        x = np.concatenate([start, path], axis=1)
        return measured.least_held(self.ocp, x, np.repeat(u[:, None], len(t), axis=1), t, self.p)

    def at_nodes(self, x: Array, u: Array, t: Array) -> Array:
        """Those at the nodes; constraints that hold the control were looked at on the way."""
        if self.ocp.states_only:
            return measured.least(self.ocp, x, t, self.p)
        return measured.least_held(self.ocp, x, u[:, :0], t, self.p)

    def at_bound(self, u: Array) -> Array:
        """Whether any control is at a bound, [B, K], as 0 or 1."""
        s = self.ocp.system
        near = AT_BOUND * (s.ubu - s.lbu)
        return ((u <= s.lbu + near) | (u >= s.ubu - near)).any(axis=2).astype(float)

    @property
    def between(self) -> int:
        """Times in an interval that the state is recorded at."""
        return BETWEEN if self.ocp.held else 1

    def score(self, t: Array, x: Array, u: Array, running: Array, magnitude: Array, saturation: Array,
              least: Array, message: list[str]) -> Simulation:
        reached, ocp = np.array([not m for m in message]), self.ocp
        x[~reached, -1] = np.nan
        end = ocp.functions.end.columns(x=x[:, -1], p=self.p)
        terminal = np.where(reached, ocp.G(*end).full().ravel(), np.inf)
        running = np.where(reached, running, np.inf)
        half = (ocp.system.ubx - ocp.system.lbx) / 2
        off = np.abs(ocp.from_goal(x[:, -1], self.p) / half).max(axis=1)
        error = np.where(reached, off, np.inf) if ocp.has_goal else np.full(len(x), np.nan)
        u[~np.isfinite(x).all(axis=2)] = np.nan
        at_end = measured.least_at_end(ocp, x[:, -1], self.p)
        violation, worst = measured.violation(ocp, least, at_end), self.worst(measured.shares(ocp, least, at_end))
        beyond = reached & (violation > self.tolerance)
        for i in np.flatnonzero(beyond):
            name, much = measured.excess(ocp, worst[i], violation[i])
            message[i] = f"violates {name!r} by {much}"
        return Simulation(t, x, u, running + terminal, running, terminal, error, np.where(reached, magnitude, np.nan),
                          np.where(reached, saturation, np.nan), measured.nearest(ocp, least, at_end), violation,
                          reached & ~beyond, message, reached, worst, *np.full((2, len(x)), np.nan))

    @staticmethod
    def worst(shares: Array) -> NDArray[np.int64]:
        """[B], the row that is violated most, -1 where none is."""
        found = np.c_[np.zeros(len(shares)), shares].argmax(axis=1) - 1
        return np.asarray(found, dtype=np.int64)


class Segment:
    """Continuous feedback from time a to each of `times`, built once and run state by state."""

    def __init__(self, judge: Judge, dae: dict[str, Any], a: float, times: Array) -> None:
        self.judge, self.dae, self.a, self.times = judge, dae, float(a), times
        self.solvers = {MULTISTEP[0]: judge.integrator(dae, times - a, MULTISTEP[0])}

    def run(self, z: Array, p: Array) -> tuple[Array, float, str]:
        """(z at the times [len(times), nx + 1], integral of ||u||, message) with the parameters p."""
        for method in MULTISTEP:
            if method not in self.solvers:
                self.solvers[method] = self.judge.integrator(self.dae, self.times - self.a, method)
            path, magnitude = self.judge.integrate(self.solvers[method], z, np.r_[self.a, 1.0, p])
            if path is not None:
                return path.T, magnitude, ""
        return self.locate(z, p)

    def locate(self, z: Array, p: Array) -> tuple[Array, float, str]:
        """Run again interval by interval, to say where it failed."""
        path = np.full((len(self.times), len(z)), np.nan)
        each = [self.judge.integrator(self.dae, np.array([1.0]), method) for method in MULTISTEP]
        a = self.a
        for k, b in enumerate(self.times):
            ends = (self.judge.integrate(step, z, np.r_[a, b - a, p])[0] for step in each)
            end = next((e for e in ends if e is not None), None)
            if end is None:
                return path, np.nan, self.judge.blow_up(a, z[:-1], float(b), "the state blows up or the control is NaN")
            path[k] = z = end[:, -1]
            a = float(b)
        return path, np.nan, failure("CVODES did not reach the end", self.a, z[:-1], a)


class Step:
    """Held controls over one interval, state by state: a mapped call is a tenth faster, but fails for all at once."""

    def __init__(self, judge: Judge) -> None:
        dae, self.m, self.judge = judge.held_dae(), judge.between, judge
        self.grid = np.arange(1, self.m + 1) / self.m
        self.solvers = [judge.integrator(dae, self.grid, method) for method in MULTISTEP]

    def run(self, z: Array, u: Array, a: float, b: float, message: list[str]) -> Array:
        """Advance the rows of z whose message is empty from time a to b; write a message where one fails.

        Returns the states on the way [B, m, nx], NaN where there are none.
        """
        start = [np.full(len(u), a)] if self.judge.ocp.uses_time else []
        p = np.column_stack([u, self.judge.p, *start, np.full(len(u), b - a)])
        path = np.full((len(z), self.m, z.shape[1] - 1), np.nan)
        for i in (i for i, m in enumerate(message) if not m):
            ends = (self.judge.integrate(solver, z[i], p[i])[0] for solver in self.solvers)
            end = next((e for e in ends if e is not None), None)
            if end is None:
                message[i] = self.judge.blow_up(a, z[i, :-1], b)
            else:
                path[i], z[i] = end[:-1].T, end[:, -1]
        return path


class Mapped:
    """Steps of a system in discrete time, all states at once."""

    grid = np.ones(1)

    def __init__(self, judge: Judge) -> None:
        self.judge, self.of = judge, judge.ocp.functions

    def run(self, z: Array, u: Array, a: float, b: float, message: list[str]) -> Array:
        """As Step.run has it: one step, from the sample at a to that at b."""
        nx, t = z.shape[1] - 1, np.full(len(z), a)
        given = self.of.arguments.columns(x=z[:, :nx], u=u, t=t, p=self.judge.p)
        after, cost = (out.full().T for out in self.of.sample(*given))
        end, alive = np.c_[after, z[:, nx:] + cost], np.array([not m for m in message])
        good = alive & np.isfinite(end).all(axis=1)
        for i in np.flatnonzero(alive & ~good):
            message[i] = failure("the state blows up", a, z[i, :nx], b)
        z[good] = end[good]
        return np.where(good[:, None, None], z[:, None, :nx], np.nan)


def failure(what: str, t: float, x: Array, until: float | None = None) -> str:
    when = f"at t = {t:.4g}" if until is None else f"between t = {t:.4g} and {until:.4g}"
    return f"{what} {when}, after x = {np.array2string(x, precision=4, separator=', ')}"
