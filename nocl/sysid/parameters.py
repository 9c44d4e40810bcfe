"""f(x, u, p) as f(x, (u, p)): identification sees parameters as controls that nobody moves along a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import casadi as ca
import numpy as np

from nocl.nets import MLP, FeatureNet
from nocl.sampling import Distribution, box
from nocl.system import System
from nocl.translate.arguments import Arguments

STILL = 1e-2  # of its value: how far about itself a parameter that is held fixed is learned


def widened(system: System, parameters: Distribution | None) -> System:
    """The system with its parameters after its controls, in the box of their distribution; itself where it has none."""
    if parameters is None:
        return system
    low, high = box(parameters)
    least = np.where(high > low, 0.0, STILL * np.where(low == 0, 1.0, np.abs(low)))
    low, high = low - least, high + least
    return replace(system, u=ca.vertcat(system.u, system.p), p=None, lbu=np.r_[system.lbu, low],
                   ubu=np.r_[system.ubu, high])


def apart(net: FeatureNet, system: System) -> FeatureNet:
    """A network of (x, (u, p)) as one of (x, u, p), for a system with parameters."""
    at = system.arguments
    return _through(net, at, at.given(u=ca.vertcat(at["u"], at["p"])).but("p"))


def together(net: FeatureNet, system: System) -> FeatureNet:
    """A network of (x, u, p) as one of (x, (u, p))."""
    at = Arguments.new(ca.SX, x=system.nx, u=system.nu + system.np)
    return _through(net, at, at.given(u=at["u"][:system.nu], p=at["u"][system.nu:]))


def _through(net: FeatureNet, at: Arguments, given: Arguments) -> FeatureNet:
    """A network whose arguments are `at`, and stand in the old one's as `given` has them."""
    phi = net.inputs.call(given.inputs)
    y = {net.outputs.name_in(i): ca.SX.sym(net.outputs.name_in(i), net.outputs.numel_in(i))
         for i in range(net.inputs.n_in(), net.outputs.n_in())}
    inputs = at.function(net.inputs.name(), dict(zip(net.inputs.name_out(), phi, strict=True)))
    value = net.outputs(*given.inputs, *y.values())
    outputs = at.function(net.outputs.name(), {net.outputs.name_out(0): value}, **y)
    return FeatureNet(inputs, cast(Sequence[MLP], net.nets), outputs).eval()
