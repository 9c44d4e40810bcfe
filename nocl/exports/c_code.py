"""CasADi Functions as C99 for microcontrollers: no torch, no libcasadi, no malloc, no globals, re-entrant.

The folder gets, for a function NAME:

    NAME.h             int NAME(const double *x, double t, double *u), with shapes, units and bounds
    NAME.c             that function, its workspace on the stack
    NAME_casadi.c      what CasADi's code generator wrote; included by NAME.c
    NAME_vectors.csv   inputs in the box, corners among them, and CasADi's outputs
    NAME_test.c        a main that holds NAME against these vectors
    Makefile           `make check` builds and runs every self-test of the folder
    README.md          what stands in the folder, how to call it, how to compile it for a microcontroller

`load(folder)` compiles it and calls it back.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.support import checks, compiler
from nocl.support.atomic import part_of, remove_parts
from nocl.support.checks import Array

MARK = "written by nocl.to_c"  # stands in the first line of every file: only such files are overwritten
# of the self-test, relative to what _scales says
TOLERANCE = {"float64": 1e-12, "float32": 1e-5}
REAL = {"float64": "double", "float32": "float"}
RESERVED = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "main", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while"))

ONE = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "log",
       "sqrt", "fabs", "floor", "ceil", "log1p", "expm1", "erf")
TWO = ("pow", "fmin", "fmax", "fmod", "remainder", "atan2", "hypot", "copysign")
SINGLE = ["#include <math.h>", "/* as <tgmath.h> would, which not every embedded C library has whole */",
          *(f"#define {f}(x) {f}f(x)" for f in ONE), *(f"#define {f}(x, y) {f}f(x, y)" for f in TWO), ""]

Box = tuple[ArrayLike, ArrayLike]


@dataclass(frozen=True)
class _Argument:
    """An input or output: a column of n numbers, passed by value where `scalar`."""

    name: str
    n: int
    labels: Sequence[str]
    box: tuple[Array, Array] | None
    scalar: bool = False


def to_c(function: ca.Function, folder: str | Path, name: str | None = None, *, bounds: Mapping[str, Box],
         labels: Mapping[str, Sequence[str]] | None = None, dtype: str = "float64", samples: int = 64, seed: int = 0,
         note: str = "") -> Path:
    """Write `function` as C99 into `folder` and return the folder; nothing is written where it fails.

    Parameters
    ----------
    function : ca.Function
        Dense columns in and out, like policy:(x[4], t) -> (u[1]). Not one that calls a library (L4CasADi).
    name : str
        The C function's name; by default the Function's.
    bounds : mapping from argument names to (lower, upper)
        The box of every input, which the test vectors are drawn from; of outputs where they have one. Numbers stand
        for all entries.
    labels : mapping from argument names to a text for each entry, with its unit ("theta [rad]").
    dtype : "float64" or "float32"
    samples, seed : how many random test vectors, beside up to 16 corners of the box.
    note : str
        Put at the head of the header: where the function comes from.

    Raises
    ------
    ValueError
        For names that C does not take, missing or crossed bounds, functions that need a library or the heap, and a
        folder with files of these names that nocl did not write.
    """
    name = name or function.name()
    inputs, outputs = _arguments(function, name, bounds, labels or {})
    checks.word(dtype, tuple(REAL), "dtype", "to_c")
    code, sizes = _generate(function, f"{name}_casadi", REAL[dtype])
    z = _samples([a.box for a in inputs if a.box], samples, seed)
    values = np.hstack([v.full().T for v in _inner(function, name).map(len(z)).call(_split(z, inputs))])
    if not np.isfinite(values).all():
        bad = z[~np.isfinite(values).all(axis=1)][0]
        raise ValueError(f"to_c: {name} is NaN or inf at {bad.tolist()}; expected finite values in the box: shrink its "
                         "bounds")
    vectors = z, values, _scales(function, inputs, z, values)
    files = {f"{name}.h": _header(name, inputs, outputs, REAL[dtype], note),
             f"{name}.c": _source(name, inputs, outputs, REAL[dtype], sizes),
             f"{name}_casadi.c": _first_line(f"{name}_casadi.c") + code,
             f"{name}_vectors.csv": _csv(name, inputs, outputs, z, values),
             f"{name}_test.c": _self_test(name, inputs, outputs, vectors, dtype),
             "Makefile": MAKEFILE}
    return _put(Path(folder), files | {"README.md": _readme(Path(folder), files[f"{name}.h"], name)})


class Compiled:
    """A compiled function of nocl's, called back: rows in, rows out (float64), whatever it computes in.

    `compiled(x, t)` takes each input as a column [n] (a number where it is a scalar) and gives a list of outputs [n],
    or the only one; with rows [B, n] it gives rows [B, n]. `name`, `inputs`, `outputs` ({name: length}), `dtype`.
    """

    def __init__(self, header: Path, library: Path) -> None:
        text = header.read_text(encoding="utf-8")
        found = re.search(r"^int (\w+)\((.*)\);$", text, re.MULTILINE)
        if MARK not in text.split("\n", 1)[0] or found is None:
            raise ValueError(f"to_c.load: {header} was not written by nocl; expected the header of to_c")
        self.name, declared = found[1], [a.rsplit(" ", 1) for a in found[2].split(", ")]
        size = {a.lower(): int(n) for a, n in re.findall(rf"#define {self.name.upper()}_N_(\w+) (\d+)", text)}
        lengths = {name.lstrip("*"): size[name.lstrip("*").lower()] for _, name in declared}
        self.outputs = {k.lstrip("*"): lengths[k.lstrip("*")] for t, k in declared
                        if k.startswith("*") and not t.startswith("const")}
        self.inputs = {k: n for k, n in lengths.items() if k not in self.outputs}
        self.dtype = "float64" if declared[0][0].split()[-1] == "double" else "float32"
        real = ctypes.c_double if self.dtype == "float64" else ctypes.c_float
        self.function = getattr(compiler.load(library), self.name)
        self.function.restype = ctypes.c_int
        self.function.argtypes = [ctypes.c_void_p if k.startswith("*") else real for _, k in declared]
        self._scalar = [not k.startswith("*") for _, k in declared][:len(self.inputs)]

    def __call__(self, *args: ArrayLike) -> Any:
        """The outputs at one point or at rows; ValueError for arguments that do not fit."""
        given = [np.asarray(a, dtype=np.float64) for a in args]
        single = all(a.ndim < 2 for a in given)
        B = max((len(a) for a in given if a.ndim == 2), default=1)
        rows = [self._rows(a, n, B) for a, n in zip(given, self._lengths(len(given)), strict=True)]
        results = [np.empty((B, n), self.dtype) for n in self.outputs.values()]
        for i in range(B):
            row = [float(a[i, 0]) if scalar else a[i].ctypes.data for a, scalar in zip(rows, self._scalar, strict=True)]
            self.function(*row, *(r[i].ctypes.data for r in results))
        answers = [r[0].astype(np.float64) if single else r.astype(np.float64) for r in results]
        return answers[0] if len(answers) == 1 else answers

    def _lengths(self, n: int) -> list[int]:
        if n != len(self.inputs):
            raise ValueError(f"{self.name}: got {n} arguments; expected {len(self.inputs)}: {', '.join(self.inputs)}")
        return list(self.inputs.values())

    def _rows(self, a: Array, n: int, B: int) -> Array:
        if n == 1 and a.shape == (B,):
            a = a[:, None]  # one number for each row
        rows = np.broadcast_to(a, (B, n)) if a.shape in ((), (n,)) else a
        if rows.shape != (B, n):
            raise ValueError(f"{self.name}: an argument has shape {a.shape}; expected [{n}] or [{B}, {n}], for "
                             f"{', '.join(self.inputs)}")
        return np.ascontiguousarray(rows, self.dtype)


def load(folder: str | Path, name: str | None = None, *, flags: Sequence[str] = ("-O2", "-std=c99")) -> Compiled:
    """The function that to_c wrote in `folder`, compiled and loaded by ctypes; nothing is written to the folder.

    name: which one, where the folder holds several. The compiler is $CC, or else gcc or cc. Raises ValueError for a
    missing compiler, a folder without such a function, and code that does not compile.
    """
    folder = Path(folder)
    there = {p.stem: p for p in sorted(folder.glob("*.h")) if (folder / f"{p.stem}_casadi.c").is_file()}
    if name is None and len(there) == 1:
        name = next(iter(there))
    if name is None or name not in there:
        raise ValueError(f"to_c.load: {folder} holds {', '.join(there) or 'no function of to_c'}; got name={name!r}: "
                         "name one of them")
    source = folder / f"{name}.c"
    with tempfile.TemporaryDirectory(dir=compiler.own_folder()) as build:  # a loaded library needs its file no longer
        library = Path(build) / f"{name}.so"
        try:
            compiler.run([*flags, "-shared", "-fPIC", source, "-o", library, "-lm"], f"{source}")
        except compiler.CompilerError as error:
            raise ValueError(f"to_c.load: {error}; expected the code that to_c wrote: write it again") from error
        return Compiled(there[name], library)


# The function and its arguments


def _arguments(function: ca.Function, name: str, bounds: Mapping[str, Box],
               labels: Mapping[str, Sequence[str]]) -> tuple[list[_Argument], list[_Argument]]:
    ins, outs = function.name_in(), function.name_out()
    for identifier in (name, *ins, *outs):
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", identifier) or identifier in RESERVED:
            raise ValueError(f"to_c: {identifier!r} is no name for C; expected letters, digits and _, and no keyword: "
                             "give the Function other names")
    repeated = set(ins) & set(outs)
    if repeated:
        raise ValueError(f"to_c: {', '.join(sorted(repeated))} stands for an input and an output of {name}; expected a "
                         "name for each: rename the Function's outputs")
    unknown = (set(bounds) | set(labels)) - set(ins) - set(outs)
    if unknown:
        raise ValueError(f"to_c: {', '.join(sorted(unknown))} is no argument of {name}; expected bounds and labels of "
                         f"its inputs ({', '.join(ins)}) and outputs ({', '.join(outs)})")
    missing = [i for i in ins if i not in bounds]
    if missing:
        raise ValueError(f"to_c: bounds has no {', '.join(missing)}; expected (lower, upper) for each input of {name}: "
                         "they document it, and the test vectors are drawn from them")
    columns = [(k, function.sparsity_in(i), True) for i, k in enumerate(ins)]
    columns += [(k, function.sparsity_out(i), False) for i, k in enumerate(outs)]
    arguments = [_argument(key, sparsity, is_input, name, bounds, labels) for key, sparsity, is_input in columns]
    return arguments[:len(ins)], arguments[len(ins):]


def _argument(key: str, sparsity: ca.Sparsity, is_input: bool, name: str, bounds: Mapping[str, Box],
              labels: Mapping[str, Sequence[str]]) -> _Argument:
    n = sparsity.size1()
    if sparsity.size2() != 1 or n == 0 or not sparsity.is_dense():
        raise ValueError(f"to_c: {key} of {name} is {sparsity.dim(True)}; expected a dense column: use ca.densify and "
                         "ca.vec")
    texts = [str(label) for label in labels.get(key, [f"{key}[{i}]" for i in range(n)])]
    if len(texts) != n:
        raise ValueError(f"to_c: labels has {len(texts)} texts for {key}, expected {n}, one for each entry")
    box = _box(bounds[key], n, key, name, texts) if key in bounds else None
    return _Argument(key, n, texts, box, scalar=is_input and n == 1)


def _box(box: Box, n: int, key: str, name: str, labels: Sequence[str]) -> tuple[Array, Array]:
    lower, upper = (np.full(n, value) if np.ndim(value) == 0 else value for value in box)
    return checks.bounds(lower, upper, n, (f"lower bound of {key}", f"upper bound of {key}"), f"to_c {name}", labels)


def _inner(function: ca.Function, name: str) -> ca.Function:
    """The same function under another name, without a level of calls."""
    if function.is_a("SXFunction"):
        sx = function.sx_in()
        return ca.Function(name, sx, function.call(sx), function.name_in(), function.name_out())
    mx = function.mx_in()
    return ca.Function(name, mx, function.call(mx, True, False), function.name_in(), function.name_out())


def _generate(function: ca.Function, name: str, real: str) -> tuple[str, dict[str, int]]:
    """CasADi's C code, and the sizes of the workspace it asks for."""
    for part in [function, *function.find_functions()]:
        if part.is_a("External", True):
            raise ValueError(f"to_c: {function.name()} calls the library of {part.name()}, which has no C source; "
                             "expected CasADi expressions: export the network with backend='native'")
    options: dict[str, Any] = {"with_header": True, "casadi_int": "int", "casadi_real": real, "verbose": False}
    with tempfile.TemporaryDirectory(dir=compiler.own_folder()) as folder:
        try:
            generator = ca.CodeGenerator(f"{name}.c", options)
            generator.add(_inner(function, name))
            generator.generate(folder + os.sep)
        except RuntimeError as error:
            raise ValueError(f"to_c: CasADi generates no C code for {function.name()}: "
                             f"{str(error).splitlines()[-1]}") from error
        code, header = (Path(folder, f"{name}{end}").read_text() for end in (".c", ".h"))
    foreign = re.search(r"#error.*|\b(malloc|calloc|free|printf|fopen|dlopen)\b", code)
    if foreign:
        raise ValueError(f"to_c: the C code of {function.name()} has {foreign[0]!r} in it; expected plain "
                         "arithmetic: leave out solvers, integrators and callbacks")
    return code, {key: int(n) for key, n in re.findall(rf"#define {name}_SZ_(\w+) (\d+)", header)}


def _samples(boxes: Sequence[tuple[Array, Array]], n: int, seed: int) -> Array:
    """Up to 16 corners of the box, its centre and n uniform samples, as rows."""
    lower, upper = (np.hstack([box[i] for box in boxes]) for i in (0, 1))
    corners = np.array(list(product([0.0, 1.0], repeat=min(4, len(lower)))))
    corners = np.hstack([corners, np.repeat(corners[:, -1:], len(lower) - corners.shape[1], axis=1)])
    inside = np.random.default_rng(seed).uniform(size=(n, len(lower)))
    share = np.vstack([corners, np.full((1, len(lower)), 0.5), inside])
    return np.clip(lower + share * (upper - lower), lower, upper)


def _scales(function: ca.Function, inputs: Sequence[_Argument], z: Array, values: Array) -> Array:
    """What the self-test's errors are relative to, [N, outputs]: the largest output of all vectors, and what a change
    of the inputs, relative to their largest, makes of it, sum_j |d output / d input_j| max |input_j|, since no code
    is better than the digits of its numbers; 1 where both are 0.
    """
    v = ca.MX.sym("z", z.shape[1])
    y = ca.vertcat(*function.call(ca.vertsplit(v, [0, *np.cumsum([a.n for a in inputs]).tolist()])))
    size = ca.Function("size", [v], [ca.densify(ca.mtimes(ca.fabs(ca.jacobian(y, v)), np.abs(z).max(axis=0)))])
    sensitive = size.map(len(z))(z.T).full().T
    scale = np.fmax(np.abs(values).max(axis=0), np.where(np.isfinite(sensitive), sensitive, 0.0))
    return np.where(scale > 0, scale, 1.0)


def _split(z: Array, inputs: Sequence[_Argument]) -> list[Array]:
    return [part.T for part in np.split(z, np.cumsum([a.n for a in inputs])[:-1], axis=1)]


# The files


def _first_line(file: str, comment: tuple[str, str] = ("/* ", " */")) -> str:
    return f"{comment[0]}{file}, {MARK}{comment[1]}\n"


def _signature(name: str, inputs: Sequence[_Argument], outputs: Sequence[_Argument], real: str) -> str:
    arguments = [f"{real} {a.name}" if a.scalar else f"const {real} *{a.name}" for a in inputs]
    return f"int {name}({', '.join(arguments + [f'{real} *{a.name}' for a in outputs])})"


def _table(arguments: Sequence[_Argument]) -> list[str]:
    """A line for each entry: where it stands, what it is, its bounds."""
    lines = []
    for a in arguments:
        for i, label in enumerate(a.labels):
            place = a.name if a.scalar else f"{a.name}[{i}]"
            box = f"in [{a.box[0][i]:g}, {a.box[1][i]:g}]" if a.box else ""
            lines.append(f" *   {place:10s} {_comment(label) if label != place else '':20s} {box}".rstrip())
    return lines


def _comment(text: str) -> str:
    return text.replace("*/", "* /").replace("\\", "/").replace("\n", "\n * ")


def _header(name: str, inputs: Sequence[_Argument], outputs: Sequence[_Argument], real: str, note: str) -> str:
    guard = f"NOCL_{name.upper()}_H"
    described = [" *", *_table(inputs), " * gives", *_table(outputs), " *"]
    text = [f"/* {name}.h, {MARK}", *([f" * {_comment(note)}"] if note else []), *described,
            " * Returns 0. Needs nothing but <math.h>. It keeps no state between calls: threads and interrupts may",
            " * call it side by side; its workspace is on the stack. Inputs and outputs must not overlap.", " */"]
    sizes = [f"#define {name.upper()}_N_{a.name.upper()} {a.n}" for a in (*inputs, *outputs)]
    return "\n".join([*text, f"#ifndef {guard}", f"#define {guard}", "", *sizes, "",
                      "#ifdef __cplusplus", 'extern "C" {', "#endif",
                      f"{_signature(name, inputs, outputs, real)};",
                      "#ifdef __cplusplus", "}", "#endif", "", f"#endif /* {guard} */", ""])


def _source(name: str, inputs: Sequence[_Argument], outputs: Sequence[_Argument], real: str,
            sizes: Mapping[str, int]) -> str:
    inner = f"{name}_casadi"
    arguments = [f"  arg_[{i}] = {'&' if a.scalar else ''}{a.name};" for i, a in enumerate(inputs)]
    results = [f"  res_[{i}] = {a.name};" for i, a in enumerate(outputs)]
    size = {key: max(1, n) for key, n in sizes.items()}
    return "\n".join([
        _first_line(f"{name}.c") + f'#include "{name}.h"', "",
        *(SINGLE if real == "float" else []),
        "/* What CasADi generates has unused parameters, and functions that describe it: the compiler drops them. */",
        "#if defined(__GNUC__)", "#pragma GCC diagnostic push", '#pragma GCC diagnostic ignored "-Wunused-parameter"',
        '#pragma GCC diagnostic ignored "-Wunused-function"', "#endif", "#define CASADI_SYMBOL_EXPORT static",
        f'#include "{inner}.c"', "#if defined(__GNUC__)", "#pragma GCC diagnostic pop", "#endif", "",
        f"{_signature(name, inputs, outputs, real)} {{",
        f"  const {real} *arg_[{size['ARG']}];", f"  {real} *res_[{size['RES']}];", f"  int iw_[{size['IW']}];",
        f"  {real} w_[{size['W']}];", *arguments, *results, f"  return {inner}(arg_, res_, iw_, w_, 0);", "}", ""])


def _csv(name: str, inputs: Sequence[_Argument], outputs: Sequence[_Argument], z: Array, values: Array) -> str:
    titles = [a.name if a.n == 1 else f"{a.name}[{i}]" for a in (*inputs, *outputs) for i in range(a.n)]
    lines = [",".join(map(repr, row)) for row in np.hstack([z, values]).tolist()]
    return _first_line(f"{name}_vectors.csv", ("# ", "")) + "\n".join([",".join(titles), *lines, ""])


def _self_test(name: str, inputs: Sequence[_Argument], outputs: Sequence[_Argument], vectors: tuple[Array, ...],
               dtype: str) -> str:
    z, values, scales = vectors
    real, n_in, n_out = REAL[dtype], z.shape[1], values.shape[1]
    place = np.cumsum([0, *(a.n for a in inputs)])
    got = np.cumsum([0, *(a.n for a in outputs)])
    call = [f"z[{p}]" if a.scalar else f"z + {p}" for a, p in zip(inputs, place[:-1], strict=True)]
    call += [f"y + {p}" for p in got[:-1]]

    def rows(array: Array) -> str:
        return ",\n".join("  {" + ", ".join(map(repr, row)) + "}" for row in array.tolist())

    return "\n".join([
        _first_line(f"{name}_test.c") + f'#include "{name}.h"', "#include <math.h>", "#include <stdio.h>", "",
        f"static const double inputs[{len(z)}][{n_in}] = {{", rows(z), "};",
        f"static const double expected[{len(z)}][{n_out}] = {{", rows(values), "};",
        "/* what the error is relative to */", f"static const double scale[{len(z)}][{n_out}] = {{", rows(scales), "};",
        "",
        "int main(void) {", f"  const double limit = {TOLERANCE[dtype]!r};", "  double worst = 0;",
        "  int i, j, bad = 0, worst_at = 0;", f"  for (i = 0; i < {len(z)}; ++i) {{",
        f"    {real} z[{n_in}], y[{n_out}];", f"    for (j = 0; j < {n_in}; ++j) z[j] = ({real})inputs[i][j];",
        f"    if ({name}({', '.join(call)})) return 2;", f"    for (j = 0; j < {n_out}; ++j) {{",
        "      const double error = fabs((double)y[j] - expected[i][j]) / scale[i][j];",
        "      if (!(error <= limit)) bad = 1;  /* NaN too */",
        "      if (error > worst) { worst = error; worst_at = i; }",
        "    }", "  }",
        f'  printf("{name}: {len(z)} vectors, largest error %.3g at vector %d, limit %.3g: %s\\n", worst, worst_at,',
        '         limit, bad ? "FAILED" : "ok");', "  return bad;", "}", ""])


MAKEFILE = f"""# Makefile, {MARK}
CC ?= cc
CFLAGS ?= -O2 -std=c99 -Wall -Wextra -Werror -pedantic
TESTS := $(patsubst %.c,%,$(wildcard *_test.c))

check: $(TESTS)
\t@for test in $(TESTS); do ./$$test || exit 1; done

%_test: %_test.c %.c %.h %_casadi.c
\t$(CC) $(CFLAGS) -o $@ $*_test.c $*.c -lm

clean:
\trm -f $(TESTS)

.PHONY: check clean
"""


README = """<!-- README.md, {mark} -->
# C code of {names}

C99 without dependencies but `<math.h>`: no heap, no globals, re-entrant. Inputs and outputs are in physical units;
each header says which, with their bounds.

{list}

- `make check` compiles every self-test with `-Wall -Wextra -Werror -pedantic` and holds it against its test vectors
  (`*_vectors.csv`: inputs, and outputs as CasADi computes them in float64; corners of the box first).
- On a microcontroller: `arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -Os
  -ffunction-sections -fstack-usage -c NAME.c`, link with `-Wl,--gc-sections -lm`. A processor with single-precision
  floating point wants code that was written with dtype="float32", and `-fsingle-precision-constant`. The workspace
  is on the stack: the `.su` file tells how much.

From Python, in this folder:

```python
import nocl

{called} = nocl.exports.c_code.load(".", "{first}")    # compiled now; takes and gives [n], or rows [B, n]
```
"""


def _readme(folder: Path, header: str, name: str) -> str:
    """README.md of all functions that stand in the folder, and of this one."""
    headers = {path.stem: path.read_text(encoding="utf-8", errors="replace") for path in folder.glob("*.h")}
    lines = {}
    for stem, text in sorted((headers | {name: header}).items()):
        if MARK in text.split("\n", 1)[0] and (declared := re.search(r"^int \w+\(.*\);$", text, re.MULTILINE)):
            lines[stem] = f"- `{stem}.h`: `{declared[0]}`" + _parameters(text)
    first = next(iter(lines))
    return README.format(mark=MARK, names=", ".join(lines), list="\n".join(lines.values()), first=first,
                         called=first.rpartition("_")[2])


def _parameters(header: str) -> str:
    """What stands in an argument p, the parameters of a problem, as a header has it; "" where there is none."""
    labels = re.findall(r"^ \*   p(?:\[\d+\])? +(\S.*?) +in \[", header, re.MULTILINE)
    return f", with p = ({', '.join(labels)})" if labels else ""


def _put(folder: Path, files: Mapping[str, str]) -> Path:
    """Write all files beside the folder first, then move them in; a foreign file of the same name is left alone."""
    for file in files:
        path = folder / file
        if path.exists() and not (path.is_file() and MARK in path.read_text(errors="replace").split("\n", 1)[0]):
            raise ValueError(f"to_c: {path} exists and was not written by nocl; nothing was written: name another "
                             "folder")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_parts(folder.parent, folder.name)
        part = part_of(folder)
        part.mkdir()
    except OSError as error:
        raise ValueError(f"to_c: {folder} cannot be made ({error.strerror}); expected a folder that can be written: "
                         "name another folder") from error
    try:
        for file, text in files.items():
            (part / file).write_text(text, encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for file in files:
            os.replace(part / file, folder / file)
    except OSError as error:
        raise ValueError(f"to_c: {folder} cannot be written ({error.strerror}): make room or name another "
                         "folder") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return folder
