"""Table I of the paper: the error of f_theta by activation, with and without gradient supervision, on four systems.

A cell is one system, one way of learning, one seed; it is kept as a file of its own once it is finished, so that an
interrupted run goes on from there. Two more ways stand below the paper's six: nocl's plain network (`method="mlp"`:
no structure, no sines and cosines of angles) and nocl's recipe.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nocl.support import store
from nocl.sysid.identification import PaperSettings, Score, Settings, identify
from nocl.system import System
from nocl.systems import load_ocp

SYSTEMS = ("dubins", "acrobot", "cartpole", "quadrotor")
HELD_OUT, HELD_OUT_SEED = 10_000, 1_000_003
WIDTH = {"acrobot": 256}  # of the paper's networks, where those of ReLU need more than PaperSettings' default
QUICK = Settings(iterations=150, polish=8, samples=20_000)
CELLS = "cells"  # the folder of finished cells


@dataclass(frozen=True)
class Way:
    """One row of the table: a way of learning f_theta."""

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


WAYS = (Way("relu-values", "ReLU (without gradients)", "paper", False, "relu"),
        Way("relu-gradients", "ReLU (with gradients)", "paper", True, "relu"),
        Way("tanh-values", "tanh (without gradients)", "paper", False, "tanh"),
        Way("tanh-gradients", "tanh (with gradients)", "paper", True, "tanh"),
        Way("sine-values", "sine (without gradients)", "paper", False),
        Way("sine-gradients", "sine (with gradients)", "paper", True),
        Way("mlp-values", "nocl, plain network (without gradients)", "mlp", False),
        Way("mlp-gradients", "nocl, plain network (with gradients)", "mlp", True),
        Way("nocl", "nocl, structure first", "default", True))

# mean, standard deviation, median, interquartile range: Table I of the paper, by WAYS[:6]
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


@dataclass(frozen=True)
class Plan:
    """What to run: each way on each system with seeds 0, ..., seeds - 1."""

    iterations: int = 50_000  # of Adam, in the paper's six ways
    seeds: int = 3
    systems: tuple[str, ...] = SYSTEMS
    ways: tuple[str, ...] = tuple(w.name for w in WAYS)
    quick: bool = False  # small budgets for nocl's own ways, and few samples for all

    def __post_init__(self) -> None:
        for name in ("iterations", "seeds"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"reproduce sysid: {name} is {value!r}; expected an integer >= 1")
        names = tuple(w.name for w in WAYS)
        for what, given, known in (("systems", self.systems, SYSTEMS), ("ways", self.ways, names)):
            if not given or not set(given) <= set(known):
                raise ValueError(f"reproduce sysid: {what} are {list(given)}; expected some of {', '.join(known)}")

    def cells(self) -> list[tuple[str, Way, int]]:
        """(system, way, seed) of every cell: all of the first seed, then of the next."""
        return [(system, way, seed) for seed in range(self.seeds) for system in self.systems
                for way in WAYS if way.name in self.ways]


@dataclass(frozen=True)
class Cell:
    """One network's errors on held-out samples of the box, and what it took."""

    system: str
    way: str
    seed: int
    score: Score
    seconds: float
    labels: int
    settings: dict[str, Any]


def run(out: str | Path, plan: Plan | None = None, *, progress: bool = True) -> list[Cell]:
    """The cells of a plan, those that are finished in folder `out` taken from there; made with other budgets, anew."""
    folder, plan = Path(out), plan or Plan()
    made = []
    with tqdm(plan.cells(), "Table I", disable=not progress, unit="cell", smoothing=0.05) as bar:
        for name, way, seed in bar:
            bar.set_postfix_str(f"{name}, {way.title}, seed {seed}")
            cell = _finished(folder, name, way, seed, plan)
            if cell is None:
                cell = _make(load_ocp(name).system, way, seed, plan)
                store.write_json(_path(folder, name, way.name, seed), asdict(cell))
            made.append(cell)
    return made


def _make(system: System, way: Way, seed: int, plan: Plan) -> Cell:
    model = identify(system, method=way.method, gradients=way.gradients, seed=seed, progress=False,
                     settings=way.settings(plan, system.name))
    score = model.score(HELD_OUT, HELD_OUT_SEED + seed)  # samples that no network was trained on
    return Cell(system.name, way.name, seed, score, model.card["seconds"], model.card["labels"],
                _key(way, plan, system.name))


def _key(way: Way, plan: Plan, system: str) -> dict[str, Any]:
    settings = way.settings(plan, system)
    return {} if settings is None else asdict(settings)


def _path(folder: Path, system: str, way: str, seed: int) -> Path:
    return folder / CELLS / f"{system}-{way}-{seed}.json"


def _finished(folder: Path, system: str, way: Way, seed: int, plan: Plan) -> Cell | None:
    path = _path(folder, system, way.name, seed)
    if not path.is_file():
        return None
    cell = _read(path)
    return cell if cell.settings == _key(way, plan, system) else None


def _read(path: Path) -> Cell:
    data = store.read_json(path)
    try:
        return Cell(**{**data, "score": Score(**data["score"])})
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} is no cell of Table I ({error}); delete it") from error


def finished(folder: str | Path) -> list[Cell]:
    """Every cell that a folder holds, whatever it was made with."""
    return [_read(path) for path in sorted((Path(folder) / CELLS).glob("*.json"))]


@dataclass(frozen=True)
class Entry:
    """A cell of the printed table: over seeds, the means of what was measured, and the spread of the mean error."""

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
        """The entry of one way on one system."""
        def over(values: Iterable[float]) -> float:
            numbers = list(values)
            return sum(numbers) / len(numbers)

        means = [c.score.mean for c in cells]
        return Entry(over(means), over(c.score.std for c in cells), over(c.score.median for c in cells),
                     over(c.score.iqr for c in cells), min(means), max(means), over(c.score.jacobian for c in cells),
                     over(c.seconds for c in cells), len(cells),
                     "; ".join(sorted({_made(c.settings) for c in cells})))


def _made(settings: Mapping[str, Any]) -> str:
    given = {name: settings.get(name) for name in ("iterations", "batch", "width")}
    steps = " x ".join(str(given[name]) for name in ("iterations", "batch") if given[name])
    return steps + (f", {given['width']} wide" if given["width"] else "")


def table(cells: Sequence[Cell]) -> dict[tuple[str, str], Entry]:
    """(system, way) -> entry, for what there is; of cells with different budgets, those with the largest."""
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.system, cell.way), []).append(cell)
    return {key: Entry.of(_dearest(group)) for key, group in groups.items()}


def _dearest(cells: Sequence[Cell]) -> list[Cell]:
    """The cells made like the one with the most samples and iterations, and the widest network."""
    budgets = ("samples", "iterations", "width")
    most = max((c.settings for c in cells), key=lambda s: [s.get(name, 0) for name in budgets])
    return [c for c in cells if c.settings == most]


def published(system: str, way: str) -> Sequence[float] | None:
    """(mean, standard deviation, median, interquartile range) of the paper; None for ways that are not its own."""
    names = [w.name for w in WAYS[: len(PAPER[system])]]
    return PAPER[system][names.index(way)] if way in names else None
