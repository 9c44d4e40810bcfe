"""Table I of the paper: the error of f_theta by activation, with and without gradient supervision, on four systems.

A cell is one network. Two more ways stand below the paper's six: nocl's plain network (`method="mlp"`: no structure, no
sines and cosines of angles) and nocl's recipe.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from nocl.comparisons.reproduce import table
from nocl.comparisons.reproduce.table import Place, grid, number, small, spread
from nocl.sysid.identification import PaperSettings, Score, Settings, identify
from nocl.systems import load_ocp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SYSTEMS = ("dubins", "acrobot", "cartpole", "quadrotor")
HELD_OUT, HELD_OUT_SEED = 10_000, 1_000_003
WIDTH = {"acrobot": 256}  # of the paper's networks, where those of ReLU need more than PaperSettings' default
QUICK = Settings(iterations=150, polish=8, samples=20_000)


@dataclass(frozen=True, kw_only=True)
class Plan(table.Plan):
    """Each way on each system."""

    seeds: int = 3
    iterations: int = 50_000  # of Adam, in the paper's six ways


@dataclass(frozen=True)
class Way:
    """A way of learning f_theta."""

    name: str
    title: str
    method: str
    gradients: bool
    activation: str = "sine"

    def settings(self, plan: Plan, system: str) -> PaperSettings | Settings | None:
        """Its budgets on a system; None: those of `identify`."""
        if self.method == "paper":
            samples = QUICK.samples if plan.quick else PaperSettings.samples
            return PaperSettings(activation=self.activation, iterations=plan.iterations, samples=samples,
                                 width=WIDTH.get(system, PaperSettings.width))
        return QUICK if plan.quick else None


WAYS = {way.name: way for way in (
    Way("relu-values", "ReLU (without gradients)", "paper", False, "relu"),
    Way("relu-gradients", "ReLU (with gradients)", "paper", True, "relu"),
    Way("tanh-values", "tanh (without gradients)", "paper", False, "tanh"),
    Way("tanh-gradients", "tanh (with gradients)", "paper", True, "tanh"),
    Way("sine-values", "sine (without gradients)", "paper", False),
    Way("sine-gradients", "sine (with gradients)", "paper", True),
    Way("mlp-values", "nocl, plain network (without gradients)", "mlp", False),
    Way("mlp-gradients", "nocl, plain network (with gradients)", "mlp", True),
    Way("nocl", "nocl, structure first", "default", True))}

class Published(NamedTuple):
    """The paper's numbers of ||f_theta - f||."""

    mean: float
    std: float
    median: float
    iqr: float


# mean, standard deviation, median, interquartile range: Table I of the paper, by the first six of WAYS
PAPER: dict[str, tuple[tuple[float, float, float, float], ...]] = {
    "dubins": ((0.0071, 0.0033, 0.0067, 0.0043), (0.0134, 0.0090, 0.0113, 0.0094), (0.0017, 0.0009, 0.0016, 0.0009),
               (0.0015, 0.0003, 0.0015, 0.0005), (0.0014, 0.0008, 0.0013, 0.0008), (0.0008, 0.0003, 0.0008, 0.0004)),
    "acrobot": ((0.7717, 0.5395, 0.6768, 0.5464), (0.6456, 0.4999, 0.5432, 0.4726), (0.4328, 0.3702, 0.3551, 0.2858),
                (0.2834, 0.1800, 0.2488, 0.1958), (0.0673, 0.0417, 0.0585, 0.0414), (0.0664, 0.0358, 0.0595, 0.0419)),
    "cartpole": ((0.0819, 0.0551, 0.0693, 0.0611), (0.0734, 0.0511, 0.0621, 0.0543), (0.0210, 0.0111, 0.0189, 0.0119),
                 (0.0137, 0.0067, 0.0124, 0.0079), (0.0149, 0.0066, 0.0140, 0.0083), (0.0101, 0.0043, 0.0096, 0.0055)),
    "quadrotor": ((20.8816, 11.2258, 18.6534, 13.0919), (35.9359, 18.6272, 30.7491, 24.2143),
                  (8.3696, 5.7249, 6.8628, 5.9049), (18.6461, 8.2238, 18.6983, 11.9576),
                  (1.3109, 0.9937, 1.0362, 0.9085), (15.6214, 8.1264, 15.8460, 13.2569))}


def published(system: str, way: str) -> Published | None:
    """The paper's numbers; None for ways that are not its own."""
    names = list(WAYS)[: len(PAPER[system])]
    return Published(*PAPER[system][names.index(way)]) if way in names else None


@dataclass(frozen=True)
class Cell:
    """One network's errors on held-out samples of the box, and what it took."""

    system: str
    way: str
    seed: int
    score: Score
    seconds: float
    labels: int
    settings: dict[str, Any]  # what it was made with; {}: as `identify` chooses

    @property
    def place(self) -> Place:
        return Place(self.system, self.way, self.seed)

    @property
    def key(self) -> dict[str, Any]:
        return self.settings


@dataclass(frozen=True)
class Entry:
    """A way on a system: over seeds, the means of what was measured, and the spread of the mean error."""

    system: str
    way: str
    mean: float
    std: float
    median: float
    iqr: float
    lowest: float  # mean error of the best seed
    highest: float
    jacobian: float
    seconds: float
    seeds: int
    made: str  # steps x batch and width; blank: as `identify` chooses

    @staticmethod
    def of(cells: Sequence[Cell]) -> Entry:
        """Of cells of one way on one system."""
        def over(values: Iterable[float]) -> float:
            numbers = list(values)
            return sum(numbers) / len(numbers)

        means, scores = [c.score.mean for c in cells], [c.score for c in cells]
        return Entry(cells[0].system, cells[0].way, over(means), over(s.std for s in scores),
                     over(s.median for s in scores), over(s.iqr for s in scores), min(means), max(means),
                     over(s.jacobian for s in scores), over(c.seconds for c in cells), len(cells),
                     "; ".join(sorted({_made(c.settings) for c in cells})))


def _made(settings: Mapping[str, Any]) -> str:
    given = {name: settings.get(name) for name in ("iterations", "batch", "width")}
    steps = " x ".join(str(given[name]) for name in ("iterations", "batch") if given[name])
    return steps + (f", {given['width']} wide" if given["width"] else "")


def _dearest(cells: Sequence[Cell]) -> list[Cell]:
    """The cells made like the one with the most samples and iterations, and the widest network."""
    budgets = ("samples", "iterations", "width")
    most = max((c.settings for c in cells), key=lambda s: [s.get(name, 0) for name in budgets])
    return [c for c in cells if c.settings == most]


class TableOne(table.PaperTable[Plan, Cell, Entry]):
    """Ways down, systems across."""

    name, title, known, file = "sysid", "Table I", "Table I", "{problem}-{way}-{seed}"
    problems, ways, plan_type, cell_type = SYSTEMS, WAYS, Plan, Cell
    quick: ClassVar[dict[str, int]] = {"seeds": 1, "iterations": 1000}
    least: ClassVar[dict[str, int]] = {"seeds": 1, "iterations": 1}

    def key(self, plan: Plan, place: Place) -> dict[str, Any]:
        settings = WAYS[place.way].settings(plan, place.problem)
        return {} if settings is None else asdict(settings)

    def make(self, plan: Plan, place: Place, folder: Path) -> Cell:
        way, system = WAYS[place.way], load_ocp(place.problem).system
        model = identify(system, method=way.method, gradients=way.gradients, seed=place.seed, progress=False,
                         settings=way.settings(plan, system.name))
        score = model.score(HELD_OUT, HELD_OUT_SEED + place.seed)  # samples that no network was trained on
        return Cell(place.problem, place.way, place.seed, score, model.card["seconds"], model.card["labels"],
                    self.key(plan, place))

    def from_data(self, data: dict[str, Any]) -> Cell:
        return Cell(**{**data, "score": Score(**data["score"])})

    def entries(self, cells: Sequence[Cell]) -> list[Entry]:
        """One a system and way, for what there is; of cells with different budgets, those with the largest."""
        groups = [[c for c in cells if (c.system, c.way) == (system, way)] for system in SYSTEMS for way in WAYS]
        return [Entry.of(_dearest(group)) for group in groups if group]

    def columns(self) -> list[table.Column[Entry]]:
        def paper(e: Entry, text: str) -> str:
            p = published(e.system, e.way)
            return "" if p is None else {"mean": spread(p.mean, p.std), "median": _iqr(p),
                                         "ratio": f"{e.mean / p.mean:.2f}"}[text]

        return [("system", lambda e: e.system), ("network", lambda e: WAYS[e.way].title),
                ("steps x batch, width; seconds", lambda e: f"{e.made}; {e.seconds:.0f}".lstrip("; ")),
                ("mean ± s.d.", lambda e: spread(e.mean, e.std)), ("median (iqr)", _iqr),
                ("mean of the seeds", lambda e: spread(e.lowest, e.highest, "{} .. {}")),
                ("paper: mean ± s.d.", lambda e: paper(e, "mean")),
                ("paper: median (iqr)", lambda e: paper(e, "median")),
                ("ours / paper's", lambda e: paper(e, "ratio"))]

    def row(self, entry: Entry) -> dict[str, Any]:
        paper = published(entry.system, entry.way)
        return asdict(entry) | {f"paper_{name}": None if paper is None else getattr(paper, name)
                                for name in Published._fields}

    def latex(self, entries: Sequence[Entry]) -> str:
        found = {(e.system, e.way): e for e in entries}
        systems = [s for s in SYSTEMS if any(e.system == s for e in entries)]
        head = [" & " + " & ".join(rf"\multicolumn{{2}}{{c}}{{{s}}}" for s in systems) + r" \\",
                " & " + " & ".join([r"mean (s.d.) & median (iqr)"] * len(systems)) + r" \\"]
        body = []
        for way in WAYS.values():
            ours = [found.get((s, way.name)) for s in systems]
            theirs = [published(s, way.name) for s in systems]
            body.append(([way.title, *(text for e in ours for text in _pair(e, "--"))],
                         [text for p in theirs for text in _pair(p, "")]))
        return grid(f"l{'cc' * len(systems)}", head, body)

    def figures(self, entries: Sequence[Entry], cells: Sequence[Cell]) -> dict[str, Figure]:
        from nocl.comparisons.reproduce.dots import Dot, dots  # matplotlib

        found = {(e.system, e.way): e for e in entries}

        def dot(system: str, way: str) -> Dot:
            e, paper = found.get((system, way)), published(system, way)
            return Dot(None if e is None else (e.mean, e.lowest, e.highest), None if paper is None else paper.mean)

        systems = [s for s in SYSTEMS if any(e.system == s for e in entries)]
        return {"": dots({s: [dot(s, way) for way in WAYS] for s in systems}, [w.title for w in WAYS.values()],
                         "mean error")}


def _iqr(e: Entry | Published) -> str:
    return f"{number(e.median)} ({number(e.iqr)})"


def _pair(e: Entry | Published | None, blank: str) -> list[str]:
    """Mean and median, in LaTeX."""
    if e is None:
        return [blank, blank]
    return [small(number(e.mean), number(e.std)), small(number(e.median), number(e.iqr))]


TABLE = TableOne()
