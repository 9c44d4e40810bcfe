"""A report as files, in a folder.

report.html, one self-contained page; summary.md, summary.json; rows.csv, a row a method and state; tables/ as CSV and
LaTeX; figures/ as SVG and PNG; animation.gif.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from nocl.comparisons.report import figures as pictures
from nocl.comparisons.report.animate import animate, can_animate
from nocl.comparisons.report.drawings import Draw
from nocl.comparisons.report.explain import worst
from nocl.comparisons.report.page import page
from nocl.comparisons.report.results import Results, csv_text, flat_rows
from nocl.comparisons.report.style import encode
from nocl.comparisons.report.tables import NAMES as TABLES
from nocl.comparisons.report.tables import Table, tables
from nocl.comparisons.report.verdict import verdict
from nocl.support import store

PACKAGES = ("nocl", "casadi", "numpy", "scipy", "torch", "matplotlib")
ANIMATED = 200  # initial states above which a report has no animation unless asked


def write_report(report: Results, folder: Path, animation: bool | None = None, draw: Draw | None = None) -> Path:
    """Write all files into the folder, each atomically; everything is made before the first is written.

    animation: whether to make animation.gif; None: up to ANIMATED states, where there is a run to show.
    """
    _check_folder(folder)
    run, found = what_was_run(report), tables(report)
    drawn = {name: {form: encode(figure, form) for form in ("svg", "png")}
             for name, figure in pictures.draw(report).items()}
    files: dict[str, bytes] = {"rows.csv": csv_text(flat_rows(report)).encode()}
    files |= {f"figures/{name}.{form}": content for name, forms in drawn.items() for form, content in forms.items()}
    for name, table in found.items():
        files |= {f"tables/{name}.csv": table.csv().encode(), f"tables/{name}.tex": table.latex().encode()}
    if animation or (animation is None and len(report.x0) <= ANIMATED and can_animate(report)):
        files["animation.gif"] = animate(report, draw=draw)
    files["summary.md"] = markdown(report, run, found).encode()
    files["report.html"] = page(report, drawn, run).encode()
    for name, content in files.items():
        store.write_bytes(folder / name, content)
    store.write_json(folder / "summary.json", summary_data(report) | run)
    for name in set(_names()) - set(files):  # of the report that this one replaces
        (folder / name).unlink(missing_ok=True)
    return folder / "report.html"


def _names() -> list[str]:
    """Every file that a report may have."""
    return ["animation.gif", *(f"figures/{name}.{form}" for name in pictures.NAMES for form in ("svg", "png")),
            *(f"tables/{name}.{form}" for name in TABLES for form in ("csv", "tex"))]


def markdown(report: Results, run: dict[str, Any], found: dict[str, Table]) -> str:
    """summary.md: the verdict, the tables, the worst states, what was run."""
    parts = [f"# {report.ocp.system.name}: {', '.join(j.name for j in report.judged)}", *verdict(report)]
    for name, table in found.items():
        parts += [f"## {table.title}", table.markdown()]
        if name == "worst":
            parts += ["\n".join(f"- **State {e.state}.** {' '.join(filter(None, e.sentences))}" for e in worst(report))]
    if report.promises:
        parts += ["\n".join(f"- {promise}" for promise in report.promises)]
    pairs = [f"- {key}: {value}" for part in ("settings", "versions", "machine") for key, value in run[part].items()]
    parts += ["## What was run", "\n".join([*pairs, f"- commit: {run['commit']}", f"- made: {run['made']}",
                                            f"- seconds: {run['seconds']:g}"]), f"```\n{run['problem']}\n```"]
    return "\n\n".join(parts) + "\n"


def summary_data(report: Results) -> dict[str, Any]:
    """Verdict, summary and what a study found, without arrays over the states, as plain data."""
    return {"verdict": verdict(report), "summary": list(report.summary()),
            "audits": [audit.summary() for audit in report.audits],
            "robustness": [] if report.robustness is None else report.robustness.summary(),
            "promises": [vars(promise) | {"text": str(promise)} for promise in report.promises],
            "stability": [s.summary() for s in report.stability], "regions": [r.summary() for r in report.regions]}


def _check_folder(folder: Path) -> None:
    for path in (folder, folder / "figures", *folder.parents):
        if path.exists() and not path.is_dir():
            raise ValueError(f"{path} is a file; expected a folder to write the report to: name another one")


def what_was_run(report: Results) -> dict[str, Any]:
    """Versions, machine, settings and equations: what it takes to run it again."""
    return {"settings": dict(report.settings), "seconds": round(report.seconds, 3),
            "commit": _commit(), "made": datetime.now(UTC).isoformat(timespec="seconds"), "versions": _versions(),
            "machine": {"python": platform.python_version(), "system": platform.platform(), "cores": os.cpu_count()},
            "problem": repr(report.ocp)}


def _versions() -> dict[str, str]:
    """The versions of the packages that this process has loaded."""
    return {name: metadata.version(name) for name in PACKAGES if name in sys.modules}


def _commit() -> str:
    """The commit of nocl's checkout, "+" where files differ from it; "" where it is installed without one."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return ""
    try:
        command = ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
        commit = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):  # no git here: the version stands beside it
        return ""
    return commit.stdout.strip()
