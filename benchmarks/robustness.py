"""What breaks from outside: kills, forged files, logs, ONNX graphs, impossible problems. Target: 0 wrong everywhere.

    python benchmarks/robustness.py [kills forged logs onnx impossible] [--seed 0] [--again]

Each case is either right or wrong; benchmarks/results/robustness.json keeps for each kind how many were tried, how many
were wrong, and which. A kind that is there already is not tried again (--again: it is). The cases of a seed are always
the same, the moments of kills aside, which hang on the machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from robustness_cases import NOTHING

from nocl.support import store

Case = tuple[str, Callable[[], str]]  # its name, and what tries it: "" or what was wrong
PATH = provenance.RESULTS / "robustness.json"
SECTIONS = {"kills": "kills", "forged": "forged", "logs": "logs", "onnx": "graphs", "impossible": "impossible"}


def kinds(section: str, seed: int, folder: Path) -> Iterator[tuple[str, list[Case]]]:
    """The kinds of cases of a section."""
    cases = import_module(f"robustness_cases.{SECTIONS[section]}")
    yield from cases.kinds(np.random.default_rng((seed, zlib.crc32(section.encode()))), folder)


def tried(cases: list[Case]) -> dict[str, object]:
    """Every case of a kind."""
    wrong, left_out, begin = dict[str, str](), 0, time.perf_counter()
    for name, case in cases:
        try:
            why = case()
        except Exception as error:  # the case itself broke: as wrong as any
            why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        if why == NOTHING:
            left_out += 1
        elif why:
            wrong[name] = why[:300]
            print(f"  {name}: {why[:300]}", flush=True)
    return {"tried": len(cases) - left_out, "left out": left_out, "wrong": len(wrong), "which": wrong,
            "seconds": round(time.perf_counter() - begin, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", default=list(SECTIONS), help=f"some of {', '.join(SECTIONS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--again", action="store_true")
    options = parser.parse_args()
    rows = json.loads(PATH.read_text())["rows"] if PATH.exists() else {}
    for section in options.sections:
        with tempfile.TemporaryDirectory(prefix="nocl-robustness-") as folder:
            for kind, cases in kinds(section, options.seed, Path(folder)):
                found = rows.setdefault(section, {})
                if kind in found and not options.again:
                    continue
                found[kind] = tried(cases) | {"seed": options.seed, "made": provenance.made()["commit"]}
                print(f"{section}, {kind}: {found[kind]['wrong']} of {found[kind]['tried']} wrong", flush=True)
                store.write_text(PATH, json.dumps({"made": provenance.made(), "rows": rows}, indent=1) + "\n")
        total = rows.get(section, {}).values()
        print(f"{section}: {sum(r['wrong'] for r in total)} of {sum(r['tried'] for r in total)} wrong", flush=True)


if __name__ == "__main__":
    main()
