"""How often the controllers of `nocl reproduce goals --problems dubins-obstacle --out RUN` touch the obstacle.

    python benchmarks/collisions.py RUN [--n 1000]

Each is run from n fresh (x0, p), others than the table's, under CVODES, and looked at between the nodes, too. Results:
benchmarks/results/collisions.json.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import provenance

import nocl
from nocl.comparisons.reproduce.goals import PROBLEMS, TABLE, drawn

PROBLEM, SEED = "dubins-obstacle", 1


def measured(cnd: nocl.CND, n: int) -> dict[str, Any]:
    ocp = PROBLEMS[PROBLEM][1]()
    x0, p = drawn(ocp, n, SEED)
    run = nocl.simulate(ocp, cnd, x0, p=p)
    clear = run.clearance
    return {"n": len(x0), "collisions": int((clear < 0).sum()), "least clearance, m": float(clear.min()),
            "failed otherwise": int((~run.reached).sum())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--n", type=int, default=1000)
    args = parser.parse_args()
    rows = {}
    for way in TABLE.ways:
        cnd = nocl.CND.load(args.run / "cells" / f"goals-{PROBLEM}-{way}-0")
        rows[way] = measured(cnd, args.n) | {"commit": provenance.STARTED}
        print(way, rows[way], flush=True)
    provenance.write("collisions", rows)


if __name__ == "__main__":
    main()
