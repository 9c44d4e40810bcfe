"""RK4 steps of the exact f, or any function, fused: it and its vector-Jacobian product as C, one autograd node each.

Eager torch walks some hundred small operations a step, forth and back; this is two calls, to rounding the same.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.support.checks import Array
from nocl.translate.kernels import Kernel, emit

_CODE = """
void nocl_step(int64_t first, int64_t last, const int64_t *index, const double *x_, const double *u_, const double *h_,
               double *next_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane x[N], u[M], next[N + 1];
        const lane h = splat(*h_);
        for (int i = 0; i < N; ++i) x[i] = gather(x_, at, N, i);
        for (int i = 0; i < M; ++i) u[i] = gather(u_, at, M, i);
        step(x, u, &h, next);
        for (int i = 0; i <= N; ++i) scatter(next_, at, N + 1, i, next[i]);
    }
}

void nocl_step_vjp(int64_t first, int64_t last, const int64_t *index, const double *x_, const double *u_,
                   const double *h_, const double *bar_, double *out_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane x[N], u[M], bar[N + 1], out[N + M];
        const lane h = splat(*h_);
        for (int i = 0; i < N; ++i) x[i] = gather(x_, at, N, i);
        for (int i = 0; i < M; ++i) u[i] = gather(u_, at, M, i);
        for (int i = 0; i <= N; ++i) bar[i] = gather(bar_, at, N + 1, i);
        step_vjp(x, u, &h, bar, out);
        for (int i = 0; i < N + M; ++i) scatter(out_, at, N + M, i, out[i]);
    }
}
"""


def fused_source(step: ca.Function) -> str:
    """C of (x, u, h) -> (x after h, integral of L), and of its product with a row from the left."""
    x, u, h = step.sx_in()
    z, bar = ca.vertcat(x, u), ca.SX.sym("bar", x.numel() + 1)
    after: Any = ca.densify(ca.vertcat(*step(x, u, h)))
    vjp = ca.densify(ca.jtimes(after, z, bar, True))
    head = f'#include "lanes.h"\n#define N {x.numel()}\n#define M {u.numel()}\n'
    return head + emit("step", [x, u, h], [after]) + emit("step_vjp", [x, u, h, bar], [vjp]) + _CODE


class FusedStep:
    """A step for `nocl.hjb.rollout` by (x, u, h) -> (end, cost) in SX; the f and L that it is handed play no part.

    x [..., nx] and u [..., nu] on the CPU, any float dtype, float64 inside. Differentiable once.
    Raises ValueError where there is no C compiler, or an operation has no C twin.
    """

    def __init__(self, step: ca.Function) -> None:
        self.nx, self.nu = step.size1_in(0), step.size1_in(1)
        self._kernel = Kernel(fused_source(step))

    def __call__(self, f: Any, L: Any, x: Tensor, u: Tensor, h: float) -> tuple[Tensor, Tensor]:
        after = _Step.apply(x, u, float(h), self)
        return after[..., :-1], after[..., -1:]

    def run(self, name: str, width: int, h: float, *rows: Array) -> Array:
        """Kernel `name` on rows [B, ...] -> [B, width]."""
        out = np.empty((len(rows[0]), width))
        self._kernel(name, np.arange(len(out)), *rows[:2], np.array([h]), *rows[2:], out)
        return out


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, u: Tensor, h: float, step: FusedStep) -> Tensor:
        ctx.rows, ctx.h, ctx.step = (_rows(x), _rows(u)), h, step
        after = step.run("nocl_step", step.nx + 1, h, *ctx.rows)
        return torch.from_numpy(after).to(x.dtype).reshape(*x.shape[:-1], -1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        step = ctx.step
        out = torch.from_numpy(step.run("nocl_step_vjp", step.nx + step.nu, ctx.h, *ctx.rows, _rows(bar))).to(bar.dtype)
        shape = bar.shape[:-1]
        return out[:, : step.nx].reshape(*shape, -1), out[:, step.nx:].reshape(*shape, -1), None, None


_FUNCTION = """
void nocl_function(int64_t first, int64_t last, const int64_t *index, const double *in_, double *out_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane in[N], out[M];
        for (int i = 0; i < N; ++i) in[i] = gather(in_, at, N, i);
        function(in, out);
        for (int i = 0; i < M; ++i) scatter(out_, at, M, i, out[i]);
    }
}

void nocl_function_vjp(int64_t first, int64_t last, const int64_t *index, const double *in_, const double *bar_,
                       double *out_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane in[N], bar[M], out[N];
        for (int i = 0; i < N; ++i) in[i] = gather(in_, at, N, i);
        for (int i = 0; i < M; ++i) bar[i] = gather(bar_, at, M, i);
        function_vjp(in, bar, out);
        for (int i = 0; i < N; ++i) scatter(out_, at, N, i, out[i]);
    }
}
"""


class FusedFunction:
    """A casadi.Function z -> y on torch rows z [B, n], as C: what `to_torch` gives, to rounding, in two calls.

    On the CPU, any float dtype, float64 inside. Differentiable once. Errors as those of FusedStep.
    """

    def __init__(self, function: ca.Function) -> None:
        z, self.m = ca.SX.sym("z", function.numel_in(0)), function.numel_out(0)
        y, bar = ca.densify(function(z)), ca.SX.sym("bar", self.m)
        vjp = ca.densify(ca.jtimes(y, z, bar, True))
        head = f'#include "lanes.h"\n#define N {z.numel()}\n#define M {self.m}\n'
        self._kernel = Kernel(head + emit("function", [z], [y]) + emit("function_vjp", [z, bar], [vjp]) + _FUNCTION)

    def __call__(self, z: Tensor) -> Tensor:
        return _Function.apply(z, self)

    def run(self, name: str, width: int, *rows: Array) -> Tensor:
        """Kernel `name` on rows [B, ...] -> [B, width]."""
        out = np.empty((len(rows[0]), width))
        self._kernel(name, np.arange(len(out)), *rows, out)
        return torch.from_numpy(out)


class _Function(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, z: Tensor, function: FusedFunction) -> Tensor:
        ctx.rows, ctx.function = _rows(z), function
        return function.run("nocl_function", function.m, ctx.rows).to(z.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        rows = ctx.rows
        return ctx.function.run("nocl_function_vjp", rows.shape[1], rows, _rows(bar)).to(bar.dtype), None


def _rows(z: Tensor) -> Array:
    """z [..., n] as contiguous float64 rows [B, n]."""
    rows: Array = np.ascontiguousarray(z.detach().reshape(-1, z.shape[-1]).double().numpy())
    return rows
