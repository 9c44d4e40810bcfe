"""Torch modules as CasADi Functions: native MX matrix products in float64, or through L4CasADi in float32.

Torch holds rows [B, n], CasADi columns [n]. Networks go over as MX, layer by layer (as SX a 64-64 net would be 14,000
instructions instead of 19); the SX maps of a FeatureNet are called as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

from nocl.exports import l4casadi_forms
from nocl.exports.onnx_operations.arithmetic import sigmoid
from nocl.nets import MLP, FeatureNet, Sine
from nocl.support import checks
from nocl.support.checks import LARGEST

BACKENDS = ("native", "l4casadi")
Names = Sequence[str]


def to_casadi(module: nn.Module, n_in: int | Sequence[int] | None = None, *, backend: str = "native",
              name: str | None = None, build_dir: str | Path | None = None, in_names: Names | None = None,
              out_names: Names | None = None) -> ca.Function:
    """A torch module as a ca.Function on columns, twice differentiable.

    Parameters
    ----------
    module : FeatureNet, MLP, nn.Sequential, a layer; any module for backend="l4casadi"
        It is not changed. Layers that behave otherwise in training mode must be in eval mode.
    n_in : int or ints
        The length of its input, or of each part where the Function shall have several inputs that the module takes
        concatenated, like (nx, 1) for (x, t). A FeatureNet knows its own; otherwise the first layer tells.
    backend : "native" or "l4casadi"
        Native MX equals the module in float64; "l4casadi" (an optional extra) takes any module that torch can trace,
        and computes in float32.
    name : str
        The name of the Function.
    build_dir : path
        Where L4CasADi compiles, and what the Function then needs; by default a folder that is removed at exit.
    in_names, out_names : names of the inputs and outputs.

    Raises
    ------
    ValueError
        For a layer with no native translation (naming it), parameters with NaN, sizes that do not fit.
    """
    if not isinstance(module, nn.Module):
        raise ValueError(f"to_casadi: got a {type(module).__name__}, expected a torch.nn.Module")
    checks.word(backend, BACKENDS, "backend", "to_casadi")
    if backend == "native" and build_dir is not None:
        raise ValueError("to_casadi: build_dir is for backend='l4casadi'; the native backend builds nothing, "
                         "expected None: leave it out")
    _check_parameters(module)
    sizes, ins, outs = _signature(module, n_in, in_names, out_names)
    name = type(module).__name__.lower() if name is None else checks.words([name], "name", "to_casadi", 1)[0]
    if backend == "native":
        args = [ca.MX.sym(i, n) for i, n in zip(ins, sizes, strict=True)]
        results = _feature_net(module, args) if type(module) is FeatureNet else _plain(module, args)
        return _function(name, args, results, ins, outs)
    return l4casadi_forms.build(module, sizes, name, build_dir, ins, outs)


def _function(name: str, args: list[ca.MX], results: list[ca.MX], ins: Names, outs: Names) -> ca.Function:
    try:
        return ca.Function(name, args, [ca.densify(r) for r in results], list(ins), list(outs))
    except RuntimeError as error:
        raise ValueError(f"to_casadi: name={name!r}, in_names={list(ins)}, out_names={list(outs)} do not make a CasADi "
                         f"Function; expected plain identifiers, each once: {str(error).splitlines()[-1]}") from error


def _check_parameters(module: nn.Module) -> None:
    for key, value in [*module.named_parameters(), *module.named_buffers()]:
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise ValueError(f"to_casadi: the parameter {key} holds NaN or inf; expected finite numbers: train it "
                             "again")


def _signature(module: nn.Module, n_in: int | Sequence[int] | None, in_names: Names | None,
               out_names: Names | None) -> tuple[list[int], Names, Names]:
    """The lengths of the inputs, and the names of inputs and outputs."""
    for what, names in (("in_names", in_names), ("out_names", out_names)):
        if names is not None:
            checks.words(names, what, "to_casadi")
    if isinstance(module, FeatureNet):
        maps = module.inputs, module.outputs
        sizes = [maps[0].size1_in(i) for i in range(maps[0].n_in())]
        if n_in is not None and _sizes(n_in) not in (sizes, [sum(sizes)]):
            raise ValueError(f"to_casadi: n_in is {n_in}, but the FeatureNet takes inputs of lengths {sizes}: "
                             "leave n_in out")
        ins, outs = in_names or maps[0].name_in(), out_names or maps[1].name_out()
    else:
        sizes = _sizes(n_in) if n_in is not None else [_first_size(module)]
        ins = in_names or (["x"] if len(sizes) == 1 else [f"x{i}" for i in range(len(sizes))])
        outs = out_names or ["y"]
    if len(ins) != len(sizes):
        raise ValueError(f"to_casadi: in_names has {len(ins)} names, expected {len(sizes)}, one for each input of "
                         f"length {sizes}")
    return sizes, list(ins), list(outs)


def _sizes(n_in: int | Sequence[int]) -> list[int]:
    sizes: list[Any] = list(n_in) if isinstance(n_in, (list, tuple)) else [n_in]
    if not sizes or any(isinstance(n, bool) or not isinstance(n, int) or not 1 <= n <= LARGEST for n in sizes):
        raise ValueError(f"to_casadi: n_in is {checks.shown(n_in)}; expected the length of the input, or one of each "
                         "input, as in (4, 1)")
    return sizes


def _first_size(module: nn.Module) -> int:
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            return layer.in_features
        if isinstance(layer, nn.LayerNorm):
            return math.prod(layer.normalized_shape)
    raise ValueError(f"to_casadi: the length of the input of {type(module).__name__} cannot be told from its layers: "
                     "pass n_in")


# Native translation: one function a layer type, (layer, column, its place in the module) -> column

Rule = Callable[[Any, ca.MX, str], ca.MX]


def _translate(layer: nn.Module, x: ca.MX, place: str) -> ca.MX:
    rule = RULES.get(type(layer))  # not isinstance: a subclass may do anything
    where = f"the layer {place!r}" if place else "the module"
    if rule is None:
        raise ValueError(f"to_casadi: {where} is a {type(layer).__name__}, which has no native translation (there is "
                         f"one for {', '.join(sorted(t.__name__ for t in RULES))}): use backend='l4casadi'")
    if layer._forward_hooks or layer._forward_pre_hooks:
        raise ValueError(f"to_casadi: {where} has forward hooks, which do not translate: remove them, or use "
                         "backend='l4casadi'")
    return rule(layer, x, place)


def _plain(module: nn.Module, args: list[ca.MX]) -> list[ca.MX]:
    return [_translate(module, ca.vertcat(*args), "")]


def _feature_net(net: FeatureNet, args: list[ca.MX]) -> list[ca.MX]:
    phi = net.inputs.call(args)
    y = [_translate(mlp, p, f"nets.{i}") for i, (mlp, p) in enumerate(zip(net.nets, phi, strict=True))]
    return net.outputs.call([*args, *y])


def _mlp(mlp: MLP, x: ca.MX, place: str) -> ca.MX:
    y = _translate(mlp.body, x, _at(place, "body"))
    return y if mlp.skip is None else y + _translate(mlp.skip, x, _at(place, "skip"))


def _sequential(layers: nn.Sequential, x: ca.MX, place: str) -> ca.MX:
    for key, layer in layers.named_children():
        x = _translate(layer, x, _at(place, key))
    return x


def _at(place: str, key: str) -> str:
    return f"{place}.{key}" if place else key


def _check_length(x: ca.MX, n: int, layer: nn.Module, place: str) -> None:
    if x.numel() != n:
        raise ValueError(f"to_casadi: the layer {place!r} ({type(layer).__name__}) takes {n} numbers and gets "
                         f"{x.numel()}: check n_in and the sizes of the layers")


def _constant(value: Tensor) -> ca.DM:
    return ca.DM(np.atleast_1d(value.detach().cpu().double().numpy()))


def _linear(layer: nn.Linear, x: ca.MX, place: str) -> ca.MX:
    _check_length(x, layer.in_features, layer, place)
    y = ca.mtimes(ca.MX(_constant(layer.weight)), x)
    return y if layer.bias is None else y + _constant(layer.bias)


def _layer_norm(layer: nn.LayerNorm, x: ca.MX, place: str) -> ca.MX:
    if len(layer.normalized_shape) != 1:
        raise ValueError(f"to_casadi: the layer {place!r} normalises over {tuple(layer.normalized_shape)}; expected "
                         "one dimension: use backend='l4casadi'")
    n = layer.normalized_shape[0]
    _check_length(x, n, layer, place)
    d = x - ca.sum1(x) / n
    y = d / ca.sqrt(ca.sumsqr(d) / n + layer.eps)
    y = y if layer.weight is None else y * _constant(layer.weight)
    return y if layer.bias is None else y + _constant(layer.bias)


def _dropout(layer: nn.Dropout, x: ca.MX, place: str) -> ca.MX:
    if layer.training and layer.p > 0:
        raise ValueError(f"to_casadi: the layer {place!r} (Dropout) is in training mode, where it is random: call "
                         "module.eval()")
    return x


# Where a branch is not taken its argument is kept harmless, so that no inf * 0 reaches a derivative.


def _softplus(layer: nn.Softplus, x: ca.MX, place: str) -> ca.MX:
    z = layer.beta * x
    linear = z > layer.threshold
    return ca.if_else(linear, x, ca.log1p(ca.exp(ca.if_else(linear, 0, z))) / layer.beta)


def _gelu(layer: nn.GELU, x: ca.MX, place: str) -> ca.MX:
    if layer.approximate == "tanh":
        return x / 2 * (1 + ca.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))
    return x / 2 * (1 + ca.erf(x / math.sqrt(2)))


def _elu(layer: nn.ELU, x: ca.MX, place: str) -> ca.MX:
    return ca.if_else(x > 0, x, layer.alpha * ca.expm1(ca.if_else(x > 0, 0, x)))


RULES: dict[type[nn.Module], Rule] = {
    MLP: _mlp, nn.Sequential: _sequential, nn.Linear: _linear, nn.LayerNorm: _layer_norm, nn.Dropout: _dropout,
    nn.Identity: lambda layer, x, place: x,
    Sine: lambda layer, x, place: ca.sin(x),
    nn.Tanh: lambda layer, x, place: ca.tanh(x),
    nn.ReLU: lambda layer, x, place: ca.if_else(x > 0, x, 0),
    nn.LeakyReLU: lambda layer, x, place: ca.if_else(x > 0, x, layer.negative_slope * x),
    nn.Sigmoid: lambda layer, x, place: sigmoid(x),
    nn.SiLU: lambda layer, x, place: x * sigmoid(x),
    nn.Softplus: _softplus, nn.GELU: _gelu, nn.ELU: _elu,
}
