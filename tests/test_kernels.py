"""Generated kernels: each operation equals CasADi's, lanes do not see each other, the cache survives two builders."""

import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from nocl.support import compiler
from nocl.translate import kernels
from nocl.translate.instructions import instructions
from nocl.translate.kernels import Kernel, emit

LOOP = """
void run(int64_t first, int64_t last, const int64_t *index, const double *x_, double *y_)
{
    for (int64_t b = first; b < last; ++b) {
        const int64_t *at = index + b * WIDTH;
        lane x[N], y[M];
        for (int i = 0; i < N; ++i) x[i] = gather(x_, at, N, i);
        f(x, y);
        for (int i = 0; i < M; ++i) scatter(y_, at, M, i, y[i]);
    }
}
"""
X = ca.SX.sym("x", 2)
A, B = ca.vertsplit(X)
UNARY = {"OP_LOG": (1e-3, 50), "OP_SQRT": (0, 50), "OP_ASIN": (-1, 1), "OP_ACOS": (-1, 1), "OP_ACOSH": (1, 50),
         "OP_ATANH": (-0.99, 0.99), "OP_LOG1P": (-0.9, 50), "OP_INV": (0.1, 5), "OP_TAN": (-1.5, 1.5)}  # else all of R
BINARY = {"OP_POW": (0.01, 5), "OP_CONSTPOW": (0.01, 5), "OP_DIV": (0.1, 5), "OP_FMOD": (0.5, 9),
          "OP_REMAINDER": (0.5, 9)}


def source(outputs: list[ca.SX], inputs: ca.SX = X) -> str:
    y = ca.vertcat(*outputs)
    return (f'#include "lanes.h"\n#define N {inputs.numel()}\n#define M {y.numel()}\n'
            + emit("f", [inputs], [ca.densify(y)]) + LOOP)


def run(kernel: Kernel, x: np.ndarray, n_out: int, threads: int = 1) -> np.ndarray:
    y = np.full((len(x), n_out), np.nan)
    kernel("run", np.arange(len(x)), np.ascontiguousarray(x), y, threads=threads)
    return y


def test_every_operation_equals_casadis_on_its_domain(tmp_path):
    # each operation gets two inputs of its own, so that each is tried on its own domain
    ops = [(op, 1) for op in kernels.C_UNARY] + [(op, 2) for op in kernels.C_BINARY]
    z = ca.SX.sym("z", 2, len(ops))
    rng = np.random.default_rng(0)
    outputs, columns = [], []
    for i, (op, arity) in enumerate(ops):
        a, b = z[0, i], z[1, i]
        code = getattr(ca, op)
        outputs.append(ca.SX.unary(code, a) if arity == 1 else ca.SX.binary(code, a, 2.5 if "CONSTPOW" in op else b))
        low, high = (UNARY if arity == 1 else BINARY).get(op, (-6, 6))
        column = rng.uniform(low, high, (403, 2))
        column[::5, 1] = column[::5, 0]  # ties, for comparisons
        columns.append(column)
    f = ca.Function("f", [ca.vec(z)], [ca.vertcat(*outputs)])
    known = {step.op for step in instructions(f)}
    assert set(kernels.C_UNARY) | set(kernels.C_BINARY) <= known | {"OP_ASSIGN"}
    x = np.concatenate(columns, axis=1)
    got = run(Kernel(source(outputs, ca.vec(z)), tmp_path), x, len(ops))
    expected = f(x.T).full().T
    assert np.isfinite(expected).all()
    for i, (op, _) in enumerate(ops):
        np.testing.assert_allclose(got[:, i], expected[:, i], rtol=1e-12, atol=1e-300, err_msg=op)


def test_special_values_as_casadi_has_them(tmp_path):
    outputs = [ca.SX(np.inf) + 0 * A, ca.fmin(A, -np.inf), ca.fmax(A, B), ca.sign(A), ca.if_else(A > B, A, ca.log(B)),
               A**2, A**3, ca.fabs(A), ca.exp(A), ca.sqrt(A), ca.logic_not(A), 1 / B]
    x = np.array([[-np.inf, 1.0], [np.inf, 2.0], [np.nan, 3.0], [0.0, -0.0], [-2.0, 0.0], [800.0, -800.0],
                  [1e-320, 2.0], [-1.0, np.nan]])
    with np.errstate(all="ignore"):
        expected = ca.Function("f", [X], [ca.vertcat(*outputs)])(x.T).full().T
    np.testing.assert_allclose(run(Kernel(source(outputs), tmp_path), x, len(outputs)), expected, rtol=1e-12)


def test_sparse_and_constant_outputs(tmp_path):
    got = run(Kernel(source([ca.SX(1, 1), ca.SX(0.1), A]), tmp_path), np.array([[3.0, 4.0]]), 3)
    assert got.tolist() == [[0.0, 0.1, 3.0]]


def test_operation_without_a_twin_is_refused_by_name():
    with pytest.raises(ValueError, match="my_function: CasADi's OP_ERFINV has no C kernel"):
        emit("my_function", [X], [ca.erfinv(A)])


def test_every_lane_and_thread_gives_the_same_bits(tmp_path):
    kernel = Kernel(source([ca.sin(A) * ca.exp(B), A**B, ca.tanh(A / B)]), tmp_path)
    W = kernel.width
    x = np.random.default_rng(1).uniform(0.1, 3, (3 * W + 2, 2))
    alone = np.concatenate([run(kernel, row[None], 3) for row in x])
    for n in (1, W - 1, W, W + 1, 3 * W + 2):
        for threads in (1, 2, 5):
            assert np.array_equal(run(kernel, x[:n], 3, threads), alone[:n])


def test_a_nan_in_one_lane_stays_there(tmp_path):
    kernel = Kernel(source([ca.sin(A) / B, ca.if_else(A > 0, A, B), A**B]), tmp_path)
    x = np.random.default_rng(1).uniform(0.1, 3, (2 * kernel.width, 2))
    clean = run(kernel, x, 3)
    x[1], x[kernel.width] = np.nan, np.inf
    dirty = run(kernel, x, 3)
    others = [i for i in range(len(x)) if i not in (1, kernel.width)]
    assert np.array_equal(dirty[others], clean[others])


def test_only_the_problems_asked_for_are_written(tmp_path):
    kernel, x = Kernel(source([A + B]), tmp_path), np.arange(40.0).reshape(20, 2)
    y = np.full((20, 1), -1.0)
    kernel("run", np.array([3, 17, 5]), x, y)
    assert (np.flatnonzero(y[:, 0] != -1) == [3, 5, 17]).all()
    kernel("run", np.array([], dtype=np.int64), x, y)
    assert (y[[3, 17, 5], 0] == x[[3, 17, 5]].sum(axis=1)).all()


def test_arrays_that_c_cannot_read_are_refused(tmp_path):
    kernel, y = Kernel(source([A]), tmp_path), np.zeros((4, 1))
    for x in (np.zeros((4, 2), dtype=np.float16), np.zeros((8, 2))[::2], np.zeros((2, 4)).T):
        with pytest.raises(ValueError, match="a kernel got an array"):
            kernel("run", np.arange(4), x, y)


def test_one_source_is_one_file_in_the_named_folder(tmp_path, monkeypatch):
    named, other = tmp_path / "named" / "deep", tmp_path / "other"
    Kernel(source([A]), named)
    written = {p: p.stat().st_mtime_ns for p in named.iterdir()}
    Kernel(source([A]), named)
    assert {p: p.stat().st_mtime_ns for p in named.iterdir()} == written
    assert [p.suffix for p in written] == [".so"]
    Kernel(source([A + 1]), named)
    assert len(list(named.iterdir())) == 2
    monkeypatch.setenv(compiler.CACHE_VARIABLE, str(other))
    Kernel(source([A]))
    assert len(list(other.iterdir())) == 1


def test_two_processes_may_build_at_once(tmp_path):
    (tmp_path / "source.c").write_text(source([ca.sin(A) + B]))
    script = ("import sys, numpy as np\nfrom pathlib import Path\nfrom nocl.translate.kernels import Kernel\n"
              "k = Kernel(Path(sys.argv[1]).read_text(), sys.argv[2])\n"
              "y = np.zeros((1, 1)); k('run', np.arange(1), np.array([[0.0, 7.0]]), y); print(y[0, 0])")
    command = [sys.executable, "-c", script, str(tmp_path / "source.c"), str(tmp_path / "cache")]
    builders = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert [b.communicate(timeout=60)[0].strip() for b in builders] == ["7.0"] * 3
    files = list((tmp_path / "cache").iterdir())
    assert [f.suffix for f in files] == [".so"]


def test_without_a_cache_nothing_stays(tmp_path):
    script = ("from tests.test_kernels import *\nfrom nocl.support.compiler import own_folder\n"
              "Kernel(source([A])); print(own_folder())")
    root = Path(__file__).resolve().parents[1]
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=root)
    assert not Path(out.stdout.strip()).exists()


@pytest.mark.parametrize(("environment", "text"), [({"PATH": ""}, "gcc, cc"), ({"CC": "no-such-cc"}, "CC=no-such-cc")])
def test_missing_compiler_is_told(tmp_path, monkeypatch, environment, text):
    monkeypatch.delenv("CC", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=f"no C compiler found .looked for {text}.*install gcc"):
        Kernel(source([A]), tmp_path)


def test_compiler_with_arguments_and_its_failure(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "gcc -DNOTHING=1")
    Kernel(source([A]), tmp_path)
    with pytest.raises(RuntimeError, match=r"could not compile a kernel[\s\S]*error"):
        Kernel("this is not C", tmp_path)
    assert len(list(tmp_path.iterdir())) == 1


def test_sines_are_accurate_wherever_they_are_asked():
    x = np.r_[np.random.default_rng(0).uniform(-1, 1, 4000) * np.geomspace(1e-3, 7e5, 4000),
              np.arange(-600, 601) * np.pi / 2, 1e6, -3e9, 1e300, 1e-310, 0.0]
    got = run(Kernel(source([ca.sin(A), ca.cos(A)])), np.stack([x, x], axis=1), 2)
    np.testing.assert_allclose(got, np.stack([np.sin(x), np.cos(x)], axis=1), rtol=1e-15, atol=0)
    bad = np.array([[np.nan] * 2, [np.inf] * 2, [1.0] * 2, [-np.inf] * 2])
    both = np.isnan(run(Kernel(source([ca.sin(A), ca.cos(A)])), bad, 2))
    assert both.all(axis=1).tolist() == [True, True, False, True]


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_looped_chain_rule_equals_the_straight_one(name, tmp_path, monkeypatch):
    import nocl
    from nocl.solvers.ddp import kernel
    from nocl.solvers.ddp.solver import DDP

    ocp = nocl.load_ocp(name)
    x0, answers = ocp.initial_states.sample(3, 0), []
    for limit in (10**9, 0):
        monkeypatch.setattr(kernel, "STRAIGHT", limit)
        assert ("chain.h" in kernel.ddp_source(ocp)) == (limit == 0)
        answers.append(DDP(ocp, intervals=20, threads=1, cache=tmp_path).solve(x0, curvature=True))
    for field, tolerance in (("cost", 1e-9), ("u", 1e-6), ("gain", 1e-6), ("V_x", 1e-6), ("V_xx", 1e-6)):
        a, b = (getattr(s, field) for s in answers)  # a descent ends near the minimum, where cost is flat
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max(), err_msg=field)
