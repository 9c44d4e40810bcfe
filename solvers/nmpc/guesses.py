"""Where multiple shooting starts from: each guess is states x [N+1, nx], controls u [N, nu], and, where the horizon is
free, the nodes t [N+1]."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nocl.data import Controller
from nocl.definition.ocp import OCP
from nocl.judge.laws import answer_of, takes_p
from nocl.solvers.lqr import LQR
from nocl.solvers.nmpc.transcription import Transcription
from nocl.solvers.starts import HALVINGS, near, random_start, spread_horizon
from nocl.support import checks
from nocl.support.checks import Array

Guess = tuple[Array, ...]  # (x, u), or (x, u, t)
BULGES = 0.1 * 1.4 ** np.arange(12)  # of a line round an obstacle, in lengths of the line


def starts(program: Transcription, lqr: LQR | None, x0: Array, t: Array, begin: int, n: int, seed: int,
           p: Array | None = None) -> list[Guess]:
    """Numbers begin ... begin + n - 1 of: x0 held under u*, an LQR rollout, a straight line to the goal, lines round
    each obstacle that it crosses, on either side, smooth random controls.

    p : the parameters [np], where there are some; lqr is that at them
    The random controls depend on `seed` and their number alone, so that a state gets the same starts in any batch.
    """
    ocp, N, row = program.ocp, program.N, np.zeros((1, 0)) if p is None else p[None]
    u_goal = np.tile(ocp.goals(row)[1], (N, 1))
    found: list[Guess] = [(np.tile(x0, (N + 1, 1)), u_goal)]
    if begin + n > 1 and lqr is not None:
        found += lqr_rollout(program, lqr, x0, t, p)
    if ocp.has_goal:
        found.append((x0 + np.linspace(0.0, 1.0, N + 1)[:, None] * -ocp.from_goal(x0, row[0]), u_goal))
        found += [(x, u_goal) for x in (sides(ocp, x0, N, t, p) if program.n_path else [])]
    random = (random_start(ocp, N, 1, np.random.default_rng([seed, number]), number, row)[0]
              for number in range(max(begin, len(found)), begin + n))
    return found[begin:begin + n] + [controlled(program, x0, u, t, p) for u in random]


def with_horizons(program: Transcription, x0: Array, t: Array, begin: int, n: int, seed: int,
                  p: Array | None = None) -> list[Guess]:
    """Those `starts` where the horizon is free, each with another one: evenly spread, of a logarithmic scale."""
    found = list[Guess]()
    for number in range(begin, begin + n):
        nodes = t / t[-1] * spread_horizon(program.ocp.horizon, number)
        found += [(*guess, nodes) for guess in starts(program, None, x0, nodes, number, 1, seed, p)]
    return found


def lqr_of(ocp: OCP) -> LQR | None:
    """LQR about the goal, or None where the problem has none."""
    try:
        lqr = LQR(ocp if ocp.states_only else ocp.unconstrained)
        lqr.P(0.0)
    except ValueError:
        return None
    return lqr


def controlled(program: Transcription, x0: Array, u: Array, t: Array, p: Array | None = None) -> Guess:
    """The rollout of controls u [N, nu] from x0, moved towards u* until it stays near the box X.

    A rollout that never does (an unstable system) gives way to x0 held.
    """
    u_goal = program.ocp.u_goal if p is None else program.ocp.goals(p[None])[1]
    for _ in range(HALVINGS):
        x = program.rolled(x0, u, t, p)
        if near(program.ocp.system, x):
            return x, u
        u = (u + u_goal) / 2
    return np.tile(x0, (len(u) + 1, 1)), u


def lqr_rollout(program: Transcription, lqr: LQR, x0: Array, t: Array, p: Array | None = None) -> list[Guess]:
    """LQR, clipped to U, from x0 on the nodes t [N+1]; nothing where it runs away."""
    N = program.N
    x, u = np.empty((N + 1, len(x0))), np.empty((N, program.ocp.system.nu))
    x[0] = x0
    for k in range(N):
        u[k] = lqr(x[k], t[k])
        x[k + 1] = program.stepped(x[k], u[k], t, k, p)
        if not near(program.ocp.system, x[:k + 2]):
            return []
    return [(x, u)]


def from_neighbour(x0: Array, x: Array, u: Array) -> Guess:
    """A neighbour's solution, its states moved to x0 and back to its own at the end."""
    fade = np.linspace(1, 0, len(x))[:, None]
    return x + fade * (x0 - x[0]), u


def controller_rollout(program: Transcription, controller: Controller, x0: Array, t: Array,
                       p: Array | None = None) -> Guess:
    """A controller (x, t[, p]) -> u from x0, sampled at the nodes, held and clipped to U; where it fails, x stays."""
    s, N, ocp = program.ocp.system, program.N, program.ocp
    x, u = np.tile(x0, (N + 1, 1)), np.tile(ocp.u_goal if p is None else ocp.goals(p[None])[1], (N, 1))
    more = [p] if takes_p(ocp, controller) else []
    for k in range(N):
        answer = checks.numeric(answer_of(controller, x[k], float(t[k]), *more), "the guess's answer", "NMPC",
                                f"u [{s.nu}]")
        if answer.size != s.nu:
            raise ValueError(f"NMPC: the guess's answer has shape {answer.shape}; expected u [{s.nu}]")
        control = np.clip(answer.reshape(s.nu), s.lbu, s.ubu)
        end = program.stepped(x[k], control, t, k, p)
        if not (np.isfinite(control).all() and np.isfinite(end).all()):
            x[k + 1:] = x[k]
            break
        x[k + 1], u[k] = end, control
    return x, u


def sides(ocp: OCP, x0: Array, N: int, t: Array | None = None, p: Array | None = None) -> list[Array]:
    """Lines from x0 to the goal [N+1, nx], bent round each obstacle that the straight one crosses, on either side.

    The times t [N+1] of the nodes and parameters p [np], where the problem has them.
    """
    s, found, node = np.linspace(0.0, 1.0, N + 1)[:, None], list[Array](), ocp.functions.node
    off = ocp.from_goal(x0, p)
    line, times = x0 - s * off, np.zeros(N + 1) if t is None else t
    for i in range(len(ocp.h_titles)):
        values = ocp.h(*node.columns(x=line, t=times, p=p)).full()[i]
        k = int(np.argmin(values))
        if values[k] >= 0:
            continue
        slopes = ocp.functions.h_derivatives(*node.columns(x=line[k], t=times[k], p=p), 0)[1]
        across = _across(slopes, i, -off)
        if across is None:
            continue
        for side in (across, -across):
            bent = (line + bulge * np.sin(np.pi * s) * side for bulge in BULGES)
            found += [x for x in bent if ocp.h(*node.columns(x=x, t=times, p=p)).full()[i].min() >= 0][:1]
    return found


def _across(gradients: ca.DM, i: int, along: Array) -> Array | None:
    """A direction as long as `along`, at a right angle to it, in the coordinates that constraint i depends on."""
    of = ca.DM(gradients.sparsity(), 1).full()[i] > 0
    e = along * of
    if of.sum() < 2 or not e.any():
        return None
    candidates = [gradients.full()[i] * of, *np.eye(len(along))[of]]
    best = max((c - (c @ e) / (e @ e) * e for c in candidates), key=lambda c: float(np.linalg.norm(c)))
    return best / np.linalg.norm(best) * np.linalg.norm(e)
