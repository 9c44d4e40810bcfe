"""Implicit steps of batches in torch, for plants whose explicit ones would be too short: Radau IIA, controls held.

The same stages as nocl/translate/radau.py and csrc/radau.h have, by Newton's method on all rows at once.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import torch
from torch import Tensor

from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.translate.radau import ITERATIONS, REACH, SETTLED, STAGES, WEIGHT
from nocl.translate.torch_functions import to_torch


class Implicit:
    """Steps of an OCP's exact f; rows where Newton's method does not converge become NaN."""

    def __init__(self, ocp: OCP) -> None:
        self.ocp, self.nx = ocp, ocp.system.nx
        self.unit = torch.from_numpy(usual_sizes(ocp).x)
        self.weight, self.reach = torch.from_numpy(WEIGHT), torch.from_numpy(REACH)

    @cached_property
    def slope(self) -> Any:
        """df/dx of rows, in torch: [B, nx nx], column by column."""
        f = self.ocp.functions.f
        given = f.sx_in()
        return to_torch(ca.Function("f_x", given, [ca.vec(ca.densify(ca.jacobian(f(*given), given[0])))]))

    def interval(self, rows: Any, x: Tensor, u: Tensor, t: Any, h: Any, substeps: int) -> tuple[Tensor, Tensor]:
        """(the states [B, nx] after intervals of length h [B, 1] or a number, the integrals [B, 1] of L over them).

        rows : the problem at the rows' parameters, an in_torch.Rows
        """
        B, short = len(x), torch.as_tensor(h, dtype=x.dtype).expand(len(x), 1) / substeps
        now, cost = torch.as_tensor(t, dtype=x.dtype).expand(B, 1), torch.zeros_like(short)
        for _ in range(substeps):
            at = [one.flatten(0, 1) for one in self._stages(rows, x, u, now, short)]
            L = rows.repeated(STAGES).L(*at).expand(B * STAGES, 1).reshape(B, STAGES)
            cost = cost + short * (L @ self.weight[-1])[:, None]
            x, now = at[0].reshape(B, STAGES, self.nx)[:, -1], now + short
        return x, cost

    def _stages(self, rows: Any, x: Tensor, u: Tensor, t: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """States, controls and times [B, s, ..] of the stages."""
        B, s, n = len(x), STAGES, self.nx
        each, z = rows.repeated(s), torch.zeros(B, s, n, dtype=x.dtype)
        u, t = u[:, None].expand(B, s, u.shape[1]), t[:, None] + self.reach[:, None] * h[:, None]
        eye = torch.eye(s * n, dtype=x.dtype)
        left = torch.ones(B, dtype=torch.bool)
        for _ in range(ITERATIONS):
            at = [one.flatten(0, 1) for one in (x[:, None] + z, u, t)]
            f = each.f(*at).reshape(B, s, n)
            f_x = each.of_f(self.slope, *at).reshape(B, s, n, n).transpose(2, 3)
            off = z - h[:, None] * (self.weight @ f)
            system = eye - (h[:, None, None, None] * self.weight[:, None, :, None]
                            * f_x.permute(0, 2, 1, 3)[:, None]).reshape(B, s * n, s * n)
            step, _ = torch.linalg.solve_ex(system, off.reshape(B, s * n, 1))
            z = z - step.reshape(B, s, n)
            left = ~((step.reshape(B, s, n) / self.unit).abs().amax(dim=(1, 2)) <= SETTLED)
            if not left.any():
                break
        return torch.where(left[:, None, None], torch.nan, x[:, None] + z), u, t
