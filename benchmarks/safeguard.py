"""What a safeguard takes: CPU time of one step in C, its size, and what making one takes.

    python benchmarks/safeguard.py [--repeats 7]

A cart-pole, its controls held for 0.1 s, under networks with random weights (their values do not change the time), of
the sizes that laws have. A step rolls out two plans, the network's and the last one, to their ends, whatever comes of
them. Process time, the least of the repeats of 200 steps; compiled as the export says, -O2 -std=c99.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import nn

sys.path.insert(0, str(Path(__file__).parent))
import provenance

import nocl
from nocl.exports import c_code
from nocl.exports.casadi_forms import to_casadi
from nocl.solvers import Safeguard

DT, CALLS = 0.1, 200
CASES = ((40, (32, 32)), (40, (64, 64, 64)), (80, (64, 64, 64)))  # (steps, layers)


def problem() -> nocl.OCP:
    """A cart-pole on a track of 4 m that is to stand upright in its middle."""
    cart = nocl.load_ocp("cartpole").system
    p, v, theta, omega = ca.vertsplit(cart.x)
    running = 0.1 * p**2 + 0.05 * v**2 + 2 * (1 - ca.cos(theta)) + 0.05 * omega**2 + 0.05 * cart.u**2
    return nocl.OCP(cart, horizon=nocl.INFINITE, running=running, x_goal=[0] * 4, u_goal=[0],
                    initial_states=nocl.Gaussian([0, 0, np.pi, 0], [0.3] * 4), constraints={"track": (-2, p, 2)})


def network(sizes: tuple[int, ...]) -> ca.Function:
    """policy:(x, t) -> u with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        widths = [5, *sizes]
        layers = [part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.Tanh())]
        net = nn.Sequential(*layers, nn.Linear(widths[-1], 1)).double()
    return to_casadi(net, (4, 1), name="policy", in_names=["x", "t"], out_names=["u"])


def measured(ocp: nocl.OCP, steps: int, sizes: tuple[int, ...], repeats: int) -> dict[str, Any]:
    begin = time.process_time()
    safe = Safeguard(ocp, network(sizes), dt=DT, steps=steps)
    made = time.process_time() - begin
    with tempfile.TemporaryDirectory() as folder:
        compiled = c_code.load(safe.to_c(folder))
        source = Path(folder, "cartpole_safeguard_casadi.c").stat().st_size
        plan, x = np.zeros(safe.steps.size), np.array([0.1, 0.0, 3.0, 0.2])
        answer = [np.empty(n) for n in compiled.outputs.values()]
        given = [a.ctypes.data for a in (x, plan, *answer)]
        in_c = min(_time(lambda: compiled.function(*given)) for _ in range(repeats))
    in_casadi = min(_time(lambda: safe.step(x, plan), 10) for _ in range(3))
    return {"steps": steps, "layers": list(sizes), "ms_c": round(1e3 * in_c, 3), "ms_casadi": round(1e3 * in_casadi, 2),
            "source_kB": round(source / 1e3), "making_s": round(made, 2), "level": safe.terminal.level,
            "proven": safe.terminal.proven, "share": safe.terminal.share, "substeps": safe.steps.motion.substeps}


def _time(call: Any, calls: int = CALLS) -> float:
    begin = time.process_time()
    for _ in range(calls):
        call()
    return (time.process_time() - begin) / calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    options, ocp = parser.parse_args(), problem()
    rows = [measured(ocp, steps, sizes, options.repeats) for steps, sizes in CASES]
    for row in rows:
        print(row)
    provenance.write("safeguard", rows)


if __name__ == "__main__":
    main()
