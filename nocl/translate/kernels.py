"""From CasADi expressions to compiled C over a batch: one problem a vector lane, blocks of lanes shared by threads."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.support import compiler
from nocl.support.compiler import CompilerError
from nocl.translate.instructions import instructions

KINDS = frozenset(np.dtype(kind) for kind in (np.float64, np.float32, np.int64))  # that a kernel takes
HEADERS = Path(__file__).parent / "csrc"
FLAGS = ("-std=gnu11", "-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-flax-vector-conversions",
         "-Wno-psabi", "-fPIC", "-shared")

C_BINARY = {"OP_ADD": "{} + {}", "OP_SUB": "{} - {}", "OP_MUL": "{} * {}", "OP_DIV": "{} / {}",
           "OP_LT": "truth({} < {})", "OP_LE": "truth({} <= {})", "OP_EQ": "truth({} == {})",
           "OP_NE": "truth({} != {})", "OP_AND": "truth(({} != 0) & ({} != 0))",
           "OP_OR": "truth(({} != 0) | ({} != 0))", "OP_IF_ELSE_ZERO": "where({} != 0, {}, (lane){{0}})",
           "OP_POW": "v_pow({}, {})", "OP_CONSTPOW": "v_pow({}, {})", "OP_ATAN2": "v_atan2({}, {})",
           "OP_HYPOT": "v_hypot({}, {})", "OP_FMOD": "v_fmod({}, {})", "OP_REMAINDER": "v_remainder({}, {})",
           "OP_COPYSIGN": "v_copysign({}, {})", "OP_FMIN": "v_fmin({}, {})", "OP_FMAX": "v_fmax({}, {})"}
C_UNARY = {"OP_ASSIGN": "{}", "OP_NEG": "-{}", "OP_SQ": "{0} * {0}", "OP_TWICE": "{0} + {0}", "OP_INV": "1 / {}",
          "OP_NOT": "truth({} == 0)"}
C_UNARY |= {f"OP_{name.upper()}": f"v_{name}({{}})" for name in (
    "sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
    "atanh", "floor", "ceil", "fabs", "sign", "erf", "log1p", "expm1")}


def emit(name: str, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> str:
    """C source of `static void name(const lane *i0, ..., lane *o0, ...)`: the nonzeros of SX outputs, lane by lane.

    Raises ValueError for an operation that has no C twin, naming it and the function.
    """
    function = ca.Function(name, list(inputs), list(outputs), {"allow_free": False})
    arguments = [f"const lane *i{i}" for i in range(len(inputs))] + [f"lane *o{i}" for i in range(len(outputs))]
    lines, current = [f"static void {name}({', '.join(arguments)})", "{"], dict[int, str]()
    for number, step in enumerate(instructions(function)):
        if step.op == "OP_OUTPUT":
            lines.append(f"    o{step.out[0]}[{step.out[1]}] = {current[step.args[0]]};")
            continue
        if step.op == "OP_INPUT":
            right = f"i{step.args[0]}[{step.args[1]}]"
        elif step.op == "OP_CONST":
            right = f"splat({_constant(step.value)})"
        else:
            right = _operation(step.op, [current[a] for a in step.args], name)
        lines.append(f"    const lane t{number} = {right};")
        current[step.out[0]] = f"t{number}"
    return "\n".join([*lines, "}", ""])


def _constant(value: float) -> str:
    if np.isfinite(value):
        return repr(float(value))
    return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"


def _operation(op: str, args: list[str], function: str) -> str:
    template = C_BINARY.get(op) if len(args) == 2 else C_UNARY.get(op)
    if template is None:
        raise ValueError(f"{function}: CasADi's {op} has no C kernel; rewrite the expression without it")
    return template.format(*args)


class Kernel:
    """A compiled library of source that includes lanes.h: its functions take (first block, last block, index, ...)."""

    def __init__(self, source: str, cache: str | os.PathLike[str] | None = None) -> None:
        headers = [path.read_text() for path in sorted(HEADERS.glob("*.h"))]
        path = compiler.shared_library("kernel", [source, headers, FLAGS], partial(_build, source), cache)
        self._library = compiler.load(path)
        self.width = int(self._library.nocl_width())

    def __call__(self, name: str, problems: NDArray[np.int64], *args: object, threads: int = 1) -> None:
        """Run function `name` on the given problem numbers, blocks of lanes shared among threads."""
        blocks = -(-len(problems) // self.width)
        if not blocks:
            return
        padding = np.full(blocks * self.width - len(problems), problems[-1])  # lanes left over repeat the last problem
        index = np.concatenate([problems, padding]).astype(np.int64)
        pointers = [_c(a) for a in args]
        share = -(-blocks // max(threads, 1))
        pieces = [(s, min(s + share, blocks)) for s in range(0, blocks, share)]

        def run(piece: tuple[int, int], held: tuple[object, ...] = args) -> None:  # arrays live as long as work on them
            function = self._library[name]  # a fresh handle: argument types are the handle's
            function(ctypes.c_int64(piece[0]), ctypes.c_int64(piece[1]), _c(index), *pointers)

        if len(pieces) < 2:
            for piece in pieces:
                run(piece)
        else:
            working = list[Future[None]]()
            try:
                for piece in pieces:
                    working.append(_threads(threads).submit(run, piece))  # ctypes releases the interpreter's lock
                for one in working:
                    one.result()
            except BaseException:  # Ctrl-C: the arrays are theirs until they are done
                wait(working)
                raise


@cache
def _threads(n: int) -> ThreadPoolExecutor:
    """Kept, since starting threads takes longer than a kernel on a small batch; a forked process makes its own."""
    return ThreadPoolExecutor(n)


os.register_at_fork(after_in_child=_threads.cache_clear)


def _c(value: object) -> Any:
    if value is None:
        return ctypes.c_void_p(None)
    if isinstance(value, np.ndarray):
        if not value.flags.c_contiguous or value.dtype not in KINDS:
            raise ValueError(f"a kernel got an array of {value.dtype}, contiguous: {value.flags.c_contiguous}")
        return ctypes.c_void_p(value.__array_interface__["data"][0])  # value.ctypes takes three times as long
    return ctypes.c_int64(int(value))  # type: ignore[call-overload]


def _build(source: str, folder: Path) -> Path:
    """The compiled library of this source, in `folder`."""
    code, target = folder / "kernel.c", folder / "kernel.so"
    code.write_text(source)
    plain = [*FLAGS, f"-I{HEADERS}", str(code), "-o", str(target), "-lm", "-Wl,-z,defs"]
    try:
        compiler.run([*plain, "-DWITH_MVEC", "-lmvec"], "a kernel of nocl's")
    except CompilerError:  # not every C library has vector mathematics
        compiler.run(plain, "a kernel of nocl's")
    return target
