"""CasADi functions as batched torch functions: the instruction list of the SX form, written out once as torch code."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import torch
from torch import Tensor

from nocl.translate.instructions import UNARY, expand, instructions

# Python source of each operation on tensors or floats {0}, {1}. CasADi's values and derivative conventions hold:
# fmin and fmax ignore NaN and share the derivative at ties; sign, floor, ceil and comparisons have derivative 0.
FLOAT_OPS = {
    "OP_ADD": "{0} + {1}", "OP_SUB": "{0} - {1}", "OP_MUL": "{0} * {1}", "OP_DIV": "{0} / {1}", "OP_NEG": "-{0}",
    "OP_EXP": "{0}.exp()", "OP_LOG": "{0}.log()", "OP_POW": "power({0}, {1})", "OP_CONSTPOW": "{0} ** {1}",
    "OP_SQRT": "{0}.sqrt()", "OP_SQ": "{0} * {0}", "OP_TWICE": "{0} * 2.0", "OP_INV": "{0}.reciprocal()",
    "OP_SIN": "{0}.sin()", "OP_COS": "{0}.cos()", "OP_TAN": "{0}.tan()",
    "OP_ASIN": "{0}.asin()", "OP_ACOS": "{0}.acos()", "OP_ATAN": "{0}.atan()",
    "OP_SINH": "{0}.sinh()", "OP_COSH": "{0}.cosh()", "OP_TANH": "{0}.tanh()",
    "OP_ASINH": "{0}.asinh()", "OP_ACOSH": "{0}.acosh()", "OP_ATANH": "{0}.atanh()",
    "OP_LOG1P": "{0}.log1p()", "OP_EXPM1": "{0}.expm1()", "OP_ERF": "{0}.erf()", "OP_ERFINV": "{0}.erfinv()",
    "OP_FABS": "{0}.abs()", "OP_SIGN": "{0}.sign()", "OP_FLOOR": "{0}.floor()", "OP_CEIL": "{0}.ceil()",
    "OP_FMOD": "fmod({0}, {1})", "OP_REMAINDER": "remainder({0}, {1})", "OP_COPYSIGN": "copysign({0}, {1})",
    "OP_FMIN": "fmin({0}, {1})", "OP_FMAX": "fmax({0}, {1})", "OP_ATAN2": "atan2({0}, {1})",
    "OP_HYPOT": "hypot({0}, {1})",
}
COMPARISONS = {"OP_LT": "{0} < {1}", "OP_LE": "{0} <= {1}", "OP_EQ": "{0} == {1}", "OP_NE": "{0} != {1}"}
LOGIC = {"OP_NOT": "~{0}", "OP_AND": "{0} & {1}", "OP_OR": "{0} | {1}"}  # of boolean tensors
BOOLEAN = COMPARISONS.keys() | LOGIC.keys()
COPIES = {"OP_ASSIGN", "OP_LIFT"}
SAFE = {  # operands at which the operation has finite derivatives, for branches that are switched off
    **dict.fromkeys(["OP_LOG", "OP_SQRT", "OP_INV", "OP_POW", "OP_CONSTPOW", "OP_DIV", "OP_FMOD", "OP_REMAINDER",
                     "OP_ATAN2", "OP_HYPOT", "OP_EXP", "OP_EXPM1", "OP_SINH", "OP_COSH"], 1.0),
    **dict.fromkeys(["OP_TAN", "OP_ASIN", "OP_ACOS", "OP_ATANH", "OP_LOG1P", "OP_ERFINV"], 0.0), "OP_ACOSH": 2.0,
}


Operand = Tensor | float


def _pair(a: Operand, b: Operand) -> tuple[Tensor, Tensor]:
    """Both as tensors; at least one is."""
    if isinstance(a, Tensor):
        return a, b if isinstance(b, Tensor) else a.new_full((), b)
    assert isinstance(b, Tensor)  # the graph folds operations on constants
    return b.new_full((), a), b


def _power(a: Operand, b: Operand) -> Tensor:
    """a^b; at b = 0, where torch drops the derivative 1 / a of d/da a^b = b a^(b - 1) by b, as a^(b - 1) a."""
    if not (isinstance(a, Tensor) and isinstance(b, Tensor)):
        return a**b  # type: ignore[return-value]  # at least one is a tensor
    zero = (b == 0) & (a != 0)
    return torch.where(zero, torch.where(zero, a, 1.0) ** (torch.where(zero, b, 0.0) - 1.0) * a, a**b)


def _fmin(a: Operand, b: Operand) -> Tensor:
    """min(a, b), half of the derivative to each at ties; NaN only where both are."""
    a, b = _pair(a, b)
    return 0.5 * (torch.fmin(a, b) + torch.fmin(b, a))


def _fmax(a: Operand, b: Operand) -> Tensor:
    """max(a, b), half of the derivative to each at ties; NaN only where both are."""
    a, b = _pair(a, b)
    return 0.5 * (torch.fmax(a, b) + torch.fmax(b, a))


def _atan2(a: Operand, b: Operand) -> Tensor:
    """The angle of the point (b, a)."""
    return torch.atan2(*_pair(a, b))


def _hypot(a: Operand, b: Operand) -> Tensor:
    """sqrt(a^2 + b^2) without overflow."""
    return torch.hypot(*_pair(a, b))


def _copysign(a: Operand, b: Operand) -> Tensor:
    """|a| with the sign of b (-0.0 counts as negative)."""
    a, b = _pair(a, b)
    return a.abs() * torch.copysign(torch.ones_like(b), b.detach())


def _fmod(a: Operand, b: Operand) -> Tensor:
    """a - n b, n = a / b rounded towards zero: exact."""
    if isinstance(a, Tensor) and not isinstance(b, Tensor):
        return torch.fmod(a, b)
    a, b = _pair(a, b)
    return _multiple_off(torch.fmod(a.detach(), b.detach()), a, b)


def _remainder(a: Operand, b: Operand) -> Tensor:
    """a - n b, n = a / b rounded half to even: exact (IEEE 754), unlike torch.remainder's floored one."""
    a, b = _pair(a, b)
    with_sign, size = torch.fmod(a.detach(), 2.0 * b.detach()), b.detach().abs()
    turns = (with_sign.abs() > 0.5 * size).to(size.dtype) + (with_sign.abs() >= 1.5 * size).to(size.dtype)
    return _multiple_off(with_sign - turns * with_sign.sign() * size, a, b)


def _multiple_off(r: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """The value r = a - n b with the derivatives 1 and -n; torch's n = trunc(a / b) is off where a / b rounds up."""
    n = ((a.detach() - r) / b.detach()).round()
    return r + (a - a.detach()) - n * (b - b.detach())


HELPERS: dict[str, Any] = {
    "torch": torch, "inf": math.inf, "nan": math.nan, "power": _power, "fmin": _fmin, "fmax": _fmax, "fmod": _fmod,
    "remainder": _remainder, "copysign": _copysign, "atan2": _atan2, "hypot": _hypot}


class Node(NamedTuple):
    """A scalar of the expression graph: an operation on earlier nodes."""

    op: str
    args: tuple[int, ...] = ()  # node numbers; of OP_INPUT: (input number, nonzero)
    value: float = 0.0  # of OP_CONST


class Graph:
    """The expression graph of a function, each distinct scalar once; `outputs[i]` are output i's nodes, by columns.

    Raises ValueError where the function has an operation without a twin in torch.
    """

    def __init__(self, function: ca.Function) -> None:
        self.nodes: list[Node] = []
        self.outputs = [[-1] * function.numel_out(i) for i in range(function.n_out())]
        self._number: dict[tuple[str, tuple[int, ...], str], int] = {}
        work = [-1] * function.sz_w()
        for step in instructions(function):
            if step.op == "OP_OUTPUT":
                self.outputs[step.out[0]][step.out[1]] = work[step.args[0]]
            elif step.op in ("OP_INPUT", "OP_CONST"):
                work[step.out[0]] = self._add(Node(step.op, step.args, step.value))
            else:
                work[step.out[0]] = self._operation(step.op, tuple(work[i] for i in step.args), function.name())

    def _operation(self, op: str, args: tuple[int, ...], owner: str) -> int:
        if not (op in FLOAT_OPS or op in BOOLEAN or op in COPIES or op == "OP_IF_ELSE_ZERO"):
            raise ValueError(f"{owner} contains {op}, which has no twin in torch; expected elementary operations of "
                             f"SX: rewrite {owner} without it (table look-ups and never_inline calls are OP_CALL)")
        if op in COPIES:
            return args[0]
        args = args[:1] if op in UNARY else args
        if all(self.nodes[i].op == "OP_CONST" for i in args):
            return self._add(Node("OP_CONST", (), _evaluate(op, [self.nodes[i].value for i in args])))
        if op == "OP_ADD" and (branches := self._if_else(*args)):
            return self._add(Node("OP_WHERE", branches))
        return self._add(Node(op, args))

    def _if_else(self, left: int, right: int) -> tuple[int, int, int] | None:
        """(c, a, b) where the sum is (c ? a : 0) + (!c ? b : 0), which is how SX holds if_else(c, a, b)."""
        for i, j in ((left, right), (right, left)):
            a, b = self.nodes[i], self.nodes[j]
            if a.op == b.op == "OP_IF_ELSE_ZERO" and self.nodes[b.args[0]] == Node("OP_NOT", a.args[:1]):
                return a.args[0], a.args[1], b.args[1]
        return None

    def _add(self, node: Node) -> int:
        key = (node.op, node.args, node.value.hex())
        if key not in self._number:
            self._number[key] = len(self.nodes)
            self.nodes.append(node)
        return self._number[key]

    def operands(self, i: int) -> tuple[int, ...]:
        """The nodes that node i reads."""
        return () if self.nodes[i].op in ("OP_INPUT", "OP_CONST") else self.nodes[i].args

    def live(self) -> list[int]:
        """The nodes that some output needs, in order."""
        needed = {i for output in self.outputs for i in output}
        for i in reversed(range(len(self.nodes))):
            if i in needed:
                needed.update(self.operands(i))
        return sorted(needed)

    def guards(self) -> dict[int, frozenset[tuple[int, bool]]]:
        """The conditions (node, wanted truth) under all of which alone a node counts, for each live node.

        sqrt in if_else(x > 0, sqrt(x), 0) has the guard (x > 0, True): it may read any other number than x
        where x <= 0, which keeps its infinite derivative out of 0 * inf.
        """
        found: dict[int, frozenset[tuple[int, bool]]] = {i: frozenset() for output in self.outputs for i in output}
        for i in reversed(self.live()):
            node = self.nodes[i]
            own: list[set[tuple[int, bool]]] = [set() for _ in self.operands(i)]
            if node.op in ("OP_IF_ELSE_ZERO", "OP_WHERE"):
                own[1:] = [{(node.args[0], True)}, {(node.args[0], False)}][: len(own) - 1]
            for j, extra in zip(self.operands(i), own, strict=True):
                found[j] = (found[i] | extra) & found.get(j, found[i] | extra)
        return found


def _evaluate(op: str, values: list[float]) -> float:
    """An operation on constants, as CasADi computes it."""
    symbols = ca.SX.sym("c", len(values))
    parts = ca.vertsplit(symbols)
    result = ca.SX.unary(getattr(ca, op), *parts) if len(parts) == 1 else ca.SX.binary(getattr(ca, op), *parts)
    return float(ca.Function("constant", [symbols], [result])(values))


class _Writer:
    """Writes a graph as the source of one Python function of the input tensors."""

    def __init__(self, graph: Graph, shapes: Sequence[tuple[int, int]]) -> None:
        self.graph, self.shapes = graph, shapes
        self.guards = graph.guards()
        self.lines: list[str] = []
        self.names: dict[tuple[int, str], str] = {}  # (node, "float" | "bool") -> variable or literal
        for output in graph.outputs:
            for i in output:
                self.visit(i)

    def visit(self, root: int) -> None:
        """Write node `root` after everything that it reads, guards included."""
        stack = [root]
        while stack:
            i = stack[-1]
            needs = [j for j in (*self.graph.operands(i), *(c for c, _ in self._guards(i))) if not self._done(j)]
            stack.extend(needs)
            if not needs:
                stack.pop()
                if not self._done(i):
                    self.write(i)

    def _done(self, i: int) -> bool:
        return (i, "float") in self.names or (i, "bool") in self.names

    def _guards(self, i: int) -> list[tuple[int, bool]]:
        return sorted(self.guards[i]) if self.graph.nodes[i].op in SAFE else []

    def new(self, source: str) -> str:
        name = f"v{len(self.lines)}"
        self.lines.append(f"{name} = {source}")
        return name

    def number(self, i: int) -> str:
        """Node i as a float tensor, or as a literal where it is constant."""
        if (i, "float") not in self.names:
            self.names[i, "float"] = self.new(f"{self.names[i, 'bool']}.to(x0.dtype)")
        return self.names[i, "float"]

    def constant(self, i: int) -> bool:
        """Whether node i is a number, known now."""
        return self.graph.nodes[i].op == "OP_CONST"

    def truth(self, i: int) -> str:
        """Node i as a boolean tensor, or as True or False."""
        if (i, "bool") not in self.names:
            value = self.graph.nodes[i].value
            self.names[i, "bool"] = str(value != 0) if self.constant(i) else self.new(f"{self.number(i)} != 0.0")
        return self.names[i, "bool"]

    def write(self, i: int) -> None:
        op, args, value = self.graph.nodes[i]
        if op == "OP_CONST":
            self.names[i, "float"] = f"({value!r})"
        elif op == "OP_INPUT":
            self.names[i, "float"] = f"x{args[0]}_{args[1]}"
        elif op in LOGIC:
            self.names[i, "bool"] = self.new(LOGIC[op].format(*map(self.truth, args)))
        elif op in COMPARISONS:
            self.names[i, "bool"] = self.new(COMPARISONS[op].format(*map(self.number, args)))
        elif op in ("OP_IF_ELSE_ZERO", "OP_WHERE"):
            self.names[i, "float"] = self.new(self._where(*args))
        else:
            self.names[i, "float"] = self.new(FLOAT_OPS[op].format(*self._operands(i)))

    def _where(self, condition: int, yes: int, no: int | None = None) -> str:
        a, b = self.number(yes), "0.0" if no is None else self.number(no)
        if self.constant(condition):
            return a if self.graph.nodes[condition].value else b
        if self.constant(yes) and (no is None or self.constant(no)):
            a = f"x0.new_full((), {a})"  # of two floats, torch.where would choose the dtype
        return f"torch.where({self.truth(condition)}, {a}, {b})"

    def _operands(self, i: int) -> list[str]:
        """The operands of node i; where its branch is off, a number at which its derivatives are finite."""
        op, args, _ = self.graph.nodes[i]
        names = [self.number(j) for j in args]
        return [name if self.constant(j) else self._guarded(name, i, SAFE.get(op, 0.0))
                for name, j in zip(names, args, strict=True)]

    def _guarded(self, name: str, i: int, safe: float) -> str:
        for condition, wanted in self._guards(i):
            if not self.constant(condition):
                branches = f"{name}, {safe}" if wanted else f"{safe}, {name}"
                name = self.new(f"torch.where({self.truth(condition)}, {branches})")
        return name

    def source(self) -> str:
        """The function body(x0, x1, ...) -> list of lists of columns (tensors or floats)."""
        head = []
        for k, (rows, columns) in enumerate(self.shapes):
            order = [f"x{k}_{i + rows * j}" for i in range(rows) for j in range(columns)]
            flat = f"x{k}" if columns == 1 else f"x{k}.flatten(-2)"
            head += [f"{', '.join(order)}, = {flat}.unbind(-1)"] if order else []
        outputs = ", ".join(f"[{', '.join(map(self.number, output))}]" for output in self.graph.outputs)
        arguments = ", ".join(f"x{k}" for k in range(len(self.shapes)))
        return "\n    ".join([f"def body({arguments}):", *_free_early([*head, *self.lines, f"return [{outputs}]"])])


def _free_early(lines: list[str]) -> list[str]:
    """The lines, with `del` behind the last use of each intermediate v0, v1, ...: their memory is used again."""
    seen, result = set(re.findall(r"\bv\d+\b", lines[-1])), [lines[-1]]
    for line in reversed(lines[:-1]):
        used = re.findall(r"\bv\d+\b", line)
        done = sorted(set(used) - seen)
        result += [line if not done else f"{line}; del {', '.join(done)}"]
        seen.update(used)
    return result[::-1]


class TorchFunction:
    """A CasADi function on rows of tensors; see `to_torch`. It holds no tensors and can be pickled."""

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self.name = function.name()
        if function.n_in() == 0:
            raise ValueError(f"{self.name} has no inputs; expected at least one, which says the batch: give it one")
        dense = expand(function)
        self._in = [dense.size_in(i) for i in range(dense.n_in())]
        self._out = [dense.size_out(i) for i in range(dense.n_out())]
        self._names = tuple(function.name_in())
        self._widths = tuple(_row_shape(*size) for size in self._in)
        self.source = _Writer(Graph(dense), self._in).source()
        self._body = self._compile()

    def _compile(self) -> Callable[..., list[list[Any]]]:
        scope = dict(HELPERS)
        exec(compile(self.source, f"<to_torch {self.name}>", "exec"), scope)
        body: Callable[..., list[list[Any]]] = scope["body"]
        return body

    def __repr__(self) -> str:
        return f"to_torch({self.function})"

    def __reduce__(self) -> tuple[Any, ...]:
        return TorchFunction, (self.function,)

    def __deepcopy__(self, memo: dict[int, Any]) -> TorchFunction:
        return self

    def __call__(self, *args: Tensor) -> Any:
        args, batch = self._check(args)
        outputs = tuple(_stack(columns, *size, batch, args[0])
                        for columns, size in zip(self._body(*args), self._out, strict=True))
        return outputs[0] if len(outputs) == 1 else outputs

    def _check(self, args: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], torch.Size]:
        """The arguments with one common batch shape, and that shape."""
        names = self._names
        if len(args) != len(names):
            raise ValueError(f"{self.name} got {len(args)} arguments, expected {len(names)}: "
                             f"pass {', '.join(names)}, each a tensor of rows [B, n]")
        batches = [self._batch(x, k) for k, x in enumerate(args)]
        for x, name in zip(args[1:], names[1:], strict=True):
            if x.dtype != args[0].dtype or x.device != args[0].device:
                raise ValueError(f"{self.name}: {name} is {x.dtype} on {x.device}, expected {args[0].dtype} on "
                                 f"{args[0].device} as {names[0]}: use {name}.to({names[0]})")
        if all(batch == batches[0] for batch in batches[1:]):
            return args, batches[0]
        try:
            batch = torch.broadcast_shapes(*batches)
        except RuntimeError:
            got = ", ".join(f"{name} {list(b)}" for name, b in zip(names, batches, strict=True))
            raise ValueError(f"{self.name} got the batch shapes {got}; expected one and the same: "
                             "pass as many rows in each argument") from None
        return tuple(x.expand(*batch, *w) for x, w in zip(args, self._widths, strict=True)), batch

    def _batch(self, x: Tensor, k: int) -> torch.Size:
        name, width = self._names[k], self._widths[k]
        if not isinstance(x, Tensor) or not x.is_floating_point():
            kind = x.dtype if isinstance(x, Tensor) else type(x).__name__
            raise ValueError(f"{self.name}: {name} is {kind}, expected a tensor of floats: use torch.as_tensor(...)")
        if x.shape[-len(width):] != width:
            rows = ", ".join(map(str, width))
            raise ValueError(f"{self.name}: {name} has shape {tuple(x.shape)}, expected [B, {rows}]: "
                             f"pass rows of {rows}")
        return x.shape[: x.ndim - len(width)]


def _row_shape(rows: int, columns: int) -> tuple[int, ...]:
    """The shape of a CasADi matrix behind the batch: [n] of a column, [r, c] of others, [0] of an empty one."""
    return (rows * columns,) if columns == 1 or rows * columns == 0 else (rows, columns)


def _stack(columns: list[Any], rows: int, width: int, batch: torch.Size, like: Tensor) -> Tensor:
    """Columns [B], floats among them, as [B, n] or [B, r, c]."""
    if not columns:
        return like.new_zeros((*batch, 0))
    tensors = [c if isinstance(c, Tensor) else like.new_full(batch, c) for c in columns]
    if width == 1:
        return torch.stack(tensors, -1)
    return torch.stack(tensors, -1).unflatten(-1, (width, rows)).transpose(-1, -2)


def to_torch(function: ca.Function) -> TorchFunction:
    """The same function on torch rows: each argument [B, n], one output [B, m] or a tuple of outputs.

    A scalar argument is [B, 1]; matrices (r, c) with c > 1 are [B, r, c]; sparse outputs come dense, empty ones
    [B, 0]. More batch dimensions, or none, may stand in place of B. Any float dtype and device; differentiable as often
    as wanted, with CasADi's conventions at kinks; a branch of if_else that is off has derivative 0.
    MX functions are expanded. Raises ValueError at translation for an operation that torch has not, naming it and the
    function, and at a call for arguments that do not fit.
    """
    if not isinstance(function, ca.Function):
        raise ValueError(f"to_torch: got a {type(function).__name__}; expected a casadi.Function, like ocp.system.f")
    return TorchFunction(function)
