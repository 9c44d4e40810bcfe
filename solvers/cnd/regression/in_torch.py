"""An OCP in torch, as training uses it: f, L and G of rows that have parameters of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nocl.definition.ocp import OCP
from nocl.definition.substeps import RADAU, RK4
from nocl.solvers.cnd.regression.implicit import Implicit
from nocl.support.checks import Array
from nocl.translate.in_c import InC
from nocl.translate.rk4 import map_cost, rk4_cost
from nocl.translate.torch_functions import to_torch

Function = Callable[..., Tensor]


class InTorch:
    """f, L and G of a problem as torch functions of what they take among (x, u, t, p).

    dynamics : (x, u[, t][, p of the system]) -> xdot in torch, as learned, in place of the exact f
    integrator : of its steps
    """

    def __init__(self, ocp: OCP, dynamics: Function | None = None, integrator: str = RK4) -> None:
        self.ocp, self.timed, self.dynamics = ocp, ocp.uses_time, dynamics
        self.implicit = Implicit(ocp, dynamics is not None) if integrator == RADAU else None
        names = ocp.functions.arguments.names
        self.takes = {"f": names if dynamics is None else ocp.system.arguments.names, "L": names,
                      "G": ocp.functions.end.names}
        self.n_p = {"f": ocp.np if dynamics is None else ocp.system.np, "L": ocp.np, "G": ocp.np}
        self.function = {"f": dynamics or InC(ocp.functions.f), "L": InC(ocp.L), "G": to_torch(ocp.G)}

    def at(self, p: Array) -> Rows:
        """The problem for rows with parameters p [B, np]."""
        return Rows(self, torch.from_numpy(p))

    def call(self, name: str, function: Function | None = None, **values: Any) -> Tensor:
        """The function of that name, or another one that takes the same."""
        given = [values[n][:, :self.n_p[name]] if n == "p" else values[n] for n in self.takes[name]]
        return (function or self.function[name])(*given)


class Rows:
    """f, L and G of rows, row by row at its own parameters."""

    def __init__(self, of: InTorch, p: Tensor) -> None:
        self.of, self._p = of, p

    @property
    def p(self) -> list[Tensor]:
        """What policies and values take after x and t: the parameters, if there are any."""
        return [self._p] if self._p.shape[1] else []

    def f(self, x: Tensor, u: Tensor, t: Tensor | None = None) -> Tensor:
        return self.of.call("f", x=x, u=u, t=t, p=self._p)

    def L(self, x: Tensor, u: Tensor, t: Tensor | None = None) -> Tensor:
        return self.of.call("L", x=x, u=u, t=t, p=self._p)

    def G(self, x: Tensor) -> Tensor:
        return self.of.call("G", x=x, p=self._p)

    def of_f(self, function: Function, x: Tensor, u: Tensor, t: Tensor | None = None) -> Tensor:
        """A function that takes what f does."""
        return self.of.call("f", function, x=x, u=u, t=t, p=self._p)

    def __getitem__(self, rows: slice) -> Rows:
        return Rows(self.of, self._p[rows])

    def repeated(self, n: int) -> Rows:
        """Each row n times."""
        return Rows(self.of, self._p.repeat_interleave(n, dim=0))

    def interval(self, x: Tensor, u: Tensor, t: Any, h: Any, substeps: int = 1) -> tuple[Tensor, Tensor]:
        """(the states after intervals of length h from t on with u held, the integral of L over them); in discrete time
        after a step, where h is dt, and where they are, where h is 0."""
        if self.of.implicit is not None:
            return self.of.implicit.interval(self, x, u, t, h, substeps)
        if self.of.ocp.system.is_discrete:
            return map_cost(self.f, self.L, x, u, h, t if self.of.timed else None)
        return rk4_cost(self.f, self.L, x, u, h, substeps, t if self.of.timed else None)

    def after(self, x: Tensor, u: Tensor, t: Any, h: Any, substeps: int = 1) -> Tensor:
        """The states alone."""
        if self.of.implicit is not None:
            return self.of.implicit.interval(self, x, u, t, h, substeps)[0]
        if self.of.ocp.system.is_discrete:
            return map_cost(self.f, lambda *_: 0.0, x, u, h, t if self.of.timed else None)[0]
        end, _ = rk4_cost(self.f, lambda *_: 0.0, x, u, h, substeps, t if self.of.timed else None)
        return end
