"""What a benchmark's results are kept with: command, commit, versions, machine."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"


def write(name: str, rows: Any, **more: Any) -> Path:
    """Keep rows in benchmarks/results/NAME.json, with what made them."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"made": made(), **more, "rows": rows}, indent=1) + "\n")
    return path


def made() -> dict[str, Any]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False,
                            cwd=Path(__file__).parent).stdout.strip()
    return {"command": command(), "commit": commit,
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
            "versions": {p: version(p) for p in ("nocl", "casadi", "torch", "numpy", "scipy")},
            "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"}


def command() -> str:
    """The command line, without the folders of this machine."""
    words = [Path(word).name if os.path.isabs(word) else word for word in sys.argv[1:]]
    return shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])
