"""CasADi functions on rows of tensors whose values, where they are long, come from compiled C: for rollouts, which ask
for no gradients. Eager torch takes some microseconds for each operation, however few rows there are.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.support.compiler import CompilerError, NoCompilerError
from nocl.translate.instructions import expand, instructions
from nocl.translate.kernels import Kernel, emit
from nocl.translate.torch_functions import to_torch

LONG, LONGEST = 50, 5000  # instructions: torch is as quick with fewer, a compiler slow with more
_CODE = """
void nocl_rows(int64_t first, int64_t last, const int64_t *index, const double *in_, double *out_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane in[N + 1], out[M + 1];
        for (int i = 0; i < N; ++i) in[i] = gather(in_, at, N, i);
        function(in, out);
        for (int i = 0; i < M; ++i) scatter(out_, at, M, i, out[i]);
    }
}
"""


class InC:
    """What `to_torch(function)` is, to rounding; without gradients, of float64 rows [B, n] on the CPU, by C.

    Of short functions, and where there is no C compiler or an operation has no C twin, it is `to_torch`'s own.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function, self.torch, self.kernel = function, to_torch(function), _kernel(function)

    def __reduce__(self) -> tuple[Any, ...]:
        return InC, (self.function,)

    def __call__(self, *args: Tensor) -> Any:
        rows = self.kernel is not None and not torch.is_grad_enabled() and \
            all(a.dtype == torch.float64 and a.ndim == 2 and a.device.type == "cpu" for a in args)
        return self._by_c(args) if rows else self.torch(*args)

    def _by_c(self, args: tuple[Tensor, ...]) -> Tensor:
        assert self.kernel is not None
        B = max(len(a) for a in args)
        z = np.concatenate([np.broadcast_to(a.detach().numpy(), (B, a.shape[1])) for a in args], axis=1)
        out = np.empty((B, self.function.numel_out(0)))
        self.kernel("nocl_rows", np.arange(B), np.ascontiguousarray(z), out)
        return torch.from_numpy(out)


def _kernel(function: ca.Function) -> Kernel | None:
    """None where torch does as well, or C cannot."""
    inputs = range(function.n_in())
    columns = function.n_out() == 1 and function.size2_out(0) == 1 and all(function.size2_in(i) == 1 for i in inputs)
    if not columns or not LONG <= len(list(instructions(expand(function)))) <= LONGEST:
        return None
    ends = np.cumsum([0, *(function.numel_in(i) for i in inputs)]).tolist()
    z = ca.SX.sym("z", ends[-1])
    y: Any = ca.densify(expand(function)(*ca.vertsplit(z, ends)))
    head = f'#include "lanes.h"\n#define N {z.numel()}\n#define M {y.numel()}\n'
    try:
        return Kernel(head + emit("function", [z], [y]) + _CODE)
    except (NoCompilerError, CompilerError, ValueError):
        return None
