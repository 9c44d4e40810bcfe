"""Microseconds a call of a controller, its Jacobian and its Hessian, in every form that it is exported to.

    python benchmarks/export.py [PROBLEM ...] [--l4casadi]

One state a call: the median of repeated runs of many calls, one thread; the time of calling from Python is in all forms
but C, which is timed in a loop of its own, states changing. A batch of 10,000 states: microseconds a batch. Beside one
solve of NMPC, warm (started at the controller's rollout). The Jacobian is du/d(x, t), the Hessian that of u_0.
"2 x 64" is an untrained network with the maps of the pretrained controller, which itself is 3 x 64.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import provenance

from nocl.exports.c_code import to_c
from nocl.exports.casadi_forms import to_casadi
from nocl.exports.onnx_writer import Session, to_onnx
from nocl.nets import MLP, FeatureNet
from nocl.solvers import NMPC
from nocl.solvers.cnd import CND, pretrained
from nocl.support import compiler

BATCH = 10_000
TIMER = """
#define _POSIX_C_SOURCE 199309L
#include "{name}.h"
#include <stdio.h>
#include <time.h>
#define N {calls}
int main(void) {{
  static {real} x[64][{nx}], u[{n_out}];
  double best = 1e9, sum = 0;
  int i, j, k;
  for (i = 0; i < 64; ++i) for (j = 0; j < {nx}; ++j) x[i][j] = ({real})(0.01 * i + 0.1 * j);
  for (k = 0; k < 7; ++k) {{
    struct timespec a, b;
    clock_gettime(CLOCK_MONOTONIC, &a);
    for (i = 0; i < N; ++i) {{ {name}(x[i % 64], ({real})1, u); sum += (double)u[0]; }}
    clock_gettime(CLOCK_MONOTONIC, &b);
    {{
      double t = ((double)(b.tv_sec - a.tv_sec) * 1e6 + (double)(b.tv_nsec - a.tv_nsec) * 1e-3) / N;
      if (t < best) best = t;
    }}
  }}
  fprintf(stderr, "%g\\n", sum);
  printf("%.4f\\n", best);
  return 0;
}}
"""


def microseconds(call: Callable[[], Any], seconds: float = 0.2) -> float:
    """The best of 7 averages."""
    call()
    start = time.perf_counter()
    call()
    n = max(1, int(seconds / 7 / max(time.perf_counter() - start, 1e-7)))
    runs = []
    for _ in range(7):
        start = time.perf_counter()
        for _ in range(n):
            call()
        runs.append((time.perf_counter() - start) / n)
    return round(1e6 * min(runs), 3)


def derivatives(f: ca.Function) -> dict[str, ca.Function]:
    """The controller, its Jacobian and Hessian, as Functions of (x, t)."""
    x, t = ca.MX.sym("x", f.size1_in(0)), ca.MX.sym("t")
    z = ca.MX.sym("z", f.size1_in(0) + 1)
    u = f(z[:-1], z[-1])
    J, H = ca.densify(ca.jacobian(u, z)), ca.densify(ca.hessian(u[0], z)[0])
    parts = {"controller": u, "jacobian": ca.vec(J), "hessian": ca.vec(H)}
    made = {k: ca.Function(k, [z], [e]) for k, e in parts.items()}
    return {k: ca.Function(k, [x, t], [g(ca.vertcat(x, t))], ["x", "t"], ["y"]) for k, g in made.items()}


def in_casadi(functions: dict[str, ca.Function], nx: int, batch: bool = True) -> dict[str, float]:
    x, t = ca.DM([0.1] * nx), ca.DM(1.0)
    row = {name: microseconds(lambda g=g: g(x, t)) for name, g in functions.items()}
    if batch:
        many, X, T = functions["controller"].map(BATCH), ca.DM(np.full((nx, BATCH), 0.1)), ca.DM.ones(1, BATCH)
        row["batch"] = microseconds(lambda: many(X, T))
    return row


def in_torch(net: FeatureNet, nx: int) -> dict[str, float]:
    x, t = torch.full((1, nx), 0.1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    X, T = x.expand(BATCH, nx).clone(), t.expand(BATCH, 1).clone()
    z = torch.cat([x, t], 1)[0]

    def u(z: torch.Tensor) -> torch.Tensor:
        return net(z[None, :-1], z[None, -1:])[0]

    with torch.no_grad():
        row = {"controller": microseconds(lambda: net(x, t)), "batch": microseconds(lambda: net(X, T))}
    row["jacobian"] = microseconds(lambda: torch.autograd.functional.jacobian(u, z))
    row["hessian"] = microseconds(lambda: torch.autograd.functional.hessian(lambda z: u(z)[0], z))
    return row


def compiled(functions: dict[str, ca.Function], folder: Path) -> dict[str, ca.Function]:
    """The same, by CasADi's code generation, the C compiler's -O3 and ca.external."""
    generator = ca.CodeGenerator("all.c")
    for f in functions.values():
        generator.add(f)
    source = generator.generate(f"{folder}/")
    library = folder / "all.so"
    compiler.run(["-O3", "-march=native", "-shared", "-fPIC", source, "-o", library, "-lm"], source)
    return {name: ca.external(name, str(library)) for name in functions}


def in_c(functions: dict[str, ca.Function], folder: Path, dtype: str, flags: tuple[str, ...]) -> dict[str, float]:
    row = {}
    for name, f in functions.items():
        nx, n_out = f.size1_in(0), f.size1_out(0)
        to_c(f, folder, name, bounds={"x": (-0.5, 0.5), "t": (0.0, 2.0)}, dtype=dtype)
        calls = {"controller": 20000, "jacobian": 4000, "hessian": 500}[name]
        real = "double" if dtype == "float64" else "float"
        (folder / "timer.c").write_text(TIMER.format(name=name, calls=calls, nx=nx, n_out=n_out, real=real))
        compiler.run([*flags, folder / "timer.c", folder / f"{name}.c", "-o", folder / "timer", "-lm"], "the timer")
        row[name] = float(subprocess.run(["./timer"], cwd=folder, capture_output=True, text=True, check=True).stdout)
    return row


def in_onnx(net: FeatureNet, nx: int, folder: Path) -> dict[str, float]:
    session = Session(to_onnx(net, folder / "net.onnx")).session
    x, t = np.full((1, nx), 0.1, np.float32), np.ones((1, 1), np.float32)
    X, T = np.repeat(x, BATCH, 0), np.repeat(t, BATCH, 0)
    return {"controller": microseconds(lambda: session.run(None, {"x": x, "t": t})),
            "batch": microseconds(lambda: session.run(None, {"x": X, "t": T}))}


def two_layers(cnd: CND, width: int = 64) -> FeatureNet:
    """The controller's maps with an untrained network of 2 x `width`."""
    torch.manual_seed(0)
    inputs, nu = cnd.policy.inputs, cnd.ocp.system.nu
    return FeatureNet(inputs, [MLP([inputs.numel_out(0), width, width, nu])], cnd.policy.outputs).double().eval()


def forms(net: FeatureNet, nx: int, l4casadi: bool) -> dict[str, Any]:
    """Microseconds of every form."""
    native = derivatives(to_casadi(net, name="policy", in_names=["x", "t"], out_names=["u"]))
    rows: dict[str, Any] = {"torch eager": in_torch(net, nx), "native MX": in_casadi(native, nx)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows["native compiled"] = in_casadi(compiled(native, folder), nx)
        rows["ONNX Runtime float32"] = in_onnx(net, nx, folder)
        for dtype in ("float64", "float32"):
            rows[f"C {dtype} -O2"] = in_c(native, folder / dtype, dtype, ("-O2",))
            rows[f"C {dtype} -O3 -march=native -ffast-math"] = in_c(native, folder / f"{dtype}-fast", dtype,
                                                                    ("-O3", "-march=native", "-ffast-math"))
        if l4casadi:
            by = to_casadi(net, backend="l4casadi", name="policy", build_dir=folder / "l4")
            rows["L4CasADi float32"] = in_casadi(derivatives(by), nx, batch=False)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=["cartpole"])
    parser.add_argument("--l4casadi", action="store_true", help="also L4CasADi, which takes its time to build")
    options, rows = parser.parse_args(), []
    torch.set_num_threads(1)
    for problem in options.problems:
        cnd = pretrained(problem)
        nmpc, x0 = NMPC(cnd.ocp), cnd.ocp.initial_states.sample(20, 1)
        nmpc.solve(x0[:1], cnd)
        row: dict[str, Any] = {"problem": problem, "batch": BATCH}
        row["nmpc_warm_us"] = round(1e6 * float(np.median(nmpc.solve(x0, cnd, workers=1).seconds)), 1)
        for name, net in (("2 x 64", two_layers(cnd)), ("pretrained", cnd.policy)):
            row[name] = forms(net, cnd.ocp.system.nx, options.l4casadi)
            print(problem, name, row["nmpc_warm_us"], *row[name].items(), sep="\n  ", flush=True)
        rows.append(row)
        provenance.write("export", rows)


if __name__ == "__main__":
    main()
