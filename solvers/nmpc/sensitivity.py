"""Sensitivities of a multiple-shooting solution: costates at both sides of a node, feedback gains, Hessians of J*.

With Q_k(x, u) = the cost of interval k + lambda_{k+1}' F(x, u), the second variation of the discretised problem about
a solution is a linear-quadratic problem with A_k, B_k = dF, W_k = the exact Hessian of Q_k, controls at their bounds
held, and active path constraints as equations on dx. Its Riccati recursion gives du_k = gain_k dx_k (the neighbouring
extremal: Bryson, Ho (1975), "Applied Optimal Control", ch. 6) and d2J*/dx_k2; equations on the state are carried
backwards as in Laine, Tomlin (2019), "Efficient computation of feedback control for equality-constrained LQR".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.solvers.nmpc.transcription import Transcription
from nocl.support.checks import Array

RANK = 1e-9  # singular values below this share of the largest count as zero
ROUNDING = 1e-12  # curvature below this share of the largest is no curvature


@dataclass(frozen=True, eq=False)
class Derivatives:
    """The derivatives of one program that sensitivities need, built when first used."""

    program: Transcription

    @cached_property
    def flow(self) -> ca.Function:
        """(x, u[, t][, p], costate) -> d/dt of (x, costate), the control held: f and -dH/dx."""
        p, at = self.program, self.program.functions.stage
        costate = at.sym("costate", p.ocp.system.nx)
        H_x = ca.gradient(at.hamiltonian(costate, soft=p.soft), at.x)
        return at.function("flow", {"slope": ca.vertcat(at.xdot, -H_x)}, costate=costate)

    @cached_property
    def first(self) -> ca.Function:
        """(x, u[, t][, p], h, costate at the end) -> gradient of Q in (x, u), side by side."""
        return self._stage(second=False)

    @cached_property
    def second(self) -> ca.Function:
        """(x, u[, t][, p], h, costate at the end) -> (gradient of Q, Jacobian of F, Hessian of Q) in (x, u)."""
        return self._stage(second=True)

    def _stage(self, second: bool) -> ca.Function:
        p, at = self.program, self.program.functions.stage_of(self.program.integrator)
        h, costate = at.sym("h"), at.sym("costate", p.ocp.system.nx)
        end, cost = at.given(h=h).call(p.step)
        Q_zz, Q_z = ca.hessian(cost + ca.dot(costate, end), at.z)
        out = {"Q_z": Q_z, "F_z": ca.jacobian(end, at.z), "Q_zz": Q_zz} if second else {"Q_z": Q_z}
        return at.function("stage", {name: ca.densify(e) for name, e in out.items()}, h=h, costate=costate)

    @cached_property
    def end(self) -> ca.Function:
        """(x, t[, p]) -> (gradient, Hessian) of the cost at the last node."""
        at = self.program.functions.feedback(ca.MX)
        hessian, gradient = ca.hessian(self.program.end_cost(*at.inputs), at["x"])
        return at.function("end", {"V_x": ca.densify(gradient), "V_xx": ca.densify(hessian)})


@lru_cache(maxsize=32)
def derivatives(program: Transcription) -> Derivatives:
    """Those of a program, built once."""
    return Derivatives(program)


def cost_to_go(program: Transcription, t: Array, x: Array, u: Array, p: Array | None = None) -> Array:
    """V [N+1] at the nodes t of x [N+1, nx], u [N, nu]; p [np], here and below, where there are parameters."""
    stages = program.step(x[:-1].T, u.T, *program.moment(t[:-1], p), np.diff(t)[None])[1].full().ravel()
    V = np.cumsum(np.r_[float(program.end_cost(x[-1], t[-1], p)), stages[::-1]])[::-1]
    if not program.held.slacks:
        return V
    slacks = program.needed(t, x, u, np.zeros(0) if p is None else p).sum(axis=1)
    return np.asarray(V + program.held.weight * np.cumsum(slacks[::-1])[::-1])


def dense(program: Transcription, t: Array, x: Array, u: Array, costate: Array, p: Array | None = None) -> Array:
    """(x, costate) at both ends of each interval and their time derivatives [N, 4, 2 nx]: start, end, slopes."""
    d, h, nx = derivatives(program), np.diff(t)[None], x.shape[1]
    moments = [program.moment(times, p) for times in (t[:-1], t[1:])]
    after = d.first(x[:-1].T, u.T, *moments[0], h, costate[1:].T).full()[:nx].T  # an active path constraint is a jump
    start, end = np.c_[x[:-1], after], np.c_[x[1:], costate[1:]]
    slopes = (d.flow(e[:, :nx].T, u.T, *moment, e[:, nx:].T).full().T
              for e, moment in zip((start, end), moments, strict=True))
    return np.stack([start, end, *slopes], axis=1)


def second_variation(program: Transcription, t: Array, x: Array, u: Array, costate: Array,
                     p: Array | None = None) -> tuple[Array, Array]:
    """(gain [N, nu, nx], V_xx [N+1, nx, nx]); NaN from where the solution is no strict local optimum."""
    d, n = derivatives(program), x.shape[1]
    N, m = u.shape
    gradient, F_z, W = (np.moveaxis(v.full().reshape(v.shape[0], N, -1), 1, 0) for v in d.second(
        x[:-1].T, u.T, *program.moment(t[:-1], p), np.diff(t)[None], costate[1:].T))
    own = [] if p is None or not p.size else [p]
    end_gradient, P = (v.full() for v in d.end(x[-1], t[-1], *own))
    after = np.vstack([gradient[:, :n, 0], end_gradient.T])  # gradient at a node without its own path constraints
    free = _free(program, u, gradient[:, n:, 0])
    gain, V_xx = np.full((N, m, n), np.nan), np.full((N + 1, n, n), np.nan)
    V_xx[N], H = P, np.zeros((0, n))
    for k in range(N - 1, -1, -1):
        P, H = _with_path(program, x[k + 1], program.moment(t[k + 1], p), after[k + 1] - costate[k + 1], P, H)
        step = _riccati(F_z[k], W[k], P, H, free[k])
        if step is None:
            break
        gain[k], P, H = step
        V_xx[k] = P
    return gain, V_xx


def _free(program: Transcription, u: Array, gradient: Array) -> NDArray[np.bool_]:
    """Controls [N, nu] not held at a bound, where multiplier times width exceeds the distance to it in widths."""
    s = program.ocp.system
    width = np.asarray(s.ubu) - s.lbu
    lower, upper = (u - s.lbu) / width, (s.ubu - u) / width
    return ~((gradient * width > lower) & (lower < 0.5) | (-gradient * width > upper) & (upper < 0.5))


def _with_path(program: Transcription, x: Array, moment: list[Array], jump: Array, P: Array,
               H: Array) -> tuple[Array, Array]:
    """P and the equations H dx = 0 with a node's own path constraints; the costate jumps by mu' dh/dx across it."""
    if not program.n_path:
        return P, H
    path = program.functions.h_derivatives
    h, h_x = (v.full() for v in path(x, *moment, 0)[:2])
    mu = np.linalg.lstsq(h_x.T, jump, rcond=None)[0]
    active = mu > np.maximum(h[:, 0], 0.0) + np.sqrt(ROUNDING)
    mu = np.where(active, mu, 0.0)
    return P - path(x, *moment, mu)[2].full(), np.vstack([H, h_x[active]])


def _riccati(F_z: Array, W: Array, P: Array, H: Array, free: NDArray[np.bool_]) -> tuple[Array, Array, Array] | None:
    """(gain, P, H) one interval earlier, or None where the free controls have a direction without curvature."""
    n = len(P)
    A, B = F_z[:, :n], F_z[:, n:][:, free]
    P_xx, P_ux = W[:n, :n] + A.T @ P @ A, W[n:, :n][free] + B.T @ P @ A
    P_uu = W[n:, n:][np.ix_(free, free)] + B.T @ P @ B
    K, Z, H = _on_equations(H @ A, H @ B)
    curvature = Z.T @ P_uu @ Z
    if Z.shape[1]:
        if np.linalg.eigvalsh(curvature)[0] <= ROUNDING * max(1.0, np.abs(P_uu).max()):
            return None
        K = K - Z @ np.linalg.solve(curvature, Z.T @ (P_ux + P_uu @ K))
    P = P_xx + P_ux.T @ K + K.T @ P_ux + K.T @ P_uu @ K
    full = np.zeros((len(free), n))
    full[free] = K
    return full, (P + P.T) / 2, H


def _on_equations(M: Array, B: Array) -> tuple[Array, Array, Array]:
    """M dx + B du = 0 as du = K dx + Z w, and the equations [r, nx] left for dx alone."""
    if not B.size:
        return np.zeros((B.shape[1], M.shape[1])), np.eye(B.shape[1]), _independent(M)
    U, s, Vt = np.linalg.svd(B)
    r = int((s > RANK * max(1.0, s[0])).sum())
    K = -Vt[:r].T @ (U[:, :r].T @ M / s[:r, None])
    return K, Vt[r:].T, _independent(U[:, r:].T @ M)


def _independent(M: Array) -> Array:
    """Rows that span what M's do."""
    if not M.size:
        return M
    _, s, Vt = np.linalg.svd(M, full_matrices=False)
    return np.asarray(Vt[s > RANK * max(1.0, s[0])])
