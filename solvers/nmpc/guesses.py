"""Where multiple shooting starts from: each guess is states x [N+1, nx] and controls u [N, nu]."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from nocl.data import Controller
from nocl.judge import dynamics_function
from nocl.ocp import OCP
from nocl.solvers.lqr import LQR
from nocl.solvers.nmpc.transcription import Transcription
from nocl.support.checks import Array

Guess = tuple[Array, Array]
WAVES = 4  # half waves in a random control
SCALES = (0.05, 1.0)  # of a random control, in half widths of U
FAR = 1.5  # widths of X round the goal: a rollout that leaves them is too wild to start from
HALVINGS = 12  # of a random control, until its rollout stays there
BULGES = 0.1 * 1.4 ** np.arange(12)  # of a line round an obstacle, in lengths of the line
LARGEST = 10  # groups of coordinates up to which mirror images of the problem are looked for, by trying all signs
PROBES = 5  # states that a mirror image must hold at
ROUNDING = 1e-9  # of the largest: a derivative that counts as none
EQUAL = 1e-10  # relative difference of equal costs and derivatives
LEARNED = 1e-3  # ... of a learned f: an image is where a solve starts from, no more


def starts(program: Transcription, lqr: LQR | None, x0: Array, t: Array, n: int, seed: int) -> list[Guess]:
    """The first n of: x0 held under u*, an LQR rollout, a straight line to the goal, lines round each obstacle that it
    crosses, on either side, smooth random controls.

    The random controls depend on `seed` alone, so that a state gets the same starts in any batch.
    """
    ocp, N = program.ocp, program.N
    u_goal = np.tile(ocp.u_goal, (N, 1))
    found = [(np.tile(x0, (N + 1, 1)), u_goal)]
    if n > 1 and lqr is not None:
        found += lqr_rollout(program, lqr, x0, t)
    found.append((x0 + np.linspace(0.0, 1.0, N + 1)[:, None] * (ocp.x_goal - x0), u_goal))
    found += [(x, u_goal) for x in (sides(ocp, x0, N) if program.n_path else [])]
    found += [controlled(program, x0, u, t) for u in random_controls(ocp, N, n - len(found), seed)]
    return found[:n]


def lqr_of(ocp: OCP) -> LQR | None:
    """LQR about the goal, or None where the problem has none."""
    try:
        lqr = LQR(ocp)
        lqr.P(0.0)
    except ValueError:
        return None
    return lqr


def controlled(program: Transcription, x0: Array, u: Array, t: Array) -> Guess:
    """The rollout of controls u [N, nu] from x0, moved towards u* until it stays near the box X.

    A rollout that never does (an unstable system) gives way to x0 held.
    """
    u_goal = program.ocp.u_goal
    for _ in range(HALVINGS):
        x = np.vstack([x0, program.rollout(x0, u.T, np.diff(t)[None]).full().T])
        if _reasonable(program.ocp, x):
            return x, u
        u = (u + u_goal) / 2
    return np.tile(x0, (len(u) + 1, 1)), u


def lqr_rollout(program: Transcription, lqr: LQR, x0: Array, t: Array) -> list[Guess]:
    """LQR, clipped to U, from x0 on the nodes t [N+1]; nothing where it runs away."""
    N = program.N
    x, u = np.empty((N + 1, len(x0))), np.empty((N, program.ocp.system.nu))
    x[0] = x0
    for k in range(N):
        u[k] = lqr(x[k], t[k])
        x[k + 1] = program.step(x[k], u[k], t[k + 1] - t[k])[0].full().ravel()
        if not _reasonable(program.ocp, x[k + 1]):
            return []
    return [(x, u)]


def _reasonable(ocp: OCP, x: Array) -> bool:
    return bool((np.abs(x - ocp.x_goal) < FAR * (ocp.system.ubx - ocp.system.lbx)).all())


def random_controls(ocp: OCP, N: int, n: int, seed: int) -> Iterator[Array]:
    """n smooth random controls [N, nu] about u*, clipped to U: a few half waves with random weights and scale."""
    s, rng = ocp.system, np.random.default_rng(seed)
    t = (np.arange(N) + 0.5) / N
    waves = np.cos(np.pi * np.outer(t, np.arange(WAVES)))  # [N, WAVES]
    for _ in range(n):
        scale = np.exp(rng.uniform(*np.log(SCALES))) * (s.ubu - s.lbu) / 2
        yield np.clip(ocp.u_goal + scale * (waves @ rng.standard_normal((WAVES, s.nu))), s.lbu, s.ubu)


def from_neighbour(x0: Array, x: Array, u: Array) -> Guess:
    """A neighbour's solution, its states moved to x0 and back to its own at the end."""
    fade = np.linspace(1, 0, len(x))[:, None]
    return x + fade * (x0 - x[0]), u


def controller_rollout(program: Transcription, controller: Controller, x0: Array, t: Array) -> Guess:
    """A controller (x, t) -> u from x0, sampled at the nodes, held and clipped to U; where it fails, x stays."""
    s, N = program.ocp.system, program.N
    x, u = np.tile(x0, (N + 1, 1)), np.tile(program.ocp.u_goal, (N, 1))
    for k in range(N):
        control = np.clip(np.asarray(controller(x[k], float(t[k])), dtype=np.float64).reshape(s.nu), s.lbu, s.ubu)
        end = program.step(x[k], control, t[k + 1] - t[k])[0].full().ravel()
        if not (np.isfinite(control).all() and np.isfinite(end).all()):
            x[k + 1:] = x[k]
            break
        x[k + 1], u[k] = end, control
    return x, u


def sides(ocp: OCP, x0: Array, N: int) -> list[Array]:
    """Lines from x0 to the goal [N+1, nx], bent round each obstacle that the straight one crosses, on either side."""
    s, found = np.linspace(0.0, 1.0, N + 1)[:, None], list[Array]()
    line = x0 + s * (ocp.x_goal - x0)
    for i in range(len(ocp.path_constraints)):
        values = ocp.h(line.T).full()[i]
        k = int(np.argmin(values))
        if values[k] >= 0:
            continue
        across = _across(ocp.functions.h_derivatives(line[k], 0)[1], i, ocp.x_goal - x0)
        if across is None:
            continue
        for side in (across, -across):
            bent = (line + bulge * np.sin(np.pi * s) * side for bulge in BULGES)
            found += [x for x in bent if ocp.h(x.T).full()[i].min() >= 0][:1]
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


def mirrors(ocp: OCP, dynamics: Any = None) -> list[tuple[Array, Array]]:
    """Signs (of x - x* [nx], of u - u* [nu]) under which f, L, G, h and U stay what they are, other than all +1.

    Found by trial at random points, so up to rounding, or with `dynamics` in place of f up to LEARNED; none are looked
    for with more than LARGEST groups of coordinates that f, L and G couple at the goal, and so must share a sign.
    """
    s, equal = ocp.system, EQUAL if dynamics is None else LEARNED
    if s.xdot is None and dynamics is None:  # a plant that is not known: no symmetry is
        return []
    f_of = dynamics_function(ocp, dynamics)
    group = _coupled(ocp, f_of, ROUNDING if dynamics is None else LEARNED)
    if group.max() >= LARGEST:
        return []
    rng, n = np.random.default_rng(0), s.nx
    z = rng.uniform(-0.5, 0.5, (PROBES, n + s.nu)) * np.r_[s.ubx - s.lbx, s.ubu - s.lbu] / 2
    goal = np.r_[ocp.x_goal, ocp.u_goal]
    middle = (s.lbu + s.ubu) / 2 - ocp.u_goal  # of U: a sign may change only where u* is in it

    def everything(signs: Array) -> Array:
        x, u = np.split((z * signs + goal).T, [n])
        f = f_of(x, u).full() * signs[:n, None]
        return np.vstack([f, ocp.L(x, u).full(), ocp.G(x).full(), np.sort(ocp.h(x).full(), axis=0)])

    same, found = everything(np.ones(n + s.nu)), []
    for flips in itertools.product((1.0, -1.0), repeat=int(group.max()) + 1):
        signs = np.array(flips)[group]
        if (signs > 0).all() or np.abs(middle[signs[n:] < 0]).max(initial=0.0) > 0:
            continue
        if np.abs(everything(signs) - same).max() <= equal * np.abs(same).max():
            found.append((signs[:n], signs[n:]))
    return found


def _coupled(ocp: OCP, f: ca.Function, rounding: float) -> NDArray[np.int32]:
    """A number for each of (x, u), equal where f's Jacobian or a Hessian of L or G at the goal couples them."""
    s = ocp.system
    n, of = s.nx, ocp.functions.on(f)
    H = of.L_derivatives(ocp.x_goal, ocp.u_goal)[2].full()
    H[:n, :n] += of.G_derivatives(ocp.x_goal)[2].full()
    A = np.hstack([j.full() for j in of.jacobian(ocp.x_goal, ocp.u_goal)])
    scale = np.r_[s.ubx - s.lbx, s.ubu - s.lbu]
    A, H = np.abs(A * scale) / scale[:n, None], np.abs(H * np.outer(scale, scale))
    H[:n] += A
    return np.asarray(connected_components(rounding * H.max() < H, directed=False)[1])


def mirrored(ocp: OCP, mirror: tuple[Array, Array], x: Array, u: Array) -> Guess:
    """The mirror image of states [..., nx] and controls [..., nu] at the goal pair."""
    return ocp.x_goal + mirror[0] * (x - ocp.x_goal), ocp.u_goal + mirror[1] * (u - ocp.u_goal)
