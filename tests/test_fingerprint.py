"""The one hash: equal for equal values in any process, another for any other value."""

import ast
import subprocess
import sys
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from nocl.support.fingerprint import fingerprint, json_text, sha256

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Point:
    x: float
    y: float = 0.0


X = ca.SX.sym("x", 2)
DIFFERENT = [b"1", "1", 1, 1.5, True, None, float("nan"), float("inf"), -float("inf"), "inf", 0.0, -0.0, [], {}, [[]],
             [1, 2], [[1], 2], [2, 1], {"a": 1}, {"a": 2}, {"b": 1}, ["a", 1], Path("1"), Point(1.0), Point(1.0, 1.0),
             np.zeros(2), np.zeros((2, 1)), np.zeros((1, 2)), np.zeros(2, np.float32), np.zeros(2, np.int64),
             np.arange(2000.0), np.r_[np.arange(1000.0), 0, np.arange(1001, 2000.0)], ca.Function("f", [X], [X]),
             ca.Function("g", [X], [X]), ca.Function("f", [X], [2 * X])]


def test_different_values_have_different_fingerprints():
    for a, b in combinations(range(len(DIFFERENT)), 2):
        assert fingerprint(DIFFERENT[a]) != fingerprint(DIFFERENT[b]), (DIFFERENT[a], DIFFERENT[b])
    assert fingerprint("ab", "c") != fingerprint("a", "bc") != fingerprint("abc")
    assert len(fingerprint()) == 32


def test_equal_values_have_equal_ones_however_they_are_kept():
    a = np.arange(12.0).reshape(3, 4)
    assert fingerprint(a) == fingerprint(np.asfortranarray(a)) == fingerprint(a.T.copy().T) == fingerprint(ca.DM(a))
    assert fingerprint({"a": 1, "b": [2]}) == fingerprint({"b": (2,), "a": 1})
    assert fingerprint(np.float64(2.5), np.int64(3)) == fingerprint(2.5, 3)
    assert json_text({"b": 1, "a": 2}) == json_text({"a": 2, "b": 1})


def test_another_process_says_the_same():
    code = ("import numpy as np, casadi as ca; from nocl.support.fingerprint import fingerprint; "
            "x = ca.SX.sym('x', 2); f = ca.Function('f', [x], [ca.sin(x)]); "
            "print(fingerprint({'a': [1.5, None], 'b': 'c'}, np.arange(3.0), f))")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    here = fingerprint({"b": "c", "a": [1.5, None]}, np.arange(3.0), ca.Function("f", [X], [ca.sin(X)]))
    assert out.stdout.strip() == here


@pytest.mark.parametrize("value", [object(), {1, 2}, lambda x: x, np.array([object()]), [np.array([None])], Point])
def test_what_has_no_lasting_text_is_refused(value):
    with pytest.raises(ValueError, match="has no fingerprint; expected"):
        fingerprint(value)


def test_sha256_is_of_the_bytes_as_they_come():
    assert sha256() == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    assert sha256(b"ab", "c") == sha256("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_only_one_file_hashes_and_only_one_runs_the_compiler():
    uses: dict[str, set[str]] = {}
    for folder in ("nocl", "systems", "solvers", "comparisons"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    for alias in node.names:
                        uses.setdefault(alias.name, set()).add(str(path.relative_to(ROOT)))
    assert uses["hashlib"] == {"nocl/support/fingerprint.py"}
    assert uses["subprocess"] == {"nocl/support/compiler.py", "comparisons/report/files.py"}  # there: git's commit
