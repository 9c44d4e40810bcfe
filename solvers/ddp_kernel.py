"""The generated half of the DDP kernel: from an OCP, and f_theta where it is learned, to C (see csrc/ddp.h)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from nocl.checks import Array
from nocl.kernels import emit
from nocl.ocp import OCP

ACTIVATION_KINDS = {"sine": 0, "tanh": 1, "relu": 2, "silu": 3}  # as csrc/mlp.h numbers them
Columns = list[ca.SX]


def pack_weights(net: Any) -> Array:
    """All networks' weights in one array, in the order that csrc/mlp.h reads; one number unused before them."""
    parts = []
    for mlp in net.nets:
        for layer in mlp.body:
            if hasattr(layer, "weight"):
                parts += [layer.weight, layer.bias]
        if mlp.skip is not None:
            parts.append(mlp.skip.weight)
    return np.concatenate([np.zeros(1), *(p.detach().double().cpu().numpy().ravel() for p in parts)])


def ddp_source(ocp: OCP, net: Any = None) -> str:
    """The generated part of the kernel: what csrc/ddp.h lists, for the exact f or for f_theta's FeatureNet."""
    x, u = ocp.system.x, ocp.system.u
    stage = _Stage(ocp, net)
    sizes = {"N": x.numel(), "M": u.numel(), "NET": stage.net.numel(), "NJ": stage.J.nnz(), "NW": stage.W.nnz()}
    lines = ['#include "lanes.h"', '#include "mlp.h"' if net else ""]
    lines += [*(f"#define {name} {value}" for name, value in sizes.items()), _networks(ocp, net)]
    lines += [emit("field", [x, u, stage.net], [ca.densify(stage.rhs)]),
              emit("stage_jacobian", [x, u, stage.net], [stage.J]),
              emit("stage_hessian", [x, u, stage.net, stage.mu], [stage.W]),
              *_chain(x.numel(), u.numel(), stage.J.sparsity(), stage.W.sparsity())]
    G = ocp.terminal
    H, g = ca.hessian(G, x)
    lines.append(emit("terminal", [x], [ca.densify(G), ca.densify(g), ca.densify(H)]))
    lines.append('#include "ddp.h"\n')
    return "\n".join(lines)


class _Stage:
    """(xdot, L) at a stage, its Jacobian and the weighted Hessian's lower triangle, with the networks as symbols."""

    def __init__(self, ocp: OCP, net: Any) -> None:
        x, u = ocp.system.x, ocp.system.u
        z, n = ca.vertcat(x, u), x.numel() + 1
        self.mu = ca.SX.sym("mu", n)
        phi, y, Jy, Hy, self.net = _network_symbols(net, x, u)
        xdot = ocp.system.equations if net is None else net.outputs(x, u, *y)
        self.rhs = ca.vertcat(xdot, ocp.L_soft(x, u))
        yz = ca.vertcat(*(J @ ca.jacobian(p, z) for J, p in zip(Jy, phi, strict=True)))
        ys = ca.vertcat(*y)
        self.J = ca.jacobian(self.rhs, z)
        scalar = ca.dot(self.mu, self.rhs)
        H = ca.hessian(scalar, z)[0]
        if y:
            self.J += ca.jacobian(self.rhs, ys) @ yz
            v = ca.gradient(scalar, ys)
            cross = ca.jacobian(ca.gradient(scalar, z), ys) @ yz
            H = H + cross + cross.T + yz.T @ ca.hessian(scalar, ys)[0] @ yz
            H += _through_features(v, phi, y, Jy, Hy, z)
        self.W = ca.tril(H)


def _network_symbols(net: Any, x: ca.SX, u: ca.SX) -> tuple[Columns, Columns, Columns, list[Columns], ca.SX]:
    """(features, values, gradients [out, d], Hessians [d, d] of each output, all symbols as csrc/mlp.h orders them)."""
    if net is None or not net.nets:
        return [], [], [], [], ca.SX(0, 1)
    phi = list(net.inputs.call([x, u]))
    values, gradients, hessians, symbols = [], [], [], []
    for g, p in enumerate(phi):
        d, out = p.numel(), net.outputs.numel_in(2 + g)
        block = ca.SX.sym(f"net{g}", 1 + d + d * (d + 1) // 2, out)
        values.append(block[0, :].T)
        gradients.append(block[1:1 + d, :].T)
        upper = [[(i, j) for i in range(d) for j in range(i, d)]] * out
        hessians.append([_symmetric(d, upper[o], ca.vertsplit(block[1 + d:, o])) for o in range(out)])
        symbols.append(ca.vec(block))
    return phi, values, gradients, hessians, ca.vertcat(*symbols)


def _symmetric(d: int, places: list[tuple[int, int]], entries: list[ca.SX]) -> ca.SX:
    H = ca.SX(d, d)
    for (i, j), entry in zip(places, entries, strict=True):
        H[i, j] = H[j, i] = entry
    return H


def _through_features(v: ca.SX, phi: Columns, y: Columns, Jy: Columns, Hy: list[Columns], z: ca.SX) -> ca.SX:
    """Sum over network outputs of v_o d2 y_o / dz2, y_o a function of the features phi(z)."""
    total, first = ca.SX(z.numel(), z.numel()), 0
    for p, values, J, H in zip(phi, y, Jy, Hy, strict=True):
        w = v[first:first + values.numel()]
        first += values.numel()
        pz = ca.jacobian(p, z)
        total += pz.T @ sum(w[o] * H[o] for o in range(values.numel())) @ pz
        s = ca.SX.sym("s", p.numel())
        total += ca.substitute(ca.hessian(ca.dot(s, p), z)[0], s, J.T @ w)
    return total


def _chain(n: int, m: int, J_pattern: ca.Sparsity, W_pattern: ca.Sparsity) -> list[str]:
    """The chain rule through one RK4 step, with the stages' Jacobians and Hessians as symbols (see csrc/ddp.h)."""
    nz, nj, nw = n + m, J_pattern.nnz(), W_pattern.nnz()
    reach, share = (0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)
    h, lam = ca.SX.sym("h"), ca.SX.sym("lam", n)
    Js, Ws = ca.SX.sym("J", 4 * nj), ca.SX.sym("W", 4 * nw)
    J = [ca.SX(J_pattern, Js[i * nj:(i + 1) * nj]) for i in range(4)]
    W = [ca.tril2symm(ca.SX(W_pattern, Ws[i * nw:(i + 1) * nw])) for i in range(4)]
    mu = [ca.SX()] * 4
    for i in reversed(range(4)):
        through = 0 if i == 3 else reach[i + 1] * h * (J[i + 1][:, :n].T @ mu[i + 1])
        mu[i] = ca.vertcat(h * share[i] * lam + through, h * share[i])
    identity = ca.SX.eye(nz)
    S, F, cost, H = identity, identity[:n, :], ca.SX(1, nz), ca.SX(nz, nz)
    for i in range(4):
        slope = J[i][:n, :] @ S
        F += h * share[i] * slope
        cost += h * share[i] * (J[i][n, :] @ S)
        H += S.T @ W[i] @ S
        if i < 3:
            S = identity + reach[i + 1] * h * ca.vertcat(slope, ca.SX(m, nz))
    J_in = [Js[i * nj:(i + 1) * nj] for i in (1, 2, 3)]
    return [emit("stage_adjoints", [*J_in, lam, h], [ca.densify(ca.vertcat(*mu))]),
            emit("step_derivatives", [Js, Ws, h], [ca.densify(F.T), ca.densify(cost), ca.densify(H)])]


def _networks(ocp: OCP, net: Any) -> str:
    """C of networks(): features by generated code, then each MLP."""
    head = "static void networks(const double *weights, const lane *x, const lane *u, int order, lane *net)\n{\n"
    if net is None or not net.nets:
        return head + "    (void)weights; (void)x; (void)u; (void)order; (void)net;\n}\n"
    x, u = ocp.system.x, ocp.system.u
    lines, weight, first_phi, first_net = [], 1, 0, 0
    for mlp in net.nets:
        sizes, d = mlp.sizes, mlp.sizes[0]
        full, widest = 1 + d + d * (d + 1) // 2, max(mlp.sizes)
        skip = int(mlp.skip is not None)
        lines.append(
            f"    {{\n        static const int sizes[] = {{{', '.join(map(str, sizes))}}};\n"
            f"        lane a[{widest * full}], y[{widest * full}];\n"
            f"        const lane *out = mlp(weights + {weight}, sizes, {len(sizes) - 1}, "
            f"{ACTIVATION_KINDS[mlp.activation]}, {skip}, order, phi + {first_phi}, a, y);\n"
            f"        const int C = order ? {full} : 1;\n"
            f"        for (int o = 0; o < {sizes[-1]}; ++o)\n"
            f"            for (int c = 0; c < C; ++c) net[{first_net} + o * {full} + c] = out[o * C + c];\n    }}")
        weight += sum((a + 1) * b for a, b in pairwise(sizes)) + skip * d * sizes[-1]
        first_phi, first_net = first_phi + d, first_net + sizes[-1] * full
    phi = [ca.densify(p) for p in net.inputs.call([x, u])]
    features = emit("features", [x, u], [ca.vertcat(*phi)])
    return features + head + f"    lane phi[{first_phi}];\n    features(x, u, phi);\n" + "\n".join(lines) + "\n}\n"
