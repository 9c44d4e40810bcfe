"""The main job's stages in a run's folder, for the command line: each is made once, and taken up where it stands.

dynamics/   the learned dynamics                              cnd/      controller and value function, training.png
export/     *.casadi, c/, c_float32/, parity.json             report/   report.html, rows.csv, summary.json, figures/
checkpoint/ what an interrupted stage goes on from; gone once it is finished
"""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from nocl import __version__
from nocl.comparisons.disturbances import mass_variants
from nocl.comparisons.each import Laws, at_each, is_plan
from nocl.comparisons.judging import Disturbance, Judging
from nocl.comparisons.learned import good_enough, held_out_loss
from nocl.comparisons.methods import Solving, Starts, own_rate, runs_of
from nocl.comparisons.report.results import count
from nocl.comparisons.studies import study
from nocl.data import TINY
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.definition.substeps import USUAL
from nocl.exports.bundle import export
from nocl.judge.simulation import simulate
from nocl.solvers import registry
from nocl.solvers.cnd.controller import CND
from nocl.solvers.cnd.settings import AUTO, TrainSettings
from nocl.solvers.cnd.training import train
from nocl.support import store
from nocl.support.budget import ENDLESS, Budget
from nocl.support.fingerprint import fingerprint, json_text, sha256
from nocl.sysid.identification import LearnedDynamics, LogSettings, Settings, identify
from nocl.sysid.logs.log import Log

PARTS = ("dynamics", "cnd", "export", "report", "checkpoint")  # folders in a run's folder
KEY = "run"  # of a card: what the stage was made from
COARSE = 0.01  # of a cost: where judge and plan differ by more, the plan's grid is too coarse
IDENTIFYING = 0.3  # of a run's minutes, at most
OPEN = 0.01  # of what control is about, that models of parts of a log may lose on each other
CHECKING = 0.2  # of those left then, for teaching it again
JUDGED = 64  # plans of `nocl solve` that are run on the exact f
OF_LOGS = ("data", "known", "control_affine", "hold_controls")  # of that, what dynamics of a log have more


@dataclass(frozen=True)
class RunFolder:
    """The stages of one problem in one folder; what was made with other settings there is made anew, and said so."""

    ocp: OCP
    folder: Path
    seed: int
    effort: str = "normal"  # the word that scales all settings: "quick", "normal" or "best"
    minutes: float | None = None  # of identification and training together, from when this is made on
    intervals: int | None = None  # of training's plans; None: as many as they need
    integrator: str | None = None  # of their steps; None: what fits
    begin: float = field(default_factory=time.monotonic)

    def check(self, exact: bool) -> None:
        """ValueError where the folder holds something that is not a run's, before any work."""
        for part in PARTS:
            if (self.folder / part).exists() and not (self.folder / part).is_dir():
                raise ValueError(f"{self.folder / part} is a file; expected a run's folder: name another --out")
        if not exact:
            self._dynamics_there()
        self._cnd_there()

    def identify(self, share: float = 1.0) -> LearnedDynamics:
        """The learned dynamics, in dynamics/; share: of the minutes that there are, if there is a limit."""
        made_from, there = self._made_from(), self._dynamics_there()
        if there is not None and (there.card[KEY] == made_from or _of_a_log(there, made_from)):
            say(f"dynamics: taken from {self.folder / 'dynamics'} ({there.card.get('score', '')})")
            return there
        say(f"dynamics: learning f of {self.ocp.system.name}" + _anew(there))
        start = time.perf_counter()
        checkpoint = self.folder / "checkpoint" / "dynamics"
        time_for = {} if self.minutes is None else {"minutes": self._minutes_left(share)}
        model = identify(self.ocp.system, seed=self.seed, settings=Settings.of(self.effort, **time_for),
                         checkpoint=checkpoint, parameters=self.ocp.plant_parameters)
        model = replace(model, card={**model.card, KEY: made_from})
        model.save(self.folder / "dynamics")
        _forget(checkpoint)
        say(f"dynamics: {model.card.get('score', 'done')}, {time.perf_counter() - start:.0f} s")
        return model

    def identify_log(self, path: Path, known: dict[str, str | float] | None = None, control_affine: bool = False,
                     hold_controls: bool = False) -> LearnedDynamics:
        """The dynamics learned from a log, in dynamics/; their errors on a fifth of its recordings are shown first."""
        log = Log.read(path, self.ocp.system, hold_controls=hold_controls)
        stated: dict[str, Any] = {"known": known, "control_affine": control_affine}
        made_from = self._made_from(data=sha256(path.read_bytes()), **stated, hold_controls=hold_controls)
        there = self._dynamics_there()
        if there is not None and there.card[KEY] == made_from:
            say(f"dynamics: taken from {self.folder / 'dynamics'} ({there.card['score']})")
            return there
        say(f"dynamics: {log!r}" + _anew(there))
        settings, where = LogSettings.of(self.effort), self.ocp.plant_parameters
        start = time.perf_counter()
        model = identify(self.ocp.system, data=log, seed=self.seed, settings=settings, parameters=where, **stated)
        if len({r.run for r in log}) > 1:
            train, test = log.split(seed=self.seed)
            held = identify(self.ocp.system, data=train, seed=self.seed, settings=settings, parameters=where,
                            **stated)
            say(f"learned from four fifths of the recordings, simulated on the others:\n{held.validate(test)}")
            self._say_left_open(model, held)
        outside = int(model.outside(fresh_states(self.ocp, 100, self.seed)).sum())
        if outside:
            say(f"{outside} of 100 initial states of the problem lie outside the log: the model guesses there")
        model = replace(model, card={**model.card, KEY: made_from})
        model.save(self.folder / "dynamics")
        say(f"dynamics: {model.card['score']}, {time.perf_counter() - start:.0f} s, in {self.folder / 'dynamics'}")
        return model

    def _say_left_open(self, model: LearnedDynamics, part: LearnedDynamics) -> None:
        """What the controls hang on the recordings that a model of a part of them has not seen."""
        if self.ocp.is_free or self.ocp.is_infinite:
            return
        try:
            loss = held_out_loss(self.ocp, model, part, seed=self.seed)
        except ValueError as error:  # what cannot be solved, training tells with what to do
            say(f"dynamics: not held against each other: {error}")
            return
        more = "" if loss.median <= OPEN else \
            ": record more where the problem goes, or the controller will be one for this model alone"
        say(f"dynamics: the optimum of the model of four fifths, on that of all: {loss}{more}")

    def train(self, exact: bool) -> CND:
        """The controller and value function, in cnd/; on dynamics/ unless exact."""
        model = None if exact else self._good_enough(self.identify(IDENTIFYING))
        data = {} if model is None else {k: v for k, v in model.card[KEY].items() if k in OF_LOGS}
        grid: dict[str, Any] = {} if self.intervals is None else {"intervals": self.intervals}
        grid |= {} if self.integrator is None else {"integrator": self.integrator}
        made_from, there = self._made_from(exact=exact, **grid, **data), self._cnd_there()
        if there is not None and there.card.get(KEY) == made_from:
            say(f"controller: taken from {self.folder / 'cnd'}")
            return there
        say(f"controller: training on {'the exact' if exact else 'learned'} dynamics" + _anew(there))
        start = time.perf_counter()
        checkpoint = self.folder / "checkpoint" / "cnd"
        settings = TrainSettings.of(self.effort, parameters=self.ocp.np, intervals=self.intervals,
                                    integrator=self.integrator or AUTO)
        left = None if self.minutes is None else self._minutes_left()
        cnd = train(self.ocp, model, seed=self.seed, settings=settings, out=checkpoint, minutes=left)
        cnd.card[KEY] = made_from
        if opinion := cnd.card.get("second_opinion", {}).get("text"):
            say(f"controller: {opinion}")
        cnd.save(self.folder / "cnd")
        cnd.plot_training(self.folder / "cnd" / "training.png")
        _forget(checkpoint)
        say(f"controller: done, {time.perf_counter() - start:.0f} s")
        return cnd

    def _good_enough(self, model: LearnedDynamics) -> LearnedDynamics:
        """The dynamics that training goes on with: what their optimum loses on the exact f is told, lowered where it
        can be, and on the card. Of an f that is not known, errors on its log were told."""
        if self.ocp.system.xdot is None or "control_loss" in model.card or "data" in model.card[KEY]:
            return model
        wanted = TrainSettings.of(self.effort).gap_median
        budget = ENDLESS if self.minutes is None else Budget(60 * self._minutes_left(CHECKING))
        try:
            better, loss = good_enough(self.ocp, model, wanted, Settings.of(self.effort), seed=self.seed,
                                       intervals=self.intervals or USUAL, budget=budget)
        except ValueError as error:  # what cannot be solved here, training tells with what to do
            say(f"dynamics: not held against the exact f: {error}")
            return model
        own = {KEY: model.card[KEY], "control_loss": loss.median, "control_gap": loss.gap}
        better = replace(better, card={**better.card, **own})
        better.save(self.folder / "dynamics")
        say(f"dynamics: {loss}")
        if not loss.gap <= wanted:
            say(f"dynamics: that is more than the gap of {100 * wanted:g} % that training wants: the controller will "
                "be that of f_theta, not of the exact f; --exact trains on the exact f, --effort best learns it longer")
        return better

    def export(self, cnd: CND, out: Path, forms: Sequence[str], against: Sequence[str] | None,
               strict: bool = False) -> None:
        """Controller, value function and, where there are any, learned dynamics, with the proof of parity."""
        start = time.perf_counter()
        model = self._dynamics_there() if cnd.card.get("dynamics") == "learned" else None
        say(f"export: {', '.join(forms)} to {out}")
        certificate = export([cnd] if model is None else [cnd, model], out, forms, against=against,
                             strict=strict)
        say(f"export: {certificate}, {time.perf_counter() - start:.1f} s")

    def compare(self, cnd: CND, out: Path, methods: Sequence[str], n: int, intervals: int | None,
                hold: Sequence[int | None] | None = None, robust: bool = False) -> None:
        """Study the methods on n fresh initial states, save the report and print its summary and verdict."""
        at = cnd.card.get("p")  # those that it was folded at
        entries = [registry.METHODS[name] for name in methods]
        options = registry.Options(intervals, self.seed, integrator=self.integrator)
        titles = ", ".join(entry.title for entry in entries)
        say(f"comparing {titles} on {n} initial states, drawn with seed {fresh_seed(self.seed)}{own_p(self.ocp, at)}, "
            "on the exact dynamics")
        chosen = {entry.title if entry.make else trained_on(entry.title, cnd):
                  built(self.ocp, entry, options) if entry.make else cnd for entry in entries}
        model = self._dynamics_there() if cnd.card.get("dynamics") == "learned" else None
        checkpoint = self._checkpoint(
            beside(out, self.folder), methods=list(methods), n=n, intervals=intervals, hold=str(hold), robust=robust,
            controller=fingerprint(cnd.to_casadi()))
        report = study(self.ocp, chosen, n=n, seed=fresh_seed(self.seed), hold=hold, model=model, robust=robust,
                       variants=mass_variants(self.ocp) if robust else None, out=checkpoint)
        if at:
            report = replace(report, settings={**report.settings, "parameters": p_text(at)})
        path = report.save(out)
        _forget(checkpoint)
        say(f"\n{report}\n\nreport: {path}")

    def _made_from(self, **settings: Any) -> dict[str, Any]:
        problem = sha256(json_text(self.ocp.to_data()))  # as the cards of earlier runs have it
        limit = {} if self.minutes is None else {"minutes": self.minutes}
        return {"problem": problem, "seed": self.seed, "effort": self.effort, **limit, **settings}

    def _minutes_left(self, share: float = 1.0) -> float:
        """A share of the minutes that there are still, and a second at least."""
        assert self.minutes is not None
        return max(share * (self.minutes - (time.monotonic() - self.begin) / 60), 1 / 60)

    def _checkpoint(self, folder: Path, **settings: Any) -> Path:
        """Where outcomes so far are kept while a comparison lasts: another one goes elsewhere."""
        key = fingerprint(self._made_from(**settings), __version__, version("casadi"))
        return folder / "checkpoint" / f"compare-{key[:12]}"

    def _dynamics_there(self) -> LearnedDynamics | None:
        folder = self.folder / "dynamics"
        return _ours(LearnedDynamics.load(folder), folder) if _has_record(folder) else None

    def _cnd_there(self) -> CND | None:
        folder = self.folder / "cnd"
        return _ours(CND.load(folder), folder) if _has_record(folder) else None


def _has_record(folder: Path) -> bool:
    return folder.exists() and (not folder.is_dir() or any(folder.glob("*" + store.SUFFIX)))


def _ours(thing: Any, folder: Path) -> Any:
    made_from = thing.card.get(KEY)
    if made_from is None:
        raise ValueError(f"{folder} holds what `nocl run` did not make, and would be overwritten; expected a folder of "
                         "a run: name another --out")
    if "quick" in made_from:  # of runs before there were three efforts
        made_from["effort"] = "quick" if made_from.pop("quick") else "normal"
    return thing


def _of_a_log(model: LearnedDynamics, made_from: dict[str, Any]) -> bool:
    """Whether a model was learned from a log for the same problem: it stays, until another log is given."""
    return "data" in model.card[KEY] and model.card[KEY]["problem"] == made_from["problem"]


def _anew(there: Any) -> str:
    """Why something that stands there is made again."""
    return "" if there is None else " (what is there was made for another problem, seed or setting)"


def trained_on(title: str, cnd: CND) -> str:
    """A controller's name in reports, which says what it was trained on where that is not the exact f."""
    return f"{title} on f_theta" if cnd.card.get("dynamics") == "learned" else title


def beside(out: Path, run: Path) -> Path:
    """The folder that a comparison works in: the run's where its report goes there, else that of the report."""
    return run if out.absolute().is_relative_to(run.absolute()) else out


def _forget(checkpoint: Path) -> None:
    """Remove the checkpoint of a finished stage."""
    shutil.rmtree(checkpoint, ignore_errors=True)
    if checkpoint.parent.is_dir() and not any(checkpoint.parent.iterdir()):
        checkpoint.parent.rmdir()


def say(text: str) -> None:
    """A line for the user, at once."""
    print(text, flush=True)


def fresh_seed(seed: int) -> int:
    """The seed of the initial states that methods are compared on: not the one that training draws from."""
    return seed + 1


def fresh_states(ocp: OCP, n: int, seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The initial states [n, nx] that methods are compared on."""
    return ocp.initial_states.sample(n, fresh_seed(seed))


def own_p(ocp: OCP, at: Mapping[str, float] | None = None) -> str:
    """That each state has its own parameters, or all have those of `at`, in words; "" where there are none."""
    return f", at {p_text(at)}" if at else f", each at its own {', '.join(ocp.parameter_names)}" if ocp.np else ""


def p_text(p: Mapping[str, float]) -> str:
    """Parameters as they are typed, "mass = 1.2, goal = 0.5"."""
    return ", ".join(f"{name} = {value:g}" for name, value in p.items())


def built(ocp: OCP, entry: registry.Method, options: registry.Options) -> Any:
    """A method of the registry for this problem, made anew at each p where it knows no parameters."""
    entry.check_parameters(ocp)
    if entry.p == "rows":
        return entry.build(ocp, options)
    return at_each(ocp, lambda one: entry.build(one, options))


def load_run(folder: Path, p: Mapping[str, float] | None = None) -> CND:
    """The controller of a run's folder, or of a folder that CND.save wrote; with p at these parameters."""
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}; expected one that `nocl run` or `nocl train` made")
    cnd = CND.load(folder / "cnd" if (folder / "cnd").is_dir() else folder)
    return cnd if p is None else cnd.at(p)


def solve(ocp: OCP, out: Path, name: str, n: int, options: registry.Options, workers: int | str = "auto",
          at: Mapping[str, float] | None = None) -> None:
    """Solve n initial states by one method, and write OUT/NAME.npz (arrays), .json (messages) and a line of summary.

    On a problem with parameters each state has its own p; `at` are those that a problem without was made at.
    Feedback is simulated; plans are judged, run in open loop on the exact f, the first JUDGED of them. What is solved
    is kept in OUT/checkpoint until all is: the same call goes on from there. ValueError, at the end, where nothing was
    solved.
    """
    seed, starts = options.seed, Starts.drawn(ocp, n, fresh_seed(options.seed))
    start, checkpoint = time.perf_counter(), out / "checkpoint" / _solve_key(ocp, name, n, options)
    method = built(ocp, registry.METHODS[name], options)
    planned = is_plan(method)
    s, arrays, facts = _solved(ocp, method, starts, workers, checkpoint) if planned else _simulated(ocp, method, starts)
    judged = _judged(ocp, starts, arrays) if planned else {}
    if ocp.np:
        arrays["p"], facts["parameters"] = starts.p, list(ocp.parameter_names)
    if at:
        facts["p"] = dict(at)
    path = _write_arrays(out / f"{name}.npz", {"x0": starts.x, **arrays, **{key: judged[key] for key in judged
                                                                             if key != "message"}})
    store.write_json(out / f"{name}.json", {"solver": name, "n": n, "seed": fresh_seed(seed), **facts,
                                            "message": list(s.message)})
    _forget(checkpoint)
    ok = arrays["success"]
    mean = f", mean cost {arrays['cost'][ok].mean():.4g}" if ok.any() else ""
    say(f"{name}: {ok.sum()} of {n} {'solved' if planned else 'simulated'}{mean}, {time.perf_counter() - start:.1f} s; "
        f"drawn with seed {fresh_seed(seed)}{own_p(ocp, at)}\n{_verdict(ocp, arrays, judged, s.message)}{path}")
    if not ok.any():
        raise ValueError(f"{name} {'solved' if planned else 'simulated'} none of {count(n, 'initial state')}; of the "
                         f"first: {s.message[0]}")
    if judged and not (judged["judged_success"] | (ok & np.isnan(judged["judged_cost"]))).any():
        raise ValueError(f"none of {name}'s plans gets to the horizon with all constraints held on the exact f; the "
                         f"first {judged['message'][0]}: expected plans that hold them between their nodes too, give "
                         "more --intervals, or tighter bounds")


def _judged(ocp: OCP, starts: Starts, arrays: dict[str, Any]) -> dict[str, Any]:
    """Cost and clearance of plans on the exact f, of the first JUDGED that were solved, and whether they hold the
    constraints there; NaN and False of the others. `message` is of those that do not.
    """
    rows, n = np.flatnonzero(arrays["success"])[:JUDGED], len(starts)
    cost, clearance, success = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, dtype=bool)
    message: list[str] = []
    if len(rows):
        horizon = arrays["t"][rows, -1] if ocp.is_free else None
        s = simulate(ocp, arrays["u"][rows], starts.x[rows], p=starts.p[rows], horizon=horizon)
        cost[rows], clearance[rows], success[rows] = s.cost, s.clearance, s.success
        message = [f"{why} (state {i})" for i, why in zip(rows, s.message, strict=True) if why]
    return {"judged_cost": cost, "judged_clearance": clearance, "judged_success": success, "message": message}


def _verdict(ocp: OCP, arrays: dict[str, Any], judged: dict[str, Any], message: Sequence[str]) -> str:
    """What the judge found beside what the plans predict, and what failed first, in lines."""
    said, failed = [], np.flatnonzero(~arrays["success"])
    rows = np.flatnonzero(~np.isnan(judged.get("judged_cost", np.zeros(0))))
    if len(rows):
        cost, clear = judged["judged_cost"][rows], judged["judged_clearance"][rows]
        held = judged["judged_success"][rows]
        mean, predicted = (f"{values[held].mean():.4g}" if held.any() else "-"
                           for values in (cost, arrays["cost"][rows]))
        clearance = f"; least clearance {clear.min():.3g}" if ocp.constraint_names else ""
        said.append(f"judged in open loop on the exact f, {count(len(rows), 'plan')}: mean cost {mean}, "
                    f"predicted {predicted}{clearance}")
        if judged["message"]:
            said.append(f"{len(judged['message'])} of {len(rows)} failed there and count in no mean: the first "
                        f"{judged['message'][0]}")
        most = COARSE * np.abs(arrays["cost"][rows]) + TINY * usual_sizes(ocp).cost
        off = np.abs(cost - arrays["cost"][rows]) > most
        if off.any():
            said.append(f"{off.sum()} of {len(rows)} differ by more than {100 * COARSE:g} %: the grid of "
                        f"{count(arrays['u'].shape[1], 'interval')} is too coarse there, or the plan is unstable in "
                        "open loop: give more --intervals or --substeps")
    if len(failed) and judged and arrays["success"].any():
        said.append(f"state {failed[0]}: {message[failed[0]]}")
    return "".join(f"{line}\n" for line in said)


def _simulated(ocp: OCP, method: Any, starts: Starts) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """(simulation, its arrays, nothing more) of feedback, at its own rate."""
    if isinstance(method, Laws):
        (run,) = runs_of(ocp, {"law": method}, starts, (None,), Solving())
        job = Judging(ocp, starts, [run], Disturbance(), [0.0], timed=False)
        s = job.judge(run, np.arange(len(starts), dtype=np.int64), 0.0).simulation
    else:
        s = simulate(ocp, method, starts.x, hold=own_rate(ocp, method), p=starts.p)
    return s, {"t": s.t, "x": s.x, "u": s.u, "cost": s.cost, "success": s.success}, {}


def _solved(ocp: OCP, method: Any, starts: Starts, workers: int | str,
            checkpoint: Path) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """(solution, its arrays, how sure each optimum is)."""
    given: dict[str, Any] = {"workers": workers, "out": checkpoint, "p": starts.p if ocp.np else None}
    takes = signature(method.solve).parameters
    s = method.solve(starts.x, **{key: value for key, value in given.items() if key in takes})
    arrays = {"t": s.t, "x": s.x, "u": s.u, "cost": s.cost, "success": s.success, "costate": s.costate,
              "clearance": np.full(len(s), np.nan) if s.clearance is None else s.clearance}
    if s.V_p is not None:
        arrays["V_p"] = s.V_p
    return s, arrays, {"starts": s.starts, "hits": s.hits, "optima": [len(o) for o in s.optima]}


def _solve_key(ocp: OCP, *settings: Any) -> str:
    return f"{settings[0]}-{fingerprint(ocp.to_data(), settings, __version__, version('casadi'))[:12]}"


def _write_arrays(path: Path, arrays: dict[str, Any]) -> Path:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return store.write_bytes(path, file.getvalue())
