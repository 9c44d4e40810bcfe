"""A problem with parameters, or in time, as one without: p and a clock among the states, which move by themselves.

The paper's method knows x and t only. On z = (x, clock, p), with clock' = 1 and p' = 0, it is what it was: V_p stands
beside V_x and is multiplied by 0. What it made of z is then one of (x, t, p).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.definition.ocp import OCP
from nocl.definition.parameters import time
from nocl.definition.sampling import Uniform, box, open_box
from nocl.definition.system import System
from nocl.nets import MLP, FeatureNet
from nocl.support.checks import Array


class Lifted:
    """A problem and the same one on (x, clock, p)."""

    def __init__(self, ocp: OCP) -> None:
        self.of, s = ocp, ocp.system
        self.clock = [ca.SX.sym("clock")] if ocp.uses_time else []
        self.p = ca.vertcat(s.p, ocp.p)
        self.ocp = ocp.with_constraints(
            self._at, system=self._system(), running=self._at(ocp.running), terminal=self._at(ocp.terminal),
            x_goal=[*ocp.x_goal, *[ocp.horizon] * len(self.clock), *ocp.nominal], u_goal=np.array(ocp.u_goal),
            initial_states=self._box(), p=None, parameters=None)

    def _at(self, expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, time(), self.clock[0]) if self.clock else expression

    def _system(self) -> System:
        s, p = self.of.system, self.of.parameters
        low, high = (np.zeros(0), np.zeros(0)) if p is None else open_box(p)
        known = [1.0] * len(self.clock) + [0.0] * self.of.np
        xdot = None if s.xdot is None else ca.vertcat(self._at(s.equations), *known)
        T = [self.of.horizon] * len(self.clock)
        return replace(s, x=ca.vertcat(s.x, *self.clock, self.p), p=None, xdot=xdot, z=None, alg=None,
                       z_guess=None, units={},
                       lbx=np.r_[s.lbx, np.zeros(len(T)), low], ubx=np.r_[s.ubx, T, high])

    def _box(self) -> Uniform:
        """Where the initial states lie, roughly: they are drawn by `sample`."""
        low, high = box(self.of.initial_states)
        zero = np.zeros(len(self.clock))
        p = self.of.parameter_box
        return Uniform(np.r_[low, zero, p[0]], np.r_[high, zero, p[1]])

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Initial states [n, nz]: x and p drawn apart."""
        x, p = self.of.initial_states.sample(n, rng), self.of.sample_parameters(n, rng)
        return np.hstack([x, np.zeros((n, len(self.clock))), p])

    def dynamics(self, f: Any) -> Any:
        """Learned dynamics (x, u[, p of the system]) -> xdot as those of z; None for the exact ones."""
        return None if f is None else LiftedDynamics(self.of, getattr(f, "net", f))

    def lowered(self, net: FeatureNet) -> FeatureNet:
        """A network of (z, t) as one of (x, t[, p])."""
        at = self.of.functions.feedback()
        z = ca.vertcat(at["x"], *[at["t"]] * len(self.clock), *([at["p"]] if self.of.np else []))
        phi = net.inputs(*[z, at["t"]][:net.inputs.n_in()])
        layers = cast(MLP, net.nets[0])
        y = ca.SX.sym("y", layers.sizes[-1])
        out = net.outputs(*[z, at["t"]][:net.outputs.n_in() - 1], y)
        return FeatureNet(at.function(net.inputs.name(), {net.inputs.name_out(0): phi}), [layers],
                          at.function(net.outputs.name(), {net.outputs.name_out(0): out}, y=y))


class LiftedDynamics(torch.nn.Module):
    """(z, u) -> zdot of learned dynamics."""

    def __init__(self, ocp: OCP, f: Callable[..., Tensor]) -> None:
        super().__init__()
        self.f, self.nx, self.clock, self.np = f, ocp.system.nx, int(ocp.uses_time), ocp.np
        self.given = [ocp.system.nx + self.clock, ocp.system.nx + self.clock + ocp.system.np]

    def forward(self, z: Tensor, u: Tensor) -> Tensor:
        first, last = self.given
        xdot = self.f(z[..., :self.nx], u, *([z[..., first:last]] if last > first else []))
        rest = torch.zeros_like(z[..., self.nx:])
        if self.clock:
            rest = torch.cat([torch.ones_like(z[..., :1]), rest[..., 1:]], -1)
        return torch.cat([xdot, rest], -1)
