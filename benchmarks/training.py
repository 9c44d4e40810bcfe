"""Time to a given gap: nocl's default training against the published method and settings, in plain eager torch.

    python benchmarks/training.py [PROBLEM] [--gaps 5 1] [--seeds 0 1 2] [--measured 2] [--published 5000]

nocl's default: seconds from `nocl.train(ocp, ...)` to a controller, labels and compilation included, stopped at the
wanted median gap of its own held-out states; the gap that counts is then judged by CVODES, as continuous feedback, on
200 other initial states. The published method: `method="paper"` without anything that nocl adds (no race, no
clipping, no sines of angles, no compiled code), Euler steps of 0.02 s, 4,096 initial states an iteration, all four
losses. Only a few of its iterations are timed. Its total is the published number of iterations times the measured
seconds of one: how many it needs for a given gap, or what gap those reach, is not known here, and no claim is made
that it gets there at all.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from controllers import optimum

import nocl
from nocl.definition.ocp import OCP
from nocl.judge import simulate
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.paper import PaperSettings, train_paper

STEP, BATCH = 0.02, 4096  # the published code's: seconds of an Euler step, initial states an iteration


def judged(ocp: OCP, cnd: nocl.CND, n: int) -> dict[str, float]:
    """The gap on n hidden initial states, as continuous feedback under CVODES on the exact f."""
    x0 = ocp.initial_states.sample(n, 12345)
    gap = simulate(ocp, cnd, x0).cost / optimum(ocp, x0, cnd.policy).cost - 1
    return {"gap_median_%": round(100 * float(np.median(gap)), 4),
            "gap_p95_%": round(100 * float(np.quantile(gap, 0.95)), 4)}


def default(ocp: OCP, wanted: float, seed: int, n: int) -> dict[str, Any]:
    """nocl's default method, stopped at a median gap (as a share) and five times that at the 95th percentile."""
    settings = replace(TrainSettings(value=False), gap_median=wanted, gap_p95=5 * wanted, least_rounds=0)
    start = time.perf_counter()
    cnd = nocl.train(ocp, settings=settings, seed=seed, progress=False)
    seconds = time.perf_counter() - start
    return {"method": "default", "wanted_%": 100 * wanted, "seed": seed, "seconds": round(seconds, 1),
            "rounds": len(cnd.card["history"]), **judged(ocp, cnd, n)}


def published_settings(ocp: OCP, iterations: int) -> PaperSettings:
    """The published code's, with everything off that nocl adds to it."""
    return PaperSettings(intervals=round(ocp.horizon / STEP), step="euler", hold=True, fused=False, batch=BATCH,
                         iterations=iterations, race=1, clip=None, sin_cos=False)


def published(ocp: OCP, measured: int, total: int) -> dict[str, Any]:
    """Seconds an iteration of the published method, the first one left aside, and what that makes of all of them."""
    times: list[float] = []
    train_paper(ocp, None, published_settings(ocp, measured + 1), progress=False,
                callback=lambda k, terms: times.append(time.perf_counter()))
    each = np.diff(times)
    return {"method": "paper, published settings, eager torch", "measured_iterations": len(each),
            "seconds_an_iteration": [round(float(s), 2) for s in each], "threads": torch.get_num_threads(),
            "published_iterations": total, "seconds_extrapolated": round(float(np.mean(each)) * total),
            "gap": "not known: the run was not finished"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problem", nargs="?", default="cartpole")
    parser.add_argument("--gaps", nargs="+", type=float, default=[5.0, 1.0], help="in per cent")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--measured", type=int, default=2, help="iterations of the published method that are timed")
    parser.add_argument("--published", type=int, default=5000, help="iterations that its code makes")
    options = parser.parse_args()
    ocp = nocl.load_ocp(options.problem)
    rows = [published(ocp, options.measured, options.published)]
    print(rows[-1], flush=True)
    for gap in options.gaps:
        for seed in options.seeds:
            row = default(ocp, gap / 100, seed, options.n)
            row["times_faster"] = round(rows[0]["seconds_extrapolated"] / row["seconds"])
            rows.append(row)
            print(row, flush=True)
            provenance.write("training", rows, problem=options.problem, n=options.n)


if __name__ == "__main__":
    main()
