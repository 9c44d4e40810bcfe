"""Keeps what `nocl reproduce gym|quadrotor --out RUN` made: a row for each way, problem and seed.

    python benchmarks/reproduce.py gym RUN         # -> results/reproduce_gym.json
    python benchmarks/reproduce.py quadrotor RUN   # -> results/reproduce_quadrotor.json

The tables themselves, over the seeds and beside the paper's numbers, are RUN/gym.md and RUN/quadrotor.md.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import provenance

from nocl.comparisons.reproduce import control


def summary(cell: control.Cell) -> dict[str, Any]:
    """A cell without its initial states: mean, standard deviation and worst over those that did not fail."""
    row: dict[str, Any] = {"problem": cell.problem, "way": cell.way, "seed": cell.seed, **cell.key,
                           "failed": int((~np.isfinite(cell.error)).sum()), "made": cell.made}
    for what in ("error", "magnitude", "cost"):
        values = np.asarray(getattr(cell, what))
        values = values[np.isfinite(values)]
        if values.size:
            row[what] = {"mean": digits(values.mean()), "std": digits(values.std()), "max": digits(values.max())}
    for what in ("seconds", "cpu", "identify", "evaluations", "ms"):
        if math.isfinite(value := getattr(cell, what)):
            row[what] = digits(value)
    return row


def digits(x: float) -> float:
    return float(f"{x:.5g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=list(control.TABLES))
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    cells = control.finished(options.run, options.table)
    print(provenance.write(f"reproduce_{options.table}", [summary(cell) for cell in cells],
                           cells=f"nocl reproduce {options.table}"))


if __name__ == "__main__":
    main()
