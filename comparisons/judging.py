"""Runs under the judge, in parts that processes share, with or without disturbances. B is the batch."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import cloudpickle
import numpy as np
from numpy.typing import NDArray

from nocl.comparisons.each import Laws
from nocl.comparisons.methods import SAMPLED, MethodRun, Starts, said, stages_of, substeps_of
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.judge.runs import Simulation
from nocl.judge.simulation import simulate
from nocl.solvers.nmpc.loop import Loop
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.support.pool import Journal, Pool, do
from nocl.support.progress import shown
from nocl.translate.arguments import Arguments

CALLS = 20  # control evaluations that are timed at each initial state, at most; the median counts
TIMED = 100.0  # milliseconds spent on that, about
Rows = NDArray[np.int64]
PARTS = 20  # that the states of a run are judged in


@dataclass(frozen=True, eq=False)
class Disturbance:
    """A disturbance that acts on all runs in the same way; the default is none."""

    f: ca.Function | None = None  # another plant than the exact one
    kicks: tuple[tuple[float, Array], ...] = ()  # (time, dx [B, nx])
    noise: Array | None = None  # [nx], standard deviation of what a controller reads of each state
    seed: int = 0  # of the noise


@dataclass(frozen=True, eq=False)
class Judgement:
    """B states of a run, judged."""

    simulation: Simulation
    ms_first: Array  # [B]
    ms_per_control: Array  # [B]
    evaluations: Array  # [B]


@dataclass(frozen=True, eq=False)
class Share:
    """Some states of one run; a task of nocl.support.pool."""

    name: str
    run: int
    rows: Rows  # [size]

    @property
    def size(self) -> int:
        return len(self.rows)

    def outcome(self, arrays: Mapping[str, Array]) -> JudgedShare:
        """What JudgedShare.arrays() kept."""
        values: dict[str, Any] = dict(arrays)
        times = [values.pop(f.name) for f in fields(Judgement) if f.name != "simulation"]
        values["message"] = [str(m) for m in values["message"]]
        return JudgedShare(self.name, self.size, Judgement(Simulation(**values), *times))


@dataclass(frozen=True, eq=False)
class JudgedShare:
    """The outcome of a Share."""

    name: str
    size: int
    judgement: Judgement

    def arrays(self) -> dict[str, Array]:
        s, j = self.judgement.simulation, self.judgement
        return {f.name: np.asarray(getattr(s, f.name)) for f in fields(Simulation)} | \
            {f.name: getattr(j, f.name) for f in fields(Judgement) if f.name != "simulation"}


@dataclass(frozen=True, eq=False)
class Judging:
    """Judges shares; `delays` [runs] is the time from a sample to its control."""

    ocp: OCP
    starts: Starts
    runs: Sequence[MethodRun]
    disturbance: Disturbance
    delays: Sequence[float]
    timed: bool = True
    tolerance: float = TOLERANCE  # of a constraint's scale

    def build(self) -> None:
        """Nothing is shared by the parts."""

    def __call__(self, part: Share) -> JudgedShare:
        run, delay = self.runs[part.run], self.delays[part.run]
        return JudgedShare(part.name, part.size, self.judge(run, part.rows, delay))

    def __reduce__(self) -> tuple[Any, ...]:
        """By cloudpickle, so that users' functions reach processes too."""
        slim = [replace(run, method=None, solved=None if run.solved is None else
                        replace(run.solved, plan=None)) for run in self.runs]  # type: ignore[arg-type]
        parts = (self.ocp, self.starts, slim, self.disturbance, self.delays, self.timed, self.tolerance)
        return _unpickled, (cloudpickle.dumps(parts),)

    def judge(self, run: MethodRun, rows: Rows, delay: float) -> Judgement:
        if run.solved is not None:
            return self._plan(run, rows)
        if isinstance(run.controller, Laws):
            return joined(self.ocp, [self._at(run, run.controller, row, delay) for row in rows])
        try:
            return self._feedback(run, rows, delay)
        except Exception as error:  # whatever a user's controller raises becomes a row: the other states go on
            if len(rows) > 1:
                return joined(self.ocp, [self.judge(run, row[None], delay) for row in rows])
            return _unknown(failed(self.ocp, [said(error)], self._nodes(run.hold)))

    def _at(self, run: MethodRun, laws: Laws, row: int, delay: float) -> Judgement:
        """One state of a law that is made for its p, judged on the problem at that p."""
        try:
            ocp, _, controller = laws.at(self.starts.p[row])
        except Exception as error:  # whatever it raises at this p
            return _unknown(failed(self.ocp, [said(error)], self._nodes(run.hold)))
        f = self.disturbance.f
        plant = None if f is None else _folded(f, ocp, self.starts.p[row])
        job = replace(self, ocp=ocp, starts=Starts(self.starts.x, np.zeros((len(self.starts), 0))),
                      disturbance=replace(self.disturbance, f=plant))
        return job.judge(replace(run, controller=controller), np.array([row]), delay)

    def _nodes(self, K: int | None) -> Array:
        return np.linspace(0.0, self.ocp.longest, (K or self.ocp.steps or SAMPLED) + 1)

    def _feedback(self, run: MethodRun, rows: Rows, delay: float) -> Judgement:
        starts, controller, d = self.starts[rows], run.controller, self.disturbance
        if d.noise is not None and run.hold is not None:
            controller = _Noisy(controller, self.ocp.horizon, run.hold, _noise(d, rows, run.hold))
        s = simulate(self.ocp, controller, starts.x, f=d.f, hold=run.hold, delay=delay,
                     kicks=[(t, dx[rows]) for t, dx in d.kicks], p=starts.p, tolerance=self.tolerance)
        if isinstance(run.controller, Loop):
            return Judgement(s, *_of_loop(run.controller))
        if not self.timed:
            return _unknown(s)
        first, median = np.array([_milliseconds(self.ocp, run.controller, starts[[i]]) for i in range(len(rows))]).T
        free = isinstance(run.controller, ca.Function)
        return Judgement(s, first, median, np.full(len(rows), 0.0 if free else np.nan))

    def _plan(self, run: MethodRun, rows: Rows) -> Judgement:
        """Controls in open loop; states without controls keep the solver's message."""
        assert run.solved is not None
        message = [run.solved.message[i] for i in rows]
        ok = np.array([not m for m in message])
        s, d = failed(self.ocp, message, self._nodes(run.controller.shape[1])), self.disturbance
        if ok.any():
            kicks = [(t, dx[rows[ok]]) for t, dx in d.kicks]
            s = _put(s, self._open_loop(run, rows[ok], kicks), ok)
        return Judgement(s, run.solved.ms[rows], np.full(len(rows), np.nan), run.solved.evaluations[rows])

    def _open_loop(self, run: MethodRun, rows: Rows, kicks: Sequence[tuple[float, Array]]) -> Simulation:
        starts, horizon = self.starts[rows], None if run.horizon is None else run.horizon[rows]
        return simulate(self.ocp, run.controller[rows], starts.x, f=self.disturbance.f, kicks=kicks, p=starts.p,
                        tolerance=self.tolerance, horizon=horizon)


def _unpickled(data: bytes) -> Judging:
    return Judging(*cloudpickle.loads(data))


def judge(job: Judging, workers: int | str, out: Path | None, progress: bool | None, what: str) -> list[Judgement]:
    """All runs of a job on all its states; with `out` what is there already is taken from there."""
    B = len(job.starts)
    rows = np.array_split(np.arange(B), min(B, PARTS))
    parts = [Share(f"run-{m}-{i:02d}", m, part) for i, part in enumerate(rows) for m in range(len(job.runs))]
    journal = Journal(out, key_of(job) if out is not None else "", "a comparison")
    show = shown(progress)
    done = do(job, parts, Pool(_possible(job, workers)), journal, show, what)
    return [joined(job.ocp, [outcome.judgement for part, outcome in zip(parts, done, strict=True) if part.run == m])
            for m in range(len(job.runs))]


def _possible(job: Judging, workers: int | str) -> int | str:
    """`workers`, or 1 for "auto" where a method cannot go to other processes."""
    if workers == 1:
        return 1
    try:
        job.__reduce__()
    except Exception as error:  # pickling raises whatever an object raises
        if workers == "auto":
            return 1
        raise ValueError(f"a method cannot be sent to other processes ({said(error)}): use workers=1") from error
    return workers


def key_of(job: Judging) -> str:
    """A fingerprint of all that outcomes depend on; plain callables are known by name."""
    d = job.disturbance
    arrays = [part for run in job.runs for part in run.identity] + [a for kick in d.kicks for a in kick]
    starts = [job.starts.x, *([job.starts.p] if job.ocp.np else [])]
    return fingerprint(job.ocp.to_data(), *starts, *arrays, list(job.delays), d.seed, job.tolerance,
                       "" if d.f is None else d.f, "" if d.noise is None else d.noise, version("nocl"),
                       version("casadi"))


def _folded(f: ca.Function, ocp: OCP, p: Array) -> ca.Function:
    """A plant of a problem with parameters, on the problem at p."""
    at = Arguments.new(ca.MX, **{name: s.numel() for name, s in ocp.functions.arguments.symbols.items()})
    return at.function("plant", {"xdot": at.given(p=ca.MX(ca.DM(p))).call(f)})


class _Noisy:
    """A controller that reads x + noise; sampled, so that each sample has its own noise."""

    def __init__(self, controller: Any, horizon: float, hold: int, noise: Array) -> None:
        self.controller, self.step, self.noise = controller, horizon / hold, noise

    def __call__(self, x: Array, t: float, *p: Array) -> Array:
        seen = x + self.noise[:, round(t / self.step)]
        if isinstance(self.controller, ca.Function):
            return np.asarray(self.controller(seen.T, t, *(rows.T for rows in p)).full().T)
        return np.asarray(self.controller(seen, t, *p))


def _noise(d: Disturbance, rows: Rows, K: int) -> Array:
    """[B, K, nx]; a state's noise does not depend on which others are run with it."""
    assert d.noise is not None
    return np.array([d.noise * np.random.default_rng([d.seed, int(i)]).standard_normal((K, len(d.noise)))
                     for i in rows])


def _of_loop(loop: Loop) -> tuple[Array, Array, Array]:
    """(ms of the first solve, the median of the later ones, evaluations of f by all), from the loop's last run."""
    ms = 1e3 * np.array([step["seconds"] for step in loop.stats])
    iterations = np.sum([step["iterations"] for step in loop.stats], axis=0)
    evaluations = iterations * loop.nmpc.intervals * stages_of(loop.ocp) * substeps_of(loop.nmpc)
    return ms[0], np.median(ms[1:] if len(ms) > 1 else ms, axis=0), evaluations


def _milliseconds(ocp: OCP, controller: Any, start: Starts) -> tuple[float, float]:
    """(first, median) time of a control evaluation at (x, 0): the first differs where a controller warm-starts."""
    x, p = start.x, start.given(ocp, controller)
    given = [x[0], 0.0, *(row[0] for row in p)] if isinstance(controller, ca.Function) else [x, 0.0, *p]
    times: list[float] = []
    try:
        while len(times) < CALLS and sum(times) < TIMED:
            start = time.perf_counter()
            controller(*given)
            times.append(1e3 * (time.perf_counter() - start))
    except Exception:  # whatever a user's controller raises: the judge has its message
        return np.nan, np.nan
    median = float(np.median(times[1:] or times))
    return (median if isinstance(controller, ca.Function) else times[0]), median


def _unknown(s: Simulation) -> Judgement:
    return Judgement(s, *np.full((3, len(s.cost)), np.nan))


def failed(ocp: OCP, message: Sequence[str], t: Array) -> Simulation:
    """What the judge says of states that there was nothing to run on; t [K]."""
    B, K = len(message), len(t)
    t = np.full((B, K), np.nan) if ocp.is_free else t
    inf, nan = np.full((4, B), np.inf), np.full((4, B), np.nan)
    x, u = (np.full((B, K, n), np.nan) for n in (ocp.system.nx, ocp.system.nu))
    return Simulation(t, x, u, inf[0], inf[1], inf[2], inf[3], nan[0], nan[1], nan[2], nan[3],
                      np.zeros(B, dtype=bool), list(message), np.zeros(B, dtype=bool), np.full(B, -1), nan[0], nan[1])


def joined(ocp: OCP, parts: Sequence[Judgement]) -> Judgement:
    """Several batches of one run as one; a part that never ran takes over the grid of those that did."""
    t = max((part.simulation.t for part in parts), key=lambda t: t.shape[-1])
    runs = [p.simulation if p.simulation.t.shape[-1] == t.shape[-1] else
            failed(ocp, p.simulation.message, np.linspace(0.0, ocp.longest, t.shape[-1])) for p in parts]
    values: dict[str, Any] = {f.name: np.concatenate([getattr(run, f.name) for run in runs])
                              for f in fields(Simulation) if f.name not in _shared(t)}
    shared: dict[str, Any] = {"t": t} if t.ndim == 1 else {}
    simulation = Simulation(message=[m for run in runs for m in run.message], **shared, **values)
    return Judgement(simulation, *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Judgement)
                                   if f.name != "simulation"))


def _put(simulation: Simulation, part: Simulation, where: Array) -> Simulation:
    """`simulation` with the rows `where` taken from `part`."""
    message = list(simulation.message)
    for i, why in zip(np.flatnonzero(where), part.message, strict=True):
        message[i] = why
    for f in fields(Simulation):
        if f.name not in _shared(simulation.t):
            getattr(simulation, f.name)[where] = getattr(part, f.name)
    return replace(simulation, message=message)


def _shared(t: Array) -> tuple[str, ...]:
    """Fields of a Simulation that are no arrays with a row for each state; nodes t [K+1] are the same for all."""
    return ("message",) if t.ndim == 2 else ("t", "message")
