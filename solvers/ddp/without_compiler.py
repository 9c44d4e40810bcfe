"""What the DDP kernel computes, without a compiler: CasADi's virtual machine for the derivatives, numpy for the sweep.

The arguments are the compiled kernel's (csrc/ddp.h says what they are), and so are the numbers, to rounding.
"""

from __future__ import annotations

import os
import warnings
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.ocp import OCP
from nocl.definition.substeps import RK4
from nocl.solvers.ddp.constraints import Block, ConstraintRows, RowModel, parameters
from nocl.solvers.ddp.kernel import damped, ddp_source
from nocl.support.checks import Array
from nocl.support.compiler import NoCompilerError
from nocl.translate.arguments import Arguments
from nocl.translate.kernels import Kernel

Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


def ddp_kernel(ocp: OCP, dynamics: Any, cache: str | os.PathLike[str] | None, substeps: int = 1,
               rows: ConstraintRows | None = None, integrator: str = RK4) -> Kernel | NumpyKernel:
    """The compiled kernel, or its twin, with a warning said once, where there is no compiler."""
    try:
        net = None if dynamics is None else dynamics.net
        return Kernel(ddp_source(ocp, net, substeps, rows, integrator), cache)
    except NoCompilerError as error:
        say_once(f"{error}. DDP goes on in CasADi's virtual machine and numpy, with the same numbers, much slower")
        return NumpyKernel(ocp, dynamics, substeps, rows, integrator)


@lru_cache
def say_once(text: str) -> None:
    warnings.warn(text, stacklevel=4)


class NumpyKernel:
    """The compiled kernel's twin: called by the same names with the same arrays, which it fills in place."""

    width = 1

    def __init__(self, ocp: OCP, dynamics: Any = None, substeps: int = 1, rows: ConstraintRows | None = None,
                 integrator: str = RK4) -> None:
        of = ocp.functions if dynamics is None else ocp.functions.on(dynamics.to_casadi())
        at, self.shape = of.stage_of(integrator), (ocp.system.nx, ocp.system.nu)
        self.np, self.timed, self.end = ocp.np, ocp.uses_time, of.end
        self.has_data = bool(self.np or self.timed)
        h, lam = at.sym("h"), at.sym("lam", ocp.system.nx)
        after, cost = at.interval(h, soft=rows is None, substeps=substeps, integrator=integrator)
        H, g = ca.hessian(ca.dot(lam, after) + cost, at.z)[0], ca.gradient(cost, at.z)
        self.rows = None if rows is None else NumpyRows(ocp, rows)
        self.damped = np.diag(damped(ocp))
        self._step = of.step(soft=rows is None, substeps=substeps, integrator=integrator)
        self._terminal = of.G_derivatives
        by_p = {"Q_p": ca.gradient(ca.dot(lam, after) + cost, at["p"])} if self.np else {}
        self._slopes = at.function("slopes", {"cost": cost, "F_z": ca.jacobian(after, at.z), "cost_z": g, "Q_zz": H,
                                              **by_p}, h=h, lam=lam)
        if self.np:
            slope = ca.gradient(of.end.call(of.G), of.end["p"])
            self._terminal_by_p = of.end.function("terminal_by_p", {"G_p": slope})

    def __call__(self, name: str, problems: Rows, *args: Any, threads: int = 1) -> None:
        """Run "nocl_rollout", "nocl_backward" or "nocl_multipliers" on some problem numbers; threads play no part."""
        if not len(problems):
            return
        with np.errstate(all="ignore"):  # what is not finite stays in its row, and is found there
            if name == "nocl_multipliers" and self.rows is not None:
                self.rows.next_round(problems, *args)
            else:
                run = self._rollout if name == "nocl_rollout" else self._backward
                first, more = list(args[:5]), list(args[5:])  # K, weights, lb, ub, h, then the data where there are any
                data = more.pop(0)[problems] if self.has_data else np.zeros((len(problems), 0))
                run(problems, data, *first, *more)

    def _moment(self, d: Array, after: Array) -> list[Array]:
        """[t] and [p], those that the problem has, a time after the start."""
        t = [d[:, :1] + after[:, None]] if self.timed else []
        return [*t, *([d[:, self.timed:]] if self.np else [])]

    def _rollout(self, b: Rows, d: Array, K: int, weights: Array, lb: Array, ub: Array, h: Array, x0: Array,
                 x_bar: Array, u_bar: Array, k: Array, gain: Array, alpha: Array, x: Array, u: Array,
                 J: Array, *of: Any) -> None:
        cost = np.zeros(len(b))
        x[b, 0] = x0[b]
        for t in range(K):
            feedback = np.einsum("bij,bj->bi", gain[b, t], x[b, t] - x_bar[b, t])
            u[b, t] = np.clip(u_bar[b, t] + alpha[b, None] * k[b, t] + feedback, lb, ub)
            at = x[b, t], u[b, t], *self._moment(d, t * h[b])
            if self.rows is not None:
                self.rows.write(of[3], b, K, t, at)
            x[b, t + 1], c = _rows(self._step, *at, h[b, None])
            cost += c[:, 0]
        J[b] = cost + _rows(self._terminal, x[b, K], *self._at_end(d))[0][:, 0]
        if self.rows is not None:
            self.rows.write(of[3], b, K, K, (x[b, K], *self._at_end(d)))
            of[4][b, 0] = J[b]
            self.rows.merit(b, K, J, *of)

    def _at_end(self, d: Array) -> list[Array]:
        return [d[:, self.timed:]] if self.np else []

    def _backward(self, b: Rows, d: Array, K: int, weights: Array, lb: Array, ub: Array, h: Array, x: Array, u: Array,
                  mu: Array, k: Array, gain: Array, slope: Array, curve: Array, positive: Array, V: Array | None,
                  V_x: Array | None, V_xx: Array | None, *more: Any) -> None:
        n, m = self.shape
        V_p, of = (more[0], more[1:]) if self.has_data else (None, more)
        value, p, P = _rows(self._terminal, x[b, K], *self._at_end(d))
        by_p = _rows(self._terminal_by_p, x[b, K], *self._at_end(d))[0] if self.np else np.zeros((len(b), 0))
        value, P = value[:, 0], P.reshape(-1, n, n)
        exact = np.ones(len(b)) if self.rows is None else of[2][b, 4]
        if self.rows is not None:
            g, W, g_p = self.rows.model(b, K, K, exact, (x[b, K], *self._at_end(d)), *of)
            p, P, by_p = p + g, P + W, by_p + g_p
        down, bend, good = np.zeros(len(b)), np.zeros(len(b)), np.ones(len(b), dtype=bool)
        for t in range(K, -1, -1):
            for out, now in ((V, value), (V_x, p), (V_xx, P)):
                if out is not None:
                    out[b, t] = now
            if t == 0:
                break
            at = x[b, t - 1], u[b, t - 1], *self._moment(d, (t - 1) * h[b])
            cost, F, l, H, *Q_p = _rows(self._slopes, *at, h[b, None], exact[:, None] * p)  # noqa: E741
            by_p = by_p + sum(Q_p)
            F, H = (a.reshape(len(b), n + m, -1).transpose(0, 2, 1) for a in (F, H))  # CasADi stores columns
            Q, q = H + F.transpose(0, 2, 1) @ P @ F, l + np.einsum("bij,bi->bj", F, p)
            if self.rows is not None:
                g, W, g_p = self.rows.model(b, K, t - 1, exact, at, *of)
                q, Q, by_p = q + g, Q + W, by_p + g_p
            Quu, Qux, qu = Q[:, n:, n:], Q[:, n:, :n], q[:, n:]
            damped, low, high = Quu + mu[b, None, None] * self.damped, lb - u[b, t - 1], ub - u[b, t - 1]
            step, held, L, ok = boxed_newton(damped, qu, low, high)
            K_t = substitute(L, np.where(held[:, :, None], 0.0, -Qux))
            good &= ok
            down += (step * qu).sum(axis=1)
            bend += 0.5 * np.einsum("bi,bij,bj->b", step, Quu, step)
            k[b, t - 1], gain[b, t - 1] = step, K_t
            value = value + cost[:, 0]
            K_T = K_t.transpose(0, 2, 1)
            p = q[:, :n] + np.einsum("bij,bj->bi", K_T, qu + np.einsum("bij,bj->bi", Quu, step)) \
                + np.einsum("bji,bj->bi", Qux, step)
            P = Q[:, :n, :n] + K_T @ (Quu @ K_t + Qux) + Qux.transpose(0, 2, 1) @ K_t
            P = (P + P.transpose(0, 2, 1)) / 2
        if V_p is not None:
            V_p[b] = by_p
        slope[b], curve[b], positive[b] = down, bend, good & np.isfinite(down) & np.isfinite(bend)


class NumpyRows:
    """What csrc/rows.h computes of a problem's constraints."""

    def __init__(self, ocp: OCP, rows: ConstraintRows) -> None:
        of, p = ocp.functions, parameters(ocp)
        self.of, self.u, self.given = rows, of.stage.u, rows.of_x(of.stage.u)
        self._stage = self._functions(of.stage, rows.stage, of.stage.z, p)
        self._end = self._functions(of.end, rows.end, of.end["x"], p)

    @staticmethod
    def _functions(at: Arguments, block: Block, z: ca.SX, p: ca.SX) -> tuple[ca.Function, ca.Function]:
        model = RowModel(block, z, p)
        out = {"slope": model.slope, "curve": model.curve, "by_p": model.by_p}
        return at.function("rows", {"c": model.c}), at.function("model", out, a=model.a, w=model.w, bent=model.bent)

    def _part(self, K: int, t: int) -> slice:
        """The rows of stage t, or for t = K of the end, among a plan's."""
        n = len(self.of.stage)
        return slice(t * n, t * n + (len(self.of.end) if t == K else n))

    def write(self, c: Array, b: Rows, K: int, t: int, at: tuple[Array, ...]) -> None:
        """c of the rows at one node."""
        c[b, self._part(K, t)] = _rows((self._end if t == K else self._stage)[0], *at)[0]

    def _equal(self, K: int) -> Mask:
        return np.r_[np.tile(self.of.stage.equal, K), self.of.end.equal]

    def _is_row(self, K: int) -> Mask:
        """Rows of x alone are none at node 0."""
        kept = np.ones(len(self._equal(K)), dtype=bool)
        kept[:len(self.given)] = ~self.given
        return kept

    def _own(self, K: int) -> Mask:
        """The end's rows that are no stage's."""
        return np.r_[np.zeros(K * len(self.of.stage), dtype=bool), self.of.end_own(self.u)]

    def _multiplier(self, c: Array, y: Array, penalty: Array, equal: Mask, own: Mask) -> tuple[Array, Array, Array]:
        """(q, a, w), [B, rows]."""
        rho, most, stiff, at_end = (penalty[:, [i]] for i in range(4))
        most = np.where(own, at_end, most)
        q, least = y - rho * c, np.where(equal, -most, 0.0)
        a = np.clip(q, least, most)
        free, capped = (q > least) & (q < most), (q >= most) | (equal & (q <= least))
        active = free & (equal | (a > 1e-16 * stiff))
        weight = np.where(stiff > 0, np.where(active, stiff, 0.0), np.where(free, rho, 0.0))
        return q, a, np.where(capped, 1e-3 * rho, weight)

    def merit(self, b: Rows, K: int, J: Array, y: Array, margin: Array | None, penalty: Array, c: Array,
              parts: Array) -> None:
        """J and what is told of the rows from c and the cost."""
        inside, rho = c[b] - (0.0 if margin is None else margin[b]), penalty[b, :1]
        q, a, _ = self._multiplier(inside, y[b], penalty[b], self._equal(K), self._own(K))
        e = np.where(q == a, inside, (y[b] - a) / rho) * self._is_row(K)
        psi = np.where(q == a, (0.5 * rho * inside - y[b]) * inside, 0.5 * (a**2 - y[b]**2) / rho + (q - a) * a / rho)
        J[b] = parts[b, 0] + (psi * self._is_row(K)).sum(axis=1)
        parts[b, 1], parts[b, 2] = (0.5 * rho * e**2).sum(axis=1), np.abs(e).max(axis=1)

    def model(self, b: Rows, K: int, t: int, exact: Array, at: tuple[Array, ...], y: Array, margin: Array | None,
              penalty: Array) -> tuple[Array, Array, Array]:
        """What the rows at a node add to the gradient and the Hessian in z there, and to dV/dp."""
        part, functions = self._part(K, t), self._end if t == K else self._stage
        c = _rows(functions[0], *at)[0] - (0.0 if margin is None else margin[b, part])
        _, a, w = self._multiplier(c, y[b, part], penalty[b], self._equal(K)[part], self._own(K)[part])
        a, w = a * self._is_row(K)[part], w * self._is_row(K)[part]
        slope, curve, by_p = _rows(functions[1], *at, a, w, exact[:, None] * a)
        return slope, curve.reshape(len(b), slope.shape[1], -1), by_p

    def next_round(self, b: Rows, K: int, margin: Array | None, c: Array, factor: Array, y: Array, penalty: Array,
                   J: Array, parts: Array) -> None:
        """y becomes a, rho grows by a factor."""
        inside = c[b] - (0.0 if margin is None else margin[b])
        a = self._multiplier(inside, y[b], penalty[b], self._equal(K), self._own(K))[1]
        y[b] = np.where(self._is_row(K), a, y[b])
        penalty[b, 0] *= factor[b]
        self.merit(b, K, J, y, margin, penalty, c, parts)


def _rows(function: ca.Function, *args: Array) -> list[Array]:
    """A Function on rows [B, n] of each argument; its outputs' nonzeros by columns, as rows [B, ...]."""
    outs = function.map(len(args[0])).call([ca.DM(a.T) for a in args])
    return [ca.DM(ca.densify(o)).full().T.reshape(len(args[0]), -1) for o in outs]


def factor(Q: Array, held: Mask) -> tuple[Array, Mask]:
    """L L' = Q on the free controls, the identity on those held; and where Q is positive definite."""
    m = Q.shape[1]
    L, positive = np.zeros_like(Q), np.ones(len(Q), dtype=bool)
    for i in range(m):
        for j in range(i + 1):
            rest = np.where(held[:, i] | held[:, j], float(i == j), Q[:, i, j])
            rest = rest - (L[:, i, :j] * L[:, j, :j]).sum(axis=1)
            if i == j:
                ok = held[:, i] | (rest > 1e-12 * Q[:, i, i])
                positive &= ok
                L[:, i, i] = np.sqrt(np.where(ok, rest, 1.0))
            else:
                L[:, i, j] = rest / L[:, j, j]
    return L, positive


def substitute(L: Array, right: Array) -> Array:
    """The solution X [B, m, c] of L L' X = right."""
    X, m = right.copy(), L.shape[1]
    for i in range(m):
        X[:, i] = (X[:, i] - np.einsum("br,brc->bc", L[:, i, :i], X[:, :i])) / L[:, i, i, None]
    for i in reversed(range(m)):
        X[:, i] = (X[:, i] - np.einsum("br,brc->bc", L[:, i + 1:, i], X[:, i + 1:])) / L[:, i, i, None]
    return X


def boxed_newton(Q: Array, q: Array, low: Array, high: Array) -> tuple[Array, Mask, Array, Mask]:
    """min q'k + k'Q k / 2 with low <= k <= high by the active sets of csrc/ddp.h: (k, held, factor, positive)."""
    k, busy, positive = np.zeros_like(q), np.ones(len(q), dtype=bool), np.ones(len(q), dtype=bool)
    held = ((low >= 0) & (q > 0)) | ((high <= 0) & (q < 0))
    for last in [*[False] * (3 * q.shape[1]), True]:
        p = np.where(held, 0.0, -q - np.einsum("bij,bj->bi", Q, k))
        L, ok = factor(Q, held)
        positive &= ok | ~busy
        p = substitute(L, p[:, :, None])[:, :, 0]
        k, blocked = _step_to_bound(p, low, high, busy, k)
        if last:
            break
        held = held | blocked
        stopped = blocked.any(axis=1)
        let_go = _release(Q, q, k, low, held, busy & ~stopped)
        held &= ~let_go
        busy &= stopped | let_go.any(axis=1)
        if not busy.any():
            break
    return k, held, L, positive


def _step_to_bound(p: Array, low: Array, high: Array, busy: Mask, k: Array) -> tuple[Array, Mask]:
    """k + p as far as the first bound, in busy rows, and the controls that it blocked."""
    bound = np.where(p > 0, high, low)
    reach = np.where(p != 0, (bound - k) / p, np.inf)
    shortest = np.clip(reach.min(axis=1, keepdims=True), 0.0, 1.0)
    blocked = busy[:, None] & (reach <= shortest) & (reach < 1)
    return np.where(busy[:, None], np.where(blocked, bound, k + shortest * p), k), blocked


def _release(Q: Array, q: Array, k: Array, low: Array, held: Mask, may: Mask) -> Mask:
    """The held control, in the rows that may, whose multiplier has the wrong sign by most."""
    g = q + np.einsum("bij,bj->bi", Q, k)
    wrong = np.where(held & may[:, None], np.where(k <= low, -g, g), 0.0)
    released: Mask = (wrong > 0) & (wrong == wrong.max(axis=1, keepdims=True))
    return released
