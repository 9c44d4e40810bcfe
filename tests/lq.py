"""Riccati's answers to linear-quadratic problems: what the solvers' own are held against."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])  # the double integrator, mass 1


def riccati(A: Array, B: Array, R: Array, P: Array, T: float, K: int) -> tuple[Array, Array, Array, Array]:
    """(S, gains, F, G) of K RK4 steps of xdot = A x + B u, u held, under int u'R u + x(T)'P x(T).

    Cost to go x'S_k x, S [K+1, n, n]; u_k = gains_k x_k, gains [K, m, n]; x_{k+1} = F x_k + G u_k.
    """
    n, m, h = len(A), B.shape[1], T / K
    M = np.block([[A, B], [np.zeros((m, n + m))]])  # z = (x, u), u held
    step = np.sum([np.linalg.matrix_power(M * h, i) / np.prod(range(1, i + 1)) for i in range(5)], axis=0)
    F, G = step[:n, :n], step[:n, n:]
    S, gains = [P], []
    for _ in range(K):
        gains.append(-np.linalg.solve(h * R + G.T @ S[-1] @ G, G.T @ S[-1] @ F))
        closed = F + G @ gains[-1]
        S.append(closed.T @ S[-1] @ closed + h * gains[-1].T @ R @ gains[-1])
    return np.array(S[::-1]), np.array(gains[::-1]), F, G


def rk4_lq(h: float, N: int) -> tuple[Array, Array, Array, Array]:
    """(F, G, K, Hessians of V) of nocl's double_integrator in N steps of h; u_k = -K_k x_k. RK4 is exact for it."""
    S, gains, F, G = riccati(A, B, 0.01 * np.eye(1), np.eye(2), N * h, N)
    return F, G, -gains, 2 * S


def lq_symbols(T: float = 2.0, R: float = 0.01, P: tuple[float, float] = (1.0, 1.0),
               mass: float = 1.0) -> tuple[ca.SX, ca.SX, ca.SX]:
    """(t, S, K) in continuous time: V = x' S(t) x and u = -K(t) x.

    The double integrator with R u^2 and x(T)' diag(P) x(T): systems/double_integrator.py has the source.
    """
    t = ca.SX.sym("t")
    s = T - t
    W = ca.vertcat(ca.horzcat(s**3 / 3, s**2 / 2), ca.horzcat(s**2 / 2, s)) / (mass**2 * R)
    Phi = ca.vertcat(ca.horzcat(1, s), ca.horzcat(0, 1))
    S = Phi.T @ ca.inv(ca.diag(ca.DM([1 / P[0], 1 / P[1]])) + W) @ Phi
    return t, S, S[1, :] / (mass * R)


def lq_value(t: ArrayLike, **problem: Any) -> tuple[Array, Array]:
    """S [n, 2, 2] and K [n, 1, 2] of lq_symbols(**problem) at times t [n]."""
    time, S, K = lq_symbols(**problem)
    f = ca.Function("lq", [time], [S, K])
    both = [f(float(one)) for one in np.asarray(t)]
    return np.array([S.full() for S, _ in both]), np.array([K.full() for _, K in both])
