"""What the page draws from: a Results as compact plain data, arrays in base64. B is the batch, M the methods.

Runs are the bulk. Each (state, channel) of a method is kept at some times as 16-bit steps between its least and its
greatest value, an error of at most 1 / 131068 of that range: far below a pixel. The page decodes them at a click.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl.comparisons.report import limits
from nocl.comparisons.report.explain import explained_method
from nocl.comparisons.report.findings import MethodAudit, Rollouts
from nocl.comparisons.report.results import Judged, Results
from nocl.comparisons.report.tables import AUDITED, failure
from nocl.definition.ocp import OCP
from nocl.support.checks import Array

NODES = {81: 1_500_000, 41: 2_500_000, 21: 3_700_000}  # times of a run, and the characters that all runs may take then
ROLLOUTS = 1_500_000  # characters that the audits' rollouts may take: left out where they take more
MISSING = 65535  # the 16-bit step that stands for NaN
PAIRS = 6  # of coordinates that V is drawn over
TIMES = (0.0, 0.5, 0.9)  # of the horizon that V is drawn at
GRID = 41  # points of a slice of V in each direction
OUTLINE = 121  # points of the grid that an obstacle's edge is found on, in each direction
MARGIN = 0.15  # of what runs visit, about a slice
# numbers of a method and state, by the names that the page looks them up by
NUMBERS: dict[str, Callable[[Judged], Array]] = {
    "cost": lambda j: j.cost, "running": lambda j: j.simulation.running_cost,
    "terminal": lambda j: j.simulation.terminal_cost, "error": lambda j: j.simulation.terminal_error,
    "saturation": lambda j: j.simulation.saturation, "clearance": lambda j: j.simulation.clearance,
    "first": lambda j: j.ms_first, "later": lambda j: j.ms_per_control}


def payload(report: Results) -> dict[str, Any]:
    """All that the page's figures need, as JSON data."""
    s, kept = report.ocp.system, kept_states(report)
    nodes, states = kept
    return {"name": s.name, "states": s.state_names, "controls": s.control_names,
            "labels": [s.unit(name) for name in s.names], "horizon": report.last,
            "goal": _goal(report), **_parameters(report),
            "lbu": s.lbu.tolist(), "ubu": s.ubu.tolist(), "explained": explained_method(report),
            "numbers": list(NUMBERS),
            "channels": channels(report), "B": len(report.x0), "x0": floats(report.x0), "gap": floats(report.gap),
            "feasible": report.feasible.astype(int).tolist(),
            "best": [_index(report, i) for i in range(len(report.x0))],
            "methods": [_method(report, j, nodes, states) for j in report.judged],
            "kept": None if len(states) == len(report.x0) else states.tolist(),
            "impossible": {str(i): report.impossible[i] for i in np.flatnonzero(~report.counted)},
            "counted": int(report.counted.sum()), "lines": [list(line) for line in limits.lines(report.ocp)],
            "held": [{"name": one.name, "bounds": [b for b in (one.low, one.high) if math.isfinite(b)]}
                     for one in limits.others(report.ocp)],
            "plane": plane(report), "obstacles": obstacles(report), "slices": slices(report), **_study(report)}


def _goal(report: Results) -> list[float | None]:
    """(x*, u*); null for each where there is none."""
    ocp = report.ocp
    return [*ocp.x_goal.tolist(), *ocp.u_goal.tolist()] if ocp.has_goal else [None] * len(ocp.system.names)


def _parameters(report: Results) -> dict[str, Any]:
    """The parameters of each state, and its goal where that depends on them."""
    ocp, p = report.ocp, report.parameters
    if not ocp.np:
        return {}
    goals = {"goals": floats(np.concatenate(ocp.goals(p), axis=1))} if ocp.goal_varies else {}
    return {"parameters": ocp.parameter_names, "plabels": [ocp.unit(name) for name in ocp.parameter_names],
            "p": floats(p), "nominal": ocp.nominal.tolist(), **goals}


def floats(values: ArrayLike) -> str:
    """Little-endian float32 in base64; NaN and inf stay."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()


def kept_states(report: Results) -> tuple[int, NDArray[np.integer[Any]]]:
    """(nodes, states) whose runs fit into the page: all states if they can, else the worst and an even choice."""
    width = len(report.ocp.system.names) + len(channels(report))
    size = len(report.judged) * width * 2 * 4 / 3  # characters of one state at one node
    for nodes, budget in NODES.items():
        if len(report.x0) * (nodes + 4) * size <= budget:
            return nodes, np.arange(len(report.x0))
    n = max(1, int(budget / ((nodes + 4) * size)))
    order = np.argsort(-report.gap[explained_method(report)], kind="stable")
    even = np.linspace(0, len(order) - 1, n - n // 4).astype(int)
    return nodes, np.unique(np.r_[order[: n // 4], order[even]])


def channels(report: Results) -> dict[str, int]:
    """Where in a run stands what follows its states and controls: the cost to go, V where a method has one, the values
    of constraints, by name, and the time where each run has its own.
    """
    names = ["togo", *(["V"] if valued(report) is not None else []),
             *(f"held {one.name}" for one in limits.others(report.ocp)), *(["time"] if report.ocp.is_free else [])]
    return {name: k for k, name in enumerate(names, len(report.ocp.system.names))}


def valued(report: Results) -> Judged | None:
    """The first method with a value function V(x, t[, p]); none where each run has times of its own."""
    return None if report.ocp.is_free else next((j for j in report.judged if j.value is not None), None)


def _index(report: Results, i: int) -> int:
    """The method that found the best known cost, -1 where none did."""
    found = report.best_index(i)
    return -1 if found is None else found


def _method(report: Results, j: Judged, nodes: int, states: NDArray[np.integer[Any]]) -> dict[str, Any]:
    s = j.simulation
    last, free = s.x.shape[1] - 1, report.ocp.is_free
    index = np.unique(np.rint(np.linspace(0, last, min(nodes, last + 1))).astype(int))
    parts = [s.x[states], s.u[states], cost_to_go(report, j)[states, :, None]]  # in the order of `channels`
    run = np.concatenate([part[:, index] for part in parts], axis=2)
    if (owner := valued(report)) is not None:
        along = values_along(owner, s.t[index], s.x[states][:, index], report.parameters[states])
        run = np.concatenate([run, along[..., None]], axis=2)
    run = np.concatenate([run, limits.values(report.ocp, s, report.parameters)[states][:, index]], axis=2)
    run = np.concatenate([run, s.times[states][:, index, None]], axis=2) if free else run
    numbers = np.stack([read(j) for read in NUMBERS.values()], axis=1)
    failed = {str(i): failure(report, report.judged.index(j), i) for i in np.flatnonzero(~j.feasible)}
    return {"name": j.name, "how": j.how, "held": j.held, "t": None if free else s.t[index].tolist(), "failed": failed,
            "numbers": floats(numbers), **quantised(run)}


def quantised(run: Array) -> dict[str, str]:
    """[n, K, channels] as 16-bit steps of each (state, channel) and their limits [n, channels, 2]."""
    run = np.where(np.isfinite(run), run, np.nan)
    missing = np.isnan(run)
    low = np.where(missing, np.inf, run).min(axis=1, keepdims=True)
    high = np.where(missing, -np.inf, run).max(axis=1, keepdims=True)
    low, high = (np.where(np.isfinite(v), v, 0.0).astype("<f4").astype(float) for v in (low, high))
    width = np.where(high > low, high - low, 1.0)
    steps = np.clip(np.rint((run - low) / width * (MISSING - 1)), 0, MISSING - 1)
    whole = np.where(missing, MISSING, steps).astype("<u2")
    return {"runs": base64.b64encode(whole.tobytes()).decode(),
            "limits": floats(np.stack([low[:, 0], high[:, 0]], axis=-1))}


def cost_to_go(report: Results, j: Judged) -> Array:
    """[B, K+1], what a run still costs at its nodes: L by trapezoids, scaled so that it starts at the judged cost."""
    s, ocp, p = j.simulation, report.ocp, report.parameters
    end = s.u[:, :-1] if j.held else s.u[:, 1:]
    t = s.times
    first, last = _running(ocp, t[:, :-1], s.x[:, :-1], s.u[:, :-1], p), _running(ocp, t[:, 1:], s.x[:, 1:], end, p)
    steps = 0.5 * np.diff(t) * (first + last)
    total = steps.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = steps * np.where(np.abs(total) > 0, s.running_cost / total, 1.0)[:, None]
        left = np.c_[np.cumsum(steps[:, ::-1], axis=1)[:, ::-1], np.zeros(len(steps))]
        return np.asarray(left + s.terminal_cost[:, None])


def _running(ocp: OCP, t: Array, x: Array, u: Array, p: Array) -> Array:
    """[B, K], L at t [B, K], x [B, K, nx], u [B, K, nu], p [B, np]."""
    (B, K), of = x.shape[:2], ocp.functions
    given = of.arguments.columns(x=x.reshape(B * K, -1), u=u.reshape(B * K, -1), t=t.ravel(), p=np.repeat(p, K, 0))
    return np.asarray(of.L(*given).full().reshape(B, K))


def values_along(owner: Judged, t: Array, x: Array, p: Array) -> Array:
    """[n, K], the owner's V along the runs x [n, K, nx] at parameters p [n, np]."""
    return np.stack([_values(owner, x[:, k], float(t[k]), p) for k in range(len(t))], axis=1)


def _values(owner: Judged, x: Array, t: float, p: Array) -> Array:
    """[n], V(x, t[, p]), NaN where x is not finite."""
    known = np.isfinite(x).all(axis=1)
    V = np.full(len(x), np.nan)
    if owner.value is not None and known.any():
        V[known] = np.asarray(owner.value(x[known], t, p[known]), dtype=float).reshape(-1)
    return V


def plane(report: Results) -> list[int]:
    """The two coordinates (of states, then controls) of a phase portrait: an obstacle's, or a state and its rate."""
    for pair in _obstacle_pairs(report.ocp):
        return list(pair)
    s, moved = report.ocp.system, _moved(report)
    if s.nx == 1:
        return [0, 1]
    at = report.ocp.functions.stage
    pairs = [] if s.xdot is None else [(i, k) for i in range(s.nx) for k in range(s.nx) if i != k
                                       and ca.is_equal(at.xdot[i], at.x[k], 0)]
    best = max(pairs, key=lambda pair: moved[pair[0]], default=None)
    return list(best) if best else sorted(np.argsort(-moved, kind="stable")[:2].tolist())


def _moved(report: Results) -> Array:
    """[nx], what each coordinate moves by along the runs, as a share of its box."""
    spans = []
    for j in report.judged:
        x = j.simulation.x[np.isfinite(j.simulation.x).all(axis=(1, 2))]
        if len(x):
            spans.append(np.median(np.ptp(x, axis=1), axis=0))
    s = report.ocp.system
    return np.max(spans, axis=0) / (s.ubx - s.lbx) if spans else np.zeros(s.nx)


def visited(report: Results) -> tuple[Array, Array]:
    """(lower, upper) [nx] of the states that runs visit, without the outermost hundredths."""
    x = np.concatenate([j.simulation.x.reshape(-1, report.ocp.system.nx) for j in report.judged])
    x = x[np.isfinite(x).all(axis=1)]
    x = np.concatenate([x, report.x0, report.ocp.x_goal[None]])
    low, high = np.percentile(x, [0.5, 99.5], axis=0)
    low, high = np.minimum(low, report.ocp.x_goal), np.maximum(high, report.ocp.x_goal)
    room = MARGIN * np.where(high > low, high - low, 1.0)
    return low - room, high + room


def _obstacle_pairs(ocp: OCP) -> dict[tuple[int, int], list[int]]:
    """Path constraints by the two coordinates that they depend on, where it is two; not those that move with t or p."""
    pairs: dict[tuple[int, int], list[int]] = {}
    at = ocp.functions.node
    for c, h in enumerate(ca.vertsplit(ocp.functions.constraints)):
        on = [k for k in range(ocp.system.nx) if ca.depends_on(h, at["x"][k])]
        if len(on) == 2 and not any(ca.depends_on(h, at[name]) for name in at.names if name != "x"):
            pairs.setdefault((on[0], on[1]), []).append(c)
    return pairs


def obstacles(report: Results) -> list[dict[str, Any]]:
    """The edges of path constraints that depend on two coordinates: min h on a grid of them."""
    low, high = visited(report)
    found = []
    for (i, k), which in _obstacle_pairs(report.ocp).items():
        x = np.tile(report.ocp.x_goal, (OUTLINE**2, 1))
        x[:, i], x[:, k] = (v.ravel() for v in np.meshgrid(*(np.linspace(low[c], high[c], OUTLINE) for c in (i, k))))
        of, n = report.ocp.functions, len(x)
        given = of.node.columns(x=x, t=np.zeros(n), p=np.tile(report.ocp.nominal, (n, 1)))  # of which these are free
        h = of.h(*given).full()[which].min(axis=0)
        found.append({"i": i, "k": k, "x": [low[i], high[i]], "y": [low[k], high[k]], "n": OUTLINE, "h": floats(h)})
    return found


def slices(report: Results) -> dict[str, Any] | None:
    """V over pairs of coordinates at some times, the others as in the median run; None without a value function.

    On a problem with parameters: at those of all states where they share them, else at the nominal ones; a V that was
    made for one p is that.
    """
    owner = valued(report)
    if owner is None:
        return None
    s, moved = owner.simulation, _moved(report)
    low, high = visited(report)
    most = np.argsort(-moved, kind="stable")[:4].tolist()
    first = [k for k in plane(report) if k < report.ocp.system.nx]
    pairs = ([tuple(first)] if len(first) == 2 else []) + list(combinations(sorted(most), 2))
    pairs = list(dict.fromkeys(pairs))[:PAIRS]
    nodes = [int(np.rint(share * (len(s.t) - 1))) for share in TIMES]
    ok = np.isfinite(s.x).all(axis=(1, 2))
    if not pairs or not ok.any():
        return None
    base = [np.median(s.x[ok, k], axis=0) for k in nodes]
    ocp, given = report.ocp, report.parameters
    p = given[0] if len(given) and (given == given[0]).all() else ocp.nominal
    takes_p = getattr(owner.value, "takes_p", False)
    of_p = {"p": p.tolist(), "goal": ocp.goals(p[None])[0][0].tolist()} if takes_p else {}
    V = [[_slice(owner, b, pair, low, high, float(s.t[k]), p) for b, k in zip(base, nodes, strict=True)]
         for pair in pairs]
    return {"method": owner.name, "pairs": [[int(k) for k in pair] for pair in pairs],
            "t": [float(s.t[k]) for k in nodes], "n": GRID, "base": np.array(base).tolist(), "low": low.tolist(),
            "high": high.tolist(), "V": floats(np.array(V)), **of_p}


def _slice(owner: Judged, base: Array, pair: tuple[int, ...], low: Array, high: Array, t: float, p: Array) -> Array:
    """[GRID, GRID] of V, the second coordinate down the rows."""
    x = np.tile(base, (GRID**2, 1))
    i, k = pair
    x[:, i], x[:, k] = (v.ravel() for v in np.meshgrid(*(np.linspace(low[c], high[c], GRID) for c in (i, k))))
    return _values(owner, x, t, np.tile(p, (len(x), 1))).reshape(GRID, GRID)


def _rollout_nodes(report: Results) -> int:
    """Times that the audits' rollouts are kept at: all of them fit, or 0."""
    runs = sum(len(audit.rollouts) for audit in report.audits) * len(report.x0)
    fits = (nodes for nodes in NODES if runs * (nodes + 4) * report.ocp.system.nx * 2 * 4 / 3 <= ROLLOUTS)
    return next(fits, 0)


def _rollout(rollout: Rollouts, nodes: int) -> dict[str, Any]:
    index = np.unique(np.rint(np.linspace(0, len(rollout.t) - 1, min(nodes, len(rollout.t)))).astype(int))
    return {"name": rollout.name, "t": rollout.t[index].tolist(), **quantised(rollout.x[:, index])}


def _audit(audit: MethodAudit, nodes: int) -> dict[str, Any]:
    """What an audit says of each state, by the names that rows have, in the words of the table of audits."""
    rows, words = audit.rows(), dict(AUDITED)
    keys = [key for key in rows[0] if any(not math.isnan(row[key]) for row in rows)]
    return {"method": audit.method, "keys": [words.get(key, key) for key in keys],
            "values": floats([[row[key] for key in keys] for row in rows]),
            "rollouts": [_rollout(rollout, nodes) for rollout in audit.rollouts] if nodes else []}


def _study(report: Results) -> dict[str, Any]:
    """What a study found beyond costs, where it did."""
    parts: list[tuple[str, Callable[[], Any]]] = [
        ("audits", lambda: [_audit(audit, _rollout_nodes(report)) for audit in report.audits]),
        ("robustness", lambda: [] if report.robustness is None else [
            {"name": s.name, "losses": [{"method": x.method, "lost": floats(x.lost)} for x in s.losses]}
            for s in report.robustness.scenarios]),
        ("stability", lambda: [
            {"method": s.method, "where": s.where, "re": floats(s.eigenvalues.real), "im": floats(s.eigenvalues.imag)}
            for s in report.stability]),
        ("regions", lambda: [
            {"method": r.method, "within": r.within, "scale": r.scale.tolist(), "n": r.n,
             "share": (r.successes / r.n).tolist(), "lower": r.lower.tolist(), "upper": r.upper.tolist(),
             "x0": floats(r.x0), "success": r.success.astype(int).ravel().tolist()} for r in report.regions])]
    return {name: make() for name, make in parts}
