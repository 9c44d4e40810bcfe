"""ONNX's operations on single numbers, with its types: arithmetic, comparisons, activations.

All let NaN through as ONNX Runtime does, so that a bad number is not hidden by a limit, and the smooth ones have their
first and second derivatives everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from nocl.exports.onnx_operations.values import (
    RANGES,
    Call,
    Rule,
    Tensor,
    Value,
    cast,
    each,
    elementwise,
    if_else,
    truncated,
)


def larger(a: ca.MX, b: ca.MX) -> ca.MX:
    return if_else(a < b, b, if_else(b <= a, a, a + b))  # the sum: NaN, if either is


def smaller(a: ca.MX, b: ca.MX) -> ca.MX:
    return if_else(a > b, b, if_else(b >= a, a, a + b))


def limited(x: ca.MX, low: Any, high: Any) -> ca.MX:
    above = if_else(x < low, low, x)
    return if_else(above > high, high, above)


def positive(x: ca.MX) -> ca.MX:
    return if_else(x < 0, 0, x)


def negative(x: ca.MX) -> ca.MX:
    return if_else(x < 0, x, 0)


def sigmoid(x: ca.MX) -> ca.MX:
    decay = ca.exp(if_else(x < 0, x, -x))  # never overflows, and keeps the digits of tiny results
    return if_else(x < 0, decay, 1) / (1 + decay)


def softplus(x: ca.MX) -> ca.MX:
    return positive(x) + ca.log1p(ca.exp(if_else(x < 0, x, -x)))


def rounded(x: ca.MX) -> ca.MX:
    """To the nearest whole number, halves to the even one."""
    below = ca.floor(x)
    rest = x - below
    return if_else(rest > 0.5, below + 1, if_else(ca.eq(rest, 0.5), 2 * ca.ceil(below / 2), below))


def _divide(call: Call) -> Tensor:
    if call.args[0].dtype.kind == "i":
        return elementwise(lambda a, b: truncated(a / b), *call.args)
    return elementwise(ca.rdivide, *call.args)


def _mod(call: Call) -> Tensor:
    if call.options["fmod"]:
        return elementwise(ca.fmod, *call.args)
    if call.args[0].dtype.kind == "f":
        raise ValueError("it is of reals with fmod = 0; expected fmod = 1: write x - floor(x / y) * y in the network")

    def with_sign_of_divisor(a: ca.MX, b: ca.MX) -> ca.MX:
        rest = ca.fmod(a, b)
        return rest + if_else(rest * b < 0, b, 0)

    return elementwise(with_sign_of_divisor, *call.args)


def _power(call: Call) -> Tensor:
    if call.args[0].dtype.kind == "i":
        return elementwise(lambda a, b: truncated(ca.MX(ca.power(a, b))), *call.args)
    return elementwise(ca.power, *call.args)


def _fold(of_two: Callable[[ca.MX, ca.MX], ca.MX]) -> Callable[[Call], Value]:
    """Any number of inputs."""
    return lambda call: reduce(lambda a, b: elementwise(of_two, a, b), call.args)


def _mean(call: Call) -> Tensor:
    return elementwise(lambda *parts: sum(parts[1:], parts[0]) / len(parts), *call.args)


def _clip(call: Call) -> Value:
    x = call.args[0]
    low, high = (_bound(call, i, name) for i, name in ((1, "min"), (2, "max")))
    x = elementwise(lambda x, low: if_else(x < low, low, x), x, low)
    return elementwise(lambda x, high: if_else(x > high, high, x), x, high)


def _bound(call: Call, i: int, name: str) -> Value:
    """An input from opset 11 on, an attribute before; left out it is the last finite number of the type."""
    dtype, given = call.args[0].dtype, call.arg(i)
    if given is not None:
        if math.prod(given.shape) != 1:
            raise ValueError(f"its {name} has the shape {given.shape}; expected a single number")
        return given
    limits = RANGES[dtype] if dtype.kind == "i" else (np.finfo(dtype).min, np.finfo(dtype).max)
    return np.asarray(call.options.get(name, limits[i - 1]), dtype)


def _where(call: Call) -> Tensor:
    return elementwise(if_else, *call.args, dtype=call.args[1].dtype)


def _is_inf(call: Call) -> Tensor:
    up, down = call.options["detect_positive"], call.options["detect_negative"]
    if up and down:
        return elementwise(lambda x: ca.eq(ca.fabs(x), math.inf), *call.args, dtype=bool)
    if not up and not down:
        raise ValueError("it looks for neither infinity; expected detect_positive or detect_negative")
    return elementwise(lambda x: ca.eq(x, math.inf if up else -math.inf), *call.args, dtype=bool)


def _activation(of_mx: Callable[..., ca.MX], *options: str) -> Callable[[Call], Tensor]:
    """of_mx(x, option, ...), the options by ONNX's names."""
    return lambda call: elementwise(lambda x: of_mx(x, *(call.options[o] for o in options)), call.args[0])


def elu(x: ca.MX, alpha: float) -> ca.MX:
    return positive(x) + alpha * ca.expm1(negative(x))


def celu(x: ca.MX, alpha: float) -> ca.MX:
    return positive(x) + alpha * ca.expm1(negative(x) / alpha)


def selu(x: ca.MX, alpha: float, gamma: float) -> ca.MX:
    return gamma * elu(x, alpha)


def relu(x: ca.MX) -> ca.MX:
    return if_else(x <= 0, 0, x)  # slope 0 at 0, as torch has it


def leaky(x: ca.MX, alpha: float) -> ca.MX:
    return if_else(x <= 0, alpha * x, x)


def hard_sigmoid(x: ca.MX, alpha: float, beta: float) -> ca.MX:
    return limited(alpha * x + beta, 0, 1)


def hard_swish(x: ca.MX) -> ca.MX:
    return x * hard_sigmoid(x, 1 / 6, 0.5)


def gelu(x: ca.MX, approximate: bytes) -> ca.MX:
    if approximate == b"tanh":
        return x / 2 * (1 + ca.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))
    return x / 2 * (1 + ca.erf(x / math.sqrt(2)))


def shrink(x: ca.MX, lambd: float, bias: float) -> ca.MX:
    return if_else(x < -lambd, x + bias, if_else(x > lambd, x - bias, 0))


def _cast(call: Call) -> Value:
    from onnx import TensorProto, helper  # onnx stays out of `import nocl`

    name = TensorProto.DataType.Name(call.options["to"])
    if name not in NUMPY:  # older versions of onnx call bfloat16 float32
        raise ValueError(f"it makes {name}; expected one of {', '.join(NUMPY)}: export the network in float32")
    return cast(call.args[0], helper.tensor_dtype_to_np_dtype(call.options["to"]))


NUMPY = ("FLOAT", "DOUBLE", "FLOAT16", "BOOL", "INT8", "INT16", "INT32", "INT64", "UINT8", "UINT16", "UINT32", "UINT64")
NAMES = {"Exp": "exp", "Log": "log", "Sqrt": "sqrt", "Sin": "sin", "Cos": "cos", "Tan": "tan", "Asin": "asin",
         "Acos": "acos", "Atan": "atan", "Sinh": "sinh", "Cosh": "cosh", "Tanh": "tanh", "Asinh": "asinh",
         "Acosh": "acosh", "Atanh": "atanh", "Erf": "erf", "Floor": "floor", "Ceil": "ceil"}
RULES: dict[str, Rule] = {
    **{op: Rule("f", each(getattr(ca, name))) for op, name in NAMES.items()},
    "Add": Rule("fi", each(ca.plus)), "Sub": Rule("fi", each(ca.minus)), "Mul": Rule("fi", each(ca.times)),
    "Div": Rule("fi", _divide), "Mod": Rule("fi", _mod), "Pow": Rule("fi", _power),
    "Neg": Rule("fi", each(lambda x: -x)), "Abs": Rule("fi", each(ca.fabs)), "Sign": Rule("fi", each(ca.sign)),
    "Round": Rule("f", each(rounded)), "Reciprocal": Rule("f", each(lambda x: 1 / x)), "Sum": Rule("f", _fold(ca.plus)),
    "Mean": Rule("f", _mean),
    "Max": Rule("fi", _fold(larger)), "Min": Rule("fi", _fold(smaller)), "Clip": Rule("fi", _clip),
    "Less": Rule("fi", each(ca.lt, bool)), "LessOrEqual": Rule("fi", each(ca.le, bool)),
    "Greater": Rule("fi", each(ca.gt, bool)), "GreaterOrEqual": Rule("fi", each(ca.ge, bool)),
    "Equal": Rule("fib", each(ca.eq, bool)), "Where": Rule("fi", _where), "Not": Rule("b", each(ca.logic_not)),
    "And": Rule("b", each(ca.logic_and)), "Or": Rule("b", each(ca.logic_or)), "Xor": Rule("b", each(ca.ne)),
    "IsNaN": Rule("f", each(lambda x: ca.logic_not(x <= math.inf), bool)), "IsInf": Rule("f", _is_inf),
    "Cast": Rule("*", _cast), "CastLike": Rule("*", lambda call: cast(call.args[0], call.args[1].dtype)),
    "Relu": Rule("fi", each(relu)), "Sigmoid": Rule("f", each(sigmoid)), "Softplus": Rule("f", each(softplus)),
    "Softsign": Rule("f", each(lambda x: x / (1 + ca.fabs(x)))), "HardSwish": Rule("f", each(hard_swish)),
    "HardSigmoid": Rule("f", _activation(hard_sigmoid, "alpha", "beta")), "Elu": Rule("f", _activation(elu, "alpha")),
    "Selu": Rule("f", _activation(selu, "alpha", "gamma")), "Celu": Rule("f", _activation(celu, "alpha")),
    "LeakyRelu": Rule("f", _activation(leaky, "alpha")), "Gelu": Rule("f", _activation(gelu, "approximate")),
    "PRelu": Rule("f", each(leaky)), "Mish": Rule("f", each(lambda x: x * ca.tanh(softplus(x)))),
    "Swish": Rule("f", _activation(lambda x, alpha: x * sigmoid(alpha * x), "alpha")),
    "ThresholdedRelu": Rule("f", _activation(lambda x, alpha: if_else(x > alpha, x, 0), "alpha")),
    "Shrink": Rule("f", _activation(shrink, "lambd", "bias")),
}
