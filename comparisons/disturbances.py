"""The same methods and states under disturbances, each held against the optimum solved anew under it. B is the batch.

The cost is the problem's own throughout. NMPC in closed loop is run at the rate that its measured solve time allows,
with that time as its delay; a feedback law at its own.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.comparisons.judging import Disturbance, Judgement, Judging, judge, key_of
from nocl.comparisons.methods import MethodRun, Solving, Starts, at_rate, checked, folder_name, how, runs_of
from nocl.comparisons.reference import SLOTS, Reference, resolved
from nocl.comparisons.report.findings import Robustness, Scenario, ScenarioLoss
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.definition.system import System
from nocl.judge.laws import dynamics_function
from nocl.judge.simulation import simulate
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support import checks
from nocl.support.checks import Array
from nocl.systems import NAMES

FINE = 320  # intervals of the optimum, a multiple of SLOTS
STARTS = 8  # cold starts of the undisturbed optimum for each state
INSTANT = 1000  # a feedback law that could answer so often over the horizon is run continuously


@dataclass(frozen=True)
class Disturbances:
    """How hard methods are hit; numbers per state may be [nx], in the states' units."""

    noise: float | Sequence[float] = 0.01  # standard deviation of what a controller reads
    kick: float | Sequence[float] = 0.05  # of each kick
    kicks: int = 5  # in a run, at random times
    hold: int = 80  # intervals that all feedback is held on under noise, held and late
    late: float = 0.5  # delay, as a share of such an interval
    weaker: float = 0.2  # share of u - u* that is lacking where the model is wrong
    fastest: int = 200  # samples over the horizon that a loop which could be faster is run at in real time
    seed: int = 12345

    def __post_init__(self) -> None:
        for name in ("kicks", "hold", "fastest"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"Disturbances: {name} is {value!r}; expected an integer >= 1")
        if self.kicks > SLOTS - 2:
            raise ValueError(f"Disturbances: kicks is {self.kicks}; expected at most {SLOTS - 2}")
        for name in ("late", "weaker"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"Disturbances: {name} is {getattr(self, name)!r}; expected a share from 0 to 1")


def robustness(ocp: OCP, methods: Mapping[str, Any], x0: ArrayLike, variants: Mapping[str, Any] | None = None,
               settings: Disturbances | None = None, workers: int | str = 1,
               out: str | os.PathLike[str] | None = None, progress: bool | None = None, p: Any = None,
               tolerance: float = TOLERANCE) -> Robustness:
    """Judge `methods`, as compare takes them, from states x0 [B, nx] under each disturbance.

    p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
    variants : plants by name that the methods do not know, {"mass +20 %": system}: a System, an OCP (its system
        counts), a casadi.Function (x, u) -> xdot, or an object with `to_casadi()`
    tolerance : a run that violates a constraint by more than this share of its scale has failed

    Where no plan holds the constraints any more, after a kick or on another plant, there is no optimum, and the state
    counts for no method.
    """
    ocp.refuse_free("robustness")
    ocp.system.refuse_discrete("robustness")
    rows, _ = checks.states(x0, ocp.system.nx, ocp.system.name)
    starts = Starts(rows.copy(), ocp.parameters_of(p, len(rows), "robustness"))
    return _Study(ocp, checked(methods), starts, settings or Disturbances(), workers,
                  None if out is None else Path(out), progress, tolerance).run(variants or {})


def plant(ocp: OCP, variant: Any) -> ca.Function:
    """The f of a variant as a casadi.Function (x, u) -> xdot; ValueError where its sizes are others."""
    thing = variant.system if isinstance(variant, OCP) else variant
    return dynamics_function(ocp, thing.f if isinstance(thing, System) else thing)


def on_plant(ocp: OCP, f: ca.Function) -> OCP:
    """The problem with another f, as `plant` gives it: cost, goal and constraints stay."""
    own, xdot = ocp.system.arguments, f(*ocp.functions.arguments.inputs)
    return replace(ocp, system=ocp.system.under(own.function(f.name(), {"xdot": xdot})))


def _spread(value: Any, nx: int, name: str) -> Array:
    """A standard deviation for each state [nx], from a number or nx of them >= 0; ValueError for others."""
    try:
        sigma = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        sigma = np.full(1, np.nan)
    if sigma.shape not in ((), (nx,)) or not (np.isfinite(sigma) & (sigma >= 0)).all():
        raise ValueError(f"Disturbances: {name} is {value!r}; expected a number >= 0, or {nx} of them, one a state")
    return np.broadcast_to(sigma, (nx,)).copy()


class _Study:
    """One call of robustness."""

    def __init__(self, ocp: OCP, methods: Mapping[str, Any], starts: Starts, settings: Disturbances,
                 workers: int | str, out: Path | None, progress: bool | None, tolerance: float) -> None:
        self.ocp, self.starts, self.settings, self.workers, self.out = ocp, starts, settings, workers, out
        self.tolerance = tolerance
        self.progress, self.x0, self.p = progress, starts.x, starts.p if ocp.np else None
        self.runs = runs_of(ocp, methods, self.starts, (None,), Solving(workers, out, progress))
        rate = settings.hold
        self.held = [run if run.solved is not None else replace(
            run, hold=rate, how=how(rate), controller=at_rate(run.controller, rate)) for run in self.runs]
        nx, rng = ocp.system.nx, np.random.default_rng(settings.seed)
        self.noise, sigma = (_spread(getattr(settings, name), nx, name) for name in ("noise", "kick"))
        slots = np.sort(rng.choice(np.arange(1, SLOTS - 1), settings.kicks, replace=False))
        self.kicks = [(int(slot), sigma * rng.standard_normal(self.x0.shape)) for slot in slots]

    def run(self, variants: Mapping[str, Any]) -> Robustness:
        plants = {name: plant(self.ocp, variant) for name, variant in variants.items()}  # checked before any work
        s, T = self.settings, self.ocp.horizon
        calm = self.judged("undisturbed", self.runs)
        guesses = [j.simulation.u[:, :-1] for j in calm]
        ddp = DDP(self.ocp)
        cold = solve_globally(ddp, self.x0, p=self.p, starts=STARTS, seed=99, progress=self.progress).u
        best = Reference(self.ocp, FINE, [cold, *guesses]).solve(self.x0, self.p)
        J = best.cost
        found = [self.scenario("undisturbed", "No disturbance.", self.runs, calm, J)]
        found.append(self.play("noise", f"Each controller reads the state with noise of {_text(s.noise)} (standard "
                               f"deviation, each in its unit), {s.hold} times.", self.held, J, noise=self.noise))
        kicks = tuple((slot * T / SLOTS, dx) for slot, dx in self.kicks)
        found.append(self.play("kicks", f"{s.kicks} kicks of {_text(s.kick)} (standard deviation) on every state, at "
                               "random times.", self.runs, resolved(self.ocp, best, self.kicks), kicks=kicks))
        found.append(self.play("held", f"All feedback is held on {s.hold} intervals.", self.held, J))
        delay = s.late * T / s.hold
        found.append(self.play("late", f"Held on {s.hold} intervals, and each control {1e3 * delay:.3g} ms late.",
                               self.held, J, delays=[delay] * len(self.runs)))
        for name, f in (plants | self.wrong()).items():
            found.append(self.play(name, f"The plant is another than every method's model: {name}.", self.runs,
                                   self.anew(f, best.u, guesses), f=f))
        found.append(self.real_time(calm, J))
        return Robustness(self.x0, tuple(found), vars(s) | {"n": len(self.x0)})

    def wrong(self) -> dict[str, ca.Function]:
        """A model that is wrong in structure's place: what a control does."""
        share, of, centre = self.settings.weaker, self.ocp.functions, ca.DM(self.ocp.u_goal)
        at = of.stage
        weak = at.function("weak", {"xdot": at.given(u=centre + (1 - share) * (at.u - centre)).call(of.f)})
        return {f"controls {100 * share:g} % weaker": weak} if share else {}

    def anew(self, f: ca.Function, u: Array, guesses: Sequence[Array]) -> Array:
        """Cost [B] of the optimum on another plant, from what is known of the first one; judged, without penalty."""
        other = on_plant(self.ocp, f)
        found = Reference(other, FINE, [u, *guesses]).solve(self.x0, self.p)
        cost = np.full(len(self.x0), np.inf)
        ok = np.flatnonzero(found.success)
        if ok.size:
            run = simulate(other, found.u[ok], self.x0[ok], p=None if self.p is None else self.p[ok])
            cost[ok] = np.where(run.success, run.cost, np.inf)
        return cost

    def real_time(self, calm: Sequence[Judgement], best: Array) -> Scenario:
        """Each loop at the rate that its measured time allows, that late; laws that answer at once continuously."""
        T, most, runs, delays = self.ocp.horizon, self.settings.fastest, list[MethodRun](), list[float]()
        for run, judgement in zip(self.runs, calm, strict=True):
            ms = judgement.ms_per_control[np.isfinite(judgement.ms_per_control)]
            seconds = float(np.quantile(ms, 0.95)) / 1e3 if ms.size else 0.0
            if run.solved is not None or (seconds * INSTANT < T and run.hold is None):
                runs.append(run)
                delays.append(0.0)
                continue
            K = int(np.clip(T / max(seconds, T / most), 1, most))
            delays.append(min(seconds, T / K))
            runs.append(replace(run, hold=K, how=how(K, delays[-1]), controller=at_rate(run.controller, K)))
        text = ("Each controller at the rate that it can afford: its measured time (95 % of the states take no longer) "
                f"is its delay, and it is asked again when it has answered, {most} times at most.")
        return self.play("real time", text, runs, best, delays=delays)

    def play(self, name: str, text: str, runs: Sequence[MethodRun], best: Array, delays: Sequence[float] | None = None,
             **disturbance: Any) -> Scenario:
        return self.scenario(name, text, runs, self.judged(name, runs, delays, **disturbance), best, delays)

    def judged(self, name: str, runs: Sequence[MethodRun], delays: Sequence[float] | None = None,
               **disturbance: Any) -> list[Judgement]:
        late = [0.0 if run.solved is not None else d for run, d in
                zip(runs, delays or [0.0] * len(runs), strict=True)]
        job = Judging(self.ocp, self.starts, list(runs), Disturbance(seed=self.settings.seed, **disturbance), late,
                      timed=name == "undisturbed", tolerance=self.tolerance)
        folder = None if self.out is None else self.out / f"{folder_name(name)}-{key_of(job)[:12]}"
        return judge(job, self.workers, folder, self.progress, name)

    def scenario(self, name: str, text: str, runs: Sequence[MethodRun], judgements: Sequence[Judgement], best: Array,
                 delays: Sequence[float] | None = None) -> Scenario:
        losses, counted = [], self.counted(best, judgements)
        for run, j, d in zip(runs, judgements, delays or [0.0] * len(runs), strict=True):
            said = run.how if run.solved is not None else how(run.hold, d)
            ok = np.asarray(j.simulation.success, dtype=bool)
            cost = np.where(ok, j.simulation.cost, np.inf)
            losses.append(ScenarioLoss(run.name, said, cost, best, ok, j.ms_per_control, counted))
        return Scenario(name, text, tuple(losses))

    def counted(self, best: Array, judgements: Sequence[Judgement]) -> Array:
        """[B], the states that count: on a problem with constraints those from which a plan, or a run, holds them."""
        if not self.ocp.constraint_names:
            return np.ones(len(best), dtype=bool)
        return np.any([np.isfinite(best), *(j.simulation.success for j in judgements)], axis=0)


def _text(sigma: float | Sequence[float]) -> str:
    return f"{sigma:g}" if isinstance(sigma, (int, float)) else "[" + ", ".join(f"{v:g}" for v in sigma) + "]"


def mass_variants(ocp: OCP, share: float = 0.2) -> dict[str, System]:
    """{"masses +20 %": System, ...} of a problem that comes with nocl, as its constants stand by default; else {}.

    Every mass is scaled alike; where a system has none, every constant but gravity and bounds is.
    """
    if ocp.system.name not in NAMES or ocp.system.np:
        return {}
    make = import_module(f"nocl.systems.{ocp.system.name}").system
    constants = {name: p.default for name, p in inspect.signature(make).parameters.items()}
    if not _same(make(), ocp.system):  # other constants than the default ones: which is not known
        return {}
    masses = [name for name in constants if name == "mass" or name.startswith("m_") or name in ("m", "m1", "m2")]
    chosen = masses or [name for name in constants if name != "g" and not name.endswith("_max")]
    what = "masses" if masses else "constants"
    return {f"{what} {sign}{100 * share:g} %": make(**{name: constants[name] * factor for name in chosen})
            for sign, factor in (("+", 1 + share), ("-", 1 - share)) if chosen}


def _same(a: System, b: System) -> bool:
    """Whether two systems have the same equations, by trial at random points."""
    if a.names != b.names:
        return False
    z = np.random.default_rng(0).uniform(-1, 1, (a.nx + a.nu, 8))
    return np.allclose(a.f(z[: a.nx], z[a.nx:]).full(), b.f(z[: a.nx], z[a.nx:]).full(), rtol=1e-12, atol=1e-12)
