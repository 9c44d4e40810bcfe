"""What the mission tests run stands in processes of its own, as a user's does."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any


def run(words: list[str], folder: Path) -> str:
    """A command in a folder; what it printed. AssertionError with its last lines where it fails."""
    made = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert made.returncode == 0, f"{' '.join(words)[:200]}: {(made.stdout + made.stderr)[-3000:]}"
    return made.stdout


def python(code: str, folder: Path) -> Any:
    """What a fresh Python prints last, read as JSON."""
    return json.loads(run([sys.executable, "-c", code], folder).splitlines()[-1])


def nocl(command: str, folder: Path) -> str:
    """`nocl COMMAND`, as the shell has it."""
    return run([sys.executable, "-m", "nocl", *command.split()], folder)


def table(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


