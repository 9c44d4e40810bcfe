"""The judge: any controller on the exact f under CVODES, the cost as an extra state. B is the batch, K the intervals.

Three kinds of control are judged alike:

- continuous feedback, where the controller is a CasADi Function policy:(x, t) -> u or has `to_casadi()`: the policy
  stands inside the ODE;
- sampled feedback, where it is any callable (x [B, nx], t) -> u [B, nu], or with `hold=K`: asked at the start of each
  of K equal intervals, its answer held;
- open loop, where it is an array u [B, K, nu]: held.

Feedback that says how long it holds a control, by its `control_dt`, as a safeguard does, is sampled so by default.

A system in discrete time is iterated, x+ = F(x, u, t, p): feedback of either kind is asked at every sample, and
constraints are judged there.

Where the horizon is free feedback runs until it arrives, and plans to their own ends (arrival.py).

On a problem with parameters they are functions of (x, t, p), p [B, np]; those of a problem without, of (x, t).

The judge clips every control to U, and starts CVODES anew wherever a control or a state jumps. Constraints are judged
between the nodes too, at BETWEEN times in each interval, those that hold the control under the one that acts there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.definition import discrete
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.judge.arrival import arriving, arriving_held, planned
from nocl.judge.laws import (
    answer_of,
    check_made_for,
    check_takes_p,
    dynamics_function,
    own_holds,
    policy_function,
    takes_p,
)
from nocl.judge.runs import Ask, Judge, Simulation
from nocl.support import checks
from nocl.support.checks import Array

Kicks = Sequence[tuple[float, ArrayLike]]
COUNTS = ("fallbacks", "lost")  # that a controller may keep of its last run, [B]
NODES = 81  # that continuous feedback is recorded at, where nobody says


def simulate(ocp: OCP, controller: Any, x0: ArrayLike, *, f: Any = None, hold: int | None = None,
             nodes: int | None = None, kicks: Kicks | None = None, delay: float = 0.0, t0: float = 0.0, p: Any = None,
             rtol: float = 1e-9, atol: float = 1e-10, tolerance: float = TOLERANCE, horizon: ArrayLike | None = None,
             duration: float | None = None) -> Simulation:
    """Run and score a controller on an OCP from states x0 [nx] or [B, nx].

    Parameters
    ----------
    controller : policy:(x, t[, p]) -> u as a casadi.Function or by `to_casadi()`, callable, or controls [B, K, nu]
    p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
    f : casadi.Function (x, u[, t][, p]) -> xdot, or an object with `to_casadi()`
        Another plant than the exact one.
    hold : K, sample the feedback at K equal intervals; default: continuous where it can be, else as its own
        `control_dt` has it, or nodes - 1
    nodes : number of nodes that continuous feedback is recorded at; default: 81
    kicks : (time, dx [nx] or [B, nx]), added to the state at that time
    delay : time from a sample of the state to its control, at most an interval; the last control acts meanwhile. The
        first control is there at once: where a run starts is known before it does
    t0 : start, so that a tail of the horizon can be judged
    tolerance : a run that violates a constraint by more than this share of its scale has failed
    horizon : of plans, where it is free (nocl.Free): a number, or [B]
    duration : where the horizon is nocl.INFINITE: how long to run; the cost is that of this time alone

    Where the horizon is free, feedback runs until it arrives: until all terminal constraints hold within the tolerance.
    `hold` then counts parts of the longest horizon, `nodes` those of each run. One that does not arrive has failed.

    A system in discrete time has a node and a control for each sample from t0 on: `hold` and `nodes` are these or left
    out, kicks come at samples, and there is no delay.

    Raises ValueError for shapes that do not fit. A state that blows up or a NaN control is a row with success False.
    """
    checks.problem(ocp, "simulate", infinite=True, discrete=True)
    check_made_for(ocp, controller, "the controller")
    ocp = _lasting(ocp, duration)
    rows, _ = checks.states(x0, ocp.system.nx, ocp.system.name)
    t0, asked = _check_options(ocp, hold, nodes, t0), nodes
    nodes = NODES if nodes is None else nodes
    for name, value in (("rtol", rtol), ("atol", atol)):
        checks.number(value, name, "simulate", positive=True)
    most = checks.number(tolerance, "tolerance", "simulate")
    values = ocp.parameters_of(p, len(rows), "simulate")
    judge = Judge(ocp, dynamics_function(ocp, f), values, float(rtol), float(atol), most)
    if ocp.is_free:
        _refuse_moments(kicks, delay, t0)
    jumps = _jumps(ocp, kicks, len(rows), t0)
    policy = policy_function(ocp, controller)
    if ocp.is_free:
        return _to_its_own_end(judge, controller, policy, rows, hold, nodes, horizon)
    if horizon is not None:
        raise ValueError(f"simulate: horizon is {checks.shown(horizon)}; expected none where the problem's own is no "
                         "nocl.Free")
    if ocp.system.is_discrete:
        return _in_steps(judge, controller, policy, rows, _samples(ocp, t0, hold, asked, delay), jumps)
    if policy is not None and hold is None:
        _check_delay(delay, 0.0, "continuous feedback: give `hold`")
        return judge.continuous(policy, rows, np.linspace(t0, ocp.horizon, nodes), jumps)
    if isinstance(controller, (np.ndarray, list, tuple)):
        u = _controls(ocp, controller, len(rows), hold)
        ask, K = (lambda x, t, k: u[:, k]), u.shape[1]
        _check_delay(delay, 0.0, "open loop, which samples nothing")
    else:
        K = hold or own_holds(controller, ocp.horizon - t0) or nodes - 1
        ask = _feedback(ocp, controller, policy, values)
        _check_delay(delay, (ocp.horizon - t0) / K, f"feedback that is sampled {K} times: sample it less often")
    run = judge.held(ask, rows, np.linspace(t0, ocp.horizon, K + 1), jumps, delay)
    counts: dict[str, Any] = {name: np.array(getattr(controller, name)) for name in COUNTS if hasattr(controller, name)}
    return replace(run, **counts)


def _lasting(ocp: OCP, duration: float | None) -> OCP:
    """The problem that a run is judged on: of an infinite horizon a part."""
    if ocp.is_infinite:
        return ocp.lasting(checks.number(duration, "duration", "simulate (the horizon is INFINITE)", positive=True))
    if duration is not None:
        raise ValueError(f"simulate: duration is {checks.shown(duration)}; expected none where the horizon is not "
                         "nocl.INFINITE")
    return ocp


def _samples(ocp: OCP, t0: float, hold: int | None, nodes: int | None, delay: float) -> Array:
    """The times of the samples from t0 to the horizon; ValueError where others are asked for."""
    s = ocp.system
    first, steps = discrete.first_step(ocp, t0, "simulate"), ocp.steps
    assert steps is not None
    left = steps - first
    for name, value, own in (("hold", hold, left), ("nodes", nodes, left + 1), ("delay", delay, 0.0)):
        if value not in (None, own):
            raise ValueError(f"simulate: {name} is {value!r}, and {s.name!r} is a system in discrete time, with {left} "
                             f"steps of dt = {s.dt:g} from t0 = {t0:g} on; expected {own}: leave it out")
    return discrete.samples(s, first, steps)


def _in_steps(judge: Judge, controller: Any, policy: ca.Function | None, x0: Array, t: Array,
              jumps: list[tuple[float, Array]]) -> Simulation:
    """Runs of a system in discrete time with the samples t [K+1]."""
    ocp, K, s = judge.ocp, len(t) - 1, judge.ocp.system
    assert s.dt is not None
    moved = [(s.dt * discrete.steps_in(s, when, "the time of a kick", "simulate"), dx) for when, dx in jumps]
    if not isinstance(controller, (np.ndarray, list, tuple)):
        return judge.held(_feedback(ocp, controller, policy, judge.p), x0, t, moved)
    u = _controls(ocp, controller, len(x0), None)
    if u.shape[1] != K:
        raise ValueError(f"controls have shape {np.shape(controller)}; expected K = {K}, one for each step of "
                         f"dt = {s.dt:g} from t0 = {t[0]:g} to {t[-1]:g}")
    return judge.held(lambda x, t, k: np.asarray(u[:, k]), x0, t, moved)


def _check_options(ocp: OCP, hold: int | None, nodes: int | None, t0: float) -> float:
    """t0, a float; ValueError where one of them is wrong."""
    if hold is not None:
        checks.whole(hold, "hold", "simulate (None: continuous feedback)", 1)
    if nodes is not None:
        checks.whole(nodes, "nodes", "simulate", 2)
    return checks.start_time(t0, ocp.longest)


def _check_delay(delay: float, most: float, of: str) -> None:
    found = checks.finite(delay)
    if found is None or not 0 <= found <= most * (1 + 1e-9):
        raise ValueError(f"delay is {delay!r}; expected 0 <= delay <= {most:g} for {of}")


def _jumps(ocp: OCP, kicks: Kicks | None, B: int, t0: float) -> list[tuple[float, Array]]:
    """The kicks in order of time, as rows [B, nx]."""
    jumps = []
    if not isinstance(kicks, (list, tuple, type(None))) or \
            not all(isinstance(kick, (list, tuple)) and len(kick) == 2 for kick in kicks or ()):
        raise ValueError(f"simulate: kicks is {checks.shown(kicks)}; expected a list of pairs (time, dx [nx] or "
                         "[B, nx])")
    for when, dx in kicks or ():
        time = checks.between(when, -np.inf, np.inf, "the time of a kick", "simulate")
        what, expected = f"the kick at t = {time:g}", f"finite ({ocp.system.nx},) or ({B}, {ocp.system.nx})"
        d = checks.numeric(dx, what, "simulate", expected)
        if d.shape not in ((ocp.system.nx,), (B, ocp.system.nx)) or not np.isfinite(d).all():
            raise ValueError(f"{what} has shape {d.shape}; expected {expected}")
        if not t0 <= time <= ocp.horizon:
            raise ValueError(f"a kick at t = {time:g}; expected a time in [{t0:g}, {ocp.horizon:g}]")
        jumps.append((time, np.broadcast_to(d, (B, ocp.system.nx))))
    return sorted(jumps, key=lambda jump: jump[0])


def _refuse_moments(kicks: Kicks | None, delay: float, t0: float) -> None:
    for name, value, usual in (("kicks", kicks or None, None), ("delay", delay, 0.0), ("t0", t0, 0.0)):
        if value != usual:
            raise ValueError(f"simulate: {name} is {checks.shown(value)}; a run whose horizon is free takes none: give "
                             "the problem a number as horizon (dataclasses.replace(ocp, horizon=...))")


def _to_its_own_end(judge: Judge, controller: Any, policy: ca.Function | None, x0: Array, hold: int | None, nodes: int,
                    horizon: ArrayLike | None) -> Simulation:
    """Runs whose horizon is free."""
    ocp = judge.ocp
    if isinstance(controller, (np.ndarray, list, tuple)):
        return planned(judge, _controls(ocp, controller, len(x0), hold), x0, _horizons(ocp, horizon, len(x0)))
    if horizon is not None:
        raise ValueError(f"simulate: horizon is {checks.shown(horizon)}; expected none: feedback says itself when it "
                         "arrives")
    if not ocp.held_at_end:
        raise ValueError(f"the problem on {ocp.system.name!r} has a free horizon and no terminal constraints, so that "
                         "feedback arrives nowhere; expected terminal_constraints, or a plan with its horizon")
    if policy is not None and hold is None:
        return arriving(judge, policy, x0, nodes)
    return arriving_held(judge, lambda p: _feedback(ocp, controller, policy, p), x0, hold or nodes - 1)


def _horizons(ocp: OCP, horizon: ArrayLike | None, B: int) -> Array:
    """[B], those of plans."""
    low, high = ocp.horizon.low, ocp.horizon.high
    expected = f"a number or [{B}] in [{low:g}, {high:g}], when each plan ends (Solution.t[:, -1])"
    if horizon is None:
        raise ValueError(f"simulate: horizon is None; the problem on {ocp.system.name!r} has a free one: {expected}")
    T = checks.numeric(horizon, "horizon", "simulate", expected)
    slack = 1e-9 * high
    if T.shape not in ((), (B,)) or not (np.clip(T, low - slack, high + slack) == T).all():
        raise ValueError(f"simulate: horizon is {checks.shown(horizon)}; expected {expected}")
    return np.broadcast_to(T, B)


def _controls(ocp: OCP, controls: ArrayLike, B: int, hold: int | None) -> Array:
    """[B, K, nu], those of plans."""
    u = checks.numeric(controls, "the controls", "simulate", f"[B, K, nu] = [{B}, K, {ocp.system.nu}]")
    if u.ndim == 2 and B == 1:
        u = u[None]
    if u.ndim != 3 or u.shape[0] != B or u.shape[2] != ocp.system.nu or u.shape[1] < 1:
        raise ValueError(f"controls have shape {np.shape(controls)}; expected [B, K, nu] = [{B}, K, {ocp.system.nu}]: "
                         "one row of K held controls for each x0")
    if hold not in (None, u.shape[1]):
        raise ValueError(f"hold is {hold}, but the controls have K = {u.shape[1]} intervals; expected these: leave "
                         "hold out")
    return u


def _feedback(ocp: OCP, controller: Any, policy: ca.Function | None, p: Array) -> Ask:
    nu = ocp.system.nu
    if policy is None and not callable(controller):
        raise ValueError(f"the controller is a {type(controller).__name__}; expected a callable (x, t) -> u, "
                         "a casadi.Function, an object with to_casadi(), or controls [B, K, nu]")
    more = [p] if takes_p(ocp, controller) else []
    if policy is None:
        check_takes_p(ocp, controller)
    columns = [p.T] if ocp.np else []

    def ask(x: Array, t: float, k: int) -> Array:
        answer = answer_of(controller, x, t, *more) if policy is None else policy(x.T, t, *columns).full().T
        u = checks.numeric(answer, "the controller's answer", "simulate", f"[B, nu] = [{len(x)}, {nu}]")
        if u.shape != (len(x), nu):
            raise ValueError(f"the controller answered with shape {u.shape} at t = {t:g}; expected [B, nu] = "
                             f"[{len(x)}, {nu}] for x of shape {x.shape}")
        return u

    return ask
