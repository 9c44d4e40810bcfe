"""System identification: f_theta, a network that answers like xdot = f(x, u), from labels of f and its Jacobians.

The default recipe reads the structure off the Jacobian labels first (nocl.sysid.structure): what is exactly known is
kept in closed form, and each group of entries with the same variables gets one small network, fitted to values and
derivatives (nocl.sysid.fitting). Where there is no structure to find, one network learns everything.
"""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from nocl import records
from nocl.data import Dataset
from nocl.definition import sampling
from nocl.definition.parameters import rows as parameter_rows
from nocl.definition.sampling import Distribution, Gaussian, Seed, Uniform
from nocl.definition.system import System
from nocl.exports.casadi_forms import to_casadi
from nocl.exports.parity import ExportPart
from nocl.nets import MLP, FeatureNet
from nocl.support import checks
from nocl.support.budget import ENDLESS, Budget
from nocl.support.checks import Array
from nocl.support.store import reading
from nocl.support.threads import one_thread
from nocl.sysid import paper
from nocl.sysid.figures import slices
from nocl.sysid.from_log import first_states, fit_log
from nocl.sysid.labels import (
    Source,
    box_of,
    data_box,
    find_structure,
    labelled,
    rows_of,
    some_labels,
    widened,
)
from nocl.sysid.logs.coverage import Coverage, share_of_nodes
from nocl.sysid.logs.known_rows import contradictions_of
from nocl.sysid.logs.log import Log
from nocl.sysid.logs.shooting import WindowFit
from nocl.sysid.logs.validation import HORIZONS, Validation, validate
from nocl.sysid.networks import apart, assemble, fit_group, fit_groups, together, weights_of
from nocl.sysid.progress import Checkpoint, Progress
from nocl.sysid.score import Score, contradictions, score_of
from nocl.sysid.settings import LogSettings, PaperSettings, Settings
from nocl.sysid.stated import Known, Stated
from nocl.sysid.structure import Expansion, Group, Split, Structure, Variables
from nocl.sysid.trial import better_affine

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["LearnedDynamics", "LogSettings", "PaperSettings", "Score", "Settings", "identify"]

RECIPES = ("default", "mlp", "paper")
KIND = "dynamics"
NO_BETTER = 0.5  # of the error of standing still: a model of a log that is warned of


@dataclass(frozen=True, eq=False, repr=False)
class LearnedDynamics:
    """xdot = f_theta(x, u[, p]): torch rows x [B, nx], u [B, nu], p [B, np] in float64 -> [B, nx].

    The system gives names, boxes and, in `score` and `refine` only, the exact f to compare with or to ask for labels.
    """

    system: System
    net: FeatureNet
    structure: str  # what was found, in words
    card: Mapping[str, Any] = field(default_factory=dict)  # how it was made: method, seed, settings, labels, score
    parts: Structure | None = None  # the structure itself; None for a network that learned everything
    coverage: Coverage | None = None  # where the log has been that it was learned from
    parameters: Distribution | None = None  # of the system's parameters, where it has some: where f_theta was taught

    def __call__(self, x: Tensor, u: Tensor, *p: Tensor) -> Tensor:
        return self.net(x, u, *p)

    @cached_property
    def widened(self) -> LearnedDynamics:
        """The same model with the parameters after the controls, as u [B, nu + np]; itself where there are none."""
        s = self.system
        if not s.np:
            return self
        if self.parameters is None:
            raise ValueError(f"LearnedDynamics of {s.name!r}: where {', '.join(s.parameter_names)} lie is not known; "
                             "expected it with parameters=nocl.Uniform(lb, ub)")
        return replace(self, system=widened(s, self.parameters), net=together(self.net, s), parameters=None)

    def _of(self, plant: System, parameters: Distribution | None) -> LearnedDynamics:
        """A model with parameters among its controls, as one of the plant that has them apart."""
        return replace(self, system=plant, net=apart(self.net, plant), parameters=parameters) if plant.np else self

    def to_casadi(self) -> ca.Function:
        """f:(x, u)->(xdot), native MX, equal to torch to rounding; with t and p, where the network has them."""
        names = self.system.arguments.names[:self.net.inputs.n_in()]
        return to_casadi(self.net, name="f", in_names=names, out_names=["xdot"])

    def export_parts(self) -> list[ExportPart]:
        """What nocl.exports.bundle.export writes: f_theta."""
        s = self.system
        box = {"x": (s.lbx, s.ubx), "u": (s.lbu, s.ubu)}
        labels = {"x": [s.unit(n) for n in s.state_names], "u": [s.unit(n) for n in s.control_names]}
        if self.parameters is not None:
            box["p"], labels["p"] = sampling.box(self.parameters), [s.unit(n) for n in s.parameter_names]
        labels = {**labels, "xdot": [f"d {n} / dt" for n in s.state_names]}
        net = copy.deepcopy(self.net).double().eval()
        return [ExportPart("dynamics", self.to_casadi(), net, box, labels, net)]

    def to_system(self) -> System:
        """The system with f_theta for its equations, in its own symbols: for problems on a plant that is not known.

        SX of all networks: for small ones, as logs teach them.
        """
        return self.system.under(self.to_casadi())

    def validate(self, log: Log, steps: Sequence[int] = HORIZONS, *, every: int | None = None) -> Validation:
        """Errors of simulations of f_theta from a log's states, by number of steps: see nocl.sysid.logs.validation."""
        if self.system.np:
            return self.widened.validate(log, steps, every=every)
        log.check(self.system)
        settings = self.card.get("settings", {})  # where cards had them before
        return validate(self.net, log, steps, every, int(self.card.get("substeps", settings.get("substeps", 1))))

    def outside(self, x: ArrayLike, what: str | None = None) -> Any:
        """Which states [N, nx] the model was not taught about, [N] bool; a UserWarning names `what`, where given.

        For a model of a log, what is far from all logged states (nocl.sysid.logs.coverage); else, what is outside the
        box X.
        """
        if self.coverage is not None:
            return self.coverage.outside(x) if what is None else self.coverage.warn(x, what)
        rows, _ = checks.states(x, self.system.nx, self.system.name, "x")
        outside = ((rows < self.system.lbx) | (rows > self.system.ubx)).any(axis=1)
        if what is not None and outside.any():
            warnings.warn(f"{outside.sum()} of {len(rows)} {what} lie outside the box X of {self.system.name!r}, which "
                          "the model was taught in: widen lbx, ubx", UserWarning, stacklevel=2)
        return outside

    def doubt(self, x: ArrayLike, u: ArrayLike) -> Array:
        """The share of each trajectory's states x [B, K+1, nx] (controls u for their number) that is `outside`: [B]."""
        return share_of_nodes(lambda rows, _: self.outside(rows), x, u)

    def plot(self) -> Figure:
        """f_theta, and the exact f where it is known, along each variable through the middle of the box."""
        wide = self.widened
        return slices(wide.system, wide)

    def score(self, n: int = 2000, seed: Seed = 1_000_003) -> Score:
        """Errors against the exact f at n fresh uniform samples of the box of x, u and p; ValueError where f is not
        known."""
        if self.system.xdot is None:
            raise ValueError(f"score: the equations of {self.system.name!r} are not known, there is nothing to compare "
                             "with: model.validate(log) has the errors of simulations on logs")
        wide = self.widened
        return score_of(wide.net, Dataset.sample(wide.system, n, seed))

    def refine(self, states: ArrayLike, controls: ArrayLike, *, p: Any = None, spread: float = 0.05,
               share: float = 0.7, seed: int = 0, settings: Settings | None = None,
               progress: bool = True) -> LearnedDynamics:
        """More training where solutions go: `share` of the samples near rows (states [N, nx], controls [N, nu]).

        p: the parameters at these rows, where the system has some: [np] for all, [N, np], or by name. Near: normal
        noise of `spread` times the width of the box; the other samples fill the box. The networks go on from their
        weights; the structure stays. Asks the system for labels. Raises ValueError for rows that do not fit, and for a
        model with nothing to train.
        """
        s, settings = self.system, settings or Settings()
        if not s.np:
            return _refined(self, states, controls, spread, share, seed, settings, progress)
        given = checks.states(controls, s.nu, s.name, "controls")[0]
        values = parameter_rows(p, s.parameter_names, len(given), f"{s.name}.refine", self.parameters)
        wide = _refined(self.widened, states, np.hstack([given, values]), spread, share, seed, settings, progress)
        return wide._of(s, self.parameters)

    def save(self, folder: str | Path) -> Path:
        """Write folder/dynamics.safetensors: weights, maps, the system's equations and the card, as data."""
        parts = None if self.parts is None else _structure_data(self.parts)
        coverage = None if self.coverage is None else self.coverage.to_data()
        card = {"system": self.system.to_data(), "structure": self.structure, "card": dict(self.card), "parts": parts,
                "coverage": coverage}
        if self.parameters is not None:
            card["parameters"] = sampling.to_data(self.parameters)
        known = {} if self.parts is None else {"linear": self.parts.linear, "exact": self.parts.exact}
        return records.save(folder, KIND, nets={"f": self.net}, functions=known, card=card)

    @staticmethod
    def load(folder: str | Path) -> LearnedDynamics:
        """What `save` wrote, bit by bit; ValueError for a missing, altered or foreign file."""
        record = records.load(folder, KIND)
        with reading(folder, "a model"):
            system = System.from_data(record.card["system"])
            there = record.card.get("parameters")
            parameters = None if there is None else sampling.from_data(there)
            parts = _structure_from(record.card["parts"], record.functions, box_of(widened(system, parameters)))
            coverage = record.card.get("coverage")
            card = record.card["card"]
            return LearnedDynamics(system, record.nets["f"].eval(), record.card["structure"], card, parts,
                                   None if coverage is None else Coverage.from_data(coverage), parameters)

    def __repr__(self) -> str:
        nets = [net for net in self.net.nets if isinstance(net, MLP)]
        sizes = ", ".join("-".join(map(str, net.sizes)) for net in nets) or "none: all in closed form"
        return (f"LearnedDynamics of {self.system.name!r} ({self.card.get('method', '?')})\n  {self.structure}\n"
                f"  networks: {sizes}\n  {self.card.get('score', 'not scored')}")


@one_thread()
def identify(system: System, *, data: Dataset | Log | None = None, method: str = "default", gradients: bool = True,
             known: Known | None = None, control_affine: bool = False, seed: int = 0,
             settings: Settings | PaperSettings | LogSettings | None = None, progress: bool = True,
             checkpoint: str | Path | None = None, parameters: Distribution | None = None) -> LearnedDynamics:
    """f_theta ~ f on the box X x U, learned from labels of f (values and, with `gradients`, Jacobians) or from logs.

    On a system with parameters it is f_theta(x, u, p), over the box of `parameters` too.

    Parameters
    ----------
    system : System
        Answers for labels at samples of its box; its equations are never read. With `data`, training takes names, boxes
        and angles from it only, and its equations may be unknown (xdot=None). The score on the card compares with
        them where they are known; for a Log, it is of simulations on that log.
    data : Dataset or Log
        Labels to learn from instead; without Jacobians A, B, from values alone. A Log of trajectories is fitted by its
        smoothed derivatives, then by simulation error (nocl.sysid.from_log).
    known : dict from states to their derivatives (SX, numbers, names of states or controls), or names of states
        Equations that need not be learned; a bare name stands for the system's own equation.
    control_affine : bool
        xdot = a(x) + B(x) u. Labels of f with Jacobians show that by themselves: drawn ones by moving the controls
        alone, given ones by a trial (nocl.sysid.trial).
    method : "default", "mlp" or "paper"
        Structure first; one plain sine network; the paper's network, loss and optimiser.
    settings : Settings, (method "paper") PaperSettings or (logs) LogSettings
        Budgets and sizes.
    parameters : Uniform or Gaussian
        Of the system's parameters [np], in their order: where they are drawn. Data have them as columns after the
        controls: Dataset.u [N, nu + np], B likewise.
    checkpoint : folder
        Finished networks are kept there, and not trained again when the same call is repeated ("paper", logs: unused;
        the trials of given labels are made again).

    Raises
    ------
    ValueError
        For settings, data or labels that cannot be used, with the remedy; for controls that are stated to be affine
        where labels show a closed form, or are drawn and show that they are not.

    Warns
    -----
    UserWarning
        Where the labels speak against what is stated.
    """
    settings = _check_arguments(system, method, gradients, settings, seed, data)
    system.refuse_discrete("nocl.identify")
    plant, system = system, _widened(system, parameters, control_affine)
    stated, start = Stated.of(system, known, control_affine), time.perf_counter()
    bar = Progress(system.name, progress, _time_of(settings))
    if isinstance(data, Log):
        assert isinstance(settings, LogSettings)
        return _from_log(system, data, stated, settings, seed, bar)._of(plant, parameters)
    assert not isinstance(settings, LogSettings)
    source = Source.of(system, data, gradients)
    _check_stated(stated, method)
    if isinstance(settings, PaperSettings):
        net, parts = paper.train(source, settings, seed, bar), None
        words = "one network of all variables, as in the paper"
    else:
        if method == "mlp":
            settings = replace(settings, structure=False, angles=False)
        parts = find_structure(source, settings, seed, stated)
        if settings.structure and not stated.control_affine:
            parts = better_affine(source, parts, settings, seed, bar)
        kept = Checkpoint(None, {}) if checkpoint is None else Checkpoint.at(checkpoint, system, seed, settings, {
            "structure": _structure_data(parts), "gradients": source.gradients, "data": source.digest})
        weights = fit_groups(source, parts, settings, seed, bar, kept)
        net, words = assemble(parts, weights, settings.angles), parts.words
        found = contradictions(net, source.box, stated, *some_labels(source, 500, seed)) if stated else []
        _warn_of(found, "labels speak", 4)
    card = {"method": method, "gradients": source.gradients, "seed": seed, "settings": asdict(settings),
            "labels": source.labels, "seconds": round(time.perf_counter() - start, 3), "torch": torch.__version__}
    card["score"] = _score_text(system, net)
    return LearnedDynamics(system, net, words, card, parts)._of(plant, parameters)


def _time_of(settings: Settings | PaperSettings | LogSettings) -> Budget:
    minutes = settings.minutes if isinstance(settings, Settings) else None
    return ENDLESS if minutes is None else Budget(60 * minutes)


def _widened(system: System, parameters: Distribution | None, control_affine: bool) -> System:
    """The system that is identified: parameters after the controls; ValueError where their place is not given."""
    owner, names = f"identify {system.name!r}", ", ".join(system.parameter_names)
    if not system.np:
        if parameters is not None:
            raise ValueError(f"{owner}: got parameters = {parameters!r}, but the system has none: leave it out, or "
                             "declare them, System(..., p=)")
        return system
    if system.uses_time:
        raise ValueError(f"{owner}: f holds the time; expected f(x, u, p): a network of the time is not learned")
    if not isinstance(parameters, (Uniform, Gaussian)) or parameters.n != system.np:
        raise ValueError(f"{owner}: parameters is {checks.shown(parameters)}; expected where {names} lie: "
                         f"parameters=nocl.Uniform(lb [{system.np}], ub [{system.np}])")
    if control_affine:
        raise ValueError(f"{owner}: control_affine is not stated for f(x, u, p); expected labels to show it: leave it "
                         "out")
    return widened(system, parameters)


def _score_text(system: System, net: FeatureNet) -> str:
    if system.xdot is None:
        return "not scored: the equations are not known"
    return str(score_of(net, Dataset.sample(system, 2000, 1_000_003)))


def _from_log(system: System, log: Log, stated: Stated, settings: LogSettings, seed: int,
              bar: Progress) -> LearnedDynamics:
    """f_theta from a log; the card's score is of simulations on that very log."""
    log.check(system)
    start = time.perf_counter()
    parts = stated.plain(data_box(system, np.vstack([np.hstack([s, r.u]) for s, r in first_states(log)])))
    said = contradictions_of(log, stated.z, stated.rows)
    net, stages, substeps = fit_log(log, parts, settings, seed, bar)
    seen = validate(net, log, (1, min(settings.window, max(map(len, log)) - 1)), substeps=substeps)
    _warn_of(said, "log speaks", 5)
    _warn_of_no_progress(stages, seen)
    errors = ", ".join(f"{100 * e:.3g} % after {k}" for k, e in zip(seen.steps, seen.relative, strict=True))
    card = {"method": "log", "gradients": False, "seed": seed, "settings": asdict(settings), "labels": len(log),
            "substeps": substeps,
            "seconds": round(time.perf_counter() - start, 3), "torch": torch.__version__,
            "windows": [asdict(stage) for stage in stages], "contradictions": said,
            "score": f"simulation error on its own log, in units of the states' spread: {errors} steps"}
    return LearnedDynamics(system, net, parts.words, card, parts, Coverage.of(log, system))


def _warn_of(contradictions: list[str], who: str, level: int) -> None:
    if contradictions:
        warnings.warn(f"identify: the {who} against what is stated, or the fit is poor: {'; '.join(contradictions)}",
                      UserWarning, stacklevel=level)


def _warn_of_no_progress(stages: list[WindowFit], seen: Validation) -> None:
    """A UserWarning where a fit to a log came to nothing."""
    if stages and stages[0].failed:
        warnings.warn(f"identify: no step lowered the simulation error, not even over {stages[0].steps} samples "
                      f"({stages[0].last:.3g} times the noise): f_theta is that of smoothed derivatives; log at a "
                      "higher rate, look for outliers, or state what is known", UserWarning, stacklevel=5)
    elif (seen.relative > NO_BETTER * seen.still_relative).all():
        warnings.warn("identify: f_theta predicts its own log little better than standing still, or worse: log longer "
                      "or livelier recordings, or state what is known", UserWarning, stacklevel=5)


def _check_stated(stated: Stated, method: str) -> None:
    if stated and method == "paper":
        raise ValueError("identify: method 'paper' learns everything; expected no `known` and no `control_affine`: use "
                         "the default method")


def _check_arguments(system: System, method: str, gradients: bool,
                     settings: Settings | PaperSettings | LogSettings | None, seed: int,
                     data: Dataset | Log | None) -> Settings | PaperSettings | LogSettings:
    checks.instance(System, system, "system", "identify", "of an OCP, pass ocp.system")
    checks.word(method, RECIPES, "method", "identify")
    checks.whole(seed, "seed", "identify", most=2**62)
    checks.flag(gradients, "gradients", "identify")
    if data is not None and not isinstance(data, (Dataset, Log)):
        raise ValueError(f"identify: data is a {type(data).__name__}; expected a nocl.Dataset or a nocl.Log")
    if isinstance(data, Log) and method != "default":
        raise ValueError(f"identify: method is {method!r}; logs take 'default' only: leave it out")
    expected = LogSettings if isinstance(data, Log) else PaperSettings if method == "paper" else Settings
    if settings is None:
        return expected()
    if not isinstance(settings, expected):
        raise ValueError(f"identify: settings is a {type(settings).__name__}; method {method!r} takes "
                         f"{expected.__name__}: pass nocl.sysid.{expected.__name__}(...)")
    return settings


def _refined(model: LearnedDynamics, states: ArrayLike, controls: ArrayLike, spread: float, share: float, seed: int,
             settings: Settings, progress: bool) -> LearnedDynamics:
    system, parts = model.system, model.parts
    if parts is None or not parts.groups:
        raise ValueError("refine: the model has no networks that could be trained; expected one of method 'default' or "
                         "'mlp' that is not all in closed form")
    if not (np.isfinite(spread) and spread > 0 and 0 < share <= 1):
        raise ValueError(f"refine: spread is {spread}, share is {share}; expected spread > 0 and 0 < share <= 1")
    near = np.hstack([checks.states(states, system.nx, system.name, "states")[0],
                      checks.states(controls, system.nu, system.name, "controls")[0]])
    rng, source, start = np.random.default_rng((seed, 2)), Source.of(system, None, True), time.perf_counter()
    n, box = rows_of(parts, settings), parts.split.box
    z = box.sample(n, rng)
    tube = rng.random(n) < share
    picked = near[rng.integers(len(near), size=int(tube.sum()))]
    z[tube] = picked + spread * box.width * rng.standard_normal(picked.shape)
    pool, bar = labelled(source, parts, z), Progress(system.name, progress, _time_of(settings))
    old = [weights_of(net) for net in model.net.nets if isinstance(net, MLP)]
    angles = bool(model.card["settings"]["angles"])
    settings = replace(settings, angles=angles)
    weights = [fit_group(parts, pool, i, settings, seed, bar.part(1 / (len(old) - i)), w) for i, w in enumerate(old)]
    net = assemble(parts, weights, angles)
    card = {**model.card, "labels": model.card["labels"] + source.labels, "refined": model.card.get("refined", 0) + 1,
            "seconds": round(model.card["seconds"] + time.perf_counter() - start, 3),
            "score": str(score_of(net, Dataset.sample(system, 2000, 1_000_003)))}
    return LearnedDynamics(system, net, model.structure, card, parts)


def _structure_data(parts: Structure) -> dict[str, Any]:
    split = parts.split
    return {"affine": list(split.affine), "w0": split.w0.tolist(), "h": split.h.tolist(), "words": parts.words,
            "labels": parts.labels, "groups": [[list(g.variables), list(g.coefficients)] for g in parts.groups],
            "expansions": [[list(e.entries), list(e.variables), list(e.degrees)] for e in parts.expansions],
            "lb": split.box.lb.tolist(), "ub": split.box.ub.tolist()}


def _structure_from(data: Mapping[str, Any] | None, functions: Mapping[str, ca.Function],
                    box: Variables) -> Structure | None:
    if data is None:
        return None
    box = replace(box, lb=np.array(data["lb"]), ub=np.array(data["ub"]))
    split = Split(box, tuple(data["affine"]), np.array(data["w0"]), np.array(data["h"]))
    expansions = tuple(Expansion(box, *map(tuple, parts)) for parts in data["expansions"])
    groups = tuple(Group(tuple(v), tuple(c)) for v, c in data["groups"])
    return Structure(split, functions["linear"], expansions, functions["exact"], groups, data["words"], data["labels"])
