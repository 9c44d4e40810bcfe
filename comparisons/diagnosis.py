"""`nocl doctor`: what can be known of a problem before work goes into it, each thing by a test that says what to do.

The goal, controllability there, convexity in the controls, the step of integration, smoothness and symmetries are
looked at, and what controls that are held do; then a few initial states are solved by DDP from several starts, and two
of them again by NMPC; the time that training takes is measured on a few solves and iterations.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.definition.substeps import RK4
from nocl.judge.runs import Simulation
from nocl.judge.simulation import simulate
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.training import estimate
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.grid import fastest_at_start
from nocl.solvers.mirrors import mirrors
from nocl.solvers.nmpc.solver import NMPC
from nocl.support import checks
from nocl.support.checks import Array

OK, REMARK, PROBLEM = "ok", "remark", "PROBLEM"
STILL = 1e-6  # of usual sizes, what a state may drift by over the horizon at a goal that is an equilibrium
RANK = 1e-8  # relative singular values below which a mode is not controlled
UNSTABLE = 1e-6  # modes times the horizon that grow faster need a control
STATES, STARTS = 8, 4  # that are solved
HELD, LOOKS = 4, 32  # that held controls are tried from, and how often they are looked at on the way
CHECKED = 2  # of them by NMPC, too
AGREE = 1e-3  # of the cost: methods that differ by more disagree
SMALL = 1e-3  # of a usual cost: costs are not divided by less
AHEAD = 1e6  # steps, that what blows up is followed
FALLEN = 1e3  # usual costs below 0: what costs as little runs away
NEAR = 0.05  # of the cost: other optima that are so near make a switching surface


@dataclass(frozen=True)
class Finding:
    """What one test says."""

    about: str
    verdict: str  # OK, REMARK or PROBLEM
    text: str

    def __str__(self) -> str:
        return f"{self.about:>16}  {self.verdict:8}{self.text}"


@dataclass(frozen=True)
class Diagnosis:
    """All findings; str() of it has a line for each."""

    findings: tuple[Finding, ...]
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether no test found a problem."""
        return all(finding.verdict != PROBLEM for finding in self.findings)

    def __str__(self) -> str:
        return "\n".join([*map(str, self.findings), f"{self.seconds:.0f} s"])


def doctor(ocp: OCP, intervals: int = 80, seed: int = 0) -> Diagnosis:
    """Examine a problem, in about half a minute for up to six states.

    intervals : of plans; seed : of the initial states and starts. Where the dynamics are not known (xdot=None) the
    tests that need them are left out, and said so.
    """
    checks.problem(ocp, "doctor")
    checks.whole(intervals, "intervals", "doctor", 2)
    checks.whole(seed, "seed", "doctor", most=2**62)
    begin = time.perf_counter()
    if ocp.system.xdot is None:
        found = [Finding("dynamics", REMARK, "not known (xdot=None): nothing else can be tested before a log has "
                         "taught them, nocl identify --data")]
    else:
        found = [*_definition(ocp), *_held(ocp, seed), *_solutions(ocp, intervals, seed), *_time(ocp, intervals, seed)]
    return Diagnosis(tuple(found), time.perf_counter() - begin)


# The definition


def _definition(ocp: OCP) -> Iterator[Finding]:
    if ocp.has_goal:
        yield _goal(ocp)
        yield _control(ocp)
    else:
        yield Finding("goal", OK, "none: what is not about one, controllability there, is left out")
    yield _convexity(ocp)
    if ocp.kinks:
        yield Finding("smoothness", REMARK, ocp.not_smooth)
    found = mirrors(ocp)
    yield Finding("symmetries", OK, f"{len(found)} mirror image(s): solutions of one side serve the other" if found
                  else "none")


def _at_goal(ocp: OCP) -> dict[str, Array]:
    """x, u, t, p at the goal, parameters at their nominal values."""
    p = ocp.nominal[None]
    x, u = (np.asarray(z) for z in ocp.goals(p))
    return {"x": x, "u": u, "t": np.zeros(1), "p": p}


def _goal(ocp: OCP) -> Finding:
    rate = ocp.functions.f(*ocp.functions.arguments.columns(**_at_goal(ocp))).full()[:, 0]
    share = np.abs(rate) * ocp.longest / usual_sizes(ocp).x
    i = int(share.argmax())
    if share[i] <= STILL:
        return Finding("goal", OK, "the goal pair is an equilibrium")
    s = ocp.system
    return Finding("goal", REMARK, f"no equilibrium: d {s.unit(s.state_names[i])} / dt is {rate[i]:.3g} there, so that "
                   "what arrives does not stay: fine if the end alone counts, else choose u_goal so that f(x_goal, "
                   "u_goal) = 0")


def _control(ocp: OCP) -> Finding:
    """The modes at the goal that grow, and no control reaches (Popov, Belevitch and Hautus), each row in its own size.
    """
    of, at = usual_sizes(ocp), _at_goal(ocp)
    A, B = (j.full() for j in ocp.functions.jacobian(*ocp.functions.arguments.columns(**at))[:2])
    A, B, n = ocp.longest * A * of.x / of.x[:, None], ocp.longest * B * of.u / of.x[:, None], len(A)
    floor, lost = RANK**2 * max(np.abs(A).max(), np.abs(B).max(), 1e-300), []
    for mode in np.linalg.eigvals(A):
        rows = np.c_[mode * np.eye(n) - A, B]
        U, sigma, _ = np.linalg.svd(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), floor))
        if mode.real > -UNSTABLE and sigma[-1] < RANK:
            lost.append(ocp.system.state_names[int(np.abs(U[:, -1]).argmax())])
    if not lost:
        return Finding("controllability", OK, "every mode at the goal that does not fall off by itself is controlled")
    return Finding("controllability", REMARK, f"at the goal no control moves {', '.join(sorted(set(lost)))} "
                   "(linearised): LQR on an infinite horizon does not exist; a finite one may do without, or the "
                   "controls there act by products only, as of a car that stands")


def _convexity(ocp: OCP) -> Finding:
    if not ocp.flat_controls:
        return Finding("convexity", OK, "the cost curves in every control")
    return Finding("convexity", REMARK, f"cost and dynamics are linear in {', '.join(ocp.flat_controls)}: the optimum "
                   "jumps between bounds (bang-bang), or is singular. DDP and training add a small quadratic term "
                   "there, and lower it; training's card says what it costs")


def _held(ocp: OCP, seed: int) -> Iterator[Finding]:
    """Whether states stay finite over the horizon under u held at u*, the middle and the bounds of U."""
    if ocp.is_free:
        return
    s, n = ocp.system, HELD
    x0, p = ocp.initial_states.sample(n, seed), ocp.sample_parameters(n, seed)
    laws = {"u*": ocp.goals(p)[1], "the middle of U": np.tile((s.lbu + s.ubu) / 2, (n, 1)),
            "lbu": np.tile(s.lbu, (n, 1)), "ubu": np.tile(s.ubu, (n, 1))}
    lost, least, far = {}, 0.0, 0.0
    for name, u in laws.items():
        held = np.clip(u, s.lbu, s.ubu)
        run = simulate(ocp, np.repeat(held[:, None], LOOKS, axis=1), x0, p=p if ocp.np else None)
        if not run.reached.all():
            lost[name] = int((~run.reached).sum())
        if not ocp.constraint_names:  # else they may be what bounds it
            least, far = min(least, _heading(ocp, run, held, p)), min(far, _cheapest(ocp, run))
    if least < -FALLEN:
        yield Finding("boundedness", PROBLEM, "states blow up under controls that are held, and the cost falls without "
                      "an end while they do: expected one that is bounded below; bound the states (state_bounds, "
                      "constraints), or let what is gained saturate")
        return
    if far < -FALLEN:
        yield Finding("boundedness", REMARK, f"controls that are held cost as little as {far:.2g} times what is usual: "
                      "to run away pays, and the horizon alone ends it; bound the states (state_bounds, constraints) "
                      "where that is not meant")
        return
    if not lost:
        yield Finding("boundedness", OK, "states stay finite over the horizon under controls that are held")
        return
    where = ", ".join(f"{name} ({count} of {n} states)" for name, count in lost.items())
    yield Finding("boundedness", REMARK, f"states blow up before the horizon under u held at {where}: first guesses "
                  "and untrained controllers do so too; a shorter horizon, narrower bounds of U, or saturation in f "
                  "where the plant has it")


def _cheapest(ocp: OCP, run: Simulation) -> float:
    """The least cost of runs, in usual costs; 0 at most."""
    return float(np.fmin.reduce(run.cost, initial=0.0) / usual_sizes(ocp).cost)


def _heading(ocp: OCP, run: Simulation, u: Array, p: Array) -> float:
    """The least L, over the horizon and in usual costs, where runs that blow up are heading: their last step before,
    AHEAD times as long; 0 at most. u [B, nu] is held.
    """
    lost, of = np.flatnonzero(~run.reached), ocp.functions
    last = np.isfinite(run.x[lost]).all(axis=2).sum(axis=1) - 1
    here, before = (run.x[lost, np.maximum(last - back, 0)] for back in (0, 1))
    x = here + AHEAD * (here - before)
    L = of.L(*of.arguments.columns(x=x, u=u[lost], t=run.t[last], p=p[lost])).full()
    return float(np.fmin.reduce(L, axis=None, initial=0.0) * ocp.longest / usual_sizes(ocp).cost)


# Solutions


def _solutions(ocp: OCP, intervals: int, seed: int) -> Iterator[Finding]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            ddp = DDP(ocp, intervals=intervals).as_best_known()
            begin = time.perf_counter()
            found = _solved(ddp, seed)
        except ValueError as error:
            yield Finding("solutions", PROBLEM, f"DDP does not take it: {error}")
            return
        took = time.perf_counter() - begin
    yield _grid(ddp, said)
    yield _success(ddp, found, took)
    if found.success.any():
        yield _inside(ocp, found[found.success])
        yield _rivals(found[found.success])
        yield _second(ocp, found[found.success])


def _time(ocp: OCP, intervals: int, seed: int) -> Iterator[Finding]:
    """How long `nocl train --exact` takes here."""
    if ocp.is_free:
        return
    settings = TrainSettings.of("normal", parameters=ocp.np, intervals=intervals)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            text = estimate(ocp, settings, seed)
        except ValueError as error:
            yield Finding("time needed", REMARK, f"not known, training does not take the problem: {error}")
            return
    yield Finding("time needed", OK, f"training on the exact f takes {text}")


def _solved(ddp: DDP, seed: int) -> Solution:
    x0, p = ddp.ocp.initial_states.sample(STATES, seed), ddp.ocp.sample_parameters(STATES, seed)
    return solve_globally(ddp, x0, p=p if ddp.ocp.np else None, starts=STARTS, rounds=1, seed=seed, progress=False)


def _grid(ddp: DDP, said: list[warnings.WarningMessage]) -> Finding:
    step, fastest = ddp.ocp.longest / ddp.intervals, fastest_at_start(ddp.ocp, ddp.ocp.functions)
    what = "Runge-Kutta" if ddp.integrator == RK4 else "implicit Radau"
    mode = f"the fastest time constant where it starts is {fastest:.3g}" if np.isfinite(fastest) else \
        "nothing decays, grows or swings by itself where it starts"
    text = f"{ddp.substeps} {what} step(s) in each of {ddp.intervals} intervals of {step:.3g}; {mode}"
    coarse = [str(w.message) for w in said if "too coarse" in str(w.message)]
    if ddp.coarse:
        return Finding("integration", PROBLEM, coarse[-1] if coarse else text)
    return Finding("integration", REMARK if ddp.substeps > 1 or ddp.integrator != RK4 else OK, text)


def _success(ddp: DDP, found: Solution, took: float) -> Finding:
    n, solved = len(found), int(found.success.sum())
    text = f"{solved} of {n} initial states by DDP, {STARTS} starts each, {took:.1f} s"
    if solved == n:
        return Finding("solutions", OK, text)
    why = Counter(found.message[~found.success].tolist()).most_common(1)[0][0]
    return Finding("solutions", REMARK if solved > n // 2 else PROBLEM,
                   f"{text}; of the others, most often: {why}. A longer horizon or wider bounds where something cannot "
                   "be reached or held; more intervals where it is stiff")


def _inside(ocp: OCP, found: Solution) -> Finding:
    """Whether plans stay in X, where learned dynamics are trained."""
    s = ocp.system
    over = np.maximum(found.x - s.ubx, s.lbx - found.x).max(axis=(0, 1))
    out = np.flatnonzero(over > STILL * (s.ubx - s.lbx))
    if not out.size:
        return Finding("box X", OK, "plans stay in it")
    names = ", ".join(f"{s.state_names[i]} by {over[i]:.3g}" for i in out)
    return Finding("box X", REMARK, f"plans leave it: {names}. Dynamics are learned inside it, and it holds nothing: "
                   "widen lbx and ubx, or bound the trajectory by state_bounds")


def _rivals(found: Solution) -> Finding:
    """States with another local optimum that costs nearly the same."""
    close = sum(bool(((costs[1:, 0] - costs[0, 0]) <= NEAR * abs(costs[0, 0])).any()) for costs in found.optima
                if len(costs))
    text = f"{close} of {len(found)} states have another optimum within {100 * NEAR:g} % of the best"
    if not close:
        return Finding("rival optima", OK, text)
    return Finding("rival optima", REMARK, f"{text}: somewhere between, the best way switches, and one smooth "
                   "controller loses there; TrainSettings(branches=2) chooses between two answers")


def _second(ocp: OCP, found: Solution) -> Finding:
    """NMPC from starts of its own, on a few states; both plans as the judge sees them, whose steps are as fine as it
    takes.
    """
    some = found[np.arange(min(CHECKED, len(found)))]
    x0, p, about = some.x[:, 0], some.p if ocp.np else None, "second opinion"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = NMPC(ocp, some.u.shape[1], passes=0, starts=STARTS, between=bool(ocp.constraint_names)).solve(
            x0, p=p, workers=1, progress=False)
        ours, theirs = (_judged(ocp, s, x0, p) for s in (some, own))
    if not own.success.any():
        return Finding(about, REMARK, f"NMPC solves none of {len(some)} states: {own.message[0]}")
    if not (np.isfinite(ours).all() and np.isfinite(theirs[own.success]).all()):
        return Finding(about, REMARK, "on the exact dynamics a plan does not hold all constraints, or blows up: more "
                       "intervals")
    off = (theirs - ours) / np.maximum(np.abs(ours), SMALL * usual_sizes(ocp).cost)
    i = int(off.argmin())
    if off[i] < -AGREE:
        return Finding(about, REMARK, f"NMPC is {-100 * off[i]:.2g} % better than DDP from state {i}: there are better "
                       "optima than a few starts find: give training more seeds and starts")
    solved = int(own.success.sum())
    return Finding(about, OK, f"NMPC, from starts of its own, finds nothing better on {solved} state(s)")


def _judged(ocp: OCP, s: Solution, x0: Array, p: Array | None) -> Array:
    """[B], the cost of plans from x0 on the exact dynamics, inf where they fail; of free horizons the plans' own."""
    if ocp.is_free:
        return s.cost
    run = simulate(ocp, np.nan_to_num(s.u), x0, p=p)
    return np.where(run.success & s.success, run.cost, np.inf)
