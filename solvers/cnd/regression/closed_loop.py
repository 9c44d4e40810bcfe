"""Runs of a policy as continuous feedback, in C: a network between its maps, f and L, in one Runge-Kutta step.

What labels.continuous_run does in torch, to rounding, for a few rows and many steps: there each of the hundred small
operations of a step takes some microseconds, however few rows there are.
"""

from __future__ import annotations

from typing import cast

import casadi as ca
import numpy as np
import torch

from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.ddp.kernel import ACTIVATION_KINDS, pack_weights, weights_of
from nocl.support.checks import Array
from nocl.support.compiler import CompilerError, NoCompilerError
from nocl.support.pool import cores
from nocl.translate.kernels import Kernel, emit


class ClosedLoop:
    """(x0, t0, p, steps) -> (J, x, t) of a policy on the problem of `of`, for RK4 steps in continuous time.

    The network may go on being trained. Raises what `Kernel` does where there is no compiler, and ValueError where an
    operation has no C twin, steps are not Runge-Kutta's, or the learned f is no network between CasADi maps.
    """

    def __init__(self, net: FeatureNet, of: InTorch) -> None:
        ocp, self.net, self.of = of.ocp, net, of
        if of.implicit is not None or ocp.system.is_discrete:
            raise ValueError("ClosedLoop: expected a problem in continuous time and Runge-Kutta steps")
        self.f_net = None if of.dynamics is None else getattr(of.dynamics, "net", of.dynamics)
        if not (self.f_net is None or isinstance(self.f_net, FeatureNet)):
            raise ValueError(f"ClosedLoop: f is a {type(self.f_net).__name__}; expected a FeatureNet")
        self.kernel = Kernel(_source(net, of, self.f_net))

    def __call__(self, x0: Array, t0: Array, p: Array, steps: int) -> tuple[Array, Array, Array]:
        """J [B], x [B, steps+1, nx], t [B, steps+1]."""
        B, nx = x0.shape
        h = (self.of.ocp.horizon - t0) / steps
        start = np.ascontiguousarray(np.column_stack([x0, t0, h, p]))
        x, J = np.empty((B, steps + 1, nx)), np.empty(B)
        weights = [pack_weights(self.net), np.zeros(1) if self.f_net is None else pack_weights(self.f_net)]
        self.kernel("nocl_closed_loop", np.arange(B), np.array([steps]), *weights, start, x, J, threads=cores())
        with torch.no_grad():
            J += self.of.at(p).G(torch.from_numpy(x[:, -1]))[:, 0].numpy()
        return J, x, t0[:, None] + h[:, None] * np.arange(steps + 1)


def closed_loop(net: FeatureNet, of: InTorch) -> ClosedLoop | None:
    """None where C cannot."""
    try:
        return ClosedLoop(net, of)
    except (NoCompilerError, CompilerError, ValueError):
        return None


def _source(net: FeatureNet, of: InTorch, f_net: FeatureNet | None) -> str:
    """The maps, each of columns of (x, t, p) and u, and csrc/closed_loop.h."""
    ocp, at = of.ocp, of.ocp.functions.arguments
    z = {"x": at["x"], "t": at["t"] if "t" in at.names else ca.SX.sym("t"), "p": at["p"] if ocp.np else ca.SX(0, 1)}
    place, u = ca.vertcat(*z.values()), at["u"]
    parts = [_network("policy", net, [z["x"], z["t"], *([z["p"]] if ocp.np else [])], [place])]
    if f_net is None:
        parts.append(emit("field", [place, u], [ca.densify(at.call(ocp.functions.f))]))
    else:
        own = {**z, "u": u, "p": z["p"][:ocp.system.np]}
        parts.append(_network("field", f_net, [own[name] for name in ocp.system.arguments.names], [place, u]))
    parts.append(emit("cost", [place, u], [ca.densify(at.call(ocp.L))]))
    sizes = {"N": ocp.system.nx, "M": ocp.system.nu, "NP": ocp.np, "LEARNED": int(f_net is not None)}
    return "\n".join(['#include "lanes.h"', '#include "mlp.h"', *(f"#define {k} {v}" for k, v in sizes.items()), *parts,
                      '#include "closed_loop.h"\n'])


def _network(name: str, net: FeatureNet, args: list[ca.SX], given: list[ca.SX]) -> str:
    """C of `name(weights, i0[, i1], out)`, the network at symbols `args` as functions of `given`."""
    nets = cast(list[MLP], list(net.nets))
    phi, y = net.inputs.call(args), [ca.SX.sym(f"y{g}", mlp.sizes[-1]) for g, mlp in enumerate(nets)]
    said = ca.densify(net.outputs(*args, *y))
    inputs = [f"i{i}" for i in range(len(given))]
    lines, weight = list[str](), 1
    for g, mlp in enumerate(nets):
        widest, skip = max(mlp.sizes), int(mlp.skip is not None)
        shape, kind = f"(const int[]){{{', '.join(map(str, mlp.sizes))}}}", ACTIVATION_KINDS[mlp.activation]
        lines += [f"    lane phi{g}[{mlp.sizes[0]}], a{g}[{widest}], b{g}[{widest}], y{g}[{mlp.sizes[-1]}];",
                  f"    {name}_features{g}({', '.join(inputs)}, phi{g});",
                  f"    mlp_values(weights + {weight}, {shape}, {len(mlp.sizes) - 1}, {kind}, {skip}, 1, phi{g}, a{g}, "
                  f"b{g}, y{g});"]
        weight += weights_of(mlp)
    answers = ", ".join([*inputs, *(f"y{g}" for g in range(len(y)))])
    head = f"static void {name}_net(const double *weights, {', '.join(f'const lane *{i}' for i in inputs)}, lane *out)"
    return "\n".join([*(emit(f"{name}_features{g}", given, [ca.densify(one)]) for g, one in enumerate(phi)),
                      emit(f"{name}_answer", [*given, *y], [said]),
                      head, "{", *lines, f"    {name}_answer({answers}, out);", "}", ""])
