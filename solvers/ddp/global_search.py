"""Global optima by the batch: cold starts of several kinds, then each state from its neighbours' solutions.

What is tried, in the order of what it found on cart-poles from anywhere (docs/ddp.md):

- smooth random controls under the feedback that holds an equilibrium, from a random time on: a pole that can be
  caught is, which no open-loop control of an unstable system stumbles on;
- solutions of the nearest states, and their mirror images where the problem has a symmetry;
- solutions that pass near the state at a later time, stretched to the whole horizon, or held at their end;
- smooth random controls, and u*.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from tqdm import tqdm

from nocl.data import Solution, hits
from nocl.judge import dynamics_function
from nocl.ocp import OCP
from nocl.sampling import Seed
from nocl.solvers.ddp.bank import SolutionBank, spread
from nocl.solvers.ddp.batch import bytes_each
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.nmpc.guesses import mirrored, mirrors
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint

Rows = NDArray[np.int64]
Report = Callable[[str], None]  # told what is being done
IMPROVED = 1e-6  # a cost lower by this share counts as an improvement
WAVES = 8  # half waves in a random control
QUIETEST = 0.003  # of random controls: the smallest amplitude, in half widths of U
SHARE = 0.5  # of the states get a cold start more in each round
DRAWS = 32  # points from which equilibria are looked for
FAR = 1.5  # widths of X from its middle: a rollout that leaves them is too wild to start from
HALVINGS = 6  # of the controls, until it stays there
LATEST = 0.7  # of the horizon: until when a solution that passes by is of use
NODES = 200_000  # of solutions, at most, that are looked at for passing by
NEAR = 8  # ... of which that many, the nearest, are drawn from
NEWTON = 30  # steps to an equilibrium
CHECKPOINT = "search.safetensors"
BYTES = 2**31  # guesses and answers that are held at a time, beside the best


def solve_globally(ddp: DDP, x0: ArrayLike, *, starts: int = 16, neighbours: int = 4, rounds: int = 8, seed: Seed = 0,
                   known: Solution | None = None, workers: int | str = "auto",
                   out: str | os.PathLike[str] | None = None, progress: bool | None = None,
                   report: Report = lambda _: None) -> Solution:
    """Solve each problem from cold starts, then from its neighbours' solutions until nothing improves.

    Neighbours alone come to rest where a whole region shares a wrong basin: a random half of the states gets one more
    cold start in each round, and so does each state whose best was found less than twice.

    Parameters
    ----------
    x0 : [nx] or [B, nx], at t0 = 0
    starts : cold starts for each state, u held at u* the first of them
    neighbours, rounds : solutions of that many neighbours are tried, of one more in each round
    known : solutions from x0 to begin with; `starts` may be 0 then
    workers, progress : as of DDP.solve
    out : a folder that gets what was found after each stage, and each piece of the stage under way: the same call, with
        the same integer seed, goes on from there

    Returns the best found of each problem; `tried`, `starts`, `hits` and `optima` say how sure that is. Raises
    ValueError for wrong input; a state for which nothing converged has success False.
    """
    rows, _ = checks.states(x0, ddp.ocp.system.nx, ddp.ocp.system.name)
    if min(starts + (known is not None), neighbours + 1, rounds + 1) < 1:
        raise ValueError(f"starts is {starts}, neighbours {neighbours}, rounds {rounds}; expected starts >= 1 (0 where "
                         "solutions are known), the others >= 0")
    search = _Search(ddp, rows, seed, known, (starts, neighbours, rounds), workers, out, progress, report)
    for start in range(starts):
        search.stage(f"cold start {start + 1} of {starts}", search.cold, np.arange(len(rows)), start)
    for round_ in range(rounds):
        search.stage(f"neighbours, round {round_ + 1}", search.round, round_, neighbours, neighbours + rounds, starts)
        if not search.improving:
            break
    return search.solution()


def clean(ddp: DDP, bank: SolutionBank, **options: Any) -> SolutionBank:
    """A bank whose solutions were solved again from each other's until nothing improves; options of solve_globally."""
    known = bank.solution
    found = solve_globally(ddp, known.x[:, 0], **{"starts": 0, **options}, known=known)
    return SolutionBank.of(ddp, found)


@dataclass(frozen=True)
class GlobalDDP:
    """DDP with a global search, as a solver: its `solve(x0)` is the best of `solve_globally`."""

    ddp: DDP
    starts: int = 16
    seed: int = 0

    def solve(self, x0: ArrayLike, workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
              progress: bool | None = None) -> Solution:
        return solve_globally(self.ddp, x0, starts=self.starts, seed=self.seed, workers=workers, out=out,
                              progress=progress)


def global_ddp(ocp: OCP, intervals: int, seed: int) -> GlobalDDP:
    """DDP from everywhere, as the command line makes it."""
    return GlobalDDP(DDP(ocp, intervals=intervals), seed=seed)


class _Search:
    """The best of all that was tried from each state, and the costs at which each start ended."""

    def __init__(self, ddp: DDP, x0: Array, seed: Seed, known: Solution | None, plan: tuple[int, int, int],
                 workers: int | str, out: str | os.PathLike[str] | None, progress: bool | None, report: Report) -> None:
        self.ddp, self.x0, self.workers, self.report = ddp, x0, workers, report
        self.show = sys.stderr.isatty() if progress is None else progress
        self.seed = int(np.random.default_rng(seed).integers(2**62))
        self.owners: list[Rows] = []  # of each start, its state
        self.costs: list[Array] = []
        self.stages = self.done = 0
        self.improving = True  # whether the last stage found anything
        self.folder = None if out is None else Path(out)
        self.key = fingerprint(ddp.key, x0, self.seed, plan, *([] if known is None else [known.u])) if out else ""
        t = np.tile(np.linspace(0, ddp.ocp.horizon, ddp.intervals + 1), (len(x0), 1))
        self.best = Solution.blank(t, x0.shape[1], ddp.ocp.system.nu)
        self.seconds, self.iterations = np.zeros(len(x0)), np.zeros(len(x0), dtype=np.int64)
        if known is not None:
            self._merge(np.arange(len(x0)), known)
        self.near: tuple[Rows, Rows, Array] | None = None  # each state's neighbours: state, image, cost when tried
        self.mirrors = mirrors(ddp.ocp, ddp.dynamics)
        self._resume()

    @cached_property
    def holds(self) -> Holds:
        return Holds(self.ddp, np.random.default_rng([self.seed, 0]))

    def stage(self, what: str, run: Callable[..., None], *args: Any) -> None:
        """A part of the search, with random numbers and a folder of its own; skipped where a run before did it."""
        self.stages += 1
        if self.stages > self.done:
            self.what, self.slices, self.rng = what, 0, np.random.default_rng([self.seed, self.stages])
            former = self.best.cost.copy()
            self.report(what)
            run(*args)
            self.improving = bool(_improved(former, self.best.cost).any())
            self._keep()
        elif self.stages == self.done:
            self.improving = self.was_improving

    def cold(self, rows: Rows, number: int) -> None:
        """One cold start of each of these states: u held at u*, the goal held, equilibria held, or random controls."""
        if number == 0:
            self._solve(rows, lambda part: {})
        elif number == 1:
            self._solve(rows, lambda part: self.holds.goal(len(part)))
        elif number % 2:
            self._solve(rows, lambda part: self._tamed(part, {"u": cold_controls(self.ddp, len(part), self.rng)}))
        else:
            self._solve(rows, lambda part: self._tamed(part, self.holds.random(len(part), self.rng)))

    def _tamed(self, part: Rows, guess: dict[str, Array]) -> dict[str, Array]:
        """A guess, its controls moved towards u* until the rollout stays near X: a wild one costs most and gives least.
        """
        s, goal, rows = self.ddp.ocp.system, np.asarray(self.ddp.ocp.u_goal), np.arange(len(part))
        middle, far = (s.lbx + s.ubx) / 2, FAR * (s.ubx - s.lbx)
        for _ in range(HALVINGS):
            x = self.ddp.rollout(self.x0[part[rows]], **{name: value[rows] for name, value in guess.items()})
            rows = rows[~(np.abs(x - middle) < np.maximum(far, np.abs(x[:, :1]))).all(axis=(1, 2))]
            guess["u"][rows] = (guess["u"][rows] + goal) / 2
        return guess

    def round(self, number: int, neighbours: int, most: int, starts: int) -> None:
        """Neighbours, one more in each round; solutions that pass by; cold starts where it is doubtful."""
        if self.best.success.any():
            scale = spread(self.ddp, self.best[self.best.success])
            if neighbours:
                self.exchange(SolutionBank(self.best, scale), neighbours + number, most)
                self.passing(SolutionBank(self.best, scale))
            self.cold(self.doubtful(), starts + number)

    def exchange(self, bank: SolutionBank, count: int, most: int) -> None:
        """Solve each state from the `count` nearest others' solutions and mirror images, if they are new to it."""
        if self.near is None:
            self.near = self._neighbours(bank.scale, most)
        others, images, tried = self.near
        for column in range(min(count, others.shape[1])):
            cost = self.best.cost[others[:, column]]
            rows = np.flatnonzero(np.isfinite(cost) & (cost != tried[:, column]))
            tried[rows, column] = cost[rows]
            self._solve(rows, partial(self._others, bank, others[:, column], images[:, column]))

    def _others(self, bank: SolutionBank, other: Rows, image: Rows, part: Rows) -> dict[str, Array]:
        return self._image(bank.guess(other[part]), image[part])

    def passing(self, bank: SolutionBank) -> None:
        """Solve each state from one of the NEAR solutions that pass nearest to it at a later time."""
        K, B = self.ddp.intervals, len(self.x0)
        solved, last = np.flatnonzero(self.best.success), max(int(LATEST * K), 1)
        chosen = np.arange(len(solved) * last)
        if len(chosen) > NODES:
            chosen = self.rng.choice(len(chosen), NODES, replace=False)
        row, node = solved[chosen // last], 1 + chosen % last
        place, image = nearest(bank.solution.x[row, node], bank.scale, self._images(), NEAR)
        weight = self.rng.random(place.shape) * (row[place] != np.arange(B)[:, None])
        pick = (np.arange(B), weight.argmax(axis=1))
        parent, start, image = row[place[pick]], node[place[pick]] * self.ddp.ocp.horizon / K, image[pick]
        held = self.rng.random(B) < 0.5
        self._solve(np.flatnonzero(weight.max(axis=1) > 0),
                    lambda part: self._image(bank.late(parent[part], start[part], held[part]), image[part]))

    def doubtful(self) -> Rows:
        """A random SHARE of the states, and those whose best was found less than twice."""
        seldom = hits(self._tried(), self.best.cost) < 2
        return np.flatnonzero((self.rng.random(len(self.x0)) < SHARE) | seldom)

    def solution(self) -> Solution:
        return replace(self.best, seconds=self.seconds, iterations=self.iterations, tried=self._tried())

    def _neighbours(self, scale: Array, count: int) -> tuple[Rows, Rows, Array]:
        state, image = nearest(self.x0, scale, self._images(), count + 1)
        own = (state == np.arange(len(self.x0))[:, None]) & (image == 0)
        order = np.argsort(own, axis=1, kind="stable")[:, :-1]  # itself, the nearest, goes last and away
        state, image = (np.take_along_axis(a, order, axis=1) for a in (state, image))
        return state, image, np.full(state.shape, np.nan)

    def _images(self) -> list[Array]:
        """The states, and their mirror images."""
        ocp = self.ddp.ocp
        return [self.x0] + [mirrored(ocp, m, self.x0, np.asarray(ocp.u_goal))[0] for m in self.mirrors]

    def _image(self, guess: dict[str, Array], image: Rows) -> dict[str, Array]:
        """Guesses in which row i is mirrored by mirror image[i] - 1."""
        for i, mirror in enumerate(self.mirrors, 1):
            at = image == i
            guess["x"][at], guess["u"][at] = mirrored(self.ddp.ocp, mirror, guess["x"][at], guess["u"][at])
            guess["gain"][at] *= mirror[1][:, None] * mirror[0]
        return guess

    def _solve(self, rows: Rows, guess: Callable[[Rows], dict[str, Array]]) -> None:
        """Solve states `rows` from guess(part of rows), as many at a time as fit, and keep what is better."""
        n = max(1, BYTES // bytes_each(self.ddp, False))
        with tqdm(total=len(rows), desc=self.what, unit="state", delay=3.0, leave=False,
                  disable=not self.show or len(rows) <= n) as bar:
            for part in (rows[i:i + n] for i in range(0, len(rows), n)):
                self.slices += 1
                folder = None if self.folder is None else self.folder / f"stage-{self.stages:03d}-{self.slices:05d}"
                self._merge(part, self.ddp.solve(self.x0[part], **guess(part), workers=self.workers, out=folder,
                                                 progress=self.show and len(rows) <= n))
                bar.update(len(part))

    def _merge(self, rows: Rows, found: Solution) -> None:
        self.owners.append(rows)
        self.costs.append(found.cost)
        self.seconds[rows] += found.seconds
        self.iterations[rows] += found.iterations
        taken = (found.cost < self.best.cost[rows]) | ~self.best.success[rows]
        self.best.put(rows[taken], found[taken])

    def _tried(self) -> Array:
        """The cost that each start ended at [B, most], NaN where there were fewer."""
        owners = np.concatenate([np.zeros(0, dtype=np.int64), *self.owners])
        costs = np.concatenate([np.zeros(0), *self.costs])
        starts = np.bincount(owners, minlength=len(self.x0))
        table = np.full((len(self.x0), max(starts, default=0)), np.nan)
        order = np.argsort(owners, kind="stable")
        column = np.arange(len(owners)) - np.repeat(np.cumsum(starts) - starts, starts)
        table[owners[order], column] = costs[order]
        return table

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


class Holds:
    """Starts that hold equilibria: f = 0 in X and U, the goal first, under the feedback of one sweep about each."""

    def __init__(self, ddp: DDP, rng: np.random.Generator) -> None:
        self.ddp, K, nx = ddp, ddp.intervals, ddp.ocp.system.nx
        z = equilibria(ddp.ocp, DRAWS, rng, ddp.dynamics)
        self.x, self.u = np.repeat(z[:, None, :nx], K + 1, axis=1), np.repeat(z[:, None, nx:], K, axis=1)
        self.gain = ddp.feedback(self.x, self.u)

    def goal(self, n: int) -> dict[str, Array]:
        """The goal held, n times."""
        rows = np.zeros(n, dtype=np.int64)
        return {"u": self.u[rows], "x": self.x[rows], "gain": self.gain[rows]}

    def random(self, n: int, rng: np.random.Generator) -> dict[str, Array]:
        """Smooth random controls until a random time; a hold, of the goal or another equilibrium, from there or from
        the start on."""
        K, s = self.ddp.intervals, self.ddp.ocp.system
        rows = np.where(rng.random(n) < 0.5, 0, rng.integers(0, len(self.x), n))
        ends, always = rng.uniform(0, 0.8 * K, (n, 1)), rng.random((n, 1)) < 0.5
        moving = np.arange(K) < ends
        u = self.u[rows] + np.where(moving[..., None], smooth(self.ddp, n, rng), 0.0)
        gain = np.where((~moving | always)[..., None, None], self.gain[rows], 0.0)
        return {"u": np.clip(u, s.lbu, s.ubu), "x": self.x[rows], "gain": gain}


def equilibria(ocp: OCP, draws: int, rng: np.random.Generator, dynamics: Any = None) -> Array:
    """(x*, u*), then points of X and U where f = 0, by Gauss-Newton steps from random ones [n, nx + nu]."""
    s = ocp.system
    goal = np.r_[ocp.x_goal, ocp.u_goal][None]
    if s.xdot is None and dynamics is None:  # a plant that is not known: no other equilibria are
        return goal
    low, high = np.r_[s.lbx, s.lbu], np.r_[s.ubx, s.ubu]
    of = ocp.functions.on(dynamics_function(ocp, dynamics))

    def linear(z: Array) -> tuple[Array, Array]:
        x, u = np.split(z.T, [s.nx])
        AB = (j.full().reshape(s.nx, len(z), -1) for j in of.jacobian.map(len(z))(x, u))
        return of.f.map(len(z))(x, u).full().T, np.concatenate(list(AB), axis=2).transpose(1, 0, 2)

    z = rng.uniform(low, high, (draws, len(low)))
    for _ in range(NEWTON):
        if not len(z):
            return goal
        value, J = linear(z)
        fine = np.isfinite(value).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
        z = z[fine] - np.einsum("bij,bj->bi", np.linalg.pinv(J[fine], rcond=1e-8), value[fine])
    inside = (z >= low).all(axis=1) & (z <= high).all(axis=1)
    still = np.abs(linear(z)[0]).max(axis=1) < 1e-8 if len(z) else inside
    return np.vstack([goal, z[inside & still]])


def cold_controls(ddp: DDP, n: int, seed: Seed) -> Array:
    """n smooth random control histories [n, K, nu] in U, about u* or the middle of U, small to full amplitude."""
    rng, s = np.random.default_rng(seed), ddp.ocp.system
    shape = smooth(ddp, n, rng)
    base = np.where(rng.random((n, 1, 1)) < 0.5, np.asarray(ddp.ocp.u_goal), (s.lbu + s.ubu) / 2)
    return np.ascontiguousarray(np.clip(base + shape, s.lbu, s.ubu))


def smooth(ddp: DDP, n: int, rng: np.random.Generator) -> Array:
    """n random sums of half waves [n, K, nu], of QUIETEST to 1 half widths of U."""
    s, K, order = ddp.ocp.system, ddp.intervals, np.arange(WAVES)
    waves = np.cos(np.pi * order[:, None] * (np.arange(K) + 0.5) / K) / (1 + order)[:, None]
    shape = np.einsum("bmk,kt->btm", rng.standard_normal((n, s.nu, WAVES)), waves)
    return np.exp(rng.uniform(np.log(QUIETEST), 0.0, (n, 1, 1))) * (s.ubu - s.lbu) / 2 * shape


def nearest(points: Array, scale: Array, images: list[Array], count: int) -> tuple[Rows, Rows]:
    """For each row of the images [B, nx] of some states, the `count` points nearest to any: (point, image) [B, count].
    """
    tree, count = KDTree(points / scale), min(count, len(points))
    found = [tree.query(image / scale, list(range(1, count + 1))) for image in images]
    distance, place = (np.concatenate([f[i] for f in found], axis=1) for i in (0, 1))
    order = np.argsort(distance, axis=1, kind="stable")[:, :count]
    return np.take_along_axis(place, order, axis=1), order // count


def _improved(former: Array, now: Array) -> NDArray[np.bool_]:
    finite = np.where(np.isfinite(former), former, 0.0)
    return np.where(np.isfinite(former), now < finite - IMPROVED * np.abs(finite), np.isfinite(now))
