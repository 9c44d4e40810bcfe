"""SX functions as instruction lists: the one walker behind torch, JAX, C, ONNX and text; functions as plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import casadi as ca

from nocl.support.checks import MALFORMED

OPERATIONS = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}
_UNARY = ("ASSIGN NEG EXP LOG SQRT SQ TWICE SIN COS TAN ASIN ACOS ATAN NOT FLOOR CEIL FABS SIGN ERF INV "
          "SINH COSH TANH ASINH ACOSH ATANH ERFINV LOG1P EXPM1")
_BINARY = ("ADD SUB MUL DIV POW CONSTPOW LT LE EQ NE AND OR FMOD REMAINDER COPYSIGN IF_ELSE_ZERO FMIN FMAX ATAN2 "
           "HYPOT LIFT PRINTME")
UNARY = frozenset(f"OP_{name}" for name in _UNARY.split())
BINARY = frozenset(f"OP_{name}" for name in _BINARY.split())  # with UNARY: every operation on scalars


class Instruction(NamedTuple):
    """One step of an SX function on a work vector of scalars."""

    op: str  # CasADi's name: OP_ADD, OP_SIN, OP_INPUT, OP_CONST, OP_OUTPUT, ...
    out: tuple[int, ...]  # the work index it writes; of OP_OUTPUT: (output number, nonzero)
    args: tuple[int, ...]  # the work indices it reads; of OP_INPUT: (input number, nonzero)
    value: float  # of OP_CONST


def expand(function: ca.Function) -> ca.Function:
    """The same function as SX with dense inputs and outputs; MX is expanded, ValueError where that is impossible."""
    name = function.name()
    if function.has_free():
        raise ValueError(f"{name} has the free symbols {', '.join(map(str, function.get_free()))}, expected none: "
                         f"make them inputs of {name}, or put numbers in their place")
    if not function.is_a("SXFunction"):
        try:
            function = function.expand()
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ValueError(f"{name} cannot be written in SX, expected elementary operations only: replace externals, "
                             "integrators, linear solvers (by ca.solve in SX) and table look-ups (by nocl.spline) in "
                             f"it ({reason})") from None
    args = [ca.SX.sym(f"{function.name_in(i)}_", *function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(r) for r in function.call(args)]
    return ca.Function(name, args, results, function.name_in(), function.name_out())


def instructions(function: ca.Function) -> Iterator[Instruction]:
    """The instructions of an SX function, in order."""
    for k in range(function.n_instructions()):
        op = OPERATIONS[function.instruction_id(k)]
        value = function.instruction_constant(k) if op == "OP_CONST" else 0.0
        yield Instruction(op, tuple(function.instruction_output(k)), tuple(function.instruction_input(k)), value)


def to_data(function: ca.Function) -> dict[str, Any]:
    """A function as JSON data that any version of CasADi can read back, exactly (constants as hex floats).

    Raises ValueError for a function that is not made of operations on scalars.
    """
    function = expand(function)
    check_scalar(function, function.name())
    code = [[i.op, *i.out, *i.args] if i.op != "OP_CONST" else [i.op, *i.out, float(i.value).hex()]
            for i in instructions(function)]
    return {"name": function.name(), "work": function.sz_w(), "code": code,
            "inputs": [[function.name_in(i), *function.size_in(i)] for i in range(function.n_in())],
            "outputs": [[function.name_out(i), *function.size_out(i)] for i in range(function.n_out())]}


def check_scalar(function: ca.Function, owner: str) -> None:
    """ValueError where an SX function calls others: these cannot be translated, nor differentiated as SX."""
    for i in instructions(function):
        if i.op not in UNARY | BINARY | {"OP_INPUT", "OP_CONST", "OP_OUTPUT"}:
            raise ValueError(f"{owner} contains {i.op}, a call of another function, expected operations on scalars "
                             "only: write a table look-up as nocl.spline(x, grid, values), two variables as splines of "
                             "splines, and inline what is marked never_inline")


def from_data(data: Mapping[str, Any], inputs: list[ca.SX] | None = None) -> ca.Function:
    """The function that to_data wrote; `inputs` gives the symbols to rebuild it in (default: new ones).

    Raises ValueError where the data is not such a function.
    """
    try:
        symbols = inputs or [ca.SX.sym(name, *size) for name, *size in data["inputs"]]
        outputs = [ca.SX.zeros(*size) for _, *size in data["outputs"]]
        _run(data["code"], [ca.SX(0)] * int(data["work"]), symbols, outputs)
        names_in, names_out = ([name for name, *_ in data[key]] for key in ("inputs", "outputs"))
        return ca.Function(data["name"], symbols, outputs, names_in, names_out)
    except MALFORMED as error:
        raise ValueError(f"not a function written by nocl: {type(error).__name__}: {error}") from error


def _run(code: list[list[Any]], work: list[ca.SX], inputs: list[ca.SX], outputs: list[ca.SX]) -> None:
    for op, *args in code:
        if op == "OP_INPUT":
            work[args[0]] = inputs[args[1]].nz[args[2]]
        elif op == "OP_OUTPUT":
            outputs[args[0]].nz[args[1]] = work[args[2]]
        elif op == "OP_CONST":
            work[args[0]] = ca.SX(float.fromhex(args[1]))
        elif op in UNARY:
            work[args[0]] = ca.SX.unary(getattr(ca, op), work[args[1]])
        elif op in BINARY:
            work[args[0]] = ca.SX.binary(getattr(ca, op), work[args[1]], work[args[2]])
        else:
            raise ValueError(f"{op!r} is not an operation on scalars")
