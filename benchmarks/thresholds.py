"""How near the tests are to their thresholds, on other processors and with other seeds.

    python benchmarks/thresholds.py [TEST ...] [--builds NAME ...] [--seeds 0 1 2] [-k ... -m ... as of pytest]

Each `a < b` that a test asserts has a ratio: a / b, at most 1, or the test fails. (For `a > b` it is b / a, for a
tolerance it is error / tolerance.) The tests run under every build with every seed. Kept are the lines that come near
and move, with the greatest ratio, its run, and the least: there a test hangs on rounding or luck.

A build says what compiled kernels, torch, BLAS and the C library do without. A seed k > 0 is mixed into all numbers
that seed numpy or torch, those of the tests and those of nocl.
"""

from __future__ import annotations

import argparse
import ast
import json
import operator
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import provenance

TESTS = provenance.ROOT / "tests"
SEED, FOLDER = "NOCL_THRESHOLDS_SEED", "NOCL_THRESHOLDS_FOLDER"  # how a run inside pytest learns of its seed and folder
NEAR = 0.3  # lines whose ratio is never greater are not kept

NO_AVX = {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE", "OPENBLAS_CORETYPE": "Nehalem",
          "ONEDNN_MAX_CPU_ISA": "SSE41", "NPY_DISABLE_CPU_FEATURES": "X86_V3",
          "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-FMA"}
BUILDS: dict[str, tuple[str, dict[str, str]]] = {  # flags that the C compiler gets last; environment
    "this machine": ("", {}),
    "SSE2": ("-march=x86-64", NO_AVX),  # 2 lanes
    "no FMA": ("-ffp-contract=off", {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA", "MKL_CBWR": "AVX"}),
    "8 lanes": ("-D__AVX512F__ -U__AVX2__", {"OPENBLAS_CORETYPE": "Sandybridge"})}  # sums in AVX-512's order, anywhere


def ratio(small: Any, large: Any) -> float:
    """How near small <= large is to failing: 0 far, 1 equal, more than 1 where it fails; the worst over arrays."""
    a, b = np.broadcast_arrays(numbers(small), numbers(large))
    with np.errstate(all="ignore"):
        r = np.where(b > 0, np.maximum(a, 0) / b, np.where(a < 0, b / a, np.inf))  # both below zero: the other way up
    return float(np.max(np.where(a == b, 1.0, r), initial=0.0))


def error(got: Any, wanted: Any, rtol: float, atol: float) -> float:
    """Error over tolerance, the worst over arrays."""
    a, b = np.broadcast_arrays(numbers(got), numbers(wanted))
    a, b = a[a != b], b[a != b]
    with np.errstate(invalid="ignore"):  # of numbers that are not finite
        return ratio(np.abs(a - b), atol + rtol * np.abs(b))


def off(got: Any, approx: Any) -> float:
    """`error` of got == pytest.approx(...)."""
    rel = 1e-6 if approx.rel is None and approx.abs is None else approx.rel or 0.0
    return error(got, approx.expected, rel, 1e-12 if approx.abs is None else approx.abs)


def numbers(value: Any) -> Any:
    array = np.asarray(value.detach() if isinstance(value, torch.Tensor) else value)
    return array if np.iscomplexobj(array) else array.astype(float)


RULES: dict[str, tuple[Callable[[Any, Any], Any], Callable[[Any, Any], float]]] = {
    "Lt": (operator.lt, ratio), "LtE": (operator.le, ratio), "Eq": (operator.eq, off),
    "Gt": (operator.gt, lambda a, b: ratio(b, a)), "GtE": (operator.ge, lambda a, b: ratio(b, a))}


# ---- inside pytest, as the plugin `thresholds` ----

class Watch(ast.NodeTransformer):
    """Turns the comparisons that tests assert, `a < b` and `(a < b).all()`, into calls of `watched`."""

    def visit_Assert(self, node: ast.Assert) -> ast.Assert:
        node.test = self.watch(node.test)
        return ast.fix_missing_locations(node)

    def watch(self, node: ast.expr) -> ast.expr:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "all":
            node.func.value = self.watch(node.func.value)
        if not isinstance(node, ast.Compare) or not {type(o).__name__ for o in node.ops} <= set(RULES):
            return node
        signs = " ".join(type(o).__name__ for o in node.ops)
        arguments = [ast.Constant(node.lineno), ast.Constant(signs), node.left, *node.comparators]
        return ast.copy_location(ast.Call(ast.Name("_watched", ast.Load()), arguments, []), node)


def watched(line: int, signs: str, *values: Any) -> Any:
    """What `a < b`, or `a < b < c`, gives; its ratios are noted."""
    result = None
    for sign, a, b in zip(signs.split(), values[:-1], values[1:], strict=True):
        compare, rule = RULES[sign]
        if rule is not off or hasattr(b, "rel"):
            note(line, rule, a, b)
        result = compare(a, b)
        if len(values) > 2 and not result:
            break
    return result


def note(line: int, rule: Callable[..., float], *args: Any) -> None:
    """Write down the ratio at a line of the test that runs, where numbers are compared."""
    try:
        value = rule(*args)
    except (TypeError, ValueError):
        return  # sets, strings, nested lists
    test = os.environ.get("PYTEST_CURRENT_TEST", "").split(" (")[0]
    with open(Path(os.environ[FOLDER], f"{os.getpid()}.jsonl"), "a") as file:
        print(json.dumps([test, line, value]), file=file)


class Loader(SourceFileLoader):
    """Loads a test module with its comparisons watched."""

    def source_to_code(self, data: Any, path: Any, **_: Any) -> Any:  # type: ignore[override]
        return compile(Watch().visit(ast.parse(data)), path, "exec")

    def path_stats(self, path: Any) -> Any:
        raise OSError("without bytecode: what was compiled for other runs is neither read nor replaced")

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["_watched"] = watched
        super().exec_module(module)


class Finder:
    @staticmethod
    def find_spec(name: str, *_: Any) -> ModuleSpec | None:
        file = TESTS / f"{name}.py"
        return spec_from_file_location(name, file, loader=Loader(name, str(file))) if file.exists() else None


def pytest_configure() -> None:
    sys.meta_path.insert(0, Finder)  # type: ignore[arg-type]
    np.testing.assert_allclose = noting(np.testing.assert_allclose, 1e-7)
    torch.testing.assert_close = noting(torch.testing.assert_close, 0.0)
    if int(os.environ[SEED]):
        reseed(int(os.environ[SEED]))


def noting(plain: Callable[..., None], rtol: float) -> Callable[..., None]:
    """assert_allclose or assert_close, with its ratio noted at the caller's line."""
    def function(got: Any, wanted: Any, *args: Any, **kwargs: Any) -> None:
        tolerances = dict(zip(("rtol", "atol"), args, strict=False)) | kwargs
        line = sys._getframe(1).f_lineno
        note(line, error, got, wanted, tolerances.get("rtol", rtol), tolerances.get("atol", 0.0))
        plain(got, wanted, *args, **kwargs)
    return function


def reseed(seed: int) -> None:
    """Every generator that is seeded by numbers gets this one beside them."""
    default_rng, manual_seed = np.random.default_rng, torch.manual_seed

    def other_rng(own: Any = None) -> np.random.Generator:
        given = isinstance(own, int | np.integer | list | tuple)
        return default_rng([*np.atleast_1d(np.array(own, object)), seed] if given else own)

    class Generator(torch.Generator):
        def manual_seed(self, own: int) -> torch.Generator:
            return super().manual_seed(own + 7919 * seed)

    np.random.default_rng, torch.Generator = other_rng, Generator  # type: ignore[assignment, misc]
    torch.manual_seed = lambda own: manual_seed(own + 7919 * seed)


def pytest_runtest_logreport(report: Any) -> None:
    if report.failed:
        with open(Path(os.environ[FOLDER], "failed"), "a") as file:
            print(report.nodeid, file=file)


# ---- outside pytest ----

Ratios = dict[tuple[str, int], float]  # the greatest, by test and line


def run(build: str, seed: int, arguments: list[str]) -> tuple[Ratios, list[str]]:
    """The ratios of one run, and the tests that failed."""
    flags, settings = BUILDS[build]
    with tempfile.TemporaryDirectory() as folder:
        compiler = Path(folder, "cc")
        no_such = 'case "$*" in *WITH_MVEC*) exit 1;; esac\n' if "512" in flags else ""  # vector mathematics of 8 lanes
        compiler.write_text(f'#!/bin/sh\n{no_such}exec {os.environ.get("CC", "gcc")} "$@" {flags}\n')
        compiler.chmod(0o755)
        environment = {**os.environ, **settings, "CC": str(compiler), SEED: str(seed), FOLDER: folder,
                       "PYTHONPATH": str(Path(__file__).parent)}
        subprocess.run([sys.executable, "-m", "pytest", "-p", "thresholds", "--assert=plain", "--tb=line", *arguments],
                       env=environment, cwd=provenance.ROOT, check=False)
        worst: Ratios = defaultdict(float)
        for file in Path(folder).glob("*.jsonl"):
            for test, line, value in map(json.loads, file.read_text().splitlines()):
                worst[test, line] = max(worst[test, line], value)
        failed = Path(folder, "failed")
        return worst, sorted(set(failed.read_text().splitlines())) if failed.exists() else []


def table(runs: dict[str, Ratios]) -> list[dict[str, Any]]:
    """The lines that come near in some run and move between runs, the nearest first."""
    rows = []
    for test, line in set().union(*runs.values()):
        own = {name: ratios[test, line] for name, ratios in runs.items() if (test, line) in ratios}
        nearest, least = max(own, key=lambda name: own[name]), min(own.values())
        if own[nearest] > max(NEAR, least):
            source = (provenance.ROOT / test.split("::")[0]).read_text().splitlines()
            rows.append({"test": test, "line": line, "asserts": source[line - 1].strip(),
                         "greatest": float(f"{own[nearest]:.4g}"), "in": nearest, "least": float(f"{least:.4g}")})
    return sorted(rows, key=lambda row: (-row["greatest"], row["test"], row["line"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--builds", nargs="+", choices=BUILDS, default=list(BUILDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options, arguments = parser.parse_known_args()
    runs, failed = {}, {}
    for name, build, seed in [(f"{b}, seed {s}", b, s) for b in options.builds for s in options.seeds]:
        runs[name], failed[name] = run(build, seed, arguments)
        provenance.write("thresholds", table(runs), failed=failed)
    for row in table(runs):
        print("{greatest:8.3f} {least:8.3f}  {test}:{line}  {asserts}  [{in}]".format(**row))


if __name__ == "__main__":
    main()
