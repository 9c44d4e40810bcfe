"""The generated half of the DDP kernel: from an OCP, and f_theta where it is learned, to C (see csrc/ddp.h)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement, pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.functions import Stage
from nocl.definition.ocp import OCP
from nocl.definition.scales import units, usual_sizes
from nocl.definition.substeps import MAP, RADAU, RK4
from nocl.solvers.ddp.constraints import ConstraintRows, rows_source
from nocl.support.checks import Array
from nocl.translate import radau
from nocl.translate.kernels import emit

STRAIGHT = 5_000  # products in the chain rule through a step, up to which it is straight-line code
ACTIVATION_KINDS = {"sine": 0, "tanh": 1, "relu": 2, "silu": 3}  # as csrc/mlp.h numbers them
Columns = list[ca.SX]
Tableau = tuple[tuple[float, ...], tuple[float, ...]]  # of an explicit step: where its stages are, and their shares
TABLEAUS: dict[str, Tableau] = {RK4: ((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)), MAP: ((0.0,), (1.0,))}


def weights_of(mlp: Any) -> int:
    """How many weights a network has, as csrc/mlp.h reads them."""
    skip = mlp.sizes[0] * mlp.sizes[-1] if mlp.skip is not None else 0
    return sum((a + 1) * b for a, b in pairwise(mlp.sizes)) + skip


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


def ddp_source(ocp: OCP, net: Any = None, substeps: int = 1, rows: ConstraintRows | None = None,
               integrator: str = RK4) -> str:
    """The generated part of the kernel: what csrc/ddp.h lists, for the exact f or for f_theta's FeatureNet.

    substeps, integrator : steps in each interval, and of which kind
    rows : constraints that are held by multipliers; None: they enter by the OCP's penalty
    """
    at = ocp.functions.stage
    stage, inputs = _Derivatives(at, net, soft=rows is None), stage_inputs(at)
    nets, networks, n, m = stage.nets, stage.networks, ocp.system.nx, ocp.system.nu
    sizes = {"N": n, "M": m, "NET": networks.numel(), "TAPE": sum(n.tape for n in nets),
             "NV": stage.v.numel(), "BEND": stage.bend.numel(), "NJ": stage.J.nnz(), "NW": stage.W.nnz(),
             "SUBSTEPS": substeps}
    if "d" in inputs:
        sizes |= {"ND": inputs["d"].numel(), "TIMED": int("t" in at.names), "NP": ocp.np}
    moment = list(inputs.values())
    lines = ['#include "lanes.h"', *(['#include "mlp.h"'] if nets else []),
             *(f"#define {name} {value}" for name, value in sizes.items()),
             f"static const double DAMPED[M] = {{{', '.join(map(repr, damped(ocp).tolist()))}}};",
             _radau(ocp) if integrator == RADAU else _explicit(TABLEAUS[integrator]),
             _networks(inputs, nets),
             emit("field", [*moment, networks], [ca.densify(stage.rhs)]),
             emit("stage_jacobian", [*moment, networks], [stage.J.T]),
             emit("network_weights", [*moment, networks, stage.mu], [stage.v]),
             emit("stage_hessian", [*moment, networks, stage.bend, stage.mu], [stage.W]),
             _patterns(stage) if integrator == RADAU else _chain(n, m, stage, TABLEAUS[integrator])]
    if ocp.np:
        lines.append(emit("stage_parameters", [*moment, networks, stage.bend, stage.mu], [stage.by_p]))
    held = [] if rows is None else rows_source(ocp, rows, inputs)
    lines += [*_terminal(ocp, inputs), *held, '#include "ddp.h"\n']
    return "\n".join(lines)


def _explicit(tableau: Tableau) -> str:
    """An explicit step, as csrc/ddp.h reads it."""
    reach, share = (_numbers(f"{name}[{len(values)}]", np.array(values))
                    for name, values in zip(("reach", "share"), tableau, strict=True))
    return "\n".join(["#define NZ (N + M)", f"#define PARTS {len(tableau[0])}", reach, share, ""])


def _radau(ocp: OCP) -> str:
    """The scheme of implicit steps, as csrc/radau.h reads it."""
    unit, (rows, columns) = usual_sizes(ocp).x, radau.WEIGHT.shape
    return "\n".join(["#define NZ (N + M)", f"#define STAGES {rows}", f"#define NEWTON {radau.ITERATIONS}",
                      _numbers(f"reach[{columns}]", radau.REACH), _numbers("UNIT[N]", unit),
                      _numbers(f"weight[{rows}][{columns}]", radau.WEIGHT), ""])


def _numbers(name: str, values: Array) -> str:
    return f"static const double {name} = {str(values.tolist()).replace('[', '{').replace(']', '}')};"


def damped(ocp: OCP) -> Array:
    """What mu is multiplied by for each control, [nu]: 1 of Quu in the solver's units."""
    of = units(ocp)
    return of.cost / of.u**2


def stage_inputs(at: Stage) -> dict[str, ca.SX]:
    """What the kernel's functions of a stage are functions of: x, u and, with time or parameters, d = (t, p)."""
    data = at.but("x", "u").inputs
    return {"x": at.x, "u": at.u, **({"d": ca.vertcat(*data)} if data else {})}


def _terminal(ocp: OCP, inputs: dict[str, ca.SX]) -> list[str]:
    """terminal() and, with parameters, terminal_parameters()."""
    end, given = ocp.functions.end, [value for name, value in inputs.items() if name != "u"]
    lines = [emit("terminal", given, end.call(ocp.functions.G_derivatives))]
    if ocp.np:
        slope = ca.densify(ca.gradient(end.call(ocp.functions.G), end["p"]))
        lines.append(emit("terminal_parameters", given, [slope]))
    return lines


class _Net:
    """One network as symbols: values and slopes along q directions; Hessian and adjoint for weights on the values.

    The directions are the variables in z that its features depend on, or the features where those are fewer.
    """

    def __init__(self, mlp: Any, phi: ca.SX, z: ca.SX, p: ca.SX, number: int) -> None:
        self.mlp, self.phi, out = mlp, ca.densify(phi), mlp.sizes[-1]
        slopes = ca.jacobian(phi, z)
        variables = sorted(set(slopes.sparsity().get_triplet()[1]))
        few = len(variables) < phi.numel()
        self.directions = z[variables] if few else phi
        self.seeds = ca.densify(ca.jacobian(phi, z)[:, variables] if few else ca.SX.eye(phi.numel()))
        self.q = q = self.directions.numel()
        self.symbols: ca.SX = ca.SX.sym(f"net{number}", 1 + q, out)  # a column for each output: value, slopes
        along = ca.jacobian(self.directions, z)
        self.y: ca.SX = self.symbols[0, :].T
        self.slopes: ca.SX = self.symbols[1:, :].T @ along
        H, s = ca.SX.sym(f"H{number}", q * (q + 1) // 2), ca.SX.sym(f"s{number}", phi.numel())
        self.bend = ca.vertcat(H, s)
        through = ca.hessian(ca.dot(s, phi), z)[0]
        self.by_p = ca.jacobian(phi, p).T @ s  # of v'y, v fixed
        self.hessian = along.T @ _symmetric(q, ca.vertsplit(H)) @ along + through  # of v'y in z, v fixed
        self.tape = (q + 2) * sum(mlp.sizes[1:-1])
        self.weights = weights_of(mlp)


def _symmetric(q: int, upper: Columns) -> ca.SX:
    """A matrix from its upper triangle, row by row."""
    H = ca.SX(q, q)
    for (i, j), entry in zip(combinations_with_replacement(range(q), 2), upper, strict=True):
        H[i, j] = H[j, i] = entry
    return H


class _Derivatives:
    """(xdot, L) at a stage, its Jacobian, the weighted Hessian's lower triangle and gradient by p; networks as symbols.
    """

    def __init__(self, at: Stage, net: Any, soft: bool) -> None:
        z, self.mu = at.z, ca.SX.sym("mu", at.x.numel() + 1)
        p = at["p"] if "p" in at.names else ca.SX(0, 1)
        given = [] if net is None else at.of_system[:net.inputs.n_in()]
        phi = net.inputs.call(given) if net is not None and net.nets else []
        nets = zip(net.nets, phi, strict=True) if phi else ()
        self.nets = [_Net(mlp, features, z, p, i) for i, (mlp, features) in enumerate(nets)]
        self.networks = ca.vertcat(*(ca.vec(n.symbols) for n in self.nets))
        self.bend = ca.vertcat(*(n.bend for n in self.nets))
        xdot = at.xdot if net is None else net.outputs(*given, *(n.y for n in self.nets))
        self.rhs = ca.vertcat(xdot, at.L_soft if soft else at.L)
        y, yz = ca.vertcat(*(n.y for n in self.nets)), ca.vertcat(*(n.slopes for n in self.nets))
        self.J, scalar = ca.jacobian(self.rhs, z), ca.dot(self.mu, self.rhs)
        H, self.v = ca.hessian(scalar, z)[0], ca.SX(0, 1)
        if self.nets:
            self.J += ca.jacobian(self.rhs, y) @ yz
            Hyy, self.v = ca.hessian(scalar, y)
            cross = ca.jacobian(ca.gradient(scalar, z), y) @ yz
            H = H + cross + cross.T + yz.T @ Hyy @ yz + sum(n.hessian for n in self.nets)
        self.v, self.W = ca.densify(self.v), ca.tril(H)
        by_p = ca.gradient(scalar, p) if p.numel() else p
        self.by_p = ca.densify(by_p + sum(n.by_p for n in self.nets))


def _chain(n: int, m: int, stage: _Derivatives, tableau: Tableau) -> str:
    """stage_adjoints() and step_derivatives(): straight-line code while that is small, else loops over sparse rows."""
    J, W = stage.J.sparsity(), stage.W.sparsity()
    S = _closure(n, m, J)
    JS, WS = (_dense(p).astype(int) @ S.astype(int) for p in (J, ca.Sparsity.unite(W, W.T)))
    terms = 3 * int(JS.sum() + WS.sum() + S.sum(axis=1) @ (WS > 0).sum(axis=1) / 2)  # the first stage has S = 1
    return "\n".join(_straight_chain(n, m, J, W, tableau)) if terms <= STRAIGHT else _looped_chain(n, m, J, W, S)


def _closure(n: int, m: int, J: ca.Sparsity) -> NDArray[np.bool_]:
    """The pattern of d(x at a stage, u)/d(x, u), closed under multiplication by J."""
    A = np.zeros((n + m, n + m), dtype=bool)
    A[:n] = _dense(J)[:n]
    S = A | np.eye(n + m, dtype=bool)
    while True:
        wider = S | (A.astype(int) @ S.astype(int) > 0)
        if (wider == S).all():
            return S
        S = wider


def _dense(pattern: ca.Sparsity) -> NDArray[np.bool_]:
    dense: NDArray[np.bool_] = ca.DM(pattern, 1.0).full() != 0
    return dense


def _patterns(stage: _Derivatives) -> str:
    """The tables that csrc/radau.h reads."""
    whole, at = _whole(stage.W.sparsity())
    return "\n".join([*_rows_of("J", _dense(stage.J.sparsity())), *_rows_of("W", whole), at, ""])


def _whole(W: ca.Sparsity) -> tuple[NDArray[np.bool_], str]:
    """The pattern of a stage's Hessian, both triangles, and the table of places among the nonzeros of the lower one."""
    number = np.full(W.shape, -1)
    rows, columns = W.get_triplet()
    number[rows, columns] = number[columns, rows] = np.arange(W.nnz())
    return number >= 0, _table("W_AT", number[number >= 0])


def _rows_of(name: str, pattern: NDArray[np.bool_]) -> list[str]:
    """The tables of a pattern, row by row."""
    return [_table(f"{name}_ROW", np.r_[0, np.cumsum(pattern.sum(axis=1))]),
            _table(f"{name}_COL", np.nonzero(pattern)[1])]


def _looped_chain(n: int, m: int, J: ca.Sparsity, W: ca.Sparsity, S: NDArray[np.bool_]) -> str:
    """The tables that csrc/chain.h reads, and itself."""
    whole, at = _whole(W)
    T = whole.astype(int) @ S.astype(int) > 0
    lines = [line for name, pattern in (("J", _dense(J)), ("W", whole), ("S", S), ("T", T))
             for line in _rows_of(name, pattern)]
    return "\n".join([*lines, at, f"#define S_ROW_END {S.sum()}", '#include "chain.h"', ""])


def _table(name: str, values: NDArray[np.int64]) -> str:
    return f"static const int {name}[] = {{{', '.join(map(str, values.tolist() or [0]))}}};"


def _straight_chain(n: int, m: int, J_pattern: ca.Sparsity, W_pattern: ca.Sparsity, tableau: Tableau) -> list[str]:
    """The chain rule through one explicit step, with the stages' Jacobians and Hessians as symbols (see csrc/ddp.h)."""
    nz, nj, nw = n + m, J_pattern.nnz(), W_pattern.nnz()
    reach, share = tableau
    last = len(reach) - 1
    h, lam, stages = ca.SX.sym("h"), ca.SX.sym("lam", n), range(last + 1)
    Js, Ws = ca.SX.sym("J", len(reach) * nj), ca.SX.sym("W", len(reach) * nw)
    J = [ca.SX(J_pattern.T, Js[i * nj:(i + 1) * nj]).T for i in stages]
    W = [ca.tril2symm(ca.SX(W_pattern, Ws[i * nw:(i + 1) * nw])) for i in stages]
    mu = [ca.SX()] * len(reach)
    for i in reversed(stages):
        through = 0 if i == last else reach[i + 1] * h * (J[i + 1][:, :n].T @ mu[i + 1])
        mu[i] = ca.vertcat(h * share[i] * lam + through, h * share[i])
    identity = ca.SX.eye(nz)
    S, F, cost, H = identity, identity[:n, :], ca.SX(1, nz), ca.SX(nz, nz)
    for i in stages:
        slope = J[i][:n, :] @ S
        F += h * share[i] * slope
        cost += h * share[i] * (J[i][n, :] @ S)
        H += S.T @ W[i] @ S
        if i < last:
            S = identity + reach[i + 1] * h * ca.vertcat(slope, ca.SX(m, nz))
    return [emit("stage_adjoints", [Js, lam, h], [ca.densify(ca.vertcat(*mu))]),
            emit("step_derivatives", [Js, Ws, h], [ca.densify(F.T), ca.densify(cost), ca.densify(H)])]


def _networks(inputs: dict[str, ca.SX], nets: Sequence[_Net]) -> str:
    """C of network_values(), network_slopes() and network_bend(): features by generated code, then each MLP."""
    given, parameters = ", ".join(inputs), "".join(f"const lane *{name}, " for name in inputs)
    moment = list(inputs.values())
    values, slopes, bend = _Body(), _Body(), _Body()
    emitted, weight, net, tape, v, bent = [], 1, 0, 0, 0, 0
    for g, n in enumerate(nets):
        d, C, sizes = n.phi.numel(), n.q + 1, n.mlp.sizes
        emitted += [emit(f"features{g}", moment, [n.phi]),
                    emit(f"seeds{g}", moment, [ca.vec(ca.horzcat(n.phi, n.seeds).T)])]
        widest, skip = max(sizes), int(n.mlp.skip is not None)
        shape = f"{{{', '.join(map(str, sizes))}}}"
        common = f"weights + {weight}, (const int[]){shape}, {len(sizes) - 1}"
        kind = ACTIVATION_KINDS[n.mlp.activation]
        values.add(f"lane phi[{d}], a[{widest}], b[{widest}]; features{g}({given}, phi);",
                   f"mlp_values({common}, {kind}, {skip}, {C}, phi, a, b, net + {net});")
        slopes.add(f"lane phi[{d * C}], a[{widest * C}], b[{widest * C}]; seeds{g}({given}, phi);",
                   f"mlp_slopes({common}, {kind}, {skip}, {C}, phi, tape + {tape}, a, b, net + {net});")
        bend.add(f"lane a[{widest}], b[{widest}], work[{widest}], *H = bend + {bent};",
                 f"mlp_bend({common}, {skip}, {n.q}, v + {v}, tape + {tape}, a, b, work, H, H + {n.bend.numel() - d});")
        weight, net, tape = weight + n.weights, net + n.symbols.numel(), tape + n.tape
        v, bent = v + sizes[-1], bent + n.bend.numel()
    return "\n".join([*emitted, values.function("network_values", f"{parameters}lane *net"),
                      slopes.function("network_slopes", f"{parameters}lane *net, lane *tape"),
                      bend.function("network_bend", "const lane *v, const lane *tape, lane *bend")])


class _Body:
    """The blocks of a C function, one a network."""

    def __init__(self) -> None:
        self.blocks: list[str] = []

    def add(self, *lines: str) -> None:
        self.blocks.append("    {\n" + "".join(f"        {line}\n" for line in lines) + "    }\n")

    def function(self, name: str, arguments: str) -> str:
        return f"static void {name}(const double *weights, {arguments})\n{{\n{''.join(self.blocks)}}}\n"
