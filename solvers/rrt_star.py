"""RRT* by OMPL in the Dubins state space, for kinematic cars: shortest paths round what an OCP's constraints forbid.

RRT* knows lengths, not costs: of the OCP it takes the turning radius, the box of positions, the path constraints and
the goal. Its path is driven at constant speed, so that it ends at the horizon, and can be judged like any plan.

Sources: Karaman and Frazzoli, Sampling-based algorithms for optimal motion planning, Int. J. Robot. Res. 30 (2011);
Dubins (1957); Sucan, Moll and Kavraki, The Open Motion Planning Library, IEEE Robot. Autom. Mag. 19 (2012).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array

try:
    from ompl import base, geometric, util
except ImportError as error:
    raise ImportError(f"RRT* needs OMPL ({error}): pip install 'nocl[ompl]'") from error

ITERATIONS = 200  # of `standard`: the larger of the paper's two budgets
PROBES = 256  # points at which f is compared with a car's
SLACK = 1e-6  # of a path's driving speed over the car's largest


@dataclass(frozen=True, eq=False)
class Path:
    """A path that RRT* found, at equal steps of arc length, or why there is none."""

    x: Array  # [K+1, 3], NaN without a path
    alpha: Array  # [K], steering ratio on each step
    length: float  # m, inf without a path
    iterations: int
    seconds: float
    message: str  # "" or why there is none


class RRTStar:
    """Plan from each state with a fixed budget: `seconds`, or `iterations`, of RRT*.

    Parameters
    ----------
    ocp : OCP on a car, xdot = [v cos psi, v sin psi, alpha v / r], u = [v, alpha] with v >= 0 and |alpha| bounded alike
        on both sides; path constraints in any of its states. ValueError for any other system.
    iterations, seconds : one of them
    tolerance : how far from the goal, in OMPL's distance (length of the Dubins curve, m), a path may end
    intervals : K, equal steps of the path that is handed out
    """

    def __init__(self, ocp: OCP, *, iterations: int | None = None, seconds: float | None = None,
                 tolerance: float = 1e-3, intervals: int = 400, seed: int = 0) -> None:
        checks.problem(ocp, "RRTStar")
        ocp.refuse_parameters("RRTStar")
        ocp.refuse_constraints("RRTStar")
        ocp.refuse_without_goal("RRTStar")
        owner = f"RRTStar on {ocp.system.name!r}"
        if (iterations is None) == (seconds is None):
            raise ValueError(f"{owner}: iterations is {iterations!r}, seconds {seconds!r}; expected one of them")
        for name, value in (("iterations", 1 if iterations is None else iterations), ("intervals", intervals),
                            ("seed", seed + 1)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{owner}: {name} is {value!r}; expected a positive integer")
        self.ocp, self.iterations, self.intervals, self.seed = ocp, iterations, intervals, seed
        self.seconds = None if seconds is None else checks.number(seconds, "seconds", owner, positive=True)
        self.tolerance = checks.number(tolerance, "tolerance", owner, positive=True)
        self.r, self.v_max, self.alpha_max = _car(ocp)

    def solve(self, x0: ArrayLike, *, progress: bool = False) -> Solution:
        """A path for each x0 [3] or [B, 3], as controls to be driven in open loop; cost is the OCP's along it.

        success: a path to the goal (within `tolerance`) that holds the path constraints at every node and can be driven
        within the horizon. The same seed and iterations give the same path.
        """
        rows, _ = checks.states(x0, 3, self.ocp.system.name)
        paths = [self.path(x, k) for k, x in enumerate(tqdm(rows, "RRT*", disable=not progress, leave=False))]
        h, K = self.ocp.horizon / self.intervals, self.intervals
        x, u = np.stack([p.x for p in paths]), np.full((len(rows), K, 2), np.nan)
        message = np.array([p.message or self._too_long(p) for p in paths])
        for k, p in enumerate(paths):
            u[k] = np.c_[np.full(K, p.length / self.ocp.horizon), p.alpha]
        success = np.array([not m for m in message])
        L = self.ocp.L(x[:, :-1].reshape(-1, 3).T, u.reshape(-1, 2).T).full().reshape(len(rows), K).sum(axis=1) * h
        cost = np.where(success, L + self.ocp.G(x[:, -1].T).full().ravel(), np.inf)
        blank = Solution.blank(np.tile(np.linspace(0.0, self.ocp.horizon, K + 1), (len(rows), 1)), 3, 2)
        return replace(blank, x=x, u=u, cost=cost, success=success, message=message,
                       seconds=np.array([p.seconds for p in paths]), iterations=np.array([p.iterations for p in paths]))

    def path(self, x0: Array, number: int = 0) -> Path:
        """The best path from one state; `number` varies the seed from state to state."""
        start = time.perf_counter()
        with _quiet():
            util.RNG.setSeed(1 + self.seed * 1_000_003 + number)  # OMPL's generator is the process's; seeds start at 1
            setup = self._setup(x0)
            planner = geometric.RRTstar(setup.getSpaceInformation())
            setup.setPlanner(planner)
            setup.solve(self._budget(planner))
            seconds, done = time.perf_counter() - start, int(planner.numIterations())
            if not setup.haveExactSolutionPath():
                return self._none(done, seconds, "no path to the goal was found within the budget")
            x = self._nodes(setup)
        steps = np.diff(x, axis=0)
        turn = (steps[:, 2] + math.pi) % (2 * math.pi) - math.pi
        length = float(setup.getSolutionPath().length())
        x[1:, 2] = x[0, 2] + np.cumsum(turn)
        worst = self.ocp.h(x.T).full().min(initial=np.inf)
        if worst < 0:
            return self._none(done, seconds, f"the path violates a path constraint by {-worst:.3g} between its checks")
        alpha = np.clip(turn * self.r * self.intervals / length, -self.alpha_max, self.alpha_max)
        return Path(x, alpha, length, done, seconds, "")

    def _nodes(self, setup: Any) -> Array:
        """[K+1, 3], by equal arc length."""
        space, states = setup.getStateSpace(), setup.getSolutionPath().getStates()
        ends = np.r_[0.0, np.cumsum([space.distance(a, b) for a, b in pairwise(states)])]
        here, nodes = space.allocState(), []
        for s in np.linspace(0.0, ends[-1], self.intervals + 1):
            k = min(int(np.searchsorted(ends, s, side="right")) - 1, len(states) - 2)
            space.interpolate(states[k], states[k + 1], float((s - ends[k]) / (ends[k + 1] - ends[k])), here)
            nodes.append([here.getX(), here.getY(), here.getYaw()])
        return np.array(nodes)

    def _setup(self, x0: Array) -> Any:
        s = self.ocp.system
        space, box = base.DubinsStateSpace(self.r / self.alpha_max), base.RealVectorBounds(2)
        for i in range(2):
            box.setLow(i, float(s.lbx[i]))
            box.setHigh(i, float(s.ubx[i]))
        space.setBounds(box)
        setup = geometric.SimpleSetup(space)
        setup.setStateValidityChecker(self._valid(space))
        states = []
        for x in (x0, np.asarray(self.ocp.x_goal)):
            state = space.allocState()
            state.setX(float(x[0]))
            state.setY(float(x[1]))
            state.setYaw(float((x[2] + math.pi) % (2 * math.pi) - math.pi))
            states.append(state)
        setup.setStartAndGoalStates(*states, self.tolerance)
        return setup

    def _valid(self, space: Any) -> Callable[[Any], bool]:
        h = self.ocp.h
        if not self.ocp.h_titles:
            return lambda state: bool(space.satisfiesBounds(state))
        buffer, run = cast(Any, h.buffer())  # CasADi without conversions: the check is called some 10,000 times a path
        x, values = np.zeros(3), np.zeros(h.numel_out(0))
        buffer.set_arg(0, memoryview(x))  # type: ignore[arg-type]
        buffer.set_res(0, memoryview(values))  # type: ignore[arg-type]

        def valid(state: Any) -> bool:
            x[0], x[1], x[2] = state.getX(), state.getY(), state.getYaw()
            run()
            return bool(values.min() >= 0) and bool(space.satisfiesBounds(state))

        valid.keep = (buffer, x, values)  # type: ignore[attr-defined]
        return valid

    def _budget(self, planner: Any) -> Any:
        if self.iterations is None:
            return base.timedPlannerTerminationCondition(self.seconds)
        return base.PlannerTerminationCondition(lambda: planner.numIterations() >= self.iterations)

    def _too_long(self, path: Path) -> str:
        speed = path.length / self.ocp.horizon
        return "" if speed <= self.v_max * (1 + SLACK) else \
            f"the path of {path.length:.3g} m needs the speed {speed:.3g}, above {self.v_max:g}, to end at the horizon"

    def _none(self, iterations: int, seconds: float, why: str) -> Path:
        return Path(np.full((self.intervals + 1, 3), np.nan), np.full(self.intervals, np.nan), math.inf, iterations,
                    seconds, why)


def standard(ocp: OCP, seed: int) -> RRTStar:
    """RRT* as the command line makes it."""
    return RRTStar(ocp, iterations=ITERATIONS, seed=seed)


def _car(ocp: OCP) -> tuple[float, float, float]:
    """(r, largest v, largest |alpha|) of a car; ValueError for any other system."""
    s = ocp.system
    remedy = (f"RRTStar plans for kinematic cars, xdot = [v cos psi, v sin psi, alpha v / r] with u = [v, alpha], like "
              f"nocl.load_ocp('dubins'); {s.name!r}")
    if (s.nx, s.nu) != (3, 2):
        raise ValueError(f"{remedy} has {s.nx} states and {s.nu} controls: use NMPC, DDP or nocl.train")
    rng = np.random.default_rng(0)
    x, u = rng.uniform(s.lbx, s.ubx, (PROBES, 3)), rng.uniform(s.lbu, s.ubu, (PROBES, 2))
    f, psi, v, alpha = ocp.functions.f(x.T, u.T).full(), x[:, 2], u[:, 0], u[:, 1]
    curvature = float(f[2] @ (v * alpha) / ((v * alpha) @ (v * alpha)))
    car = np.array([v * np.cos(psi), v * np.sin(psi), curvature * v * alpha])
    if curvature <= 0 or not np.allclose(f, car, rtol=1e-9, atol=1e-9):
        raise ValueError(f"{remedy} has other equations: use NMPC, DDP or nocl.train")
    if s.lbu[0] < 0 or s.ubu[0] <= 0 or not math.isclose(-s.lbu[1], s.ubu[1], rel_tol=1e-9):
        raise ValueError(f"{remedy} has v in [{s.lbu[0]:g}, {s.ubu[0]:g}], alpha in [{s.lbu[1]:g}, {s.ubu[1]:g}]; "
                         "expected v >= 0 (a Dubins car has no reverse gear) and equal turns to both sides")
    return 1 / curvature, float(s.ubu[0]), float(s.ubu[1])


@contextmanager
def _quiet() -> Iterator[None]:
    """OMPL logs to the console; its level is the process's, so it is put back."""
    level = util.getLogLevel()
    util.setLogLevel(util.LogLevel.LOG_NONE)
    try:
        yield
    finally:
        util.setLogLevel(level)
