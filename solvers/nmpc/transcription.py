"""Multiple shooting: an OCP as a nonlinear program with the structure that fatrop needs, and back.

Variables w = [x_0, u_0, x_1, u_1, ..., x_N], parameters p = [x_0, h_0, ..., h_{N-1}, t_N], the lengths of the
intervals and the time of the last node, then the parameters of the problem.
Constraints, stage by stage: x_{k+1} - F(x_k, u_k; h_k) = 0, then x_0 - p = 0 at k = 0 and the problem's own
(held.py). Implicit steps have their stages z_k behind u_k: F is of (x_k, u_k, z_k), and their equations stand last. A
free horizon T stands behind the state of each node, T_{k+1} = T_k, and h_k are then shares of it. A soft constraint has
slacks behind u_k. A gap's multiplier is minus the costate of the node that it leads to:
lambda_{k+1} = dJ*/dx_{k+1}.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nocl.definition.functions import Functions
from nocl.definition.ocp import OCP
from nocl.definition.scales import steps, units
from nocl.definition.substeps import RADAU, RK4
from nocl.solvers.between import Dips
from nocl.solvers.nmpc.held import Block, Layout, layout
from nocl.support import compiler
from nocl.support.checks import Array
from nocl.support.guard import Guarded, NoAnswerError
from nocl.translate import radau
from nocl.translate.arguments import Arguments

BACKENDS: dict[str, dict[str, Any]] = {
    "ipopt": {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9, "ipopt.max_iter": 500},
    "fatrop": {"fatrop.print_level": 0, "fatrop.tol": 1e-9, "fatrop.max_iter": 500},
}
WARM: dict[str, dict[str, Any]] = {  # near a solution: a barrier that is small from the start does not push it away
    "ipopt": {"ipopt.mu_init": 1e-8, "ipopt.warm_start_init_point": "yes", **{
        f"ipopt.warm_start_{name}": 1e-8 for name in ("bound_push", "bound_frac", "slack_bound_push",
                                                      "slack_bound_frac", "mult_bound_push")}},
    "fatrop": {"fatrop.mu_init": 1e-8},
}
FLAGS = ("-O2", "-march=native", "-fPIC", "-shared")  # of compiled programs
FEASIBLE = 1e-6  # largest violation of a constraint in a solution, in the units that the solver sees
# how a solve ended, by the names that CasADi has for all solvers, and in words
OUTCOMES = {"SOLVER_RET_SUCCESS": "solved", "SOLVER_RET_LIMITED": "stopped at its limit of iterations or time",
            "SOLVER_RET_INFEASIBLE": "infeasible", "SOLVER_RET_NAN": "NaN in a function",
            "SOLVER_RET_UNKNOWN": "not converged"}
STOPPED, NOT_A_NUMBER, INFEASIBLE = "SOLVER_RET_LIMITED", "SOLVER_RET_NAN", "SOLVER_RET_INFEASIBLE"
GIVEN_UP = "given up"  # outcomes of our own: the solver did not come back,
NOT_HELD = "not held"  # and constraints that not even the nearest plan holds
LEAST = 10.0  # seconds that a solve has, without a time limit of the user's
OTHERS = 20.0  # ... or that many times the slowest that came back
WORK = 10.0  # ... or that many evaluations of the second derivatives in each iteration allowed
TIMED = 3  # evaluations, of which the fastest counts
UNLIMITED = 3000  # iterations of a solver whose limit is not known


@dataclass(frozen=True, eq=False)
class Answer:
    """One solve of one program."""

    x: Array  # [N+1, nx]
    u: Array  # [N, nu]
    costate: Array  # [N+1, nx]
    cost: float  # inf where it failed
    success: bool
    message: str
    violation: float  # the largest, of any constraint, scaled
    iterations: int
    outcome: str  # how it ended: a key of OUTCOMES, GIVEN_UP, or CasADi's own name
    V_p: Array | None = None  # [np], dJ*/dp, where there are parameters
    t: Array | None = None  # [N+1], the nodes, where the horizon is free
    cut: bool = False  # whether constraints are left between nodes

    @property
    def rank(self) -> tuple[int, float]:
        """Of failures: the one that says which constraint cannot be held comes first, then those that say that there is
        no solution, then the most feasible."""
        return {NOT_HELD: 0, INFEASIBLE: 1}.get(self.outcome, 2), self.violation


@dataclass(frozen=True, eq=False)
class Scales:
    """What 1 stands for in the program that the solver sees."""

    w: Array  # of each variable
    g: Array  # of each constraint
    cost: float
    x: Array  # [nx], of the states

    @property
    def ordinary(self) -> bool:
        """Whether all of them are 1."""
        return bool((self.w == 1).all() and (self.g == 1).all() and self.cost == 1)


@dataclass(frozen=True, eq=False)
class Transcription:
    """The program of an OCP under dynamics f on N intervals; built when first used, so that settings travel alone."""

    ocp: OCP
    f: ca.Function  # (x, u[, t][, p]) -> xdot
    N: int
    substeps: int = 1
    soft: bool = False  # path constraints as the penalty of ocp.L_soft, not as constraints
    backend: str = "ipopt"
    options: tuple[tuple[str, Any], ...] = ()
    terminal: ca.Function | None = None  # (x), (x, t) or (x, t, p) -> cost at the last node; default: G
    compiled: tuple[str, Path] | None = None  # (the program's key, cache folder) of compiled functions; or interpreted
    eased: tuple[str, ...] = ()  # constraints that an exact penalty holds, by name
    integrator: str = RK4

    @cached_property
    def functions(self) -> Functions:
        """Those of the problem under f."""
        return self.ocp.functions.on(self.f)

    def end_cost(self, x: Any, t: Any, p: Any = None) -> Any:
        """What the state x at the last node, at time t, costs."""
        if self.terminal is None:
            return Arguments({"x": x, "p": p}).call(self.ocp.G)
        return self.terminal(*(x, t, p)[: self.terminal.n_in()])

    def moment(self, t: Array | float, p: Array | None) -> list[Array]:
        """The times [n] and parameters p [np], as columns, that the problem's functions take behind x and u."""
        n, p = np.size(t), np.zeros(0) if p is None else p
        return self.functions.arguments.but("x", "u").columns(t=np.reshape(t, n), p=np.tile(p, (n, 1)))

    @property
    def expandable(self) -> bool:
        return all(g is None or g.is_a("SXFunction") for g in (self.f, self.terminal))

    @property
    def n_path(self) -> int:
        """Inequalities of x alone at each node, h."""
        return 0 if self.soft else self.functions.rows.n_h

    @cached_property
    def held(self) -> Layout:
        """The constraints, by where they stand."""
        return layout(self.ocp, self.eased, not self.soft)

    @property
    def free(self) -> int:
        """How many variables of a node the horizon is: T, the same at all nodes, where it is free."""
        return int(self.ocp.is_free)

    @property
    def inner(self) -> int:
        """How many variables, and equations, the stages of an interval's steps are: 0 where those are explicit."""
        return self.substeps * radau.STAGES * self.ocp.system.nx if self.integrator == RADAU else 0

    @cached_property
    def step(self) -> ca.Function:
        """(x, u[, t][, p], h) -> (x at the end of the interval, integral of L over it)."""
        return self.functions.step(soft=self.soft, substeps=self.substeps, integrator=self.integrator)

    @cached_property
    def _interval(self) -> ca.Function:
        """(x, u[, t][, p], h[, z]) -> (end, cost[, residual]): as the program has it."""
        return self.functions.collocated(soft=self.soft, substeps=self.substeps) if self.inner else self.step

    @cached_property
    def _path(self) -> ca.Function:
        """(x, u[, t][, p], h) -> z."""
        return self.functions.radau_path(self.substeps)

    @cached_property
    def rollout(self) -> ca.Function:
        """(x0, u [nu, N][, t [1, N]][, p [np, N]], h [1, N]) -> x_1 ... x_N [nx, N]."""
        return self.step.slice("F", range(self.step.n_in()), [0]).mapaccum(self.N)

    def rolled(self, x0: Array, u: Array, t: Array, p: Array | None) -> Array:
        """The states [N+1, nx] from x0 under controls u [N, nu] on the nodes t [N+1]."""
        after = self.rollout(x0, u.T, *self.moment(t[:-1], p), np.diff(t)[None]).full().T
        return np.vstack([x0, after])

    def stepped(self, x: Array, u: Array, t: Array, k: int, p: Array | None) -> Array:
        """The state at node k + 1 from x at node k of t [N+1], u held."""
        return self.step(x, u, *self.moment(t[k], p), t[k + 1] - t[k])[0].full().ravel()

    @cached_property
    def program(self) -> dict[str, ca.MX]:
        """x, p, f, g of the nonlinear program, in MX."""
        s, N, m = self.ocp.system, self.N, self.held.slacks
        X, U, S = ca.MX.sym("x", s.nx + self.free, N + 1), ca.MX.sym("u", s.nu, N), ca.MX.sym("slack", m, N + 1)
        Z = ca.MX.sym("z", self.inner, N)
        p = ca.MX.sym("p", s.nx + N + 1 + self.ocp.np)
        w = ca.vertcat(*(v for k in range(N) for v in (X[:, k], U[:, k], S[:, k], Z[:, k])), X[:, N], S[:, N])
        flat = ca.Function("flat", [X, U, S, Z, p], [w, *self._cost_and_rows(X, U, S, Z, p)])
        w_sym, scales = ca.MX.sym("w", w.numel()), self.scales
        _, cost, constraints = flat(*self._split(w_sym if scales.ordinary else w_sym * scales.w), p)
        if not scales.ordinary:
            cost, constraints = cost / scales.cost, constraints / scales.g
        return {"x": w_sym, "p": p, "f": cost, "g": constraints}

    def _cost_and_rows(self, X: ca.MX, U: ca.MX, S: ca.MX, Z: ca.MX, p: ca.MX) -> tuple[ca.MX, ca.MX]:
        """(cost, g) of states [nx (+ T), N+1], controls [nu, N], slacks [slacks, N+1], stages [inner, N], parameters.
        """
        s, N = self.ocp.system, self.N
        h, end, own, x = p[s.nx: s.nx + N].T, p[s.nx + N], p[s.nx + N + 1:], X[:s.nx, :]
        t = self._times(h, end) if self.ocp.uses_time else end
        if self.free:
            T = X[s.nx, :]
            h, end, t = h * T[:N], T[N], t * (T if self.ocp.uses_time else T[N])
        stages = Arguments({"x": x[:, :-1], "u": U, "t": t[:, :-1], "p": ca.repmat(own, 1, N)})
        ends, costs, *inner = self._interval.map(N)(*(stages[name] for name in self.functions.arguments.names), h,
                                                    *([Z] if self.inner else []))
        if self.free:
            ends = ca.vertcat(ends, X[s.nx, :-1])
        gaps, paths = ca.horzsplit(X[:, 1:] - ends), [ca.vertcat(x[:, 0] - p[: s.nx], *self._rows(0, x, U, S, t, own))]
        paths += [ca.vertcat(ca.MX(0, 1), *self._rows(k, x, U, S, t, own)) for k in range(1, N + 1)]
        steps = [[zeros[:, k] for zeros in inner] for k in range(N)]
        g = ca.vertcat(*(v for k in range(N) for v in (gaps[k], *paths[k: k + 1], *steps[k])), *paths[N:])
        cost = ca.sum2(costs) + self.end_cost(x[:, N], end, own)
        return (cost + self.held.weight * ca.sum1(ca.sum2(S)) if self.held.slacks else cost), g

    def _rows(self, k: int, x: ca.MX, U: ca.MX, S: ca.MX, t: ca.MX, p: ca.MX) -> list[ca.MX]:
        """The constraints at node k, in their own units."""
        of, held = self.functions, self.held
        node = Arguments({"x": x[:, k], "u": U[:, min(k, self.N - 1)], "t": t[min(k, t.numel() - 1)], "p": p})
        found = []
        for block, c in ((held.x, of.c_of_x), (held.u, of.c_of_u), (held.end, of.c_at_end)):
            if len(block) and block in held.at(k, self.N):
                value = node.call(c)
                found.append(value + ca.DM(block.slack) @ S[:, k] if block.slack.any() else value)
        return found

    def _times(self, h: ca.MX, end: ca.MX) -> ca.MX:
        """The times of the nodes [1, N+1] from the lengths of the intervals [1, N] and the time of the last one."""
        left = ca.MX(0)
        times = [end]
        for length in reversed(ca.horzsplit(h)):
            left = left + length
            times.append(end - left)
        return ca.horzcat(*reversed(times))

    @cached_property
    def scales(self) -> Scales:
        """The sizes that the solver sees as 1, in steps of about a thousand: most problems are solved as they stand."""
        N, of = self.N, units(self.ocp)
        T, slacks = steps(np.full(self.free, self.ocp.longest)), np.ones(self.held.slacks)
        inner = np.tile(of.x, self.inner // len(of.x))
        w = np.r_[np.tile(np.r_[of.x, T, of.u, slacks, inner], N), of.x, T, slacks]
        rows = [[block.unit for block in self.held.at(k, N)] for k in range(N + 1)]
        g = [of.x, T, of.x, *rows[0], inner,
             *(part for k in range(1, N) for part in (of.x, T, *rows[k], inner)), *rows[N]]
        return Scales(w, np.concatenate(g), of.cost, of.x)

    def _split(self, w: Any) -> tuple[Any, Any, Any, Any]:
        """(X [nx (+ T), N+1], U [nu, N], slacks [slacks, N+1], Z [inner, N]) of the interleaved variables."""
        s, N = self.ocp.system, self.N
        n, nu, slacks = s.nx + self.free, s.nu, self.held.slacks
        size = n + nu + slacks + self.inner
        first, last = ca.reshape(w[: size * N, :], size, N), w[size * N:, :]
        x, u, slack, z = ca.vertsplit(first, np.cumsum([0, n, nu, slacks, self.inner]).tolist())
        return ca.horzcat(x, last[:n, :]), u, ca.horzcat(slack, last[n:, :]), z

    @cached_property
    def solver(self) -> ca.Function:
        """The nlpsol, with exact Hessians."""
        if self.compiled is None:
            return self._nlpsol(self.program, {"expand": self.expandable})
        key, folder = self.compiled
        identity = [key, ca.CasadiMeta.version(), FLAGS]
        return self._nlpsol(str(compiler.shared_library("nlp", identity, self._build, folder)), {})

    def _build(self, folder: Path) -> Path:
        """The functions that the solver calls, compiled."""
        solver = self._nlpsol(self.program, {})  # not expanded: loops over the intervals stay loops
        code, library = folder / "nlp.c", folder / "nlp.so"
        generator = ca.CodeGenerator(code.name)  # a solver's generate_dependencies writes to the working folder only
        for function in (solver.oracle(), *(solver.get_function(part) for part in solver.get_function())):
            generator.add(function)
        generator.generate(f"{folder}{os.sep}")
        compiler.run([*FLAGS, code, "-o", library, "-lm"], "the program of NMPC")
        return library

    def _nlpsol(self, problem: Any, options: dict[str, Any]) -> ca.Function:
        s, N, m = self.ocp.system, self.N, self.held.slacks
        options = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False, **options,
                   **BACKENDS.get(self.backend, {})}
        if self.backend == "fatrop":
            options |= {"structure_detection": "manual", "N": N, "nx": [s.nx + self.free] * (N + 1),
                        "nu": [s.nu + m + self.inner] * N + [m],
                        "ng": [s.nx * (k == 0) + self.held.size(k, N) + self.inner * (k < N) for k in range(N + 1)]}
        try:
            return ca.nlpsol("nmpc", self.backend, problem, {**options, **dict(self.options)})
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ValueError(f"NMPC: {self.backend} could not be built with options {dict(self.options)}: {reason}; "
                             "give options by CasADi's names, like {'ipopt.tol': 1e-6}") from error

    @cached_property
    def bounds(self) -> dict[str, Array]:
        s, N, horizon, slacks = self.ocp.system, self.N, self.ocp.horizon, self.held.slacks
        any_x, T = np.full(s.nx, np.inf), [(horizon.low, horizon.high)] if self.free else []
        low, high = (np.array([pair[i] for pair in T]) for i in (0, 1))
        any_z, none = np.full(self.inner, np.inf), np.zeros(self.inner)
        lbx = [np.tile(np.r_[-any_x, low, s.lbu, np.zeros(slacks), -any_z], N), -any_x, low, np.zeros(slacks)]
        ubx = [np.tile(np.r_[any_x, high, s.ubu, np.full(slacks, np.inf), any_z], N), any_x, high,
               np.full(slacks, np.inf)]
        gap, rows = np.zeros(s.nx + self.free), [[b.upper for b in self.held.at(k, N)] for k in range(N + 1)]
        ubg = np.concatenate([gap, np.zeros(s.nx), *rows[0], none,
                              *(part for k in range(1, N) for part in (gap, *rows[k], none)), *rows[N]])
        return {"lbx": np.concatenate(lbx) / self.scales.w, "ubx": np.concatenate(ubx) / self.scales.w,
                "lbg": np.zeros(len(ubg)), "ubg": ubg}

    def inside(self, margin: Array) -> Array:
        """Lower bounds of the rows of g with margins [N+1, rows along the trajectory], in scales; soft rows have none.
        """
        held, N, n = self.held, self.N, self.functions.rows.n_x
        of_rows, nx = {id(held.x): slice(0, n), id(held.u): slice(n, None)}, self.ocp.system.nx
        parts = [np.zeros(nx + self.free)]
        for k in range(N + 1):
            parts += [np.zeros(nx * (k == 0) + (nx + self.free) * (0 < k < N))]
            parts += [np.zeros(len(block)) if block is held.end else block.inward(margin[k, of_rows[id(block)]])
                      for block in held.at(k, N)]
            parts += [np.zeros(self.inner * (k < N))]
        return np.concatenate(parts)

    @cached_property
    def _limits(self) -> dict[str, ca.DM]:
        """The bounds as CasADi takes them: converting them at each solve would take a millisecond."""
        return {name: ca.DM(value) for name, value in self.bounds.items()}

    @cached_property
    def gap_rows(self) -> Array:
        """Where x_0 - p and the gaps stand in g, [N+1, nx]."""
        s, N = self.ocp.system, self.N
        n = s.nx + self.free
        stages = [n + self.held.size(k, N) + s.nx * (k == 0) + self.inner for k in range(N)]
        first = np.r_[n, np.cumsum([0, *stages])[:N]].astype(np.int64)
        return first[:, None] + np.arange(s.nx)

    @cached_property
    def row_titles(self) -> list[tuple[str, int]]:
        """What each row of g is, in words, and its node."""
        s, N = self.ocp.system, self.N
        x, T = [f"the dynamics of {name}" for name in s.state_names], ["the horizon"] * self.free
        held = [[block.rows.title(i) for block in self.held.at(k, N) for i in range(len(block))] for k in range(N + 1)]
        found = [(what, k + 1) for k in range(N) for what in (*x, *T)]
        inner = x * (self.inner // len(x))
        stages = [found[k * len(x + T):(k + 1) * len(x + T)] + [(what, k) for what in (*x * (k == 0), *held[k], *inner)]
                  for k in range(N)]
        return [row for stage in stages for row in stage] + [(what, N) for what in held[N]]

    def solve(self, x0: Array, t: Array, x: Array, u: Array, time_limit: float | None = None,
              p: Array | None = None, margin: Array | None = None) -> Answer:
        """Solve from x0 on the nodes t [N+1] with the guess x [N+1, nx], u [N, nu], in a copy of this process.

        p : the parameters [np], where there are some
        time_limit : seconds; default: `patience`, from what other solves took
        margin : by which each row is held further inside at each node, in scales [N+1, rows along the trajectory]
        """
        begin = time.perf_counter()
        try:
            answer: Answer = self._guarded(self.patience if time_limit is None else time_limit, x0, t, x, u,
                                            np.zeros(0) if p is None else p, margin)
        except NoAnswerError as error:
            return self._no_answer(t, x, u, f"was given up: {error}")
        self._took[0] = max(self._took[0], time.perf_counter() - begin)
        return answer

    @property
    def patience(self) -> float:
        """Seconds after which a solve is given up, generous beside the slowest that came back and beside the work that
        the solver's own limit of iterations allows it."""
        iterations = self.max_iter if np.isfinite(self.max_iter) else UNLIMITED
        return max(LEAST, OTHERS * self._took[0], WORK * iterations * self._evaluation)

    @cached_property
    def _took(self) -> list[float]:
        return [0.0]  # seconds of the slowest solve that came back

    @cached_property
    def settled(self) -> dict[str, Any]:
        """What its first solutions have shown once they were held against the plant, by the integrator that was asked
        for; and whether it was `told` of a program with steps of its own."""
        return {}

    @cached_property
    def _guarded(self) -> Guarded:
        self.solver  # noqa: B018 - built here, the copies have it
        return Guarded(self._solve, self._rehearse)

    def _rehearse(self) -> None:
        for name in self.solver.get_function():
            _at_zero(self.solver.get_function(name))
        self._split(ca.DM.zeros(self.solver.sparsity_in(0)))
        if self.inner:
            _at_zero(self._path)

    @cached_property
    def _evaluation(self) -> float:
        """Seconds of the program's second derivatives, its dearest function, at any point."""
        name = next((name for name in self.solver.get_function() if "hess" in name), None)
        if name is None:
            return 0.0
        hessian, took = self.solver.get_function(name), list[float]()
        for _ in range(TIMED):
            begin = time.perf_counter()
            _at_zero(hessian)
            took.append(time.perf_counter() - begin)
        return min(took)

    def _no_answer(self, t: Array, x: Array, u: Array, why: str) -> Answer:
        """A failure of the solver itself, which leaves the guess."""
        return Answer(x, u, np.full_like(x, np.nan), np.inf, False, f"{self.backend} {why}", np.inf, 0, GIVEN_UP,
                      t=t if self.free else None)

    def _start(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """The variables of a guess; slacks are what it takes to hold the soft constraints."""
        T = np.full((len(t), self.free), t[-1])
        S = self.needed(t, x, u, p)
        return np.r_[np.c_[x[:-1], T[:-1], u, S[:-1], self._stages(t, x, u, p)].ravel(), x[-1], T[-1], S[-1]]

    def _stages(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """The stages z [N, inner] of a guess; on a straight line to the next node where there are none."""
        if not self.inner:
            return np.zeros((self.N, 0))
        z = self._path(x[:-1].T, u.T, *self.moment(t[:-1], p), np.diff(t)[None]).full().T
        reach = np.tile(radau.REACH, self.substeps) / self.substeps
        straight = (reach[None, :, None] * np.diff(x, axis=0)[:, None]).reshape(self.N, -1)
        return np.where(np.isfinite(z).all(axis=1, keepdims=True), z, straight)

    def needed(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """The slacks [N+1, slacks] that hold the soft constraints at states x [N+1, nx], controls u [N, nu]."""
        of, held, N = self.functions, self.held, self.N
        found = np.zeros((N + 1, held.slacks))
        if not held.slacks:
            return found
        own = np.tile(p, (N + 1, 1))
        given = {"x": x, "t": t, "p": own}
        self._add(found[1:], held.x, of.c_of_x(*of.node.columns(**given)).full()[:, 1:])
        now = {"x": x[:-1], "u": u, "t": t[:-1], "p": own[:-1]}
        self._add(found[:-1], held.u, of.c_of_u(*of.arguments.columns(**now)).full())
        self._add(found[-1:], held.end, of.c_at_end(*of.end.columns(x=x[-1:], p=own[-1:])).full())
        return found

    def slack(self, t: Array, x: Array, u: Array, p: Array | None) -> Array:
        """By how much each soft constraint is exceeded at each node [N+1, soft ones], as a share of its scale."""
        S, held = self.needed(t, x, u, np.zeros(0) if p is None else p), self.held
        found = np.zeros((len(t), len(self.eased)))
        for block in (held.x, held.u, held.end):
            for i, j in np.argwhere(block.slack):
                k = self.eased.index(block.rows.names[i])
                found[:, k] = np.maximum(found[:, k], S[:, j])
        return found

    @staticmethod
    def _add(slacks: Array, block: Block, c: Array) -> None:
        """What a block's values c [m, n] need, written to the slacks [n, all]; an equation has two of them."""
        if not len(block):
            return
        need = -c / block.scales[:, None]
        for j in np.flatnonzero(block.slack.any(axis=0)):
            i = int(np.flatnonzero(block.slack[:, j])[0])
            slacks[:, j] = np.maximum(np.sign(block.slack[i, j]) * need[i], 0.0)

    def _solve(self, x0: Array, t: Array, x: Array, u: Array, own: Array, margin: Array | None) -> Answer:
        w0, ends = self._start(t, x, u, own), t / t[-1] if self.free else t
        limits = self._limits if margin is None else {**self._limits, "lbg": ca.DM(self.inside(margin))}
        try:
            result = self.solver(x0=w0 / self.scales.w, p=np.r_[x0, np.diff(ends), ends[-1], own], **limits)
        except RuntimeError as error:  # of the library: it fails one start, not the batch
            return self._no_answer(t, x, u, f"ended with an error: {str(error).strip().splitlines()[-1]}")
        return self._answer(result, self.solver.stats(), ends, own)

    def _answer(self, result: dict[str, ca.DM], stats: dict[str, Any], ends: Array, own: Array) -> Answer:
        """What the solver found; ends: the nodes, as shares of T where that is free."""
        X, U, t, cost = self._plan(result, ends, own)
        costate = -result["lam_g"].full().ravel()[self.gap_rows] * self.scales.cost / self.scales.x
        worst, where = self.violation(result["g"].full().ravel(), t)
        iterations = int(stats.get("iter_count", 0))
        outcome = outcome_of(stats, iterations >= self.max_iter)
        finite = bool(np.isfinite(cost) and np.isfinite(X).all())
        if stats["success"] and not finite:  # fatrop calls a cost of NaN solved
            outcome = NOT_A_NUMBER
        status = words(stats, outcome)
        success = bool(stats["success"] and worst <= FEASIBLE and finite)
        if not success:
            status += f"; worst violation {where}" if worst > FEASIBLE else \
                ", at a feasible point that may not be optimal"
        V_p = -result["lam_p"].full().ravel()[-len(own):] * self.scales.cost if len(own) else None
        return Answer(X, U, costate, cost if success else np.inf, success, status, worst, iterations, outcome, V_p,
                      t if self.free else None)

    def _plan(self, result: dict[str, ca.DM], ends: Array, own: Array) -> tuple[Array, Array, Array, float]:
        """(x [N+1, nx], u [N, nu], t [N+1], cost) of what the solver found."""
        s, cost = self.ocp.system, float(result["f"]) * self.scales.cost
        X, U, S, _ = (v.full().T for v in self._split(result["x"] * self.scales.w))
        U = np.clip(U, s.lbu, s.ubu)  # IPOPT relaxes bounds by 1e-8
        X, t = X[:, :s.nx], ends * X[0, s.nx] if self.free else ends
        if self.held.slacks:  # whose bounds it relaxes, too
            cost += self.held.weight * float((self.needed(t, X, U, own) - S).sum())
        return X, U, t, cost

    @property
    def max_iter(self) -> float:
        """The solver's limit of iterations, where it is known."""
        name = f"{self.backend}.max_iter"
        return float(dict(self.options).get(name, BACKENDS.get(self.backend, {}).get(name, np.inf)))

    @cached_property
    def warm(self) -> Transcription:
        """The same program for guesses that are solutions of problems nearby."""
        return replace(self, options=tuple({**WARM.get(self.backend, {}), **dict(self.options)}.items()))

    @cached_property
    def second(self) -> Transcription:
        """The same program for IPOPT, which tells an infeasible problem from an unfinished solve."""
        return replace(self, backend="ipopt", options=(), compiled=None)

    def violation(self, g: Array, t: Array) -> tuple[float, str]:
        """(largest violation of a constraint, scaled; how much, in its unit, of what, state, node, time)."""
        excess = np.maximum(self.bounds["lbg"] - g, g - self.bounds["ubg"])
        excess = np.where(np.isnan(excess), np.inf, excess)
        row = int(np.argmax(excess))
        what, node = self.row_titles[row]
        return float(excess[row]), f"{excess[row] * self.scales.g[row]:.3g} of {what} at node {node}, t = {t[node]:.4g}"

    @cached_property
    def dips(self) -> Dips:
        """What its hard inequalities along the trajectory dip by between nodes."""
        of = self.functions
        soft = np.array([name in self.eased for name in of.rows.names], dtype=bool)
        return Dips(of, of.rows.column / ca.DM(of.scales), of.rows.equal | soft, self.substeps, self.integrator)

    @cached_property
    def elastic(self) -> Transcription:
        """The same program, all constraints soft, for IPOPT: what comes nearest to holding them."""
        return replace(self, backend="ipopt", options=(), compiled=None, eased=self.ocp.constraint_names)

    def worst_slack(self, t: Array, x: Array, u: Array, p: Array | None) -> tuple[float, str]:
        """(the largest violation of a soft constraint, as a share of its scale; how much, in its unit, of what, where).
        """
        S, held = self.needed(t, x, u, np.zeros(0) if p is None else p), self.held
        node, j = np.unravel_index(int(np.argmax(S)), S.shape)
        block, i = next((b, int(np.flatnonzero(b.slack[:, j])[0])) for b in (held.x, held.u, held.end)
                        if len(b) and b.slack[:, j].any())
        return float(S[node, j]), (f"{block.rows.title(i)} is exceeded by {S[node, j] * block.scales[i]:.3g} at node "
                                   f"{node}, t = {t[node]:.4g}")


def _at_zero(function: ca.Function) -> None:
    function(*(ca.DM.zeros(function.sparsity_in(i)) for i in range(function.n_in())))


def outcome_of(stats: dict[str, Any], limited: bool = False) -> str:
    """How a solve ended, a key of OUTCOMES where CasADi's name is one; limited: it used all its iterations."""
    if "Infeasible" in str(stats.get("return_status", "")):  # IPOPT's own status: CasADi's name does not tell
        return INFEASIBLE
    if limited and not stats.get("success"):
        return STOPPED
    return str(stats.get("unified_return_status", ""))


def words(stats: dict[str, Any], outcome: str) -> str:
    """The outcome in words, with the solver's own status."""
    status, plain = stats.get("return_status", ""), OUTCOMES.get(outcome, outcome.lower())
    return f"{plain} ({status})" if isinstance(status, str) and status else plain
