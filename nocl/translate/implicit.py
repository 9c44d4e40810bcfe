"""Implicit steps in torch that can be differentiated: Radau IIA, for rollouts of stiff plants.

Newton's method finds the stages without a graph; one more of its steps, with one, has the derivatives of the implicit
function theorem, in x, u and whatever f and the policy depend on. The scheme is that of nocl/translate/radau.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nocl.support.checks import Array
from nocl.translate.radau import ITERATIONS, LEFT, REACH, SETTLED, STAGES, WEIGHT

Map = Callable[..., Tensor]
Field = Callable[[Tensor], Tensor]  # states [..., s, nx] of the stages -> xdot
ROUNDING = 100.0  # of a float's: what Newton's corrections need not fall below


class RadauStep:
    """(f, L, x, u, h) -> (x after h with u held, integral of L), and `fed_back` under a policy; rows where Newton's
    method does not converge are NaN.

    unit : usual states [nx]
    """

    def __init__(self, unit: Array) -> None:
        self.unit, self.evaluations = torch.from_numpy(unit), 0  # of f, one for each state

    def __call__(self, f: Map, L: Map, x: Tensor, u: Tensor, h: float) -> tuple[Tensor, Tensor]:
        held = u[..., None, :].expand(*x.shape[:-1], STAGES, u.shape[-1])
        stages = self._stages(lambda states: f(states, held), x, h)
        return stages[..., -1, :], h * _weighed(L(stages, held))

    def fed_back(self, policy: Map, f: Map, L: Map, x: Tensor, t: Tensor, h: float) -> tuple[Tensor, Tensor]:
        """The same with u = policy(x, t) at each stage; t [..., 1] when the step begins."""
        times = t[..., None, :] + h * torch.as_tensor(REACH, dtype=x.dtype, device=x.device)[:, None]
        stages = self._stages(lambda states: f(states, policy(states, times)), x, h)
        return stages[..., -1, :], h * _weighed(L(stages, policy(stages, times)))

    def _stages(self, field: Field, x: Tensor, h: float) -> Tensor:
        """The states [..., s, nx] of the stages, as functions of what field and x depend on."""
        weight, unit = (torch.as_tensor(one, dtype=x.dtype, device=x.device) for one in (WEIGHT, self.unit))
        with torch.no_grad():
            z, matrix = self._solved(field, x.detach(), h, weight, unit)
        off = z - h * (weight @ field(x[..., None, :] + z))
        self.evaluations += z[..., 0].numel()
        return x[..., None, :] + z - _solve(matrix, off)

    def _solved(self, field: Field, x: Tensor, h: float, weight: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
        """(z [..., s, nx], the stages less x; Newton's matrix there, [..., s nx, s nx])."""
        z, enough = x.new_zeros(*x.shape[:-1], STAGES, x.shape[-1]), max(SETTLED, ROUNDING * torch.finfo(x.dtype).eps)
        for _ in range(ITERATIONS):
            f, slope = _with_slope(field, x[..., None, :] + z)
            self.evaluations += z[..., 0].numel()
            matrix, off = _matrix(slope, h, weight), z - h * (weight @ f)
            step = _solve(matrix, off)
            z, moved = z - step, (step / unit).abs().amax((-2, -1))
            if not (moved > enough).any():  # rows that are NaN are lost
                break
        left = (off / unit).abs().amax((-2, -1))  # at kinks steps do not settle
        lost = ~((moved <= enough) | (left <= max(LEFT, enough)))
        return torch.where(lost[..., None, None], torch.nan, z), matrix


def _weighed(L: Tensor) -> Tensor:
    """The stages' costs [..., s, 1] by their weights [..., 1]; of a constant cost, too."""
    weight = torch.as_tensor(WEIGHT[-1], dtype=L.dtype, device=L.device)
    return (L * weight[:, None]).sum(-2)


def _matrix(slope: Tensor, h: float, weight: Tensor) -> Tensor:
    """I - h A x J, J [..., s, n, n] that of each stage."""
    s, n = slope.shape[-3:-1]
    blocks = weight[:, None, :, None] * slope.movedim(-3, -2)[..., None, :, :, :]  # [..., s, n, s, n]
    eye = torch.eye(s * n, dtype=slope.dtype, device=slope.device)
    return eye - h * blocks.reshape(*slope.shape[:-3], s * n, s * n)


def _solve(matrix: Tensor, off: Tensor) -> Tensor:
    step, _ = torch.linalg.solve_ex(matrix, off.flatten(-2)[..., None])
    return step.reshape(off.shape)


def _with_slope(field: Field, states: Tensor) -> tuple[Tensor, Tensor]:
    """(f [..., s, n], its slopes [..., s, n, n] in the same row's state)."""
    with torch.enable_grad():
        at = states.detach().requires_grad_()
        f = field(at)
        rows: list[Any] = [torch.autograd.grad(f[..., i].sum(), at, retain_graph=True, allow_unused=True)[0]
                           for i in range(f.shape[-1])]
    return f.detach(), torch.stack([torch.zeros_like(states) if row is None else row for row in rows], dim=-2)
