"""How pictures look, and how they become bytes; matplotlib's object interface: no global state, no window."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")  # Okabe, Ito: safe for all eyes
LIMIT = "#b2182b"  # of constraints
DASHES = ("-", "--", "-.", ":")
STYLE: dict[Any, Any] = {"svg.fonttype": "path", "svg.hashsalt": "nocl", "font.size": 9, "axes.spines.top": False,
         "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.25, "legend.frameon": False}
SMALL_GAP = 1e-2  # per cent: the gap axis is linear below it


def encode(figure: Figure, form: str) -> bytes:
    """A figure as SVG or PNG, the same bytes for the same report."""
    file = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(file, format=form, dpi=150, metadata={"Date": None} if form == "svg" else {"Software": None})
    return file.getvalue()


def look(m: int) -> dict[str, Any]:
    """Colour and dash of the m-th method: they tell methods apart without colour, too."""
    return {"color": COLOURS[m % len(COLOURS)], "linestyle": DASHES[m % len(DASHES)]}


def plain(text: str) -> str:
    """Text as matplotlib draws it unchanged: a pair of $ would start a formula."""
    return text.replace("$", r"\$")
