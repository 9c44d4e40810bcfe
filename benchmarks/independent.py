"""A check of controllers and plans that is written without nocl's solvers and judge, for benchmarks/strangers.py.

Runs are scipy's LSODA, with the running cost as one more state. Optima are direct collocation: Radau's three points in
each interval, a control at each of them, IPOPT. A plan counts as what LSODA makes of it: its controls from its initial
state on, moved at each of its nodes by an LQR about it, since an unstable plant leaves any open loop; its cost where
all constraints are held on the way. So no optimum here is lower than what can be paid. Violations are shares of each
constraint's scale, as nocl has them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import minimize_scalar

import nocl

RTOL, ATOL = 1e-8, 1e-10  # of LSODA; the second in usual sizes
LOOKS = 2000  # times of a run at which constraints are looked at
PARTS = 40  # of the longest horizon, after each of which a run is asked whether it has arrived
ALLOWED = 1e-3  # of a constraint's scale
LAST = 1e3  # times the weight of a plan's other nodes that its last one has for the LQR about it
ROOM = 1e-4  # of a scale, that collocation gives constraints along the way at the end
MARGIN = 0.2  # of a scale, the most that collocation stays away from a constraint to hold it between its points
POINTS = 3  # of a collocation interval
FAR = 1e3  # times X, where a run has blown up

Array = np.ndarray
Rows = tuple[list[str], ca.Function, Array, Array]  # names; values as shares of scales, of (x, u, t, p); low, high


@dataclass(frozen=True)
class Run:
    """What LSODA says of a controller, or of a plan, from one state."""

    cost: float = np.inf
    violation: float = np.inf  # the largest, as a share of its constraint's scale
    of: str = ""  # whose it is
    why: str = ""  # it did not get to its end, "" where it did
    t: Array | None = None  # [K+1]
    x: Array | None = None  # [K+1, nx]
    u: Array | None = None  # [K+1, nu], what acts there

    @property
    def ends(self) -> bool:
        return not self.why

    @property
    def holds(self) -> bool:
        return self.ends and self.violation <= ALLOWED


@dataclass(frozen=True)
class Plan:
    """Nodes of one solution and its controls: held on each interval, or the parabola through its three points."""

    t: Array  # [K+1]
    x: Array  # [K+1, nx]
    u: Array  # [K, nu], or [K, POINTS, nu]

    def powers(self, k: int) -> Array:
        """u(s) = sum_i powers[i] s^i [POINTS, nu], on interval k, at a share s of it."""
        if self.u.ndim == 2:
            return np.vstack([self.u[k:k + 1], np.zeros((POINTS - 1, self.u.shape[1]))])
        return np.linalg.solve(np.vander(TAU, increasing=True), self.u[k])


TAU = np.array(ca.collocation_points(POINTS, "radau"))


class Quick:
    """A CasADi function of dense arguments without the way through matrices; its answer as [n]."""

    def __init__(self, f: ca.Function) -> None:
        self.buffer, self.evaluate = f.buffer()
        self.given = [np.zeros(f.nnz_in(i)) for i in range(f.n_in())]
        self.answer = np.zeros(f.nnz_out(0))
        for i, values in enumerate(self.given):
            self.buffer.set_arg(i, memoryview(values))
        self.buffer.set_res(0, memoryview(self.answer))

    def __call__(self, *values: Any) -> Array:
        for own, value in zip(self.given, values, strict=True):
            own[:] = value
        self.evaluate()
        return self.answer.copy()


class Equations:
    """A problem's expressions as functions of (x, u, t, p), from its definition; `p` are the parameters' values."""

    def __init__(self, ocp: nocl.OCP, p: Array) -> None:
        s, self.ocp, self.p = ocp.system, ocp, p
        self.symbols = [s.x, s.u, nocl.time(), ca.vertcat(s.p, ocp.p)]
        self.rate = ca.Function("rate", self.symbols, [ca.vertcat(s.equations, ocp.running)])
        self.low, self.high = s.lbu, s.ubu
        self.size = np.maximum(np.abs(s.lbx), np.abs(s.ubx))
        of, least = ocp.functions, self._least_scale
        self.along = self._rows(ocp.held, least(of.rows.names, of.scales))
        self.at_end = self._rows(ocp.held_at_end, least(of.end_rows.names, of.end_scales))

    @staticmethod
    def _least_scale(names: Any, scales: Array) -> dict[str, float]:
        found: dict[str, float] = {}
        for name, scale in zip(names, scales, strict=True):
            found[name] = min(float(scale), found.get(name, np.inf))
        return found

    def _rows(self, held: Any, scales: dict[str, float]) -> Rows:
        size = np.array([scales[one.name] for one in held])
        e = ca.vertcat(*(one.expression for one in held)) / ca.DM(size) if held else ca.SX(0, 1)
        bounds = [np.array([getattr(one, side) for one in held]) / size for side in ("low", "high")]
        return [one.name for one in held], ca.Function("rows", self.symbols, [e]), *bounds

    def over(self, rows: Rows, x: Array, u: Array, t: Array) -> tuple[Array, str]:
        """The largest violation at each of many moments [n], and the worst constraint's name."""
        names, e, low, high = rows
        if not names:
            return np.zeros(len(t)), ""
        value = e(x.T, u.T, t[None], np.tile(self.p[:, None], len(t))).full()
        over = np.maximum(np.maximum(low[:, None] - value, value - high[:, None]), 0.0)
        return over.max(axis=0), names[int(over.max(axis=1).argmax())]

    @cached_property
    def slopes(self) -> ca.Function:
        """(x, u, t, p) -> df/dx, df/du."""
        x, u, *_ = self.symbols
        f = self.ocp.system.equations
        return ca.Function("slopes", self.symbols, [ca.jacobian(f, x), ca.jacobian(f, u)])

    @cached_property
    def terminal(self) -> ca.Function:
        x, _, t, p = self.symbols
        return ca.Function("terminal", [x, t, p], [self.ocp.terminal])

    def G(self, x: Array, t: float) -> float:
        return float(self.terminal(x, t, self.p))

    @cached_property
    def control(self) -> ca.Function:
        """(powers [POINTS, nu], s) -> u, clipped to U."""
        powers, s = ca.SX.sym("powers", POINTS, len(self.low)), ca.SX.sym("s")
        u = powers.T @ ca.vertcat(*(s**i for i in range(POINTS)))
        return ca.Function("control", [powers, s], [ca.fmin(ca.fmax(u, self.low), self.high)])

    @cached_property
    def replay(self) -> Quick:
        """(x, t, powers, begin, length) -> d/dt of (x, cost) under a plan's control."""
        x, t, begin, length = self.symbols[0], ca.SX.sym("t"), ca.SX.sym("begin"), ca.SX.sym("length")
        powers = ca.SX.sym("powers", POINTS, len(self.low))
        rate = self.rate(x, self.control(powers, (t - begin) / length), t, ca.DM(self.p))
        return Quick(ca.Function("replay", [x, t, powers, begin, length], [ca.densify(rate)]))

    def lsoda(self, slope: Callable[[float, Array], Array], z: Array, begin: float, end: float, times: Array) -> Any:
        """scipy's answer at `times`; what is not finite ends it."""
        def far(t: float, z: Array) -> float:
            return float(FAR - np.max(np.abs(z[:-1]) / self.size))

        far.terminal = True  # type: ignore[attr-defined]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return solve_ivp(slope, (begin, end), z, method="LSODA", t_eval=times, rtol=RTOL,
                             atol=ATOL * np.r_[self.size, 1.0], max_step=(end - begin) / 10, events=far)


class Judge(Equations):
    """Runs of laws and plans."""

    def law(self, policy: ca.Function) -> ca.Function:
        """(x, t) -> u, clipped to U, of a controller's CasADi function (x, t[, p])."""
        x, t = ca.MX.sym("x", len(self.size)), ca.MX.sym("t")
        u = policy(*[x, t, ca.DM(self.p)][:policy.n_in()])
        return ca.Function("law", [x, t], [ca.fmin(ca.fmax(u, self.low), self.high)])

    def feedback(self, policy: ca.Function, x0: Array) -> Run:
        """In closed loop from x0 [nx] to the horizon; where that is free, to where it arrives."""
        law = self.law(policy)
        x, t = ca.MX.sym("x", len(x0)), ca.MX.sym("t")
        closed = Quick(ca.Function("closed", [x, t], [ca.densify(self.rate(x, law(x, t), t, self.p))]))
        end, seen_t, seen_z = self.ocp.longest, [np.zeros(1)], [np.r_[x0, 0.0][None]]
        parts = PARTS if self.ocp.is_free else 1
        for part in range(parts):
            begin, until = end * part / parts, end * (part + 1) / parts
            times = np.linspace(begin, until, LOOKS // parts + 1)
            answer = self.lsoda(lambda t, z: closed(z[:-1], t), seen_z[-1][-1], begin, until, times)
            if not _whole(answer):
                return Run(why=f"it does not get beyond t = {_reached(answer, begin):.4g}")
            seen_t.append(answer.t[1:])
            seen_z.append(answer.y.T[1:])
            if self.ocp.is_free and (run := self._arrived(np.concatenate(seen_t), np.vstack(seen_z))) is not None:
                return self._ended(law, *run)
        if self.ocp.is_free:
            nearest = self._missing(np.vstack(seen_z), np.concatenate(seen_t))
            return Run(why=f"it does not arrive within {end:g}: {nearest}")
        return self._ended(law, np.concatenate(seen_t), np.vstack(seen_z))

    def _end(self, z: Array, t: Array) -> tuple[Array, str]:
        return self.over(self.at_end, z[:, :-1], np.zeros((len(t), len(self.low))), t)

    def _missing(self, z: Array, t: Array) -> str:
        over, _ = self._end(z, t)
        k = int(over.argmin())
        _, name = self._end(z[k:k + 1], t[k:k + 1])
        return f"nearest at t = {t[k]:.4g}, where {name!r} is off by {over[k]:.2g} scales"

    def _arrived(self, t: Array, z: Array) -> tuple[Array, Array] | None:
        """The run up to the first moment at which all ends hold; between two looks it is a straight line."""
        over = np.where(t >= self.ocp.horizon.low, self._end(z, t)[0], np.inf)
        if (over <= ALLOWED).any():
            k = int(np.flatnonzero(over <= ALLOWED)[0])
            return t[:k + 1], z[:k + 1]
        near = np.flatnonzero((over[1:-1] <= over[:-2]) & (over[1:-1] <= over[2:]) & np.isfinite(over[:-2])) + 1
        for k in near:
            found = minimize_scalar(lambda at: self._end(_line(at, t, z), np.array([at]))[0][0],
                                    bounds=(t[k - 1], t[k + 1]), method="bounded")
            if found.fun <= ALLOWED:
                before = t < found.x
                return np.r_[t[before], found.x], np.vstack([z[before], _line(found.x, t, z)])
        return None

    def _ended(self, law: ca.Function, t: Array, z: Array) -> Run:
        u = law(z[:, :-1].T, t[None]).full().T
        if not np.isfinite(u).all():
            return Run(why="a control is not finite")
        return self._judged(t, z[:, :-1], u, z[-1, -1])

    def _judged(self, t: Array, x: Array, u: Array, paid: float) -> Run:
        """A run that got to its end, by all that is held along it and there."""
        along, name = self.over(self.along, x, u, t)
        end, last = self._end(np.c_[x[-1:], [[0.0]]], t[-1:])
        worst = max(float(along.max()), float(end[0]))
        return Run(paid + self.G(x[-1], float(t[-1])), worst, last if end[0] >= along.max() else name, "", t, x, u)

    def plan(self, plan: Plan) -> Run:
        """Its controls from its initial state on, moved at each node by what the LQR about it says."""
        return self.followed(plan, self._gains(plan))

    def _gains(self, plan: Plan) -> Array:
        """Of u = u_k(t) + gain_k (x(t_k) - x_k), held: weights of one for each state's range and each control's box."""
        K, nx, nu = len(plan.t) - 1, plan.x.shape[1], plan.u.shape[-1]
        R, Q = np.diag(1 / np.maximum(self.high - self.low, 1e-12)**2), np.diag(1 / _range(plan)**2)
        u = plan.u if plan.u.ndim == 2 else plan.u.mean(axis=1)
        P, gains = LAST * Q, np.zeros((K, nu, nx))
        for k in reversed(range(K)):
            A, B = (j.full() for j in self.slopes(plan.x[k], u[k], plan.t[k], self.p))
            step = expm(np.block([[A, B], [np.zeros((nu, nx + nu))]]) * (plan.t[k + 1] - plan.t[k]))[:nx]
            F, G = step[:, :nx], step[:, nx:]
            gains[k] = -np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)
            P = Q + F.T @ P @ (F + G @ gains[k])
        return gains

    def followed(self, plan: Plan, gains: Array) -> Run:
        """Under its controls and gains [K, nu, nx]."""
        K, z = len(plan.t) - 1, np.r_[plan.x[0], 0.0]
        seen: list[tuple[Array, Array, Array]] = []
        for k in range(K):
            begin, length = plan.t[k], plan.t[k + 1] - plan.t[k]
            powers, times = plan.powers(k), np.linspace(begin, plan.t[k + 1], max(LOOKS // (4 * K), 4) + 1)
            powers[0] += gains[k] @ (z[:-1] - plan.x[k])
            answer = self.lsoda(self._under(powers.ravel("F"), begin, length), z, times[0], times[-1], times)
            if not _whole(answer):
                return Run(why=f"its controls do not get beyond t = {_reached(answer, begin):.4g}")
            seen.append((answer.t, answer.y.T[:, :-1], self._controls(powers, times)))
            z = answer.y[:, -1]
        t, x, u = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        return self._judged(t, x, u, float(z[-1]))


    def _under(self, powers: Array, begin: float, length: float) -> Callable[[float, Array], Array]:
        return lambda t, z: self.replay(z[:-1], t, powers, begin, length)

    def _controls(self, powers: Array, times: Array) -> Array:
        """A plan's at many times of an interval [n, nu]."""
        shares = (times - times[0]) / (times[-1] - times[0])
        return np.clip(np.vander(shares, POINTS, increasing=True) @ powers, self.low, self.high)


def _whole(answer: Any) -> bool:
    return bool(answer.status == 0 and np.isfinite(answer.y).all())


def _reached(answer: Any, begin: float) -> float:
    """The last time at which a run was finite."""
    finite = np.isfinite(answer.y).all(axis=0) if len(answer.t) else np.zeros(0, dtype=bool)
    return float(answer.t[finite][-1]) if finite.any() else begin


def _range(plan: Plan) -> Array:
    """What each state goes through along a plan [nx]."""
    return np.ptp(plan.x, axis=0) + 1e-3 * np.abs(plan.x).max(axis=0) + 1e-12


def _line(at: float, t: Array, z: Array) -> Array:
    """A run's state at one moment [1, nx + 1]."""
    return np.array([[np.interp(at, t, column) for column in z.T]])


@dataclass(frozen=True)
class Guess:
    """Of a solution, over shares s of its horizon T."""

    s: Array  # [K+1]
    x: Array  # [K+1, nx]
    u: Array  # [K+1, nu]
    T: float

    @staticmethod
    def of_plan(plan: Plan) -> Guess:
        u = plan.u if plan.u.ndim == 2 else plan.u.mean(axis=1)
        return Guess(plan.t / plan.t[-1], plan.x, np.vstack([u, u[-1:]]), float(plan.t[-1]))

    @staticmethod
    def of_run(run: Run) -> Guess:
        return Guess(run.t / run.t[-1], run.x, run.u, float(run.t[-1]))

    @staticmethod
    def straight(ocp: nocl.OCP, p: Array, x0: Array) -> Guess:
        """From x0 to the goal, where there is one."""
        x_goal, u_goal = (z[0] for z in ocp.goals(p[None]))
        end = x_goal if ocp.has_goal else x0
        T = float(np.sqrt(ocp.horizon.low * ocp.horizon.high)) if ocp.is_free else ocp.longest
        return Guess(np.array([0.0, 1.0]), np.array([x0, end]), np.array([u_goal, u_goal]), T)

    def at(self, s: Array) -> tuple[Array, Array]:
        """(x [n, nx], u [n, nu]); controls as they are held."""
        x = np.stack([np.interp(s, self.s, column) for column in self.x.T], axis=1)
        return x, self.u[np.clip(np.searchsorted(self.s, s, side="left") - 1, 0, len(self.s) - 1)]


class Collocation:
    """min J over collocation states, controls and, where it is free, T: one program for all initial states."""

    def __init__(self, of: Equations, intervals: int = 60, seconds: float = 60.0) -> None:
        self.of, self.N, self.ocp = of, intervals, of.ocp
        s, self.limit = self.ocp.system, seconds
        self.sx, self.su = of.size, np.maximum(np.maximum(np.abs(s.lbu), np.abs(s.ubu)), 1e-12)
        self.solver, self.low, self.high, self.low_g, self.high_g = self._program()
        along, ends = of.along, len(of.at_end[0])
        if ends:  # a bound at which the end is fixed leaves an interior-point method no room
            last = slice(-ends - len(along[0]), -ends)
            self.low_g[last], self.high_g[last] = self.low_g[last] - ROOM, self.high_g[last] + ROOM
        inside = np.where(along[2] < along[3], 1.0, 0.0)  # an equation has no margin
        self.inside = np.r_[np.zeros(s.nx * POINTS * intervals), np.tile(inside, (POINTS + 1) * intervals),
                            np.zeros(ends)]

    def _stage(self) -> ca.Function:
        """(x_k, states [nx, 3], controls [nu, 3], t_k, h) -> residuals, cost, rows [m, 4]: where the interval begins
        those with controls count, too."""
        s, of = self.ocp.system, self.of
        C, _, B = ca.collocation_coeff(list(TAU))
        x, X, U = ca.SX.sym("x", s.nx), ca.SX.sym("X", s.nx, POINTS), ca.SX.sym("U", s.nu, POINTS)
        t, h = ca.SX.sym("t"), ca.SX.sym("h")
        at = [(X[:, j], U[:, j], t + float(TAU[j]) * h, ca.DM(of.p)) for j in range(POINTS)]
        rate = ca.horzcat(*(of.rate(*z) for z in at))
        residual = (ca.horzcat(x, X) @ C - h * rate[:-1, :]) / ca.DM(self.sx)
        first = U @ ca.DM(np.linalg.inv(np.vander(TAU, increasing=True))[0])
        starts = of.along[1](x, first, t, of.p)
        starts = ca.vertcat(*(e if ca.depends_on(e, U) else z for e, z in
                              zip(ca.vertsplit(starts), ca.vertsplit(of.along[1](*at[0])), strict=True)))
        held = ca.horzcat(starts, *(of.along[1](*z) for z in at))
        return ca.Function("stage", [x, X, U, t, h], [ca.vec(residual), h * (rate[-1, :] @ B), ca.vec(held)])

    def _program(self) -> tuple[ca.Function, Array, Array, Array, Array]:
        s, N, ocp = self.ocp.system, self.N, self.ocp
        x0, Z, V = ca.MX.sym("x0", s.nx), ca.MX.sym("Z", s.nx, POINTS * N), ca.MX.sym("V", s.nu, POINTS * N)
        T = ca.MX.sym("T") if ocp.is_free else ca.MX(ocp.horizon)
        X, U = ca.DM(self.sx) * Z, ca.DM(self.su) * V
        nodes = ca.horzcat(x0, X[:, POINTS - 1:-1:POINTS])
        parts = [ca.horzsplit(z, POINTS) for z in (X, U)]
        stage, h = self._stage(), T / N
        made = [stage(nodes[:, k], parts[0][k], parts[1][k], k * h, h) for k in range(N)]
        end = self.of.at_end[1](X[:, -1], U[:, -1], T, self.of.p)
        cost = sum(one[1] for one in made) + self.of.terminal(X[:, -1], T, self.of.p)
        w = ca.vertcat(ca.vec(Z), ca.vec(V), *([T] if ocp.is_free else []))
        g = ca.vertcat(*(one[0] for one in made), *(one[2] for one in made), end)
        free, m = np.full(s.nx * POINTS * N, np.inf), s.nx * POINTS * N
        bounds_T = [[ocp.horizon.low], [ocp.horizon.high]] if ocp.is_free else [[], []]
        low, high = (np.r_[sign * free, np.tile(limit / self.su, POINTS * N), at_T] for sign, limit, at_T in
                     ((-1, s.lbu, bounds_T[0]), (1, s.ubu, bounds_T[1])))
        along, at_end = self.of.along, self.of.at_end
        low_g, high_g = (np.r_[np.zeros(m), np.tile(along[side], (POINTS + 1) * N), at_end[side]] for side in (2, 3))
        options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.max_iter": 1000,
                   "ipopt.tol": 1e-9, "ipopt.acceptable_tol": 1e-7, "ipopt.max_wall_time": self.limit,
                   "expand": s.nx <= 12, "error_on_fail": False}
        nlp = {"x": w, "p": x0, "f": cost, "g": g}
        return ca.nlpsol("collocation", "ipopt", nlp, options), low, high, low_g, high_g

    def solve(self, x0: Array, guess: Guess, margin: float = 0.0) -> tuple[Plan | None, str]:
        """The optimum near a guess, or None and IPOPT's word; margin: of constraints along the way, in scales."""
        s, N = self.ocp.system, self.N
        x, u = guess.at(((np.arange(N)[:, None] + TAU) / N).ravel())
        T = [guess.T] if self.ocp.is_free else []
        start = np.r_[(x / self.sx).ravel(), (np.clip(u, s.lbu, s.ubu) / self.su).ravel(), T]
        answer = self.solver(x0=start, p=x0, lbx=self.low, ubx=self.high, lbg=self.low_g + margin * self.inside,
                             ubg=self.high_g - margin * self.inside)
        said = str(self.solver.stats()["return_status"])
        if said not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            return None, said
        w, n = answer["x"].full().ravel(), s.nx * POINTS * N
        X = w[:n].reshape(POINTS * N, s.nx) * self.sx
        U = w[n:n + s.nu * POINTS * N].reshape(N, POINTS, s.nu) * self.su
        length = float(w[-1]) if self.ocp.is_free else float(self.ocp.horizon)
        return Plan(np.linspace(0, length, N + 1), np.vstack([x0, X[POINTS - 1::POINTS]]), U), said

    def best(self, judge: Judge, x0: Array, guesses: Iterator[Guess] | list[Guess]) -> Run:
        """The least cost that LSODA confirms, of all guesses; where there is none, what comes nearest."""
        runs = [Run(why="no guess")]
        for guess in guesses:
            plan, said = self.solve(x0, guess)
            runs.append(Run(why=f"IPOPT: {said}") if plan is None else judge.plan(plan))
            if plan is not None and ALLOWED < runs[-1].violation <= MARGIN:
                plan, said = self.solve(x0, Guess.of_plan(plan), runs[-1].violation)
                runs.append(Run(why=f"IPOPT: {said}") if plan is None else judge.plan(plan))
        return min(reversed(runs), key=lambda run: (not run.holds, run.cost if run.holds else run.violation))
