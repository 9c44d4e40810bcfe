"""A table of the paper, made again: rows are ways, a cell is one way on one problem with one seed.

A cell is a file of its own once it is finished, so that an interrupted run goes on from there; one that was made with
other settings is made anew. What a folder holds is written as Markdown, LaTeX, CSV and figures, the paper's numbers
beside ours. A table itself says what its cells are made of, and how a row reads.
"""

from __future__ import annotations

import csv
import io
import math
import string
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from nocl.solvers import registry
from nocl.support import store
from nocl.support.progress import bar as progress_bar
from nocl.support.progress import say

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CELLS = "cells"  # the folder of finished cells


class Place(NamedTuple):
    """Where a cell stands in its table."""

    problem: str
    way: str
    seed: int = 0


class Cell(Protocol):
    """What a way gave; a dataclass, whose fields are the file's."""

    @property
    def place(self) -> Place: ...
    @property
    def key(self) -> dict[str, Any]: ...  # what it was made with


class Way(Protocol):
    """A row of the table."""

    @property
    def title(self) -> str: ...


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to run of a table: its problems and ways (default: all), with seeds 0, ..., seeds - 1."""

    problems: tuple[str, ...] = ()
    ways: tuple[str, ...] = ()
    seeds: int = 1
    quick: bool = False  # small budgets


P = TypeVar("P", bound=Plan)
C = TypeVar("C", bound=Cell)
E = TypeVar("E")
Column = tuple[str, Callable[[E], str]]  # its head, and a row's text


class PaperTable(ABC, Generic[P, C, E]):
    """A table of the paper. P is its plan, C its cells, E its rows."""

    name: str  # at the command line, and of its files
    title: str  # on the bar
    known: str  # what errors call it
    file: str  # of a cell, in the fields of Place
    problems: tuple[str, ...]
    ways: Mapping[str, Way]
    plan_type: type[P]
    cell_type: type[C]
    quick: ClassVar[Mapping[str, Any]] = {}  # budgets of a plan that is quick
    least: ClassVar[Mapping[str, int]] = {"seeds": 1}  # of each whole number in a plan
    numbers: ClassVar[tuple[str, ...]] = ()  # fields of a cell, where infinity and NaN are text in the file
    methods: ClassVar[Mapping[str, str]] = {}  # way -> its name in nocl.solvers.registry, where that needs an extra

    # what a table says of itself
    @abstractmethod
    def key(self, plan: P, place: Place) -> dict[str, Any]:
        """What a cell is made with, as JSON has it."""

    @abstractmethod
    def make(self, plan: P, place: Place, folder: Path) -> C:
        """One cell, from nothing."""

    @abstractmethod
    def entries(self, cells: Sequence[C]) -> list[E]:
        """The rows, in the table's order."""

    @abstractmethod
    def columns(self) -> Sequence[Column[E]]:
        """Of the Markdown table."""

    @abstractmethod
    def row(self, entry: E) -> dict[str, Any]:
        """All numbers of a row by name, for CSV."""

    @abstractmethod
    def latex(self, entries: Sequence[E]) -> str:
        """In the form of the paper."""

    @abstractmethod
    def figures(self, entries: Sequence[E], cells: Sequence[C]) -> dict[str, Figure]:
        """By what follows the table's name in the file's."""

    def can_run(self) -> list[str]:
        """The ways that a plan may name."""
        return list(self.ways)

    def from_data(self, data: dict[str, Any]) -> C:
        """The cell of a file's data."""
        numbers = {name: np.asarray(data[name], dtype=float).tolist() for name in self.numbers}
        return self.cell_type(**{**data, **numbers})

    # what all tables do
    def plan(self, quick: bool = False, **given: Any) -> P:
        """The plan with what is given (None: by default)."""
        chosen = {name: value for name, value in given.items() if value is not None}
        return self.plan_type(quick=quick, **{**(self.quick if quick else {}), **chosen})

    def places(self, plan: P) -> list[Place]:
        """Every cell of a plan: all of the first seed, then of the next; ValueError for a plan that cannot be."""
        for name, least in self.least.items():
            value = getattr(plan, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"reproduce {self.name}: {name} is {value!r}; expected an integer >= {least}")
        problems = self._some("problems", plan.problems, self.problems)
        ways = self._some("ways", plan.ways, self.can_run())
        return [Place(problem, way, seed) for seed in range(plan.seeds) for problem in problems for way in ways]

    def _some(self, what: str, given: Sequence[str], known: Sequence[str]) -> list[str]:
        """Those of `known` that are given, in its order; all where none is."""
        if not set(given) <= set(known):
            raise ValueError(f"reproduce {self.name}: {what} are {list(given)}; expected some of {', '.join(known)}")
        return [name for name in known if name in given or not given]

    def run(self, out: str | Path, plan: P, *, progress: bool = True) -> list[C]:
        """The cells of a plan, those that are finished in folder `out` taken from there; a way whose extra is not
        installed is left out, and said so on the bar."""
        folder, cells = Path(out), []
        places = self.places(plan)
        with progress_bar(len(places), self.title, progress, unit="cell") as bar:
            for place in places:
                if missing := self.missing(place.way):
                    say(f"{self.ways[place.way].title} is left out: {missing}", progress)
                    continue
                bar.set_postfix_str(f"{place.problem}, {self.ways[place.way].title}, seed {place.seed}")
                cells.append(self._kept(folder, plan, place) or self._made(folder, plan, place))
                bar.update()
        return cells

    def missing(self, way: str) -> str:
        """What has to be installed for a way, "" where it is there."""
        return registry.find(self.methods[way]).missing if way in self.methods else ""

    def path(self, out: str | Path, place: Place) -> Path:
        """The file of a cell."""
        return Path(out) / CELLS / (self.file.format(**place._asdict()) + ".json")

    def _kept(self, folder: Path, plan: P, place: Place) -> C | None:
        path = self.path(folder, place)
        cell = self._read(path) if path.is_file() else None
        return cell if cell is not None and cell.key == self.key(plan, place) else None

    def _made(self, folder: Path, plan: P, place: Place) -> C:
        cell = self.make(plan, place, folder)
        store.write_json(self.path(folder, place), asdict(cell))  # type: ignore[call-overload]
        return cell

    def _read(self, path: Path) -> C:
        data = store.read_json(path)
        try:
            cell = self.from_data(data)
            if cell.place.problem not in self.problems or cell.place.way not in self.ways:
                raise ValueError(f"it has no {cell.place.way} on {cell.place.problem}")
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is no cell of {self.known} ({error}); delete it") from error
        return cell

    def finished(self, out: str | Path) -> list[C]:
        """Every cell that a folder holds, whatever it was made with: by seed, problem and way."""
        problems, ways = list(self.problems), list(self.ways)
        pattern = "".join(text + ("*" if field else "") for text, field, _, _ in string.Formatter().parse(self.file))
        cells = [self._read(path) for path in sorted((Path(out) / CELLS).glob(f"{pattern}.json"))]
        return sorted(cells, key=lambda c: (c.place.seed, problems.index(c.place.problem), ways.index(c.place.way)))

    def write(self, folder: str | Path, cells: Sequence[C]) -> list[Path]:
        """NAME.md, .tex, .csv and the figures in the folder; their paths."""
        from nocl.comparisons.report.style import encode  # matplotlib

        entries, folder = self.entries(cells), Path(folder)
        texts = {"md": self.markdown(entries), "tex": self.latex(entries), "csv": self.csv(entries)}
        paths = [store.write_text(folder / f"{self.name}.{kind}", text) for kind, text in texts.items()]
        return paths + [store.write_bytes(folder / f"{self.name}{suffix}.png", encode(drawing, "png"))
                        for suffix, drawing in self.figures(entries, cells).items()]

    def markdown(self, entries: Sequence[E]) -> str:
        """A line for each row."""
        columns = self.columns()
        return lines([head for head, _ in columns], [[text(entry) for _, text in columns] for entry in entries])

    def csv(self, entries: Sequence[E]) -> str:
        """All numbers in full; blank where there is none."""
        rows, file = [self.row(entry) for entry in entries], io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0] if rows else [])
        for row in rows:
            writer.writerow(["" if value is None or value != value else value for value in row.values()])
        return file.getvalue()


def lines(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    rows = [f"| {' | '.join(row)} |" for row in (head, *body)]
    return "\n".join([rows[0], f"|{'---|' * len(head)}", *rows[1:]]) + "\n"


def number(x: float, digits: int = 3) -> str:
    """So many digits, plain where that is readable; blank for NaN and infinity."""
    if not math.isfinite(x):
        return ""
    if 1e-4 <= abs(x) < 10**digits or x == 0:
        return f"{x:.{digits}g}"
    return f"{x:,.0f}" if 1 <= abs(x) < 1e7 else f"{x:.1e}".replace("e+0", "e").replace("e-0", "e-")


def spread(mean: float, deviation: float, form: str = "{} ± {}") -> str:
    """Like '0.25 ± 0.05', blank without a mean."""
    return form.format(number(mean), number(deviation)) if math.isfinite(mean) else ""


def grid(columns: str, head: Sequence[str], body: Sequence[tuple[Sequence[str], Sequence[str]]]) -> str:
    """A tabular in LaTeX (booktabs, color): of each row ours, and where there are any the paper's in grey below."""
    def line(cells: Sequence[str]) -> str:
        return " & ".join(cells) + r" \\"

    text = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", *head, r"\midrule"]
    for ours, theirs in body:
        text.append(line(ours))
        if any(theirs):
            blank = len(ours) - len(theirs) - 1  # of further columns that only ours has
            grey = [rf"\color{{gray}}{cell}" if cell else "" for cell in theirs]
            text.append(line([r"\quad paper", *[""] * blank, *grey]))
    return "\n".join([*text, r"\bottomrule", r"\end{tabular}", ""])


def small(mean: str, deviation: str) -> str:
    """A mean, and after it the deviation in small print, in LaTeX."""
    return rf"{mean}\scriptsize{{$\pm${deviation}}}"
