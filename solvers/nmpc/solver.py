"""NMPC: the reference. Multiple shooting from several starts for each initial state, the best kept, failures told."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.data import Solution, Trajectory
from nocl.definition import discrete
from nocl.definition.ocp import OCP
from nocl.definition.substeps import INTEGRATORS, RADAU, RK4, Grid, Steps, settled
from nocl.judge.laws import check_made_for, dynamics_function
from nocl.solvers.grid import fastest_at_start, followed, measured
from nocl.solvers.lqr import LQR
from nocl.solvers.mirrors import Mirror, mirrors
from nocl.solvers.nmpc import guesses as starting
from nocl.solvers.nmpc.guesses import Guess
from nocl.solvers.nmpc.loop import Loop
from nocl.solvers.nmpc.sensitivity import cost_to_go, dense, second_variation
from nocl.solvers.nmpc.tasks import Outcome, Task, attempt, failure, outside, solved_by, violated_start
from nocl.solvers.nmpc.transcription import BACKENDS, Answer, Transcription
from nocl.solvers.search import Found, Moves, Rows, Search
from nocl.solvers.starts import middle
from nocl.support import checks, compiler
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.support.pool import Journal, Pool, do
from nocl.support.progress import shown

KEPT = 32  # programs kept in memory
PROBES = 3  # states on which more substeps are tried where nothing was solved


@dataclass(frozen=True, eq=False)
class NMPC:
    """min over u_0 ... u_{N-1}, held, of the OCP's cost under RK4 steps, or under the steps of a system in discrete
    time, for each initial state.

    Parameters
    ----------
    ocp : OCP
    intervals : N; default: 80, in discrete time one a step, and no other number
    dynamics : casadi.Function (x, u[, t][, p]) -> xdot, or an object with `to_casadi()`; default: the exact f
    solver : "fatrop" (fast) or "ipopt" (reference); another nlpsol of CasADi's by its name
    substeps : steps in each interval; default: 1, or where the first solutions show that this is too coarse for the
        plant, as many as they ask for (nocl/definition/substeps.py); a warning says so
    integrator : "rk4", or "radau" for implicit steps (Radau IIA, 3 stages), whose stages are variables of the program;
        default: implicit where substeps are left to nocl too, and explicit ones would be many
    horizon : length of the window that is optimised, at most the OCP's horizon T (default); it ends at T at the latest
    terminal : cost at the window's end in place of G: a casadi.Function (x), (x, t) or (x, t, p) -> number, or an
        object with `value_to_casadi()`, such as a trained value function
    starts : guesses tried for each state, beyond those that `solve` is given
    passes : rounds in which states of one batch are solved again from other states' solutions, until a round improves
        nothing; nocl.solvers.search says what a round tries
    neighbours : how many of them are the nearest states', one more in each round
    constraints : "hard": all constraints at the nodes, those that hold the control at the start of each interval, under
        its control, and those of the end at the last node; "soft": the penalty of ocp.L_soft in the cost instead, where
        all are inequalities of (x, t, p)
    between : whether hard inequalities hold between nodes too, all but exactly: by margins at the nodes, exchanged
        twice or more, each time for as much as the plan dips between them; `Solution.cut` where that is not enough
    soft : names of constraints that an exact penalty holds: they are held where they can be, and exceeded where not, by
        as little as may be; `cost` has the penalty in it, and the Solution's `slack` says by how much
    seed : of the random starts
    time_limit : seconds after which a single solve, from one start, is given up and the others go on; default: generous
        beside what the other solves took (at least 10 s)
    options : of the nlpsol, like {"ipopt.tol": 1e-6}
    compiled : compile the program by the C compiler, once: into the folder that is named here, or for True into that
        of the environment's NOCL_CACHE (without it: for as long as the process lives); later constructions load it

    Parameters of the problem are parameters of the program: other values need no other one.

    A second NMPC of an equal problem with equal settings uses the program that the first one built.
    """

    ocp: OCP
    intervals: Any = None  # an int, once it is made
    dynamics: Any = field(default=None, kw_only=True)
    solver: str = field(default="fatrop", kw_only=True)
    substeps: int | None = field(default=None, kw_only=True)
    integrator: str | None = field(default=None, kw_only=True)
    horizon: float | None = field(default=None, kw_only=True)
    terminal: Any = field(default=None, kw_only=True)
    starts: int = field(default=8, kw_only=True)
    passes: int = field(default=4, kw_only=True)
    neighbours: int = field(default=3, kw_only=True)
    constraints: str = field(default="hard", kw_only=True)
    between: bool = field(default=False, kw_only=True)
    soft: Sequence[str] = field(default=(), kw_only=True)
    seed: int = field(default=0, kw_only=True)
    time_limit: float | None = field(default=None, kw_only=True)
    options: Mapping[str, Any] | None = field(default=None, kw_only=True)
    compiled: bool | str | os.PathLike[str] = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        checks.problem(self.ocp, "NMPC", discrete=True)
        fewest = 1 if self.ocp.system.is_discrete else 2
        for name, least in (("intervals", fewest), ("substeps", 1), ("starts", 1), ("passes", 0), ("neighbours", 1)):
            if name not in ("intervals", "substeps") or getattr(self, name) is not None:
                checks.whole(getattr(self, name), name, "NMPC", least)
        if self.integrator is not None and not self.ocp.system.is_discrete:
            checks.word(self.integrator, INTEGRATORS, "integrator", "NMPC")
        checks.whole(self.seed, "seed", "NMPC", most=2**63)
        checks.word(self.constraints, ("hard", "soft"), "constraints", "NMPC")
        checks.flag(self.between, "between", "NMPC")
        self._check_soft()
        if not isinstance(self.solver, str) or (self.solver not in BACKENDS and not _known(self.solver)):
            raise ValueError(f"NMPC: solver is {self.solver!r}; expected {' or '.join(BACKENDS)}, or an nlpsol "
                             "that this CasADi has")
        if not isinstance(self.compiled, bool):
            checks.folder(self.compiled, "compiled (True, False, or a folder)", "NMPC")
        if self.options is not None and not (isinstance(self.options, Mapping)
                                             and all(isinstance(key, str) for key in self.options)):
            raise ValueError(f"NMPC: options is {checks.shown(self.options)}; expected a dict of options of the "
                             'nlpsol by name, like {"ipopt.tol": 1e-6}')
        self._check_window()
        self._set_grid()
        if self.time_limit is not None:
            checks.number(self.time_limit, "time_limit", "NMPC", positive=True)
        if self.dynamics is not None:
            object.__setattr__(self, "dynamics", dynamics_function(self.ocp, self.dynamics))
        object.__setattr__(self, "terminal", _terminal(self.ocp, self.terminal))

    def _set_grid(self) -> None:
        """The intervals, and in discrete time the steps, which are given there."""
        found: dict[str, Any] = {"intervals": discrete.intervals_of(self.ocp, self.intervals, "NMPC", self.horizon)}
        if self.ocp.system.is_discrete:
            steps = discrete.check_steps(self.ocp.system, self.substeps, self.integrator, "NMPC")
            found |= {"substeps": steps.substeps, "integrator": steps.integrator}
            if self.between:
                raise ValueError(f"NMPC: between is True, and {self.ocp.system.name!r} is a system in discrete time, "
                                 "where nothing is between two nodes; expected False: constraints hold at every sample")
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def _check_window(self) -> None:
        if self.horizon is not None and self.ocp.is_free:
            raise ValueError(f"NMPC: horizon is {self.horizon!r}, but that of the problem is {self.ocp.horizon!r}; "
                             "expected one of them: leave it out")
        if checks.number(self.window, "horizon", "NMPC", positive=True) > self.ocp.longest:
            raise ValueError(f"NMPC: horizon is {self.horizon!r}; expected at most {self.ocp.longest:g}, the OCP's")

    def _check_soft(self) -> None:
        """ValueError for names of no constraints, and for the penalty where it says nothing of some."""
        soft = tuple(checks.words(self.soft, "soft", "NMPC"))
        unknown = [name for name in soft if name not in self.ocp.constraint_names]
        if unknown or len(set(soft)) < len(soft):
            raise ValueError(f"NMPC: soft is {list(soft)}; expected names of constraints, each once "
                             f"({', '.join(self.ocp.constraint_names) or 'the problem has none'})")
        object.__setattr__(self, "soft", soft)
        if self.constraints == "soft" and soft:
            raise ValueError(f"NMPC: constraints is 'soft' and soft is {list(soft)}; expected one of them: 'soft' is "
                             "the penalty of ocp.L_soft for all")
        if self.constraints == "soft":
            self.ocp.refuse_constraints("NMPC with constraints='soft'", "name what is soft, NMPC(soft=[...])")

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # without what is cached: it is built again

    @property
    def window(self) -> float:
        """The length of the window that is optimised."""
        return self.ocp.longest if self.horizon is None else self.horizon

    @cached_property
    def key(self) -> str:
        """A fingerprint of the program: of the problem, models and settings that it is built from."""
        options = sorted((self.options or {}).items())
        return fingerprint(self.ocp.to_data(), self.dynamics, self.terminal,
                           int(self.intervals), int(self.substeps or 0), self.constraints, self.solver, options,
                           *([list(self.soft)] if self.soft else []), *([self.between] if self.between else []),
                           *([self.integrator] if self.integrator == RADAU else []))

    @property
    def program(self) -> Transcription:
        """The nonlinear program, built once for each problem and settings."""
        return self.settled._program

    @cached_property
    def _program(self) -> Transcription:
        return shared_program(_Recipe(f"{self.key}{self._folder or ''}", self))

    @property
    def settled(self) -> NMPC:
        """This one, its steps given: those that its solutions so far have asked for, before there are any the first
        that are tried."""
        return self if self.substeps is not None else self._with(self._known.get("steps", self._begin))

    @property
    def _begin(self) -> Steps:
        """What is tried first."""
        return Steps(self.integrator or RK4)

    @property
    def _known(self) -> dict[str, Any]:
        """What solutions have shown: `steps` that they ask for, and whether the grid is still `coarse` with them."""
        found: dict[str, Any] = self._first._program.settled.setdefault(self.integrator or "chosen", {})
        return found

    @property
    def _first(self) -> NMPC:
        return self._with(self._begin)

    def _with(self, steps: Steps) -> NMPC:
        if steps not in self._others:
            self._others[steps] = replace(self, substeps=steps.substeps, integrator=steps.integrator)
        return self._others[steps]

    @cached_property
    def _others(self) -> dict[Steps, NMPC]:
        return {}

    @property
    def _folder(self) -> Path | None:
        """Where compiled code is kept; None: it is not compiled."""
        named = None if isinstance(self.compiled, bool) else self.compiled
        return None if self.compiled is False else compiler.cache_folder(named)

    @cached_property
    def mirrors(self) -> list[Mirror]:
        """Mirror images of the problem, as signs of x - x* and u - u*."""
        return mirrors(self.ocp, self.dynamics)

    def solve(self, x0: ArrayLike, guesses: Any = None, *, p: Any = None, t0: float = 0.0,
              nodes: ArrayLike | None = None, starts: int | None = None, gains: bool = False,
              workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
              progress: bool | None = None) -> Solution:
        """The best solution found from each state x0 [nx] or [B, nx] at time t0.

        Parameters
        ----------
        p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
        guesses : tried first: a Solution or Trajectory nearby (solved with a small barrier: a warm start), controls u
            [B, N, nu], (x [B, N+1, nx], u), a controller (x, t[, p]) -> u whose rollout is meant, or a list of them
        nodes : times of the nodes [N+1]; default: N equal intervals from t0 to the window's end. In discrete time they
            are the samples from t0 on, fewer towards the horizon, and so is the plan
        starts : built-in starts for each state; default: self.starts, or none where guesses are given
        gains : also the Solution's `gain` and `V_xx`; where all constraints are inequalities of (x, t, p), none of them
            soft, and the horizon is a number
        workers : 1, a number of processes, "auto": processes where the measured cost of the first states says that
            they pay; or "tcp://...", a Dask scheduler
        out : a folder that gets each state's outcome as soon as it is there: the same call resumes what is there
        progress : on stderr: a bar on a terminal, else a line every 10 s; default: True

        Returns a Solution with a row for each state, the same for any `workers`. Its `seconds`, `iterations`, `starts`
        and `optima` cover all that was tried. A state without a solution has success False, cost inf, and the message
        of its most feasible start. A state outside X is solved, and its message notes it: X is where samples are drawn
        from, which binds no exact f, but a learned model was not fitted there. Where the horizon is free, each row has
        nodes t of its own. Where constraints cannot be held, the message names the one that the nearest plan exceeds
        most, by how much and at which node.
        Raises ValueError before any solve where shapes do not fit or numbers are not finite.
        """
        s = self.ocp.system
        if s.is_discrete and len(t := self._samples(t0, nodes)) != self.intervals + 1:
            return self._lasting(len(t) - 1).solve(x0, guesses, p=p, nodes=t, starts=starts, gains=gains,
                                                   workers=workers, out=out, progress=progress)
        rows, _ = checks.states(x0, s.nx, s.name)
        if not len(rows):
            raise ValueError(f"x0 has shape {np.shape(x0)}; expected at least one state")
        self._check_gains(gains)
        t, values = self._nodes(t0, nodes), self.ocp.parameters_of(p, len(rows), "NMPC")
        tried = [one for one in (guesses if isinstance(guesses, list) else [guesses]) if one is not None]
        tried.sort(key=lambda one: not _is_solution(one))
        given, warm = [_given(one, self, rows, t, values) for one in tried], sum(map(_is_solution, tried))
        n = checks.whole(starts, "starts", "NMPC.solve") if starts is not None else (0 if given else self.starts)
        if n < 1 and not given:
            raise ValueError(f"starts is {n}; expected at least 1, or guesses")
        show = shown(progress)
        call = _Call(rows, t, values, given, warm, n, self.passes if n else 0, Pool(workers),
                     None if out is None else Path(out), show)
        solution = self._settle(call) if self.substeps is None else self._told(self._search(call))
        return self.with_gains(solution) if gains else solution

    def _settle(self, call: _Call) -> Solution:
        """Solved with as few substeps as the first solutions are right with, which is remembered.

        In a folder all that is asked there begins with 1, so that the same call finds what it left. Where nothing was
        solved, more substeps are first tried on a few states, from one start each.
        """
        known = self._known
        if "steps" in known and call.out is None:
            solution = self.settled._search(call)
            return self._followed(solution, known["steps"]) if known["coarse"] else solution
        functions, step = self._first._program.functions, float(np.diff(call.t).max())
        found, grids = dict[Steps, Solution](), dict[Steps, Grid | None]()

        def ask(steps: Steps) -> Grid | None:
            finer = self._with(steps)
            hope = not found or any(s.success.any() for s in found.values())
            if not hope and not finer._search(call.few()).success.any():
                return None
            s = found[steps] = finer._search(call.within(steps))
            grids[steps] = measured(self.ocp, functions, s, *reversed(steps), self.constraints == "soft")
            return grids[steps]

        steps = settled(f"NMPC of {self.ocp.system.name}", ask, step, lambda: fastest_at_start(self.ocp, functions),
                        integrator=self.integrator)
        grid = grids[steps]
        if any(s.success.any() for s in found.values()):
            known.update(steps=steps, coarse=grid is not None and grid.coarse)
        return self._followed(found[steps], steps) if grid is not None and grid.coarse else found[steps]

    def _followed(self, solution: Solution, steps: Steps) -> Solution:
        functions, soft = self._first._program.functions, self.constraints == "soft"
        return followed(self.ocp, functions, solution, *reversed(steps), soft)

    def _told(self, solution: Solution) -> Solution:
        """The same; a warning, once for each program, where the first solutions show a grid that is too coarse."""
        p = self.program
        if "told" not in p.settled and solution.success.any():
            p.settled["told"] = True
            grid = measured(self.ocp, p.functions, solution, p.substeps, p.integrator, self.constraints == "soft")
            if grid is not None and grid.coarse:
                warnings.warn(f"NMPC of {self.ocp.system.name}: {grid}", stacklevel=3)
        return solution

    def _search(self, call: _Call) -> Solution:
        """Solved with this number of substeps."""
        key = self._run_key(call.x0, call.t, call.p, call.given, call.starts, call.warm) if call.out else ""
        states = _States(self, call, Journal(call.out, key))
        search = Search(states, self.ocp, self.mirrors if call.passes else [], call.x0, call.t,
                        neighbours=self.neighbours, rounds=call.passes, seed=self.seed, p=call.p)
        search.stage("NMPC", search.cold, np.arange(len(call.x0)), 0, call.starts)
        search.improve(call.starts)
        return states.finished(search.solution())

    def _check_gains(self, gains: bool) -> None:
        """ValueError where gains are asked for, and there are none yet."""
        if checks.flag(gains, "gains", "NMPC.solve"):
            self.ocp.refuse_constraints("NMPC with gains", "solve it without gains")
        if gains and self.soft:
            raise ValueError(f"NMPC: gains are not implemented for soft constraints, and soft is {list(self.soft)}; "
                             "expected soft=[], or gains=False")

    def with_gains(self, solution: Solution) -> Solution:
        """A Solution of this NMPC with its feedback `gain` and `V_xx`.

        By a Riccati recursion with the exact second derivatives of the discretised problem; controls at a bound keep
        it (zero gain) and active path constraints stay active.
        """
        self._check_gains(True)
        B, (N, nx, nu) = len(solution.x), (self.intervals, self.ocp.system.nx, self.ocp.system.nu)
        if solution.u.shape != (B, N, nu):
            raise ValueError(f"the solution's u has shape {solution.u.shape}; expected [B, {N}, {nu}], of this NMPC")
        gain, V_xx = np.full((B, N, nu, nx), np.nan), np.full((B, N + 1, nx, nx), np.nan)
        for i in np.flatnonzero(solution.success):
            gain[i], V_xx[i] = second_variation(self.program, solution.t[i], solution.x[i], solution.u[i],
                                                solution.V_x[i], None if solution.p is None else solution.p[i])
        return replace(solution, gain=gain, V_xx=V_xx)

    def controller(self, hold: int | None = None, receding: bool = False) -> Loop:
        """Closed loop u(x, t[, p]), solved again at each call from the shifted last plan.

        hold: how many controls T has (default N); receding: a window that moves on, instead of one that ends at T.
        """
        self.ocp.refuse_free("NMPC.controller")
        return Loop(self, hold, receding)

    def _nodes(self, t0: float, nodes: ArrayLike | None) -> Array:
        if self.ocp.is_free:
            return self._free_nodes(t0, nodes)
        if self.ocp.system.is_discrete:
            return self._samples(t0, nodes)
        T, N = self.ocp.horizon, self.intervals
        t0 = checks.start_time(t0, T)
        t = np.linspace(t0, min(t0 + self.window, T), N + 1) if nodes is None else \
            checks.array(nodes, [N + 1], "nodes", "NMPC.solve")
        if t.shape != (N + 1,) or not (np.diff(t) > 0).all() or t[0] < 0 or t[-1] > T * (1 + 1e-9):
            raise ValueError(f"nodes have shape {t.shape}; expected N + 1 = {N + 1} rising times in [0, {T:g}]")
        if self.horizon is None and t[-1] < T * (1 - 1e-9):
            raise ValueError(f"nodes end at {t[-1]:g}; expected {T:g}, the horizon: give NMPC a shorter `horizon`")
        return t

    def _samples(self, t0: float, nodes: ArrayLike | None) -> Array:
        """The samples of a plan in discrete time, from t0, or the first of the nodes, to the window's end."""
        system, T = self.ocp.system, self.ocp.horizon
        given = None if nodes is None else np.atleast_1d(checks.numeric(nodes, "nodes", "NMPC.solve", "times [N+1]"))
        begin = checks.start_time(t0 if given is None or not given.size else float(given[0]), T)
        first = discrete.first_step(self.ocp, begin, "NMPC.solve")
        steps, n = (discrete.steps_in(system, time, "horizon", "NMPC.solve") for time in (T, self.window))
        t = discrete.samples(system, first, min(first + n, steps))
        if given is not None and not (given.shape == t.shape and np.allclose(given, t, rtol=0, atol=1e-9 * T)):
            raise ValueError(f"nodes are {checks.shown(nodes)}; expected the samples of {system.name!r} from {t[0]:g} "
                             f"to {t[-1]:g}, one a step: leave them out, and give t0")
        return t

    def _lasting(self, n: int) -> NMPC:
        """The same one for plans of n intervals: in discrete time towards the end of the horizon."""
        other = replace(self)
        object.__setattr__(other, "intervals", n)
        return other

    def _free_nodes(self, t0: float, nodes: ArrayLike | None) -> Array:
        """Equal intervals, as long as a middling horizon makes them."""
        if t0 != 0 or nodes is not None:
            raise ValueError(f"NMPC: t0 is {t0!r}, nodes are {checks.shown(nodes)}, but the horizon is free; expected "
                             "t0 = 0 and no nodes: the solver finds where they are")
        return np.linspace(0.0, middle(self.ocp.horizon), self.intervals + 1)

    def _run_key(self, x0: Array, t: Array, p: Array, given: list[list[Guess]], *counts: int) -> str:
        """A fingerprint of all that outcomes depend on."""
        arrays = [*([p] if p.size else []), *(part for guess in given for row in guess for part in row)]
        return fingerprint(self.key, x0, t, *arrays, counts, self.passes, self.neighbours, self.seed, self.time_limit,
                           version("casadi"), version("nocl"))


def _known(solver: str) -> bool:
    """Whether this CasADi has an nlpsol of that name."""
    try:
        return bool(solver.isidentifier() and ca.has_nlpsol(solver))
    except RuntimeError:
        return False


def closed_loop(ocp: OCP, intervals: int | None, seed: int, substeps: int | None = None,
                integrator: str | None = None) -> Loop:
    """NMPC as feedback, as the command line makes it."""
    return NMPC(ocp, intervals, seed=seed, substeps=substeps, integrator=integrator).controller()


@dataclass(frozen=True)
class _Recipe:
    """What a program is built from, known by its key alone."""

    key: str
    nmpc: NMPC = field(compare=False)


@lru_cache(maxsize=KEPT)
def shared_program(recipe: _Recipe) -> Transcription:
    m = recipe.nmpc
    return Transcription(m.ocp, dynamics_function(m.ocp, m.dynamics), int(m.intervals), int(m.substeps or 1),
                         m.constraints == "soft", m.solver, tuple(sorted((m.options or {}).items())), m.terminal,
                         None if m._folder is None else (m.key, m._folder), tuple(m.soft), m.integrator or RK4)


@lru_cache(maxsize=KEPT)
def _lqr(ocp: OCP, p: tuple[float, ...]) -> LQR | None:
    """LQR about the goal at parameters p, or None where there is none."""
    return starting.lqr_of(ocp.folded(np.array(p)))


def _terminal(ocp: OCP, terminal: Any) -> ca.Function | None:
    """The terminal cost as a casadi.Function (x), (x, t) or (x, t, p) -> number."""
    if terminal is None:
        return None
    check_made_for(ocp, terminal, "NMPC: the terminal cost")
    g = terminal.value_to_casadi() if hasattr(terminal, "value_to_casadi") else terminal
    if not isinstance(g, ca.Function):
        raise ValueError(f"NMPC: terminal is a {type(terminal).__name__}; expected a casadi.Function (x) or (x, t) -> "
                         "cost, or an object with value_to_casadi()")
    sizes, every = [g.numel_in(i) for i in range(g.n_in())], [v.numel() for v in ocp.functions.feedback().inputs]
    if not sizes or sizes != every[:len(sizes)] or g.numel_out(0) != 1:
        raise ValueError(f"NMPC: terminal {g.name()} takes vectors of length {sizes} and returns {g.numel_out(0)}; "
                         f"expected (x [{ocp.system.nx}]) or (x, t) -> one number"
                         + (f", or one of (x, t, p [{ocp.np}])" if ocp.np else ""))
    return g


@dataclass(frozen=True, eq=False)
class _Call:
    """One call of solve, checked."""

    x0: Array  # [B, nx]
    t: Array  # [N+1]
    p: Array  # [B, np]
    given: list[list[Guess]]
    warm: int  # how many of these, the first ones, are solutions
    starts: int
    passes: int
    pool: Pool
    out: Path | None
    show: bool

    def within(self, steps: Steps) -> _Call:
        """The same, what it keeps in a folder of its own for other steps than one of Runge and Kutta's."""
        if steps == Steps() or self.out is None:
            return self
        kind = "" if steps.integrator == RK4 else f"-{steps.integrator}"
        return replace(self, out=self.out / f"substeps-{steps.substeps}{kind}")

    def few(self) -> _Call:
        """At most PROBES of its states, from their guesses and one start each; nothing is kept in a folder."""
        some = np.unique(np.linspace(0, len(self.x0) - 1, PROBES).astype(int))
        given = [[guess[i] for i in some] for guess in self.given]
        return replace(self, x0=self.x0[some], p=self.p[some], given=given, starts=min(self.starts, 1), passes=0,
                       out=None)


@dataclass(frozen=True)
class _Job:
    """What a worker does with a task."""

    nmpc: NMPC

    def build(self) -> None:
        self.nmpc.program.solver  # noqa: B018

    def __call__(self, task: Task) -> Outcome:
        program, guesses = self.nmpc.program, list(task.guesses)
        if task.starts and program.free:
            guesses += starting.with_horizons(program, task.x0, task.t, task.begin, task.starts, task.seed, task.p)
        elif task.starts:
            p = () if task.p is None else tuple(task.p.tolist())
            guesses += starting.starts(program, _lqr(self.nmpc.ocp, p), task.x0, task.t, task.begin, task.starts,
                                       task.seed, task.p)
        return attempt(program, task, guesses)


class _States:
    """The states of one call of solve, as a search asks for them: a task for each state and stage."""

    def __init__(self, nmpc: NMPC, call: _Call, journal: Journal) -> None:
        self.nmpc, self.call, self.journal = nmpc, call, journal
        self.x0, self.t, self.p = call.x0, call.t, call.p
        self.refusal = [violated_start(nmpc.program, x, self.t[0], p) for x, p in zip(self.x0, self.p, strict=True)]
        self.failed: list[Answer | None] = [None] * len(self.x0)  # of each state's solves that failed, by rank
        held = nmpc.program.held
        self.between = nmpc.between and bool(len(held.x) + len(held.u))

    def begin(self, stage: int, what: str) -> None:
        self.number, self.what = stage - 1, what

    def cold(self, rows: Rows, first: int, count: int) -> Found:
        """The first time also the guesses that solve was given."""
        name, begun = (f"fresh-{self.number}", True) if self.number else ("start", False)
        given, warm = ([], 0) if begun else (self.call.given, self.call.warm)
        tasks = [Task(f"{name}-{i:06d}", i, self.x0[i], self.t, [guess[i] for guess in given], warm, first, count,
                      self.nmpc.seed, self.nmpc.time_limit, self._own(i), self.between) for i in rows]
        return self._do(tasks)

    def _own(self, i: int) -> Array | None:
        """The parameters of a state."""
        return self.p[i] if self.nmpc.ocp.np else None

    def follow(self, moves: Moves, guess: Callable[[Moves], dict[str, Array]]) -> Found:
        tasks = []
        for i in np.unique(moves.row):
            mine = moves[moves.row == i]
            made = guess(mine)
            guesses = [starting.from_neighbour(self.x0[i], x, u) for x, u in zip(made["x"], made["u"], strict=True)]
            if "t" in made:
                guesses = [(*one, t) for one, t in zip(guesses, made["t"], strict=True)]
            tasks.append(Task(f"round-{self.number}-{i:06d}", int(i), self.x0[i], self.t, guesses,
                              time_limit=self.nmpc.time_limit, p=self._own(i), between=self.between))
        return self._do(tasks)

    def _do(self, tasks: Sequence[Task]) -> Found:
        tasks = [task for task in tasks if not self.refusal[task.row]]
        outcomes = do(_Job(self.nmpc), tasks, self.call.pool, self.journal, self.call.show, self.what)
        for outcome in outcomes:
            best, failed = self.failed[outcome.row], outcome.failed
            if failed is not None and (best is None or failed.rank < best.rank):
                self.failed[outcome.row] = failed
        yield np.array([o.row for o in outcomes], dtype=np.int64), \
            solved_by(self.nmpc.ocp, self.t, outcomes, self.p, self.between)

    def finished(self, found: Solution) -> Solution:
        """What the search found, with V, what solution(t) interpolates, and messages."""
        p, between = self.nmpc.program, np.full((*found.u.shape[:2], 4, 2 * found.x.shape[2]), np.nan)
        message = [why or found.message[i] + outside(p, self.x0[i]) for i, why in enumerate(self.refusal)]
        slack = np.full((*found.x.shape[:2], len(self.nmpc.soft)), np.nan)
        in_steps = self.nmpc.ocp.system.is_discrete  # then there is nothing between two nodes
        for i in range(len(self.x0)):
            row = (found.t[i], found.x[i], found.u[i])
            if found.success[i]:
                own = self._own(i)
                found.V[i] = cost_to_go(p, *row, own)
                if not in_steps:
                    between[i] = dense(p, *row, found.V_x[i], own)
                slack[i] = p.slack(*row, own)
            elif not self.refusal[i]:
                message[i] = failure(p, self.x0[i], int(found.starts[i]), self.failed[i], self._own(i))
        return replace(found, message=np.array(message), dense=None if in_steps else between,
                       slack=slack if self.nmpc.soft else None)


def _is_solution(guess: Any) -> bool:
    return isinstance(guess, (Solution, Trajectory))


def _given(guess: Any, nmpc: NMPC, x0: Array, t: Array, p: Array) -> list[Guess]:
    """A user's guess, checked: states and controls for each x0."""
    s, N, B = nmpc.ocp.system, nmpc.intervals, len(x0)
    check_made_for(nmpc.ocp, guess, "NMPC: the guess")
    if isinstance(guess, tuple) and len(guess) != 2:
        raise ValueError(f"NMPC: the guess is a tuple of {len(guess)}; expected (x [B, N+1, nx], u [B, N, nu])")
    if nmpc.ocp.is_free:
        return _of_free(guess, nmpc, x0, t, p)
    if callable(guess) and not isinstance(guess, Solution):
        return [starting.controller_rollout(nmpc.program, guess, row, t, own)
                for row, own in zip(x0, p, strict=True)]
    x, u = (guess.x, guess.u) if hasattr(guess, "x") and hasattr(guess, "u") else \
        guess if isinstance(guess, tuple) else (None, guess)
    u = _shaped(u, (B, N, s.nu), "the guess's u", "[B, N, nu]")
    if x is not None:
        return list(zip(_shaped(x, (B, N + 1, s.nx), "the guess's x", "[B, N+1, nx]"), u, strict=True))
    return [_rollout(nmpc.program, row, v, t, own) for row, v, own in zip(x0, u, p, strict=True)]


def _of_free(guess: Any, nmpc: NMPC, x0: Array, t: Array, p: Array) -> list[Guess]:
    """A guess where the horizon is free: a Solution or Trajectory, which have one, or (x, u) of a middling one."""
    if not (_is_solution(guess) or isinstance(guess, tuple)):
        raise ValueError(f"NMPC: the guess is a {type(guess).__name__}, which says no horizon, and that is free; "
                         "expected a Solution, a Trajectory, or states and controls (x [B, N+1, nx], u [B, N, nu])")
    s, N, B = nmpc.ocp.system, nmpc.intervals, len(x0)
    x, u = (guess.x, guess.u) if _is_solution(guess) else guess
    nodes = np.broadcast_to(guess.t if _is_solution(guess) else t, (B, N + 1))
    return list(zip(_shaped(x, (B, N + 1, s.nx), "the guess's x", "[B, N+1, nx]"),
                    _shaped(u, (B, N, s.nu), "the guess's u", "[B, N, nu]"), nodes, strict=True))


def _rollout(program: Transcription, x0: Array, u: Array, t: Array, p: Array) -> Guess:
    rolled = program.rolled(x0, u, t, p)
    return (rolled if np.isfinite(rolled).all() else np.tile(x0, (len(u) + 1, 1))), u


def _shaped(value: ArrayLike, shape: tuple[int, ...], what: str, form: str) -> Array:
    array = checks.numeric(value, what, "NMPC", f"{form} = {list(shape)}", copy=False)
    if array.ndim == 2 and shape[0] == 1:
        array = array[None]
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}; expected {form} = {list(shape)}, a row for each x0")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=(1, 2)))[0])
        raise ValueError(f"{what} is not finite in row {row}; expected numbers: leave out rows without a solution")
    return array
