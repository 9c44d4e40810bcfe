"""Global optima by the batch: nocl.solvers.search with DDP, and the cold starts that are DDP's own.

These are u*, the goal held by feedback, and then by turns smooth random controls and, what found most on cart-poles
from anywhere (docs/ddp.md), smooth random controls under the feedback that holds an equilibrium, from a random time on:
a pole that can be caught is, which no open-loop control of an unstable system stumbles on. A problem without a goal has
none to hold, but equilibria, and its random controls are by turns smooth and held over a few parts of the time.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.sampling import Seed
from nocl.judge.laws import dynamics_function
from nocl.solvers.ddp.bank import SolutionBank
from nocl.solvers.ddp.batch import bytes_each
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.mirrors import Mirror, mirrors
from nocl.solvers.search import Found, Guess, Moves, Rows, Search
from nocl.solvers.starts import HALVINGS, near, random_start, smooth, spread_horizon
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.support.progress import bar as progress_bar
from nocl.support.progress import shown

OnMessage = Callable[[str], None]  # told what is being done
DRAWS = 32  # points from which equilibria are looked for
NEWTON = 30  # steps to an equilibrium
CHECKPOINT = "search.safetensors"
BYTES = 2**31  # guesses and answers that are held at a time, beside the best


def solve_globally(ddp: DDP, x0: ArrayLike, *, p: Any = None, starts: int = 16, neighbours: int = 4, rounds: int = 8,
                   seed: Seed = 0, known: Solution | None = None, workers: int | str = "auto",
                   out: str | os.PathLike[str] | None = None, progress: bool | None = None,
                   report: OnMessage = lambda _: None) -> Solution:
    """Solve each problem from cold starts, then from its neighbours' solutions until nothing improves.

    nocl.solvers.search says what a round tries. Hard constraints hold between nodes too, unless the DDP says otherwise
    (`between`).

    Parameters
    ----------
    x0 : [nx] or [B, nx], at t0 = 0
    p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
    starts : cold starts for each state, u held at u* the first of them
    neighbours, rounds : solutions of that many neighbours are tried, of one more in each round
    known : solutions from x0 to begin with; `starts` may be 0 then
    workers, progress : as of DDP.solve
    out : a folder that gets what was found after each stage, and each piece of the stage under way: the same call, with
        the same integer seed, goes on from there

    Returns the best found of each problem; `tried`, `starts`, `hits` and `optima` say how sure that is. Raises
    ValueError for wrong input; a state for which nothing converged has success False.
    """
    rows, ddp = checks.states(x0, ddp.ocp.system.nx, ddp.ocp.system.name)[0], ddp.as_best_known()
    values, known = ddp.ocp.parameters_of(p, len(rows), "solve_globally"), known and ddp.looked_at(known)
    if min(starts + (known is not None), neighbours + 1, rounds + 1) < 1:
        raise ValueError(f"starts is {starts}, neighbours {neighbours}, rounds {rounds}; expected starts >= 1 (0 where "
                         "solutions are known), the others >= 0")
    number, folder = int(np.random.default_rng(seed).integers(2**62)), None if out is None else Path(out)
    key = "" if out is None else fingerprint(ddp.key, rows, number, (starts, neighbours, rounds),
                                             *([] if known is None else [known.u]), *([values] if ddp.ocp.np else []))
    states = _States(ddp, rows, values, number, workers, folder, shown(progress))
    t = np.linspace(0, ddp.ocp.longest, ddp.intervals + 1)  # of a free horizon shares alone count
    search = _Kept(states, mirrors(ddp.ocp, ddp.dynamics), t, folder, key, report, neighbours=neighbours,
                   rounds=rounds, seed=number, known=known, p=values)
    for start in range(starts):
        search.stage(f"cold start {start + 1} of {starts}", search.cold, np.arange(len(rows)), start, 1)
    search.improve(starts)
    return search.solution()


def clean(ddp: DDP, bank: SolutionBank, **options: Any) -> SolutionBank:
    """A bank whose solutions were solved again from each other's until nothing improves; options of solve_globally."""
    known = bank.solution
    found = solve_globally(ddp, known.x[:, 0], p=known.p, **{"starts": 0, **options}, known=known)
    return SolutionBank.of(ddp, found)


@dataclass(frozen=True)
class GlobalDDP:
    """DDP with a global search, as a solver: its `solve(x0)` is the best of `solve_globally`."""

    ddp: DDP
    starts: int = 16
    seed: int = 0

    @property
    def substeps(self) -> int:
        return self.ddp.substeps

    @property
    def ocp(self) -> OCP:
        return self.ddp.ocp

    def solve(self, x0: ArrayLike, workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
              progress: bool | None = None, p: Any = None) -> Solution:
        return solve_globally(self.ddp, x0, p=p, starts=self.starts, seed=self.seed, workers=workers, out=out,
                              progress=progress)


def global_ddp(ocp: OCP, intervals: int | None, seed: int, substeps: int | None = None,
               integrator: str | None = None) -> GlobalDDP:
    """DDP from everywhere, as the command line makes it."""
    return GlobalDDP(DDP(ocp, intervals=intervals, substeps=substeps, integrator=integrator), seed=seed)


class _Kept(Search):
    """A search that tells its stages, and keeps what is known after each in a folder, to go on from there."""

    def __init__(self, solver: _States, mirrors: list[Mirror], t: Array, out: Path | None, key: str, report: OnMessage,
                 **plan: Any) -> None:
        super().__init__(solver, solver.ddp.ocp, mirrors, solver.x0, t, **plan)
        self.folder, self.key, self.report = out, key, report
        self.done = 0  # stages that a run before did
        self._resume()

    def stage(self, what: str, run: Callable[..., None], *args: Any) -> None:
        if self.stages + 1 > self.done:
            self.report(what)
            super().stage(what, run, *args)
            self._keep()
            return
        self.stages += 1
        if self.stages == self.done:
            self.improving = self.was_improving

    def _keep(self) -> None:
        """Write what is known after a stage, then drop the stage's pieces."""
        if self.folder is None:
            return
        from nocl.support import store  # torch

        best = {name: value for name, value in self.best.arrays().items() if name != "message"}
        state = {"best": best, "message": self.best.message.tolist(), "near": self.near,
                 "owners": np.concatenate(self.owners), "costs": np.concatenate(self.costs),
                 "seconds": self.seconds, "iterations": self.iterations}
        meta = {"key": self.key, "stages": self.stages, "improving": self.improving}
        store.save_checkpoint(self.folder / CHECKPOINT, state, meta)
        for part in self.folder.glob("stage-*"):
            shutil.rmtree(part)

    def _resume(self) -> None:
        """Take up what a run before kept; ValueError where the folder holds another search, or something else."""
        if self.folder is None or not self.folder.exists() or not any(self.folder.iterdir()):
            return
        if not (self.folder / CHECKPOINT).exists():
            if all(part.name.startswith("stage-001") for part in self.folder.iterdir()):
                return
            raise ValueError(f"{self.folder} is not empty and holds no search; expected a new folder: change `out`")
        from nocl.support import store  # torch

        state, meta = store.load_checkpoint(self.folder / CHECKPOINT)
        if meta.get("key") != self.key:
            raise ValueError(f"{self.folder} holds another search (other states, problem, settings, starts or seed); "
                             "expected the same one, or a new folder: change `out`")
        self.best = Solution.of_arrays({**state["best"], "message": np.array(state["message"])})
        self.seconds, self.iterations = state["seconds"], state["iterations"]
        self.near, self.owners, self.costs = state["near"], [state["owners"]], [state["costs"]]
        self.done, self.was_improving = meta["stages"], meta["improving"]


class _States:
    """The states of one call, as a search asks for them: batches as large as fit, each with a folder of its own."""

    def __init__(self, ddp: DDP, x0: Array, p: Array, seed: int, workers: int | str, out: Path | None,
                 show: bool) -> None:
        self.ddp, self.x0, self.p, self.seed, self.workers, self.folder, self.show = \
            ddp, x0, p, seed, workers, out, show

    @cached_property
    def holds(self) -> Holds:
        return Holds(self.ddp, np.random.default_rng([self.seed, 0]))

    def begin(self, stage: int, what: str) -> None:
        self.number, self.what, self.slices = stage, what, 0

    def cold(self, rows: Rows, first: int, count: int) -> Found:
        for number in range(first, first + count):
            rng = np.random.default_rng([self.seed, 1, number])
            yield from self._solve(rows, partial(self._start, rows, number, rng))

    def follow(self, moves: Moves, guess: Callable[[Moves], Guess]) -> Found:
        yield from self._solve(moves.row, lambda at: guess(moves[at]))

    def _start(self, rows: Rows, number: int, rng: np.random.Generator, at: slice) -> Guess:
        """A cold start of a part of these states, where the horizon is free each with another one."""
        free, K = self.ddp.ocp.is_free, self.ddp.intervals
        nodes = np.linspace(0.0, spread_horizon(self.ddp.ocp.horizon, number), K + 1) if free else np.zeros(0)
        times = {"t": np.tile(nodes, (len(rows[at]), 1))} if free else {}
        return self._control(rows, number, rng, at, times) | times

    def _control(self, rows: Rows, number: int, rng: np.random.Generator, at: slice, times: Guess) -> Guess:
        """u held at u*, the goal held, equilibria held, or random controls; times: nodes t, of a free horizon."""
        ddp, n = self.ddp, len(rows[at])
        if number == 0:
            return {}
        if number == 1 and ddp.ocp.has_goal:
            return self.holds.goal(self.p[rows[at]])
        if number % 2:
            u = random_start(ddp.ocp, ddp.intervals, n, rng, number // 2, self.p[rows[at]])
            return self._tamed(rows[at], {"u": u, **times})
        return self._tamed(rows[at], {**self.holds.random(self.p[rows[at]], rng), **times})

    def _tamed(self, states: Rows, guess: Guess) -> Guess:
        """A guess, its controls moved towards u* until the rollout stays near X."""
        goal, rows = self.ddp.ocp.goals(self.p[states])[1][:, None], np.arange(len(states))
        for _ in range(HALVINGS):
            some = {name: value[rows] for name, value in guess.items()}
            x = self.ddp.rollout(self.x0[states[rows]], self.p[states[rows]], **some)
            rows = rows[~near(self.ddp.ocp.system, x)]
            guess["u"][rows] = (guess["u"][rows] + goal[rows]) / 2
        return guess

    def _solve(self, rows: Rows, guess: Callable[[slice], Guess]) -> Found:
        """Solve states `rows` from guess(part of rows), as many at a time as fit."""
        n = max(1, BYTES // bytes_each(self.ddp, False))
        with progress_bar(len(rows), self.what, self.show and len(rows) > n, unit="state", delay=3.0,
                          leave=False) as bar:
            for at in (slice(i, i + n) for i in range(0, len(rows), n)):
                self.slices += 1
                folder = None if self.folder is None else self.folder / f"stage-{self.number:03d}-{self.slices:05d}"
                p = self.p[rows[at]] if self.ddp.ocp.np else None
                yield rows[at], self.ddp.solve(self.x0[rows[at]], p=p, **guess(at), workers=self.workers, out=folder,
                                               progress=self.show and len(rows) <= n)
                bar.update(len(rows[at]))


class Holds:
    """Starts that hold equilibria: f = 0 in X and U, the goal first, under the feedback of one sweep about each.

    Without parameters the same few for all states. With them each state has its own: its goal, and one other.
    """

    def __init__(self, ddp: DDP, rng: np.random.Generator) -> None:
        self.ddp = ddp
        if not ddp.ocp.np:
            z = equilibria(ddp.ocp, DRAWS, rng, ddp.dynamics)
            self.x, self.u = self._everywhere(z)
            self.gain = ddp.feedback(self.x, self.u)

    def goal(self, p: Array) -> Guess:
        """The goal held, for parameters p [n, np]."""
        if self.ddp.ocp.np:
            return self._own(np.column_stack(self.ddp.ocp.goals(p)), p)
        rows = np.zeros(len(p), dtype=np.int64)
        return {"u": self.u[rows], "x": self.x[rows], "gain": self.gain[rows]}

    def random(self, p: Array, rng: np.random.Generator) -> Guess:
        """Smooth random controls until a random time; a hold, of the goal or another equilibrium, from there or from
        the start on. For parameters p [n, np]."""
        K, s, n = self.ddp.intervals, self.ddp.ocp.system, len(p)
        hold = self._any(p, rng)
        ends, always = rng.uniform(0, 0.8 * K, (n, 1)), rng.random((n, 1)) < 0.5
        moving = np.arange(K) < ends
        u = hold["u"] + np.where(moving[..., None], smooth(s, K, n, rng), 0.0)
        gain = np.where((~moving | always)[..., None, None], hold["gain"], 0.0)
        return {"u": np.clip(u, s.lbu, s.ubu), "x": hold["x"], "gain": gain}

    def _any(self, p: Array, rng: np.random.Generator) -> Guess:
        """The goal, or another equilibrium, as often."""
        n, ocp = len(p), self.ddp.ocp
        if not ocp.np:
            rows = np.where(rng.random(n) < 0.5, 0, rng.integers(0, len(self.x), n))
            return {"u": self.u[rows], "x": self.x[rows], "gain": self.gain[rows]}
        z = np.column_stack(ocp.goals(p))
        others, found = settled(ocp, draws(ocp, n, rng), p, self.ddp.dynamics)
        other = found & (rng.random(n) < 0.5)
        return self._own(np.where(other[:, None], others, z), p)

    def _own(self, z: Array, p: Array) -> Guess:
        x, u = self._everywhere(z)
        return {"u": u, "x": x, "gain": self.ddp.feedback(x, u, p)}

    def _everywhere(self, z: Array) -> tuple[Array, Array]:
        """Points (x, u) [n, nx + nu] as trajectories."""
        K, nx = self.ddp.intervals, self.ddp.ocp.system.nx
        return np.repeat(z[:, None, :nx], K + 1, axis=1), np.repeat(z[:, None, nx:], K, axis=1)


def equilibria(ocp: OCP, number: int, rng: np.random.Generator, dynamics: Any = None) -> Array:
    """(x*, u*), then points of X and U where f = 0, by Gauss-Newton steps from random ones [n, nx + nu]."""
    goal = np.r_[ocp.x_goal, ocp.u_goal][None]
    if ocp.system.xdot is None and dynamics is None:  # a plant that is not known: no other equilibria are
        return goal
    z, found = settled(ocp, draws(ocp, number, rng), np.zeros((number, 0)), dynamics)
    return np.vstack([goal, z[found]])


def draws(ocp: OCP, n: int, rng: np.random.Generator) -> Array:
    """n random points of X and U [n, nx + nu]."""
    s = ocp.system
    low = np.r_[s.lbx, s.lbu]
    return rng.uniform(low, np.r_[s.ubx, s.ubu], (n, len(low)))


def settled(ocp: OCP, z: Array, p: Array, dynamics: Any = None) -> tuple[Array, NDArray[np.bool_]]:
    """z [n, nx + nu] after Gauss-Newton steps to f = 0 at t = 0 and p [n, np], and where it is such a point of X and U.
    """
    s, z, fine = ocp.system, z.copy(), np.ones(len(z), dtype=bool)
    if s.xdot is None and dynamics is None:
        return z, ~fine
    low, high = np.r_[s.lbx, s.lbu], np.r_[s.ubx, s.ubu]
    of, half = ocp.functions.on(dynamics_function(ocp, dynamics)), (high - low) / 2
    rate = half[:s.nx] / ocp.longest  # what 1 stands for in f; half the box in z

    def linear(rows: Rows) -> tuple[Array, Array]:
        x, u = np.split(z[rows], [s.nx], axis=1)
        at = of.arguments.columns(x=x, u=u, t=np.zeros(len(rows)), p=p[rows])
        AB = (j.full().reshape(s.nx, len(rows), -1) for j in of.jacobian.map(len(rows))(*at))
        J = np.concatenate(list(AB), axis=2).transpose(1, 0, 2)
        return of.f.map(len(rows))(*at).full().T / rate, J / rate[:, None] * half

    for _ in range(NEWTON):
        rows = np.flatnonzero(fine)
        if not len(rows):
            return z, fine
        value, J = linear(rows)
        good = np.isfinite(value).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
        fine[rows[~good]] = False
        z[rows[good]] -= half * np.einsum("bij,bj->bi", np.linalg.pinv(J[good], rcond=1e-8), value[good])
    rows = np.flatnonzero(fine)
    inside = (z[rows] >= low).all(axis=1) & (z[rows] <= high).all(axis=1)
    still = np.abs(linear(rows)[0]).max(axis=1) < 1e-8 if len(rows) else inside
    fine[rows] = inside & still
    return z, fine
