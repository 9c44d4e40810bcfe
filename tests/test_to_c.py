"""The C code compiles without a warning, passes its own test, and is CasADi's function."""

from __future__ import annotations

import csv
import ctypes
import importlib.util
import re
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nocl.exports.c_code import to_c
from nocl.exports.casadi_forms import to_casadi
from nocl.nets import MLP, FeatureNet

BOUNDS = {"x": ([-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]), "t": (0.0, 4.0), "u": (-1.0, 1.0)}
LABELS = {"x": ["p [m]", "v [m/s]", "theta [rad]"], "t": ["time [s]"], "u": ["force [N]", "torque [N m]"]}
STRICT = ["gcc", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"]


def policy(activation: str = "tanh", width: int = 16) -> ca.Function:
    x, t, y = ca.SX.sym("x", 3), ca.SX.sym("t"), ca.SX.sym("y", 2)
    phi = ca.vertcat(x / 3, ca.sin(x[2]), ca.cos(x[2]), ca.log(1.02 - t / 4))
    inputs = ca.Function("inputs", [x, t], [phi], ["x", "t"], ["phi"])
    outputs = ca.Function("outputs", [x, t, y], [ca.fmin(ca.fmax(y, -1), 1)], ["x", "t", "y"], ["u"])
    torch.manual_seed(0)
    return to_casadi(FeatureNet(inputs, [MLP([6, width, width, 2], activation, True)], outputs).double(), name="policy")


def run(*command: str, cwd=None) -> str:
    result = subprocess.run([str(c) for c in command], capture_output=True, text=True, cwd=cwd, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_self_test_passes_without_a_warning(tmp_path, dtype):
    folder = to_c(policy(), tmp_path / "c", bounds=BOUNDS, labels=LABELS, dtype=dtype, note="a controller")
    assert sorted(p.name for p in folder.iterdir()) == ["Makefile", "README.md", "policy.c", "policy.h",
                                                        "policy_casadi.c", "policy_test.c", "policy_vectors.csv"]
    assert [p.name for p in tmp_path.iterdir()] == ["c"]
    run(*STRICT, "policy_test.c", "policy.c", "-o", "a.out", "-lm", cwd=folder)
    assert re.search(r"81 vectors, largest error .*: ok", run("./a.out", cwd=folder))
    assert "ok" in run("make", "check", cwd=folder)


def test_compiled_and_called_back_it_is_casadis_function(tmp_path):
    function = policy()
    folder = to_c(function, tmp_path, "control_law", bounds=BOUNDS)
    run(*STRICT, "-shared", "-fPIC", "control_law.c", "-o", "law.so", "-lm", cwd=folder)
    law = ctypes.CDLL(str(folder / "law.so")).control_law
    pointer = np.ctypeslib.ndpointer(np.float64)
    law.argtypes, law.restype = [pointer, ctypes.c_double, pointer], ctypes.c_int
    for row in np.random.default_rng(1).uniform(-3, 3, (50, 4)):
        u = np.zeros(2)
        assert law(row[:3].copy(), abs(row[3]), u) == 0
        np.testing.assert_allclose(u, function(row[:3], abs(row[3])).full().ravel(), rtol=1e-12, atol=1e-12)


def test_it_needs_no_heap_no_library_and_keeps_no_state(tmp_path):
    folder = to_c(policy(), tmp_path, bounds=BOUNDS)
    run(*STRICT, "-c", "policy.c", cwd=folder)
    symbols = [line.split()[-2:] for line in run("nm", "policy.o", cwd=folder).splitlines()]
    needed = {name for kind, name in symbols if kind == "U"}
    assert needed <= {"sin", "cos", "sincos", "tanh", "log", "fmin", "fmax", "memset", "memcpy"}
    assert not [name for kind, name in symbols if kind in "dDbBC"]  # writable data
    assert {name for kind, name in symbols if kind == "T" and not name.startswith("policy_casadi")} == {"policy"}


def test_the_header_documents_shapes_units_and_bounds(tmp_path):
    text = (to_c(policy(), tmp_path, bounds=BOUNDS, labels=LABELS, note="cart */ and pole") / "policy.h").read_text()
    for line in (r"x\[2\] +theta \[rad\] +in \[-3, 3\]", r"t +time \[s\] +in \[0, 4\]",
                 r"u\[1\] +torque \[N m\] +in \[-1, 1\]",
                 r"int policy\(const double \*x, double t, double \*u\);", "#define POLICY_N_X 3"):
        assert re.search(line, text), line
    with open(tmp_path / "policy_vectors.csv") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))
    assert rows[0] == ["x[0]", "x[1]", "x[2]", "t", "u[0]", "u[1]"]
    values = np.array(rows[1:], dtype=float)
    np.testing.assert_array_equal(values[:, :4].min(axis=0), [-1, -2, -3, 0])
    np.testing.assert_array_equal(values[:, :4].max(axis=0), [1, 2, 3, 4])
    expected = policy().map(len(values))(values[:, :3].T, values[:, 3:4].T).full().T
    np.testing.assert_allclose(values[:, 4:], expected, rtol=0, atol=1e-15)


def test_several_functions_share_a_folder_and_are_written_anew(tmp_path):
    function = policy()
    args = function.mx_in()
    gain = ca.Function("gain", args, [ca.vec(ca.jacobian(function(*args), args[0]))], ["x", "t"], ["K"])
    x = ca.SX.sym("x", 3)
    energy = ca.Function("energy", [x], [ca.sumsqr(x), x[0]], ["x"], ["E", "p"])  # an SX function with two outputs
    for f in (function, gain, energy, function):
        to_c(f, tmp_path, bounds={name: BOUNDS[name] for name in f.name_in()})
    lines = run("make", "check", cwd=tmp_path).splitlines()
    assert sum(line.endswith(": ok") for line in lines) == 3


def test_a_changed_weight_fails_the_self_test(tmp_path):
    folder = to_c(policy(), tmp_path, bounds=BOUNDS)
    code = (folder / "policy_casadi.c").read_text()
    changed = re.sub(r"(casadi_c\d+\[\d+\] = *\n? *\{)(-?[0-9.e+-]+)", r"\g<1>9.5", code, count=1)
    assert changed != code
    (folder / "policy_casadi.c").write_text(changed)
    run(*STRICT, "policy_test.c", "policy.c", "-o", "a.out", "-lm", cwd=folder)
    result = subprocess.run([folder / "a.out"], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "FAILED" in result.stdout


def test_foreign_files_are_left_alone(tmp_path):
    (tmp_path / "Makefile").write_text("all:\n")
    with pytest.raises(ValueError, match="Makefile exists and was not written by nocl"):
        to_c(policy(), tmp_path, bounds=BOUNDS)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("Makefile", "all:\n")]


def solver() -> ca.Function:
    x, z = ca.MX.sym("x", 3), ca.MX.sym("z")
    root = ca.rootfinder("root", "newton", {"x": z, "p": x, "g": z**3 + z - ca.sum1(x)})
    return ca.Function("solve", [x], [root(0, x)], ["x"], ["z"])


def shaped(expression: ca.SX, x: ca.SX) -> ca.Function:
    return ca.Function("shaped", [x], [expression], ["x"], ["y"])


X = ca.SX.sym("x", 3)
XBOX = {"x": (-1.0, 1.0)}


@pytest.mark.parametrize(("function", "options", "message"), [
    (policy(), {"bounds": {"x": BOUNDS["x"]}}, "bounds has no t"),
    (policy(), {"bounds": BOUNDS | {"y": (0, 1)}}, "y is no argument"),
    (policy(), {"bounds": BOUNDS | {"t": (1.0, 0.0)}}, "empty interval"),
    (policy(), {"bounds": BOUNDS | {"x": ([0, 0], [1, 1])}}, r"shape \(2,\), expected \(3,\)"),
    (shaped(ca.log(X), X), {"bounds": XBOX}, r"NaN or inf at \[-1"),
    (policy(), {"bounds": BOUNDS, "labels": {"x": ["p"]}}, "labels has 1 texts for x, expected 3"),
    (policy(), {"bounds": BOUNDS, "dtype": "float16"}, "expected 'float64' or 'float32'"),
    (policy(), {"bounds": BOUNDS, "name": "while"}, "no name for C"),
    (policy(), {"bounds": BOUNDS, "name": "1st"}, "no name for C"),
    (shaped(X @ X.T, X), {"bounds": XBOX}, "expected a dense column"),
    (shaped(ca.vertcat(X[0], ca.SX(1, 1), X[1]), X), {"bounds": XBOX}, "expected a dense column"),
    (solver(), {"bounds": XBOX}, "Code generation not supported for Newton"),
])
def test_refusals_say_why_and_write_nothing(tmp_path, function, options, message):
    with pytest.raises(ValueError, match=message):
        to_c(function, tmp_path / "c", **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(importlib.util.find_spec("l4casadi") is None, reason="l4casadi is not installed")
def test_l4casadi_functions_have_no_c(tmp_path):
    function = to_casadi(MLP([2, 3, 1]), backend="l4casadi")
    with pytest.raises(ValueError, match="export the network with backend='native'"):
        to_c(function, tmp_path / "c", bounds=XBOX)


ARM = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-Os", "-std=c99",
       "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffunction-sections", "-fdata-sections", "-fstack-usage"]


@pytest.mark.skipif(shutil.which(ARM[0]) is None, reason=f"{ARM[0]} is not installed")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_it_compiles_for_a_microcontroller(tmp_path, dtype):
    """On newlib: linked whole, without the heap, with its workspace on the stack."""
    folder = to_c(policy(), tmp_path, bounds=BOUNDS, dtype=dtype)
    real, single = ("double", []) if dtype == "float64" else ("float", ["-fsingle-precision-constant"])
    (folder / "main.c").write_text(f'#include "policy.h"\nvolatile {real} z[6];\nint main(void) {{\n  {real} x[3] = '
                                   "{z[0], z[1], z[2]}, u[2];\n  policy(x, z[3], u);\n  z[4] = u[0];\n  return 0;\n}\n")
    for source in ("policy", "main"):
        run(*ARM, *single, "-c", f"{source}.c", cwd=folder)
    stack = {line.split("\t")[0].split(":")[-1]: int(line.split("\t")[1]) for line in
             (folder / "policy.su").read_text().splitlines()}
    assert stack["policy"] < 2000
    run(*ARM[:5], "-Wl,--gc-sections", "--specs=nosys.specs", "main.o", "policy.o", "-lm", "-o", "firmware", cwd=folder)
    assert "malloc" not in run("arm-none-eabi-nm", "firmware", cwd=folder)
    undefined = {line.split()[-1] for line in run("arm-none-eabi-nm", "-u", "policy.o", cwd=folder).splitlines()}
    if dtype == "float32":  # nothing in double precision, which such a processor has to emulate
        assert not {name for name in undefined if name.startswith("__aeabi_d") or name.endswith("f2d")}


@settings(max_examples=6, deadline=None, derandomize=True)
@given(activation=st.sampled_from(["sine", "tanh", "relu", "silu"]), width=st.integers(1, 24))
def test_networks_of_any_shape_pass(tmp_path_factory, activation, width):
    folder = to_c(policy(activation, width), tmp_path_factory.mktemp("c"), bounds=BOUNDS)
    assert ": ok" in run("make", "check", cwd=folder)


def test_a_slope_that_is_infinite_leaves_a_self_test_that_runs(tmp_path):
    """sqrt at 0, a corner of the box: its slope says nothing of how large errors may be."""
    x = ca.SX.sym("x")
    folder = to_c(ca.Function("root", [x], [ca.sqrt(x)], ["x"], ["y"]), tmp_path / "c", "root", bounds={"x": (0, 1)})
    assert ": ok" in run("make", "check", cwd=folder)
