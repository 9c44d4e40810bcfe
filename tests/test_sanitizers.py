"""The kernels under AddressSanitizer and UBSan, in a process of their own; threads at once get the same bits."""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import nocl
from nocl.solvers.ddp.solver import DDP
from nocl.support.compiler import CACHE_VARIABLE

ROOT = Path(__file__).resolve().parents[1]
SANITIZERS = "-fsanitize=address,undefined -fno-sanitize-recover=all -g1"
SCRIPT = """
import sys
import numpy as np
import nocl
from nocl.solvers.ddp import kernel
from nocl.solvers.ddp.solver import DDP, DDPSettings
from test_ddp import random_model
cache, name, kind = sys.argv[1:]
ocp = nocl.load_ocp(name)
if kind == "looped":
    kernel.STRAIGHT = 0
d = DDP(ocp, intervals=7, dynamics=random_model(name) if kind == "learned" else None, threads=2, cache=cache,
        settings=DDPSettings(max_iterations=4))
W = d.kernel.width
for n in (1, W, 2 * W + 1):
    x0 = ocp.initial_states.sample(n, 0)
    x0[n // 2] *= 1e30  # one that blows up, far from where sines are polynomials
    s = d.solve(x0, curvature=n > 1)
    d.solve(x0, u=s.u, x=s.x, gain=s.gain)
print("clean")
"""
VALUE = """
import itertools, torch
from nocl.nets import MLP
from nocl.solvers.cnd.loss_kernel import ValueKernel
for sizes, nx, dtype in itertools.product(([3, 5, 4], [7, 17, 16, 3]), (1, 4), (torch.float32, torch.float64)):
    torch.manual_seed(0)
    mlp, n, nz = MLP(sizes, "tanh", skip=True).to(dtype), 37, sizes[0]
    kernel = ValueKernel(mlp, *(torch.rand(n, k, dtype=dtype) for k in (sizes[0], nz)), torch.arange(nz) % sizes[0],
                         torch.arange(nz) % nx, *(torch.rand(n, k, dtype=dtype) for k in (nx, 1, 1, 1)), 1e-3)
    for batch in (1, 2, 15, 16, 17, 63, 64, 65, 130):
        loss = kernel(torch.cat([torch.tensor([n - 1]), torch.randint(n, (batch - 1,))]))
        loss.backward()
        assert torch.isfinite(loss)
print("clean")
"""
BROKEN = """
import ctypes, sys
import numpy as np
from nocl.translate.kernels import Kernel
k = Kernel('#include "lanes.h"\\nvoid run(int64_t first, int64_t last, const int64_t *index, double *x) '
           '{ int64_t three[3] = {first}; x[0] = three[last + 5]; }', sys.argv[1])
k("run", np.arange(1), np.zeros(1))
print("clean")
"""


def libraries() -> str:
    found = [subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True).stdout.strip()
             for name in ("libasan.so", "libubsan.so")] if shutil.which("gcc") else ["missing"]
    if not all(Path(f).is_absolute() for f in found):
        pytest.skip("gcc's sanitizers are not installed")
    return ":".join(found)


def sanitized(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "CC": f"gcc {SANITIZERS}", "LD_PRELOAD": libraries(), "OMP_NUM_THREADS": "1",
                   "ASAN_OPTIONS": "detect_leaks=0:halt_on_error=1", "UBSAN_OPTIONS": "halt_on_error=1"}
    return subprocess.run([sys.executable, "-c", script, *arguments], env=environment, cwd=ROOT / "tests", timeout=300,
                          capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("acrobot", "exact"), ("dubins", "looped"), ("cartpole", "learned")])
def test_kernels_are_clean(name, kind, tmp_path):
    done = sanitized(SCRIPT, str(tmp_path), name, kind)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.strip() == "clean"


@pytest.mark.slow
def test_the_loss_of_v_is_clean(tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    done = sanitized(VALUE)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.strip() == "clean"


@pytest.mark.slow
def test_the_sanitizers_would_have_seen_it(tmp_path):
    done = sanitized(BROKEN, str(tmp_path))
    assert done.returncode != 0
    assert "AddressSanitizer" in done.stderr or "runtime error" in done.stderr


def test_threads_that_solve_different_batches_at_once_get_the_same_bits(tmp_path):
    ocp = nocl.load_ocp("acrobot")
    shared = DDP(ocp, intervals=30, threads=2, cache=tmp_path)
    batches = [ocp.initial_states.sample(5 + 3 * i, i) for i in range(6)]
    alone = [shared.solve(x0) for x0 in batches]
    with ThreadPoolExecutor(6) as pool:
        together = list(pool.map(shared.solve, batches))
    for a, b in zip(alone, together, strict=True):
        for field in ("cost", "x", "u", "gain", "V", "V_x", "message", "iterations"):
            assert np.array_equal(getattr(a, field), getattr(b, field)), field
