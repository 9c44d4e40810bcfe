"""Implicit steps of batches in torch, for plants whose explicit ones would be too short: Radau IIA.

Controls are held, as in nocl/translate/radau.py and csrc/radau.h, or a policy's at each stage: then its slope is part
of Newton's method, so that feedback on what is fast is followed too. All rows of a piece are solved at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import torch
from torch import Tensor

from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.translate.radau import ITERATIONS, LEFT, REACH, SETTLED, STAGES, WEIGHT
from nocl.translate.torch_functions import to_torch

ROWS = 4096  # solved at once: what Newton's matrices take grows with them
Policy = Callable[..., Tensor]
Field = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]  # x, t of stages -> u, f and its slope in x


class Implicit:
    """Steps of an OCP's exact f, or of a learned one; rows where Newton's method does not converge become NaN.

    learned : whether f is a network's, whose slopes are torch's own
    rows : the problem at the rows' parameters, an in_torch.Rows
    h, t : length and beginning of the intervals, [B, 1] or a number
    """

    def __init__(self, ocp: OCP, learned: bool = False) -> None:
        self.nx, self.slopes = ocp.system.nx, None if learned else _slopes_of(ocp)
        self.unit = torch.from_numpy(usual_sizes(ocp).x)
        self.weight, self.reach = torch.from_numpy(WEIGHT), torch.from_numpy(REACH)

    def interval(self, rows: Any, x: Tensor, u: Tensor, t: Any, h: Any, substeps: int) -> tuple[Tensor, Tensor]:
        """(the states [B, nx] after intervals with u [B, nu] held, the integrals [B, 1] of L over them)."""
        def held(part: slice) -> Field:
            each, controls = rows[part].repeated(STAGES), u[part].repeat_interleave(STAGES, dim=0)
            return lambda x, t: (controls, *self._f(each, x, controls, t)[:2])

        return self._pieces(rows, x, t, h, substeps, held)

    def fed_back(self, rows: Any, x: Tensor, policy: Policy, t: Any, h: Any) -> tuple[Tensor, Tensor]:
        """The same under a policy (x, t[, p]) -> u, as continuous feedback."""
        def closed(part: slice) -> Field:
            each = rows[part].repeated(STAGES)

            def field(x: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
                u, (u_x,) = _with_slopes(lambda x: policy(x, t, *each.p), x)
                f, f_x, f_u = self._f(each, x, u, t)
                return u, f, f_x + f_u @ u_x
            return field

        return self._pieces(rows, x, t, h, 1, closed)

    def _f(self, each: Any, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if self.slopes is None:
            f, (f_x, f_u) = _with_slopes(lambda x, u: each.f(x, u, t), x, u)
            return f, f_x, f_u
        slopes = each.of_f(self.slopes, x, u, t).reshape(len(x), -1, self.nx).transpose(1, 2)
        return each.f(x, u, t), slopes[:, :, :self.nx], slopes[:, :, self.nx:]

    def _pieces(self, rows: Any, x: Tensor, t: Any, h: Any, substeps: int,
                field: Callable[[slice], Field]) -> tuple[Tensor, Tensor]:
        begin, length = (torch.as_tensor(one, dtype=x.dtype).expand(len(x), 1) for one in (t, h))
        parts = [self._steps(rows[part], x[part], begin[part], length[part] / substeps, substeps, field(part))
                 for part in (slice(k, k + ROWS) for k in range(0, len(x), ROWS))]
        ends, costs = zip(*parts, strict=True) if parts else ([x], [x[:, :1]])
        return torch.cat(list(ends)), torch.cat(list(costs))

    def _steps(self, rows: Any, x: Tensor, t: Tensor, h: Tensor, substeps: int, field: Field) -> tuple[Tensor, Tensor]:
        B, each, cost = len(x), rows.repeated(STAGES), torch.zeros_like(h)
        for _ in range(substeps):
            states, times = self._stages(x, t, h, field)
            flat = states.flatten(0, 1)
            L = each.L(flat, field(flat, times)[0], times).expand(B * STAGES, 1).reshape(B, STAGES)
            cost = cost + h * (L @ self.weight[-1])[:, None]
            x, t = states[:, -1], t + h
        return x, cost

    def _stages(self, x: Tensor, t: Tensor, h: Tensor, field: Field) -> tuple[Tensor, Tensor]:
        """States [B, s, nx] and times [B s, 1] of the stages."""
        B, s, n = len(x), STAGES, self.nx
        z, eye = torch.zeros(B, s, n, dtype=x.dtype), torch.eye(s * n, dtype=x.dtype)
        times = (t + h * self.reach).reshape(-1, 1)
        for _ in range(ITERATIONS):
            _, f, f_x = field((x[:, None] + z).flatten(0, 1), times)
            off = z - h[:, None] * (self.weight @ f.reshape(B, s, n))
            weighted = h[:, :, None, None, None] * self.weight[:, None, :, None] * \
                f_x.reshape(B, 1, s, n, n).transpose(2, 3)
            step, _ = torch.linalg.solve_ex(eye - weighted.reshape(B, s * n, s * n), off.reshape(B, s * n, 1))
            moved = (step.reshape(B, s, n) / self.unit).abs().amax(dim=(1, 2))
            z = z - step.reshape(B, s, n)
            if not (moved > SETTLED).any():  # rows that are NaN are lost
                break
        left = (off / self.unit).abs().amax(dim=(1, 2))  # at a policy's kinks steps do not settle
        lost = ~((moved <= SETTLED) | (left <= LEFT))
        return torch.where(lost[:, None, None], torch.nan, x[:, None] + z), times


def _slopes_of(ocp: OCP) -> Any:
    """df/d(x, u) of rows, in torch: [B, nx (nx + nu)], column by column."""
    f = ocp.functions.f
    given = f.sx_in()
    slopes = ca.densify(ca.jacobian(f(*given), ca.vertcat(*given[:2])))
    return to_torch(ca.Function("slopes", given, [ca.vec(slopes)]))


def _with_slopes(function: Callable[..., Tensor], *given: Tensor) -> tuple[Tensor, list[Tensor]]:
    """(y [B, m], its slopes [B, m, n] in each of the given) of a function whose rows do not see each other."""
    with torch.enable_grad():
        at = [one.detach().requires_grad_() for one in given]
        y = function(*at)
        rows = [torch.autograd.grad(one, at, retain_graph=True, allow_unused=True) for one in y.sum(dim=0)]
    slopes = [torch.stack([torch.zeros_like(one) if row[i] is None else row[i] for row in rows], dim=1)
              for i, one in enumerate(at)]
    return y.detach(), slopes
