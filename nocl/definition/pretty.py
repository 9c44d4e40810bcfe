"""SX expressions as readable lines: infix, few brackets, long shared subexpressions named once."""

from __future__ import annotations

import textwrap
from collections import Counter
from typing import NamedTuple

import casadi as ca

from nocl.translate.instructions import Instruction, instructions

SHARED = 16  # characters from which a subexpression used several times gets a name of its own
_ATOM, _POWER, _PRODUCT, _QUOTIENT, _SUM, _COMPARISON, _LOGIC = range(7)  # how loosely a text binds
_INFIX = {"OP_ADD": (" + ", _SUM), "OP_SUB": (" - ", _SUM), "OP_MUL": (" ", _PRODUCT), "OP_DIV": ("/", _QUOTIENT),
          "OP_POW": ("^", _POWER), "OP_CONSTPOW": ("^", _POWER), "OP_LT": (" < ", _COMPARISON),
          "OP_LE": (" <= ", _COMPARISON), "OP_EQ": (" == ", _COMPARISON), "OP_NE": (" != ", _COMPARISON),
          "OP_AND": (" and ", _LOGIC), "OP_OR": (" or ", _LOGIC)}
_ASSOCIATIVE = {"OP_ADD", "OP_MUL", "OP_AND", "OP_OR"}


def wrapped(label: str, text: str, indent: str = "  ") -> str:
    """'label = text', filled."""
    return filled(f"{label} = {text}", indent)


def filled(text: str, indent: str = "  ", width: int = 120) -> str:
    """The text broken at blanks so that no line is wider than `width` where that can be."""
    return textwrap.fill(text, width, initial_indent=indent, subsequent_indent=indent + "    ",
                         break_long_words=False, break_on_hyphens=False)


class Text(NamedTuple):
    """A written subexpression and how loosely it binds."""

    text: str
    level: int

    def within(self, level: int, strict: bool = False) -> str:
        """The text, in brackets where an operation of this level would tear it apart."""
        return f"({self.text})" if self.level > level or (strict and self.level == level) else self.text


def lines(expression: ca.SX, symbols: ca.SX, prefix: str = "s", digits: int = 6) -> tuple[list[str], dict[str, str]]:
    """(the rows of a column as text, the names of shared subexpressions in them with their texts, in order)."""
    expression = ca.densify(expression)
    function = ca.Function("f", [symbols], [expression])
    names = [s.name() for s in ca.vertsplit(symbols)]
    taken = set(names)
    rows, shared = [""] * expression.numel(), dict[str, str]()
    uses = _uses(function)
    slots: dict[int, Text] = {}
    for k, step in enumerate(instructions(function)):
        if step.op == "OP_OUTPUT":
            rows[step.out[1]] = slots[step.args[0]].text
            continue
        text = _write(step, slots, names, digits)
        if uses[k] > 1 and len(text.text) >= SHARED:
            name = next(n for i in range(1, len(taken) + 2) if (n := f"{prefix}{i}") not in taken)
            taken.add(name)
            shared[name], text = text.text, Text(name, _ATOM)
        slots[step.out[0]] = text
    return rows, shared


def _uses(function: ca.Function) -> Counter[int]:
    """How often the result of each instruction is read."""
    writer: dict[int, int] = {}
    uses: Counter[int] = Counter()
    for k, step in enumerate(instructions(function)):
        if step.op not in ("OP_INPUT", "OP_CONST"):
            uses.update(writer[i] for i in step.args)
        if step.op != "OP_OUTPUT":
            writer[step.out[0]] = k
    return uses


def _write(step: Instruction, slots: dict[int, Text], names: list[str], digits: int) -> Text:
    if step.op == "OP_INPUT":
        return Text(names[step.args[1]], _ATOM)
    if step.op == "OP_CONST":
        return Text(f"{step.value:.{digits}g}", _SUM if step.value < 0 else _ATOM)
    args = [slots[i] for i in step.args]
    if step.op in _INFIX:
        return _infix(step.op, *args)
    match step.op:
        case "OP_SQ":
            return Text(f"{args[0].within(_POWER, strict=True)}^2", _POWER)
        case "OP_TWICE":
            return Text(f"2 {args[0].within(_PRODUCT)}", _PRODUCT)
        case "OP_NEG":
            return Text(f"-{args[0].within(_PRODUCT)}", _SUM)
        case "OP_INV":
            return Text(f"1/{args[0].within(_PRODUCT, strict=True)}", _QUOTIENT)
        case "OP_IF_ELSE_ZERO":
            return Text(f"({args[1].text} if {args[0].text} else 0)", _ATOM)
    function = step.op.removeprefix("OP_").lower()
    return Text(f"{function}({', '.join(a.text for a in args)})", _ATOM)


def _infix(op: str, left: Text, right: Text) -> Text:
    sign, level = _INFIX[op]
    if op == "OP_ADD" and right.level == _SUM and right.text.startswith("-"):
        return Text(f"{left.within(level)} - {right.text[1:]}", level)
    if op == "OP_SUB" and right.level == _SUM and right.text.startswith("-") and " " not in right.text:
        return Text(f"{left.within(level)} + {right.text[1:]}", level)
    if op == "OP_DIV":
        return Text(left.within(level, strict=True) + sign + right.within(_PRODUCT, strict=True), level)
    if op == "OP_MUL" and left.level == _SUM and left.text.startswith("-") and " " not in left.text:
        return Text(left.text + sign + right.within(level), _SUM)  # -3 a
    return Text(left.within(level, strict=level == _POWER) + sign + right.within(level, op not in _ASSOCIATIVE), level)
