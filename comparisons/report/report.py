"""Report: results as sentences, as text in the terminal, and as files."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nocl.comparisons.report.findings import percentile
from nocl.comparisons.report.results import Results, count, notes, percent, text_table
from nocl.comparisons.report.verdict import verdict
from nocl.support.checks import Array

WIDTH = 118  # characters of a line in the terminal


@dataclass(frozen=True, eq=False, repr=False)
class Report(Results):
    """Any methods on the same B initial states of a problem, with a verdict, and to be saved."""

    def verdict(self) -> list[str]:
        """What the numbers say, in a few sentences."""
        return verdict(self)

    def save(self, folder: str | Path, animation: bool | None = None, draw: Any = None) -> Path:
        """Write report.html and its companions (files.py lists them) into the folder; return the path of report.html.

        A report that stands there is replaced, file by file and each atomically; other files stay.

        Parameters
        ----------
        animation : whether to make animation.gif, of the first two methods side by side; default: up to 200 states
        draw : how the system is drawn there: see nocl.comparisons.report.animate
        """
        from nocl.comparisons.report.files import write_report  # matplotlib is imported where pictures are drawn

        return write_report(self, Path(folder), animation, draw)

    def __str__(self) -> str:
        own, fixed = ", ".join(self.ocp.parameter_names), self.settings.get("parameters", "")
        each = f", each at its own {own}" if own else f", at {fixed}" if fixed else ""
        what = f"{self.ocp.system.name}, {count(len(self.x0), 'initial state')} {self.settings['initial states']}{each}"
        said = [textwrap.fill(sentence, WIDTH, subsequent_indent="  ") for sentence in self.verdict()]
        promised = [textwrap.fill(str(promise), WIDTH, subsequent_indent="  ") for promise in self.promises]
        noted = [textwrap.fill(note, WIDTH, subsequent_indent="  ") for note in notes(self)]
        return "\n".join([what, "", str(self.summary()), "", *noted, "", *self._disturbed(), *promised, *said])

    def _disturbed(self) -> list[str]:
        """Medians and 95th percentiles of what disturbances cost, as a table in plain text."""
        if self.robustness is None:
            return []
        scenarios = self.robustness.scenarios
        body = [[s.name, *(f"{_loss(one.lost, 50)} / {_loss(one.lost, 95)}" for one in s.losses)] for s in scenarios]
        head = ["cost lost %, median / p95", *(one.method for one in scenarios[0].losses)]
        return [text_table(head, body), ""]

    __repr__ = __str__


def _loss(lost: Array, q: float) -> str:
    known = lost[~np.isnan(lost)]
    return percent(percentile(known, q)) if known.size else "-"
