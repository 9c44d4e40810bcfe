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

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"


def write(name: str, rows: Any, **more: Any) -> Path:
    """Keep rows in benchmarks/results/NAME.json, with what made them."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"made": made(), **more, "rows": rows}, indent=1) + "\n")
    return path


def kept(name: str) -> dict[str, Any]:
    """The rows of benchmarks/results/NAME.json so far, by name, each with the commit that measured it."""
    path = RESULTS / f"{name}.json"
    if not path.exists():
        return {}
    found = json.loads(path.read_text())
    return {row: {"commit": found["made"]["commit"], **values} for row, values in found["rows"].items()}


def commit() -> str:
    """The commit of the working tree; "+" behind it where Python files differ from it."""
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], capture_output=True, text=True, check=False, cwd=ROOT).stdout

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "*.py", "*.h")
    return git("rev-parse", "--short", "HEAD").strip() + "+" * bool(changed)


STARTED = commit()  # read when a benchmark starts: others may commit while it runs


def made() -> dict[str, Any]:
    return {"command": command(), "commit": STARTED,
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
            "versions": {p: version(p) for p in ("nocl", "casadi", "torch", "numpy", "scipy")},
            "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"}


def command() -> str:
    """The command line, without the folders of this machine."""
    words = [Path(word).name if os.path.isabs(word) else word for word in sys.argv[1:]]
    return shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])
