"""Where multiple shooting starts from: each guess is states x [N+1, nx] and controls u [N, nu]."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nocl.checks import Array
from nocl.ocp import OCP
from nocl.solvers.lqr import LQR
from nocl.solvers.transcription import Transcription

Guess = tuple[Array, Array]
WAVES = 4  # half waves in a random control
SCALES = (0.05, 1.0)  # of a random control, in half widths of U
FAR = 1.5  # widths of X round the goal: a rollout that leaves them is too wild to start from
HALVINGS = 12  # of a random control, until its rollout stays there


def starts(program: Transcription, lqr: LQR | None, x0: Array, t: Array, n: int, seed: int) -> list[Guess]:
    """The first n of: x0 held under u*, an LQR rollout, a straight line to the goal, smooth random controls.

    The random controls depend on `seed` alone, so that a state gets the same starts in any batch.
    """
    ocp, N = program.ocp, program.N
    u_goal = np.tile(ocp.u_goal, (N, 1))
    found = [(np.tile(x0, (N + 1, 1)), u_goal)]
    if n > 1 and lqr is not None:
        found += lqr_rollout(program, lqr, x0, t)
    found.append((x0 + np.linspace(0.0, 1.0, N + 1)[:, None] * (ocp.x_goal - x0), u_goal))
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
