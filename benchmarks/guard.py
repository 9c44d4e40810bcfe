"""What it costs to make NMPC's solves in a copy of the process that can be ended: batches with it and without, in turn.

    python benchmarks/guard.py [--problems cartpole quadrotor --states 8 --rounds 5]

Results go to benchmarks/results/guard.json: medians over the rounds of the ratio of times with and without.
"""

from __future__ import annotations

import argparse
import json
import time
from unittest import mock

import numpy as np
import provenance

import nocl
from nocl.solvers import NMPC
from nocl.solvers.nmpc.transcription import Answer, Transcription
from nocl.support import store
from nocl.support.checks import Array

PATH = provenance.RESULTS / "guard.json"


def here(self: Transcription, x0: Array, t: Array, x: Array, u: Array, time_limit: float | None = None,
         p: Array | None = None) -> Answer:
    """A solve in this process."""
    return self._solve(x0, t, x, u, np.zeros(0) if p is None else p)


def seconds(nmpc: NMPC, x0: Array) -> float:
    begin = time.perf_counter()
    assert nmpc.solve(x0, workers=1, progress=False).success.all()
    return time.perf_counter() - begin


def compared(problem: str, states: int, rounds: int) -> dict[str, object]:
    ocp = nocl.load_ocp(problem)
    nmpc, x0 = NMPC(ocp, starts=2, passes=0), ocp.initial_states.sample(states, 0)
    ratios, alone = [], []
    for _ in range(rounds + 1):
        guarded = seconds(nmpc, x0)
        with mock.patch.object(Transcription, "solve", here):
            alone.append(seconds(nmpc, x0))
        ratios.append(guarded / alone[-1])
    return {"states": states, "starts": 2, "ratios": ratios[1:], "ratio": float(np.median(ratios[1:])),
            "milliseconds a solve without": 1000 * float(np.median(alone[1:])) / (2 * states)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=["cartpole", "quadrotor"])
    parser.add_argument("--states", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    rows = {name: compared(name, args.states, args.rounds) for name in args.problems}
    store.write_text(PATH, json.dumps({"made": provenance.made(), "rows": rows}, indent=1) + "\n")
    for name, row in rows.items():
        print(f"{name}: {row['ratio']:.3f} times, {row['milliseconds a solve without']:.1f} ms a solve without")


if __name__ == "__main__":
    main()
