"""Keeps what `nocl reproduce gym|quadrotor|dubins|approaches|goals --out RUN` made.

    python benchmarks/reproduce.py gym RUN         # -> results/reproduce_gym.json: way, problem, seed
    python benchmarks/reproduce.py quadrotor RUN   # -> results/reproduce_quadrotor.json
    python benchmarks/reproduce.py dubins RUN      # -> results/reproduce_dubins.json: the table's rows
    python benchmarks/reproduce.py approaches RUN  # -> results/reproduce_approaches.json: problem, way
    python benchmarks/reproduce.py goals RUN       # -> results/reproduce_goals.json: the table's rows
    python benchmarks/reproduce.py goals RUN --add # ... those that RUN does not have stay as they are

The tables themselves, over the seeds and beside the paper's numbers, are RUN/gym.md, RUN/quadrotor.md and so on.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import provenance

from nocl.comparisons.reproduce import approaches, dubins, goals
from nocl.comparisons.reproduce.control import GYM_TABLE, QUADROTOR_TABLE
from nocl.comparisons.reproduce.controllers import Cell

CONTROL = {table.name: table for table in (GYM_TABLE, QUADROTOR_TABLE)}
ENTRIES: dict[str, Any] = {"dubins": dubins.TABLE, "goals": goals.TABLE}  # their rows are kept, not their cells


def summary(cell: Cell) -> dict[str, Any]:
    """A cell without its initial states: mean, standard deviation and worst over those that did not fail."""
    row: dict[str, Any] = {"problem": cell.problem, "way": cell.way, "seed": cell.seed, "key": cell.key,
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


def plain(row: Any) -> dict[str, Any]:
    """A row of a table as data; None where there is no number."""
    return {name: value if not isinstance(value, float) else digits(value) if math.isfinite(value) else None
            for name, value in asdict(row).items()}


def added(table: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The kept rows of a table, those of the same problem and way replaced by `rows`."""
    kept = json.loads((provenance.RESULTS / f"reproduce_{table}.json").read_text())
    before = [{"commit": kept["made"]["commit"]} | row for row in kept["rows"]]
    return list({(row.get("problem"), row["way"]): row for row in [*before, *rows]}.values())


def digits(x: float) -> float:
    return float(f"{x:.5g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=[*CONTROL, *ENTRIES, "approaches"])
    parser.add_argument("run", type=Path)
    parser.add_argument("--add", action="store_true", help="keep the rows of problems and ways that RUN does not have")
    options = parser.parse_args()
    if table := ENTRIES.get(options.table):
        rows = [plain(entry) | {"commit": provenance.STARTED} for entry in table.entries(table.finished(options.run))]
        rows = added(options.table, rows) if options.add else rows
    elif options.table == "approaches":
        rows = [plain(cell) for cell in approaches.TABLE.finished(options.run)]
    else:
        rows = [summary(cell) for cell in CONTROL[options.table].finished(options.run)]
    print(provenance.write(f"reproduce_{options.table}", rows, cells=f"nocl reproduce {options.table}"))


if __name__ == "__main__":
    main()
