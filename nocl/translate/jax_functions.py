"""CasADi functions as JAX functions of arrays: the instruction list of the SX form, run on jax.numpy as JAX traces it.

Needs the extra `levelset` (JAX).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import jax.numpy as jnp
from jax.scipy import special

from nocl.translate.instructions import Instruction, expand, instructions


def _remainder(a: Any, b: Any) -> Any:
    """a - n b, n = a / b rounded half to even (IEEE 754)."""
    size = jnp.abs(b)
    r = jnp.fmod(a, 2 * size)
    turns = (jnp.abs(r) > 0.5 * size).astype(float) + (jnp.abs(r) >= 1.5 * size).astype(float)
    return r - turns * jnp.sign(r) * size


OPERATIONS: dict[str, Callable[..., Any]] = {
    "ASSIGN": lambda a: a, "LIFT": lambda a, b: a, "NEG": jnp.negative, "ADD": jnp.add, "SUB": jnp.subtract,
    "MUL": jnp.multiply, "DIV": jnp.divide, "SQ": jnp.square, "TWICE": lambda a: 2.0 * a, "INV": lambda a: 1.0 / a,
    "EXP": jnp.exp, "LOG": jnp.log, "EXPM1": jnp.expm1, "LOG1P": jnp.log1p, "SQRT": jnp.sqrt, "POW": jnp.power,
    "CONSTPOW": jnp.power, "SIN": jnp.sin, "COS": jnp.cos, "TAN": jnp.tan, "ASIN": jnp.arcsin, "ACOS": jnp.arccos,
    "ATAN": jnp.arctan, "ATAN2": jnp.arctan2, "SINH": jnp.sinh, "COSH": jnp.cosh, "TANH": jnp.tanh,
    "ASINH": jnp.arcsinh, "ACOSH": jnp.arccosh, "ATANH": jnp.arctanh, "ERF": special.erf, "ERFINV": special.erfinv,
    "FABS": jnp.abs, "SIGN": jnp.sign, "FLOOR": jnp.floor, "CEIL": jnp.ceil, "FMOD": jnp.fmod,
    "REMAINDER": _remainder, "COPYSIGN": jnp.copysign, "FMIN": jnp.fmin, "FMAX": jnp.fmax, "HYPOT": jnp.hypot,
    "LT": lambda a, b: _number(a < b), "LE": lambda a, b: _number(a <= b), "EQ": lambda a, b: _number(a == b),
    "NE": lambda a, b: _number(a != b), "NOT": lambda a: _number(a == 0),
    "AND": lambda a, b: _number((a != 0) & (b != 0)), "OR": lambda a, b: _number((a != 0) | (b != 0)),
    "IF_ELSE_ZERO": lambda condition, a: jnp.where(condition != 0, a, 0.0),
}


def _number(truth: Any) -> Any:
    """True and False as CasADi has them, 1.0 and 0.0."""
    return jnp.where(truth, 1.0, 0.0)


def to_jax(function: ca.Function) -> Callable[..., Any]:
    """The same function on JAX arrays: each argument [..., n], one output [..., m] or a tuple of outputs.

    Inputs and outputs are columns, in CasADi's order; the leading axes broadcast. Values only: derivatives that are
    wanted are best taken in CasADi first. Under `jax.enable_x64(True)` values equal CasADi's to rounding. MX functions
    are expanded. Raises ValueError for matrices and for an operation that JAX has not.
    """
    name = function.name() if isinstance(function, ca.Function) else ""
    if not name:
        raise ValueError(f"to_jax: got a {type(function).__name__}; expected a casadi.Function, like ocp.system.f")
    dense = expand(function)
    shapes = [dense.size_in(i) for i in range(dense.n_in())] + [dense.size_out(i) for i in range(dense.n_out())]
    if any(columns != 1 for _, columns in shapes):
        raise ValueError(f"to_jax: {name} has the shapes {shapes}; expected columns only: use ca.vec(...)")
    steps, rows_in = list(instructions(dense)), [dense.numel_in(i) for i in range(dense.n_in())]
    rows_out = [dense.numel_out(i) for i in range(dense.n_out())]
    unknown = {s.op for s in steps if s.op.removeprefix("OP_") not in {*OPERATIONS, "INPUT", "OUTPUT", "CONST"}}
    if unknown:
        raise ValueError(f"to_jax: {name} contains {', '.join(sorted(unknown))}, which has no twin in JAX; expected "
                         f"elementary operations of SX: rewrite {name} without it")

    def call(*args: Any) -> Any:
        got = [jnp.shape(a)[-1:] for a in args]
        if got != [(n,) for n in rows_in]:
            raise ValueError(f"{name} got arguments whose last axes are {got}; expected {rows_in}: pass [..., n]")
        columns = _run(steps, [jnp.asarray(a) for a in args], rows_out)
        batch = jnp.broadcast_shapes(*(jnp.shape(a)[:-1] for a in args))
        outputs = tuple(jnp.stack([jnp.broadcast_to(c, batch) for c in column], -1) for column in columns)
        return outputs[0] if len(outputs) == 1 else outputs

    return call


def _run(steps: list[Instruction], args: list[Any], rows_out: list[int]) -> list[list[Any]]:
    """The columns of each output."""
    work: dict[int, Any] = {}
    outputs: list[list[Any]] = [[None] * n for n in rows_out]
    for op, out, operands, value in steps:
        if op == "OP_INPUT":
            work[out[0]] = args[operands[0]][..., operands[1]]
        elif op == "OP_CONST":
            work[out[0]] = value
        elif op == "OP_OUTPUT":
            outputs[out[0]][out[1]] = work[operands[0]]
        else:
            work[out[0]] = OPERATIONS[op.removeprefix("OP_")](*(work[i] for i in operands))
    return outputs
