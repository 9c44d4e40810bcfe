"""Batched control-limited differential dynamic programming with exact second derivatives, in C generated from CasADi.

Notation: z = (x, u); K RK4 intervals on [t0, T], u held on each, as NMPC has it; a problem of the batch is a pair
(x0, t0), with parameters p where the problem has some: data, no states. V, V_x, V_xx are the cost-to-go at the nodes
and its derivatives, u + gain (x' - x) is the locally optimal feedback.

Sources: Jacobson and Mayne, Differential Dynamic Programming (1970); Tassa, Mansard and Todorov, Control-limited
differential dynamic programming, ICRA 2014.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from dataclasses import replace
from functools import cache, cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl.data import Solution
from nocl.definition import discrete
from nocl.definition.constraints import TOLERANCE
from nocl.definition.functions import Functions
from nocl.definition.ocp import OCP
from nocl.definition.substeps import COARSE, INTEGRATORS, RK4, STABLE, STARTS, TRIED, Grid, Steps, enduring, settled
from nocl.solvers.between import EXCHANGES, MOST, SAME, Dips
from nocl.solvers.ddp.augmented import Augmented
from nocl.solvers.ddp.batch import Job, Piece, assembled, by_length, of_lengths, pieces, stretched
from nocl.solvers.ddp.constraints import ConstraintRows, rows_of
from nocl.solvers.ddp.free import FreeTime, lifted, with_horizons
from nocl.solvers.ddp.kernel import ddp_source, pack_weights
from nocl.solvers.ddp.smoothing import continued, in_own_cost, regularised, weights_for, with_weight
from nocl.solvers.ddp.without_compiler import ddp_kernel
from nocl.solvers.ddp.work import CONVERGED, GROWTH, DDPSettings, Work
from nocl.solvers.grid import fastest_at_start, firsts, followed, measured
from nocl.solvers.starts import middle, random_start
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.support.pool import Journal, Pool, stream
from nocl.support.progress import shown

if TYPE_CHECKING:
    from nocl.sysid.identification import LearnedDynamics


FIRST, FEW = 4, 12  # substeps, and starts of each state, by which it is found out how fast a plant without a goal gets


class DDP:
    """Solve batches of an OCP's problems from any (x0, t0); path constraints hold exactly.

    Parameters
    ----------
    ocp : OCP
    intervals : int, optional
        K, the number of held controls on [t0, T]. Default: 80; in discrete time one a step, and no other number.
    substeps : int, optional
        Steps in each interval. Default: 1, or where a few solutions from the OCP's initial states show that this is
        too coarse for the plant, as many as they ask for, and as keep initial states under held controls from running
        away (nocl/definition/substeps.py); a warning says so.
    integrator : "rk4" or "radau", optional
        Explicit Runge-Kutta steps, or implicit ones (Radau IIA, 3 stages), which stiff systems need. Default: implicit
        where substeps are left to nocl too, and explicit ones would be many; the warning says so.
    dynamics : LearnedDynamics, optional
        f_theta in place of the exact f; its networks' derivatives are generated C too.
    constraints : "hard", "elastic" or "soft"
        "hard": they hold at every node, to 1e-9 of their scales (OCP.constraint_scales), by the multipliers of an
        augmented Lagrangian; where no plan was found that holds them success is False, and the message names one.
        "elastic": the same, but a violation has a price: where holding them would cost more, they are left by as little
        as pays, and the message says so; the cost has the price in it. "soft": they enter by the OCP's penalty, and
        nothing is held.
    between : bool, optional
        Whether they hold between nodes too, all but exactly: by margins at the nodes, exchanged twice, each time for as
        much as the plan dips between them. Default: no; but `solve_globally` does so where constraints are hard.
    threads : int, optional
        Default: all cores.
    rows : ConstraintRows, optional
        In place of the problem's own constraints.
    cache : folder for compiled kernels, optional
        Default: the folder that NOCL_CACHE names, or else one that goes with the process.

    Controls that the Hamiltonian is linear in (`OCP.flat_controls`) are solved with a small quadratic term
    (nocl/solvers/ddp/smoothing.py) where the horizon is a number; costs are those of the problem without it.
    """

    def __init__(self, ocp: OCP, *, intervals: int | None = None, substeps: int | None = None,
                 integrator: str | None = None, dynamics: LearnedDynamics | None = None,
                 settings: DDPSettings | None = None, constraints: str = "hard", between: bool | None = None,
                 threads: int | None = None, cache: str | os.PathLike[str] | None = None,
                 rows: ConstraintRows | None = None) -> None:
        checks.problem(ocp, "DDP", discrete=True)
        for name, value in (("intervals", intervals), ("substeps", substeps), ("threads", threads)):
            checks.whole(1 if value is None else value, name, "DDP", 1)
        if ocp.system.is_discrete:
            _check_steps(ocp, substeps, integrator, between, dynamics)
        elif integrator is not None:
            checks.word(integrator, INTEGRATORS, "integrator", "DDP")
        checks.word(constraints, ("hard", "elastic", "soft"), "constraints", "DDP")
        if constraints == "soft":
            ocp.refuse_constraints("DDP with constraints='soft'", "take constraints='hard', or solve it by NMPC")
        if dynamics is not None:
            ocp.refuse_free("DDP on learned dynamics")
        if settings is not None:
            checks.instance(DDPSettings, settings, "settings", "DDP", "DDPSettings(max_iterations=...)")
        self.ocp, self.settings = ocp, settings or DDPSettings()
        self.intervals = discrete.intervals_of(ocp, intervals, "DDP")
        self.smoothed = bool(ocp.flat_controls) and not ocp.is_free
        self.posed = _posed(ocp, self.smoothed)  # what the kernel solves
        self.constraints, self.dynamics, self.cache = constraints, dynamics, cache
        self.between = None if between is None else checks.flag(between, "between", "DDP")
        self.margin: Array | None = None  # see `inside`
        self.checked = self.coarse = False  # whether the grid was held against the plant, and is too coarse for it
        self.left = substeps is None  # whether the grid was left to nocl
        self.threads = int(threads or os.cpu_count() or 1)
        self.evaluations: Counter[str] = Counter()  # of f in this process, one for each state: "rollout", "backward"
        net = None if dynamics is None else _fitting(ocp, dynamics)
        self._weights = np.zeros(1) if net is None else pack_weights(net)
        self.integrator, self.substeps = \
            Steps(integrator or RK4, int(substeps)) if substeps and not ocp.system.is_discrete else \
            steps_for(ocp, dynamics, self.intervals, COARSE, integrator)
        self._own_rows = rows is not None
        given = rows_of(self.posed) if rows is None else rows
        self.rows = ConstraintRows() if constraints == "soft" else given
        self.held = self.rows.count(self.intervals)  # how many rows a plan has that multipliers hold
        self.kernel = ddp_kernel(self.posed, dynamics, cache, self.substeps, self._multiplied,
                                 self.integrator)
        self._lb, self._ub = np.ascontiguousarray(ocp.system.lbu), np.ascontiguousarray(ocp.system.ubu)

    @cached_property
    def weighed(self) -> bool:
        """Whether costs are about a goal, and weigh each control: Gauss-Newton has their curvature."""
        of = self.posed.functions
        bends = ca.diag(ca.hessian(of.running, of.arguments["u"])[0])
        return self.ocp.has_goal and not any(bends[i].is_zero() for i in range(bends.numel()))

    @cached_property
    def weights(self) -> tuple[float, ...]:
        """Of the quadratic term in flat controls, those that solutions are continued through."""
        x0, p = firsts(self.ocp)
        few = Piece("few", 0, x0, np.zeros(len(x0)), {}, False, p)
        return weights_for(self.ocp, self.posed, self._descended, few)

    @property
    def _multiplied(self) -> ConstraintRows | None:
        """The rows that multipliers hold, none or not; None where the kernel knows of no such rows."""
        return self.rows if self.held or self.ocp.is_free else None

    def __getstate__(self) -> dict[str, Any]:
        if self._own_rows:
            raise ValueError("a DDP that was given rows of its own cannot go to another process, whose symbols differ; "
                             "expected the constraints of its problem: leave `rows` out, or use workers of this one")
        return {"ocp": self.ocp, "intervals": self.intervals, "substeps": self.substeps,
                "integrator": self.integrator, "dynamics": self.dynamics, "settings": self.settings,
                "constraints": self.constraints, "between": self.between, "threads": self.threads, "cache": self.cache,
                "margin": self.margin, **({"weights": self.weights} if self.smoothed else {})}

    def __setstate__(self, options: dict[str, Any]) -> None:
        found: dict[str, Any] = {name: options.pop(name) for name in ("margin", "weights") if name in options}
        DDP.__init__(self, **options)  # the kernel is built, or found in the cache, where it is needed
        self.__dict__.update(found)

    def inside(self, margin: Array) -> DDP:
        """The same solver, which holds each row further inside, by a share of its scale [rows of a stage, then of the
        end]."""
        n, other = len(self.rows.stage) + len(self.rows.end), self._with_threads(self.threads)
        other.margin = checks.vector(margin, n, "margin", "DDP.inside")
        other.__dict__.pop("key", None)  # it is another solver
        return other

    def solve(self, x0: ArrayLike, t0: ArrayLike = 0.0, *, u: Array | None = None, x: Array | None = None,
              gain: Array | None = None, t: Array | None = None, p: Any = None, curvature: bool = False,
              workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
              progress: bool | None = None) -> Solution:
        """Descend from a guess u [B, K, nu] (default u*), followed with u + gain (x' - x) where x and gain are given.

        Parameters
        ----------
        x0 : [nx] or [B, nx]
        t0 : number or [B], each < horizon; 0 where that is free; in discrete time samples, whole numbers of dt
        t : nodes [B, K+1] of the guess, whose last one says its horizon; where that is free, default: a middling one
        p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
        curvature : whether to return V_xx
        workers : "auto" (this process, `threads` of it), a number of threads, or "tcp://...", a Dask scheduler
        out : a folder that gets each piece of the batch as soon as it is solved: the same call resumes what is there
        progress : on stderr: a bar on a terminal, else a line every 10 s; default: True

        Raises ValueError before any work for wrong shapes, x0 that is not finite and t0 outside [0, horizon). A problem
        whose guess blows up, or that finds no minimum, has success False, cost inf and a message; the others go on.
        Rows do not depend on each other, nor on `workers`. In discrete time a row that starts later has fewer steps:
        its last node stands until K, at the time T, under its last control.
        """
        rows, _ = checks.states(x0, self.ocp.system.nx, self.ocp.system.name)
        rows = np.ascontiguousarray(rows)
        values = self.ocp.parameters_of(p, len(rows), "DDP")
        curvature = checks.flag(curvature, "curvature", "DDP.solve")
        times, (pool, here) = self._start_times(t0, len(rows)), self._where(workers)
        guess = self._guesses(len(rows), u=u, x=x, gain=gain, t=t)
        journal = Journal(None if out is None else Path(out),
                          self._run_key(rows, times, values, guess, curvature) if out else "", "DDP")
        show = shown(progress)
        tasks = pieces(self, rows, times, guess, curvature, values)
        solution = assembled(len(rows), stream(Job(here), tasks, pool, journal, show, f"DDP, {self.ocp.system.name}"))
        return self._held_against_plant(solution)

    def _held_against_plant(self, solution: Solution) -> Solution:
        """Warns, once, where the first solutions show a grid that is too coarse; rows far off fail if it was nocl's."""
        functions, soft = _functions(self.ocp, self.dynamics), self.constraints == "soft"
        if not self.checked and solution.success.any():
            self.checked = True
            grid = measured(self.ocp, functions, solution, self.substeps, self.integrator, soft)
            self.coarse = grid is not None and grid.coarse
            if self.coarse:
                warnings.warn(f"DDP of {self.ocp.system.name}: {grid}", stacklevel=3)
        lost = self.coarse and self.left
        return followed(self.ocp, functions, solution, self.substeps, self.integrator, soft) if lost else solution

    def descend(self, batch: Piece) -> Solution:
        """Solve one piece of a batch, here; in discrete time each problem on as many intervals as it has steps."""
        if not self.ocp.system.is_discrete:
            return self._solved(batch)
        left = self.intervals_from(batch.t0)
        return by_length(batch, self.intervals, left, lambda n, part: self.lasting(n)._solved(part))

    def intervals_from(self, t0: Array) -> NDArray[np.int64]:
        """[B], how many intervals there are from t0 [B] on: in discrete time the steps that are left."""
        dt = self.ocp.system.dt
        done = np.zeros(len(t0)) if dt is None else np.round(t0 / dt)
        return self.intervals - done.astype(np.int64)

    def lasting(self, n: int) -> DDP:
        """The same solver, by the same kernel, of problems with n intervals."""
        if n == self.intervals:
            return self
        other = self._with_threads(self.threads)
        other.intervals, other.held = n, self.rows.count(n)
        other.__dict__.pop("key", None)  # it is another solver
        return other

    def _solved(self, batch: Piece) -> Solution:
        """A piece solved on this solver's intervals."""
        if self.smoothed:
            found = continued(self._descended, batch, self.weights)
            return in_own_cost(self.ocp, self.posed, found, self.weights[-1])
        return self._descended(batch)

    def _descended(self, batch: Piece, weight: float | None = None) -> Solution:
        """A piece solved; weight : of the quadratic term, where there is one; default: the last."""
        work = self._work(batch.x0, batch.t0, batch.guess, batch.p, weight)
        work.descend()
        if not (self.between and isinstance(work, Augmented)):
            return work.solution(batch.curvature)
        self._exchange(work)
        return replace(work.solution(batch.curvature), cut=work.cut)

    def attempt(self, x0: Array, t0: ArrayLike = 0.0, *, p: Array | None = None, iterations: int = 1,
                **guess: Array) -> tuple[Array, Array]:
        """(cost [B] with a price of violations, u [B, K, nu]) after so many iterations from a guess of `solve`'s: what
        to choose among guesses by."""
        brief = self._with_threads(self.threads)
        brief.settings = replace(self.settings, max_iterations=iterations)
        cost, controls = np.empty(len(x0)), np.empty((len(x0), self.intervals, self.ocp.system.nu))
        for batch in pieces(brief, x0, self._start_times(t0, len(x0)), self._guesses(len(x0), **guess), False, p):
            for n, rows, part in of_lengths(batch, self.intervals_from(batch.t0)):
                work = brief.lasting(n)._work(part.x0, part.t0, part.guess, part.p)
                work.most[:] = iterations
                work.descend()
                here = batch.first + rows
                cost[here], controls[here] = work.promise(), stretched(work.u, self.intervals)
        return cost, controls

    def as_best_known(self) -> DDP:
        """The same solver, which holds hard constraints between nodes too, unless it was said whether it does."""
        if self.between is not None or self.constraints != "hard" or self.rows.stage.equal.all():
            return self
        if self.ocp.system.is_discrete:
            return self
        other = self._with_threads(self.threads)
        other.between = True
        other.__dict__.pop("key", None)  # it is another solver
        return other

    def _exchange(self, work: Augmented) -> None:
        """Hold constraints between nodes, by margins at them."""
        dips, u = self._dips, self.posed.functions.arguments["u"]
        t, left = work.t0[:, None] + work.h[:, None] * np.arange(self.intervals + 1), np.full(len(work.x0), np.inf)
        for number in range(MOST):
            margin = self.rows.margins(dips.margins(t, work.x, work.u, work.p), u)
            work.exchange(work.with_margin(margin))
            with np.errstate(invalid="ignore"):  # plans that failed may be anything
                former, left = left, dips.left(t, work.x, work.u, work.p)
                open_ = (work.state == CONVERGED) & ~(left <= TOLERANCE)
                moved = np.abs(left[open_] - former[open_]) > SAME * former[open_]
            if number + 1 >= EXCHANGES and not moved.any():
                break
        work.cut[:] = open_

    @property
    def _dips(self) -> Dips:
        stage = self.rows.stage
        return Dips(_functions(self.posed, self.dynamics), stage.c, stage.equal, self.substeps,
                    self.integrator)

    def looked_at(self, known: Solution) -> Solution:
        """Solutions of this problem on this grid, with `cut` where this solver holds constraints between nodes."""
        if not self.between or known.cut is not None:
            return known
        T, free = known.t[:, -1], self.ocp.is_free
        t, x = (known.t / T[:, None], with_horizons(known.x, T)) if free else (known.t, known.x)
        p = with_weight(known.p, len(known), self.weights[-1]) if self.smoothed else known.parameters
        return replace(known, cut=known.success & self._dips.cut(t, x, known.u, p))

    def rollout(self, x0: Array, p: Array | None = None, **guess: Array) -> Array:
        """The states [B, K+1, nx] from x0 [B, nx] at t0 = 0 under a guess of `solve`'s: where the descent begins.

        p [B, np], where the problem has parameters.
        """
        given = self._guesses(len(x0), **guess)
        return self._work(np.ascontiguousarray(x0), np.zeros(len(x0)), given, p).x[..., :self.ocp.system.nx]

    def feedback(self, x: Array, u: Array, p: Array | None = None) -> Array:
        """Gains [B, K, nu, nx] of one sweep about x [B, K+1, nx], u [B, K, nu]: those of the OCP's cost, damped until
        it is convex there; 0 where no damping helps. p [B, np], where the problem has parameters."""
        B, s = len(x), self.settings
        work = self._work(np.ascontiguousarray(x[:, 0]), np.zeros(B), {}, p)
        work.x[..., :x.shape[2]], work.u[:] = x, u
        rows = np.arange(B)
        while rows.size:
            work._sweep(rows)
            rows = rows[work.positive[rows] == 0]
            work.mu[rows] = np.maximum(GROWTH * work.mu[rows], s.damping)
            work.gain[rows] = 0.0
            rows = rows[work.mu[rows] <= s.largest_damping]
        return work.gain[..., :x.shape[2]]

    def _work(self, x0: Array, t0: Array, guess: dict[str, Array], p: Array | None,
              weight: float | None = None) -> Work:
        u, x, gain = (guess.get(name) for name in ("u", "x", "gain"))
        p = with_weight(p, len(x0), weight or self.weights[-1]) if self.smoothed else p
        if not self.ocp.is_free:
            return (Augmented if self.held else Work)(self, x0, t0, u, x, gain, p)
        T = guess["t"][:, -1] if "t" in guess else np.full(len(x0), middle(self.ocp.horizon))
        gain = None if gain is None else np.concatenate([gain, np.zeros_like(gain[..., :1])], axis=-1)
        return FreeTime(self, with_horizons(x0, T), t0, u, None if x is None else with_horizons(x, T), gain, p)

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
        shapes = {"u": (B, K, nu), "x": (B, K + 1, nx), "gain": (B, K, nu, nx), "t": (B, K + 1)}
        found = {name: _shaped(value, shapes[name], name) for name, value in given.items() if value is not None}
        if "t" in found:
            self._check_nodes(found["t"])
        return found

    def _check_nodes(self, t: Array) -> None:
        """ValueError for a guess's nodes where the horizon is a number, or that end outside its bounds."""
        horizon = self.ocp.horizon
        if not self.ocp.is_free:
            raise ValueError(f"DDP: the guess has nodes t, but the horizon is {horizon:g}; expected none: leave t out")
        bad = np.flatnonzero(~((t[:, -1] >= horizon.low) & (t[:, -1] <= horizon.high)))
        if bad.size:
            raise ValueError(f"DDP: the guess's t ends at {t[bad[0], -1]:g} in row {bad[0]}; expected a horizon of "
                             f"{horizon!r}")

    @cached_property
    def key(self) -> str:
        """A fingerprint of the problem, the model and the settings."""
        net = None if self.dynamics is None else self.dynamics.net
        source = ddp_source(self.posed, net, self.substeps, self._multiplied, self.integrator)
        return fingerprint(self.ocp.to_data(), source, self._weights, self.intervals, self.settings, self.constraints,
                           *([self.between] if self.between else []), *([] if self.margin is None else [self.margin]),
                           version("nocl"))

    def _run_key(self, x0: Array, t0: Array, p: Array, guess: dict[str, Array], curvature: bool) -> str:
        """A fingerprint of all that the solution depends on."""
        return fingerprint(self.key, x0, t0, *([p] if p.size else []),
                           *(part for pair in sorted(guess.items()) for part in pair), curvature)

    def _start_times(self, t0: ArrayLike, B: int) -> Array:
        given = checks.numeric(t0, "t0", "DDP.solve", f"a number, or one for each of the {B} states")
        if given.shape not in ((), (1,), (B,)):
            raise ValueError(f"t0 has shape {given.shape}; expected a number, or one for each of the {B} states")
        times = np.broadcast_to(given, (B,)).copy()
        if self.ocp.is_free:
            return self._free_start_times(times)
        bad = np.flatnonzero(~((times >= 0) & (times < self.ocp.horizon)))
        if bad.size:
            raise ValueError(f"t0[{bad[0]}] is {times[bad[0]]}; expected 0 <= t0 < horizon = {self.ocp.horizon}")
        if self.ocp.steps is None:
            return times
        first = np.array([discrete.first_step(self.ocp, t, "DDP") for t in times], dtype=np.int64)
        return discrete.samples(self.ocp.system, 0, self.ocp.steps)[first]


    def _free_start_times(self, times: Array) -> Array:
        if times.any():
            raise ValueError(f"t0 is {checks.shown(times)}, but the horizon is free; expected 0: the time that is left "
                             "is found from there")
        return times


def _check_steps(ocp: OCP, substeps: int | None, integrator: str | None, between: bool | None,
                 dynamics: LearnedDynamics | None) -> None:
    """ValueError for what is about continuous time, on a system in discrete time."""
    discrete.check_steps(ocp.system, substeps, integrator, "DDP")
    if between:
        raise ValueError(f"DDP: between is True, and {ocp.system.name!r} is a system in discrete time, where nothing "
                         "is between two nodes; expected none: leave it out, constraints hold at every sample")
    if dynamics is not None:
        ocp.system.refuse_discrete("DDP on learned dynamics")


def _posed(ocp: OCP, smoothed: bool) -> OCP:
    """The problem as the kernel solves it."""
    if ocp.is_free:
        return lifted(ocp)
    return regularised(ocp) if smoothed else ocp


def substeps_for(ocp: OCP, dynamics: LearnedDynamics | None, intervals: int, tolerance: float = COARSE) -> int:
    """As many RK4 steps as solutions from a few initial states ask for, so that they are off by `tolerance` at most."""
    return steps_for(ocp, dynamics, intervals, tolerance, RK4).substeps


@lru_cache(maxsize=32)
def steps_for(ocp: OCP, dynamics: LearnedDynamics | None, intervals: int, tolerance: float = COARSE,
              integrator: str | None = None) -> Steps:
    """The steps that solutions from a few initial states ask for, so that they are off by `tolerance` at most, and with
    which more initial states stay finite under held controls.

    integrator : of these steps alone; None: RK4, or implicit ones where it would take many of those
    """
    if ocp.system.is_discrete:
        return discrete.check_steps(ocp.system, None, integrator, "DDP")
    free = ocp.is_free  # without its constraints a horizon would be as short as it may be
    tried = ocp if ocp.states_only or free else ocp.unconstrained  # a few descents, to see how fast the plant is
    functions, (x0, p) = _functions(tried, dynamics), firsts(ocp)

    @cache
    def ddp_of(intervals: int, steps: Steps) -> DDP:
        ddp = DDP(tried, intervals=intervals, substeps=steps.substeps, integrator=steps.integrator, dynamics=dynamics,
                  constraints="hard" if free else "soft")
        ddp.checked = True
        return ddp

    def solved(steps: Steps) -> Solution:
        ddp = ddp_of(intervals, steps)
        return ddp.solve(x0, p=p, progress=False) if ocp.has_goal else _best_of_few(ddp, x0, p)

    def ask(steps: Steps) -> Grid | None:
        found = solved(steps) if ocp.has_goal else fine()
        return measured(tried, functions, found, steps.substeps, steps.integrator)

    @cache
    def fine() -> Solution:
        """Without a goal optima may be where a coarse grid has none: those of a fine one are asked about."""
        return solved(Steps(substeps=FIRST))

    @cache
    def kept(steps: Steps) -> int:
        """With controls held, substeps are intervals: one kernel has them all."""
        starts, values = firsts(ocp, STARTS)
        one = ddp_of(intervals * steps.substeps, Steps(steps.integrator))
        return int(np.isfinite(one._work(starts, np.zeros(STARTS), {}, values if ocp.np else None).J).sum())

    def stiff() -> bool:
        return step > STABLE * TRIED[-1] * fastest_at_start(ocp, functions, STARTS)

    owner, step = f"DDP of {ocp.system.name}", (middle(ocp.horizon) if free else ocp.horizon) / intervals
    chosen = settled(owner, ask, step, lambda: fastest_at_start(ocp, functions), tolerance, integrator)
    return enduring(owner, chosen, kept, stiff, ask, tolerance, integrator)


def _best_of_few(ddp: DDP, x0: Array, p: Array) -> Solution:
    """The best of FEW starts of each state, of a problem without a goal."""
    B, rng = len(x0), np.random.default_rng(0)
    u = np.concatenate([random_start(ddp.ocp, ddp.intervals, B, rng, number, p) for number in range(FEW)])
    found = ddp.solve(np.tile(x0, (FEW, 1)), u=u, p=np.tile(p, (FEW, 1)) if ddp.ocp.np else None, progress=False)
    best = found.cost.reshape(FEW, B).argmin(axis=0)
    return found[best * B + np.arange(B)]


def _functions(ocp: OCP, dynamics: LearnedDynamics | None) -> Functions:
    return ocp.functions if dynamics is None else ocp.functions.on(dynamics.to_casadi())


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
