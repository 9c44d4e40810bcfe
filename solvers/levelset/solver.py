"""HJB level sets: the value function of an OCP on a grid, by hj-reachability (JAX). Up to 3 states, 4 with a warning.

    V_t + min_{u in U} (L(x, u) + V_x' f(x, u)) = 0,   V(x, T) = G(x),

solved backwards in time: one-sided differences by WENO, each control judged by those on the side that it drives to, TVD
Runge-Kutta under the CFL condition (levelset_scheme.py). Path constraints enter as the OCP's penalty (OCP.L_soft). V is
right where optimal trajectories stay inside the box: beyond its edges V is taken to rise, so that leaving never pays.
Give the box a margin. V's narrowest valleys end at the goal: put it on a node, or let `stretch` do it, and more.

Sources: Osher and Shu, High-order essentially nonoscillatory schemes for Hamilton-Jacobi equations, SIAM J. Numer.
Anal. 28 (1991); Jiang and Peng, Weighted ENO schemes for Hamilton-Jacobi equations, SIAM J. Sci. Comput. 21 (2000).
"""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import NdBSpline, make_interp_spline

from nocl.definition.hamiltonian import minimiser
from nocl.definition.ocp import OCP
from nocl.support import checks, store
from nocl.support.checks import Array
from nocl.support.progress import bar as progress_bar
from nocl.support.progress import shown

try:
    import hj_reachability as hj
    import jax
    import jax.numpy as jnp

    from nocl.solvers.levelset.scheme import (
        INTEGRATORS,
        Dynamics,
        axis,
        eased,
        exact_minimiser,
        lattice,
        sampled_minimiser,
    )
    from nocl.translate.jax_functions import to_jax
except ImportError as error:
    raise ImportError(f"level sets need hj-reachability and JAX ({error}): pip install 'nocl[levelset]'") from error

SCHEMES = {"first": ("first_order", 1), "weno3": ("WENO3", 3), "weno5": ("WENO5", 3)}  # derivative; Runge-Kutta order
PERIOD = 2 * math.pi
SMALLEST = 8  # nodes along an axis
STANDARD = {1: 401, 2: 161, 3: 61}  # nodes along each axis of `standard`, by the number of states
EARLY = 1.5  # the k-th of n slices stands (k / n)^EARLY of the horizon before its end, where V changes fastest


@dataclass(frozen=True)
class Prediction:
    """What a solve will take."""

    points: int
    steps: int
    memory: float  # GB: what XLA allots to a step, the slices kept, and the splines through them
    seconds: float  # steps times a measured step; JAX's compilation is over by then


class LevelSet:
    """V(x, t) of an OCP on a grid.

    Parameters
    ----------
    ocp : OCP with at most 4 states
    grid : numbers of nodes along each state
    box : (lower [nx], upper [nx])
        Default: the system's box [lbx, ubx]. An axis is periodic where it is a declared angle, f, L and G have the
        period 2 pi in it, and the box covers a period: it then spans [lower, lower + 2 pi).
    stretch : [nx]
        Width s of the region round the goal in which cells are narrow, for each state: nodes stand at
        x_goal + s sinh(y), y uniform. inf, the default: uniform in x. The box may grow by up to a cell, so that the
        goal is a node.
    penalty_slope : float
        Path constraints' penalties rise no steeper than this with depth (`eased`): what rises by far more than V within
        a cell is smeared. V is then nowhere too high for it, and right where optima keep as far out as before.
    scheme : "weno3", "weno5" or "first" (order)
    slices : times at which V is kept, denser towards the end
    samples : values of each control that are tried where H is not quadratic in u, refined by bisection from the best
    max_memory : GB
    max_seconds : wall time; both are predicted before the solve starts, which is refused above them
    """

    def __init__(self, ocp: OCP, grid: Sequence[int], *, box: tuple[ArrayLike, ArrayLike] | None = None,
                 stretch: ArrayLike | None = None, penalty_slope: float = math.inf, scheme: str = "weno3",
                 slices: int = 41, cfl: float = 0.75, samples: int = 9, max_memory: float = 4.0,
                 max_seconds: float = 600.0) -> None:
        checks.problem(ocp, "LevelSet")
        ocp.refuse_parameters("LevelSet")
        ocp.refuse_constraints("LevelSet")
        owner = f"LevelSet of {ocp.system.name!r}"
        self.ocp, self.grid = ocp, _checked_grid(grid, ocp.system.nx, owner)
        if scheme not in SCHEMES:
            raise ValueError(f"{owner}: scheme is {scheme!r}; expected one of {', '.join(SCHEMES)}")
        for name, value, least in (("slices", slices, 2), ("samples", samples, 3)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{owner}: {name} is {value!r}; expected an integer >= {least}")
        self.scheme, self.samples = scheme, samples
        self.cfl = checks.number(cfl, "cfl", owner, positive=True)
        self.max_memory = checks.number(max_memory, "max_memory", owner, positive=True)
        self.max_seconds = checks.number(max_seconds, "max_seconds", owner, positive=True)
        lower, upper = (ocp.system.lbx, ocp.system.ubx) if box is None else box
        self.lower, upper = checks.bounds(lower, upper, ocp.system.nx, ("box[0]", "box[1]"), owner,
                                          ocp.system.state_names)
        self.periodic = periodic_axes(ocp, self.lower, upper)
        self.upper = np.where(self.periodic, self.lower + PERIOD, upper)
        self.stretch = self._checked_stretch(stretch, owner)
        self.penalty_slope = math.inf if penalty_slope == math.inf else checks.number(
            penalty_slope, "penalty_slope", owner, positive=True)
        self.t = ocp.horizon * (1 - (np.arange(slices)[::-1] / (slices - 1)) ** EARLY)
        self.solved = ocp if self.penalty_slope == math.inf else eased(ocp, self.penalty_slope)
        self.minimise = exact_minimiser(self.solved) or sampled_minimiser(self.solved, samples)
        goal = np.asarray(ocp.x_goal, dtype=float).ravel()
        self.lattice = tuple(axis(*row) for row in zip(self.lower, self.upper, self.grid, goal, self.stretch,
                                                       self.periodic, strict=True))
        self.lower = np.array([a.nodes[0] for a in self.lattice])
        self.upper = np.where(self.periodic, self.upper, [a.nodes[-1] for a in self.lattice])

    @property
    def exact(self) -> bool:
        """Whether H's minimum over u is exact, and not sampled."""
        return minimiser(self.ocp) is not None

    @property
    def axes(self) -> tuple[Array, ...]:
        """The nodes along each state."""
        return tuple(a.nodes for a in self.lattice)

    def predict(self) -> Prediction:
        """Memory, steps and seconds, by compiling the solver and timing one step; ValueError above a limit."""
        with jax.enable_x64(True):
            return self._ready()[2]

    def solve(self, progress: bool = False) -> LevelSetSolution:
        """V on the grid from T back to 0; ValueError above a limit, or where V ceases to be finite."""
        with jax.enable_x64(True):
            advance, V, prediction = self._ready()
            start, kept, times = time.perf_counter(), [np.asarray(V, dtype=np.float32)], self.t[::-1]
            with progress_bar(round(self.ocp.horizon, 3), "level sets", progress, unit="s") as bar:
                for before, now in itertools.pairwise(times):
                    V = advance(before, V, now)
                    kept.append(np.asarray(V, dtype=np.float32))
                    if not np.isfinite(kept[-1]).all():
                        raise ValueError(f"level sets of {self.ocp.system.name!r}: V is not finite at t = {now:.4g}; "
                                         "expected a smaller cfl, a finer grid or a smaller box")
                    bar.update(before - now)
            seconds = time.perf_counter() - start
        return LevelSetSolution(self, self.t, np.stack(kept[::-1]), seconds, prediction)

    def _ready(self) -> tuple[Callable[..., Any], Any, Prediction]:
        """(advance(t, V, t') -> V at t', V at the horizon, what it will take)."""
        settings = self._settings()
        dynamics = Dynamics(self.solved, self.minimise, self.lattice, self.samples)
        shapes = jax.eval_shape(self._lattice)
        number = jax.ShapeDtypeStruct((), np.float64)
        values = jax.ShapeDtypeStruct(self.grid, np.float64)
        step = hj.step.lower(settings, dynamics, shapes, number, values, number, progress_bar=False).compile()
        memory = self._memory(step)
        if memory > self.max_memory:
            self._refuse(f"max_memory = {self.max_memory:g} GB", f"{memory:.3g} GB", memory / self.max_memory,
                         len(self.grid))
        nodes = self._lattice()
        V = to_jax(self.ocp.G)(nodes.states)[..., 0]
        dt = min(self.cfl / float(dynamics.rate(nodes.states)), self.ocp.horizon)

        def advance(t: float, V: Any, target: float) -> Any:
            return step(settings, nodes, jnp.float64(t), V, jnp.float64(target)).block_until_ready()

        steps = int(np.ceil(np.diff(self.t) / dt).sum())
        seconds = steps * _timed(lambda: advance(self.ocp.horizon, V, self.ocp.horizon - 0.99 * dt))
        if seconds > self.max_seconds:
            self._refuse(f"max_seconds = {self.max_seconds:g} s", f"{seconds:.3g} s ({steps} steps)",
                         seconds / self.max_seconds, len(self.grid) + 1)
        return advance, V, Prediction(math.prod(self.grid), steps, memory, seconds)

    def _settings(self) -> Any:
        derivative, order = SCHEMES[self.scheme]
        return hj.SolverSettings(upwind_scheme=getattr(hj.finite_differences.upwind_first, derivative),
                                 time_integrator=INTEGRATORS[order], CFL_number=self.cfl)

    def _lattice(self) -> Any:
        return lattice(self.lattice, self.periodic)

    def _checked_stretch(self, stretch: ArrayLike | None, owner: str) -> Array:
        nx = self.ocp.system.nx
        widths = np.full(nx, np.inf) if stretch is None else np.asarray(stretch, dtype=float)
        if widths.shape != (nx,) or not (widths > 0).all():
            raise ValueError(f"{owner}: stretch is {stretch!r}; expected {nx} widths > 0, inf for a uniform axis")
        goal = np.asarray(self.ocp.x_goal, dtype=float).ravel()
        for i in np.flatnonzero(np.isfinite(widths)):
            name = self.ocp.system.state_names[i]
            if self.periodic[i]:
                raise ValueError(f"{owner}: stretch[{i}] is {widths[i]:g} and {name} is periodic; expected inf there")
            if not self.lower[i] <= goal[i] <= self.upper[i]:
                raise ValueError(f"{owner}: stretch[{i}] is {widths[i]:g} and the goal {goal[i]:g} lies outside the "
                                 f"box along {name}; expected inf there, or a box round the goal")
        return widths

    def _memory(self, step: Any) -> float:
        """GB: XLA's own account of a step, the slices in float32, and the two splines in use with their making."""
        m = step.memory_analysis()
        points = math.prod(self.grid)
        kept = points * (4 * len(self.t) + 8 * 4)
        return float(m.argument_size_in_bytes + m.output_size_in_bytes + m.temp_size_in_bytes + kept) / 1e9

    def _refuse(self, limit: str, needed: str, factor: float, power: int) -> None:
        smaller = tuple(max(SMALLEST, int(n * (0.95 / factor) ** (1 / power))) for n in self.grid)
        raise ValueError(f"level sets of {self.ocp.system.name!r} on {' x '.join(map(str, self.grid))} nodes would "
                         f"take about {needed}; expected at most {limit}: about {' x '.join(map(str, smaller))} nodes "
                         "fit, or raise the limit")


@dataclass(frozen=True, eq=False)
class LevelSetSolution:
    """V on the grid at times t, and its optimal feedback: a controller (x [B, nx], t) -> u [B, nu].

    V is a cubic spline in x and linear in t between slices, u the Hamiltonian's minimiser for the spline's gradient.
    Outside the box there is no answer: V and u are NaN there, so that a judge sees the failure.
    """

    problem: LevelSet
    t: Array  # [slices], from 0 to the horizon
    V: Any  # [slices, *grid], float32
    seconds: float  # of the solve, JAX's compilation left out
    prediction: Prediction

    def __call__(self, x: ArrayLike, t: float = 0.0) -> Array:
        """u [nu] or [B, nu]."""
        s = self.problem.ocp.system
        rows, single = checks.states(x, s.nx, s.name, "x")
        p, u = self._evaluate(rows, t, gradient=True), np.full((len(rows), s.nu), np.nan)
        inside = np.isfinite(p).all(axis=1)
        u[inside] = self.problem.minimise.rows(rows[inside], p[inside])
        return u[0] if single else u

    def value(self, x: ArrayLike, t: float = 0.0) -> Array | float:
        """V [B], or a number for one state."""
        s = self.problem.ocp.system
        rows, single = checks.states(x, s.nx, s.name, "x")
        V = self._evaluate(rows, t, gradient=False)[:, 0]
        return float(V[0]) if single else V

    def value_gradient(self, x: ArrayLike, t: float = 0.0) -> Array:
        """dV/dx [nx] or [B, nx]."""
        s = self.problem.ocp.system
        rows, single = checks.states(x, s.nx, s.name, "x")
        p = self._evaluate(rows, t, gradient=True)
        return p[0] if single else p

    def _evaluate(self, x: Array, t: float, gradient: bool) -> Array:
        """V [B, 1] or dV/dx [B, nx]; NaN outside the box."""
        problem, nx = self.problem, x.shape[1]
        x = np.where(problem.periodic, problem.lower + (x - problem.lower) % PERIOD, x)
        inside = ((x >= problem.lower) & (x <= problem.upper)).all(axis=1)
        orders = np.eye(nx, dtype=int) if gradient else np.zeros((1, nx), dtype=int)
        last = len(self.t) - 1
        k = min(max(int(np.searchsorted(self.t, t, side="right")) - 1, 0), last - 1)
        part = min(max((t - self.t[k]) / (self.t[k + 1] - self.t[k]), 0.0), 1.0)
        values = np.full((len(x), len(orders)), np.nan)
        values[inside] = sum(weight * np.stack([self._spline(j)(x[inside], nu=tuple(o)) for o in orders], axis=1)
                             for j, weight in ((k, 1 - part), (k + 1, part)) if weight)
        return values

    def _spline(self, k: int) -> NdBSpline:
        """The cubic spline through slice k; the last ones used are kept."""
        if k not in self._splines:
            while len(self._splines) > 1:
                self._splines.pop(next(iter(self._splines)))
            self._splines[k] = _tensor_spline(self.problem.axes, np.asarray(self.V[k], dtype=np.float64),
                                              self.problem.periodic)
        return self._splines[k]

    @cached_property
    def _splines(self) -> dict[int, NdBSpline]:
        return {}

    def save(self, path: str | Path) -> Path:
        """Write V and its times to one file, atomically; `load` needs the same LevelSet."""
        p = self.prediction
        return store.save_checkpoint(path, {"t": self.t, "V": self.V}, {
            "problem": _fingerprint(self.problem), "seconds": self.seconds,
            "prediction": [p.points, p.steps, p.memory, p.seconds]})

    @staticmethod
    def load(path: str | Path, problem: LevelSet) -> LevelSetSolution:
        """What save wrote; ValueError where it is of another problem, grid, box or scheme."""
        state, meta = store.load_checkpoint(path)
        if meta.get("problem") != _fingerprint(problem):
            raise ValueError(f"{path} holds the level sets of another problem or grid; expected those of "
                             f"{problem.ocp.system.name!r} on {problem.grid}: solve again")
        return LevelSetSolution(problem, np.asarray(state["t"]), np.asarray(state["V"]), meta["seconds"],
                                Prediction(*meta["prediction"]))


def standard(ocp: OCP) -> LevelSet:
    """Level sets on the problem's box, as the command line makes them; ValueError for more than 3 states."""
    checks.problem(ocp, "level sets")
    ocp.refuse_parameters("level sets")
    ocp.refuse_constraints("level sets")
    nx = ocp.system.nx
    if nx not in STANDARD:
        raise ValueError(f"level sets of {ocp.system.name!r}: the problem has {nx} states; expected at most "
                         f"{max(STANDARD)}, since the nodes of a grid grow with their power: use nmpc or ddp")
    return LevelSet(ocp, (STANDARD[nx],) * nx)


def standard_solution(ocp: OCP) -> LevelSetSolution:
    """V on that grid, solved."""
    return standard(ocp).solve(progress=shown(None))


@dataclass(frozen=True, eq=False)
class Refinement:
    """V(x, 0) of the same states on finer and finer grids, and its limit as the spacing goes to 0."""

    spacing: Array  # [grids], relative to the coarsest: (n_0 - 1) / (n - 1) of the first axis
    V: Array  # [grids, B]
    seconds: Array  # [grids]

    @property
    def order(self) -> float:
        """q of mean |V_h - V_0| ~ h^q, from the last three grids; NaN with fewer."""
        return float("nan") if len(self.V) < 3 else _order(self.spacing[-3:], self.V[-3:])

    @property
    def limit(self) -> Array:
        """Richardson's extrapolation [B] of the last two grids with the observed order (1, if there are but two)."""
        q = 1.0 if len(self.V) < 3 else min(max(self.order, 1.0), 3.0)
        ratio = (self.spacing[-2] / self.spacing[-1]) ** q
        return np.asarray(self.V[-1] + (self.V[-1] - self.V[-2]) / (ratio - 1))


def refine(ocp: OCP, grids: Sequence[Sequence[int]], x: ArrayLike, **options: Any) -> Refinement:
    """Solve on each grid, coarse to fine, and take V(x [B, nx], 0); options are LevelSet's."""
    if len(grids) < 2:
        raise ValueError(f"refine got {len(grids)} grid; expected at least 2, coarse to fine")
    solutions = [LevelSet(ocp, grid, slices=2, **options).solve() for grid in grids]
    spacing = np.array([(grids[0][0] - 1) / (grid[0] - 1) for grid in grids])
    return Refinement(spacing, np.stack([np.atleast_1d(s.value(x)) for s in solutions]),
                      np.array([s.seconds for s in solutions]))


def _order(h: Array, V: Array) -> float:
    """q for which mean |V_1 - V_2| / mean |V_2 - V_3| = (h_1^q - h_2^q) / (h_2^q - h_3^q), by bisection on [0, 8]."""
    wanted = np.mean(np.abs(V[0] - V[1])) / np.mean(np.abs(V[1] - V[2]))
    low, high = 1e-3, 8.0
    for _ in range(60):
        q = (low + high) / 2
        low, high = (q, high) if (h[0]**q - h[1]**q) / (h[1]**q - h[2]**q) < wanted else (low, q)
    return q


def periodic_axes(ocp: OCP, lower: Array, upper: Array) -> Array:
    """[nx] bool: declared angles whose axis covers a period and in which f, L and G have the period 2 pi."""
    s = ocp.system
    rng = np.random.default_rng(0)
    x, u = rng.uniform(lower, upper, (64, s.nx)), rng.uniform(s.lbu, s.ubu, (64, s.nu))
    of = ocp.functions

    def values(x: Array) -> Array:
        return np.vstack([of.f(x.T, u.T).full(), of.L_soft(x.T, u.T).full(), of.G(x.T).full()])

    here, scale = values(x), 1e-9 * (1 + np.abs(values(x)))
    found = np.zeros(s.nx, dtype=bool)
    for i in s.angle_indices:
        turned = x + PERIOD * np.eye(s.nx)[i]
        same = bool((np.abs(values(turned) - here) <= scale).all())
        found[i] = same and bool(upper[i] - lower[i] >= PERIOD * (1 - 1e-9))
    return found


def _checked_grid(grid: Sequence[int], nx: int, owner: str) -> tuple[int, ...]:
    if nx > 4:
        raise ValueError(f"{owner}: the problem has {nx} states; expected at most 3 (4 with a warning), since a grid "
                         f"of 30 nodes an axis would have {30.0**nx:.1g} nodes: use nocl.train, DDP or NMPC")
    sizes = tuple(grid) if isinstance(grid, (tuple, list)) else ()
    if len(sizes) != nx or any(isinstance(n, bool) or not isinstance(n, int) or n < SMALLEST for n in sizes):
        raise ValueError(f"{owner}: grid is {grid!r}; expected {nx} numbers of nodes >= {SMALLEST}, one for each state")
    if nx == 4:
        warnings.warn(f"{owner}: 4 states: an affordable grid is coarse, and V far less exact than on 3: check it "
                      "against other solutions", stacklevel=3)
    return sizes


def _tensor_spline(axes: Sequence[Array], V: Array, periodic: Array) -> NdBSpline:
    """The cubic spline through V [*grid], not-a-knot, or periodic where its last node is left out."""
    knots, coefficients = [], V
    for i, nodes in enumerate(axes):
        if periodic[i]:
            nodes = np.r_[nodes, nodes[0] + PERIOD]
            coefficients = np.concatenate([coefficients, np.take(coefficients, [0], axis=i)], axis=i)
        one = make_interp_spline(nodes, coefficients, k=3, axis=i, bc_type="periodic" if periodic[i] else None)
        knots.append(one.t)
        coefficients = np.moveaxis(one.c, 0, i)
    return NdBSpline(tuple(knots), np.ascontiguousarray(coefficients), 3)


def _timed(call: Callable[[], Any]) -> float:
    """Seconds of a call, the least of two after the first."""
    call()
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def _fingerprint(problem: LevelSet) -> dict[str, Any]:
    return {"ocp": problem.ocp.to_data(), "grid": list(problem.grid), "lower": problem.lower.tolist(),
            "upper": problem.upper.tolist(), "scheme": problem.scheme, "t": problem.t.tolist(), "cfl": problem.cfl,
            "samples": problem.samples,
            "stretch": [str(w) for w in problem.stretch], "penalty_slope": str(problem.penalty_slope)}
