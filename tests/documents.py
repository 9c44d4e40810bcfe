"""The pages of the documentation, and their blocks of code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

import nocl

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", *(p for p in ROOT.glob("*.md") if p.name != "README.md"),
                *(ROOT / "docs").glob("*.md")])
FENCE = re.compile(r"^(<!-- slow -->\n)?```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    language: str  # "" where the fence has none
    code: str
    slow: bool  # <!-- slow --> stands above it


def blocks(page: Path) -> list[Block]:
    return [Block(language, code, bool(slow)) for slow, language, code in FENCE.findall(page.read_text())]


def python_of(page: Path, slow: bool) -> str:
    """The code of a page's Python blocks, one after another; without the slow ones, unless asked for."""
    return "\n".join(b.code for b in blocks(page) if b.language == "python" and (slow or not b.slow))


def pages_with_python(slow: bool) -> list[Path]:
    """The pages that have some; with `slow` those that have slow ones."""
    return [p for p in PAGES if (any(b.slow for b in blocks(p)) if slow else python_of(p, slow=False))]


def write_log(folder: Path) -> None:
    """log.csv, which the pages read: the pendulum under held random torques, a little noisy."""
    ocp, rng = nocl.load_ocp("pendulum"), np.random.default_rng(0)
    x0, u = rng.uniform([-3, -2], [3, 2], (8, 2)), np.repeat(rng.uniform(-5, 5, (8, 15, 1)), 10, axis=1)
    run = nocl.simulate(ocp, u, x0)
    x = run.x + 1e-3 * rng.standard_normal(run.x.shape)
    lines = ["run,t,theta,omega,tau"]
    lines += [f"{i},{t},{x[i, k, 0]},{x[i, k, 1]},{run.u[i, k, 0]}" for i in range(8) for k, t in enumerate(run.t)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
