"""Problems of others as their users would write them, by default settings: does it run, how long, how near the optimum.

    python benchmarks/strangers.py --check                 # each by NMPC, DDP and collocation from one state
    python benchmarks/strangers.py fishing tumour          # the whole route, default settings
    python benchmarks/strangers.py --minutes 3             # ... each within three minutes
    python benchmarks/strangers.py --table                 # the rows that are kept, in markdown

Each file of examples/ goes the way of `nocl run FILE --exact`: it is loaded, a controller is trained on the exact f,
and exported (where the horizon is free, without a limit of minutes).
Then benchmarks/independent.py judges it, which uses neither solvers nor judge of nocl: closed loop under LSODA from
fresh initial states, beside the best of NMPC's plan, DDP's and Radau collocation's that LSODA confirms.

gap     (J - J*) / |J*| of the runs that hold all constraints, median and 95th percentile
gain    the same, as a share of what control is about: (J - J*) / (J_held - J*), J_held the least cost of a held control
        that holds the constraints, where there is one. A run may end within 1e-3 of a scale: its gap may be negative
clean   no exception, no run that does not get to its end, and no warning but those that tell which steps are taken

Each problem has a process of its own and --limit minutes. Rows go to benchmarks/results/strangers.json, problem by
problem; those of problems that are not run are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from independent import Collocation, Guess, Judge, Plan, Run

import nocl
from nocl.cli.commands import QUICK_PROOF
from nocl.cli.run_folder import RunFolder
from nocl.data import Solution
from nocl.solvers import CND, DDP, NMPC, solve_globally

EXAMPLES = {path.stem: path for path in sorted((provenance.ROOT / "examples").glob("*.py"))}
RESULTS = provenance.RESULTS / "strangers.json"
STEPS_TOLD = ("implicit Radau", "so they are taken", "are taken, and")  # in warnings that say no more than that
FRESH = 1000  # more than the seed of training: initial states that it has not seen
SHOWN = 200  # letters of what went wrong, in the table
WIDE = 12  # states, from which on more time is allowed
GOALS = {"gap median": 1e-3, "gap p95": 0.02, "minutes": 3.0, "minutes above 12 states": 20.0}


# Optima


def plan_of(s: Solution, i: int) -> Plan:
    return Plan(s.t[i], s.x[i], s.u[i])


class Optimum:
    """The best known from one state after the other, by three methods, each confirmed by LSODA."""

    def __init__(self, ocp: nocl.OCP, p: np.ndarray, starts: int) -> None:
        self.ocp, self.starts = ocp, starts
        self.judge = Judge(ocp, p)
        self.collocation = Collocation(self.judge)
        self.given = {"p": p} if ocp.np else {}

    def plans(self, x0: np.ndarray) -> dict[str, tuple[Solution | None, str]]:
        """Of NMPC and DDP, from all states x0 [n, nx]; None and what was raised."""
        nmpc = NMPC(self.ocp, starts=self.starts, between=bool(self.ocp.held))
        methods = {
            "NMPC": lambda: nmpc.solve(x0, workers=1, progress=False, **self.given),
            "DDP": lambda: solve_globally(DDP(self.ocp), x0, starts=2 * self.starts, rounds=2, progress=False,
                                          **self.given)}
        return {name: _tried(method) for name, method in methods.items()}

    def runs(self, x0: np.ndarray, i: int, plans: dict[str, tuple[Solution | None, str]],
             more: list[Guess]) -> dict[str, Run]:
        """Each method's, from the i-th state; `more` are guesses of collocation beside the methods' plans."""
        found, guesses = {}, [*more, Guess.straight(self.ocp, self.judge.p, x0)]
        for name, (solution, error) in plans.items():
            if solution is None or not solution.success[i]:
                found[name] = Run(why=error or str(solution.message[i]) if solution is not None else error)
                continue
            found[name] = self.judge.plan(plan_of(solution, i))
            guesses.append(Guess.of_plan(plan_of(solution, i)))
        found["collocation"] = self.collocation.best(self.judge, x0, guesses)
        return found

    def held(self, x0: np.ndarray) -> float:
        """The least cost of controls that are held and hold the constraints; inf where there are none."""
        s, costs = self.ocp.system, [np.inf]
        if self.ocp.is_free:
            return np.inf
        for u in (self.ocp.goals(self.judge.p[None])[1][0], s.lbu, (s.lbu + s.ubu) / 2, s.ubu):
            plan = Plan(np.array([0.0, self.ocp.longest]), np.array([x0, x0]), u[None])
            run = self.judge.followed(plan, np.zeros((1, s.nu, s.nx)))
            costs += [run.cost] * run.holds
        return min(costs)


def _tried(method: Any) -> tuple[Solution | None, str]:
    try:
        return method(), ""
    except Exception as error:  # of a stranger's problem anything may be raised, and is told
        return None, f"{type(error).__name__}: {error}"


def best_of(runs: dict[str, Run]) -> tuple[str, float]:
    """(method, cost) of the best run that holds; ("", inf) where there is none."""
    holding = {name: run.cost for name, run in runs.items() if run.holds}
    return min(holding.items(), key=lambda one: one[1]) if holding else ("", np.inf)


# One problem


def check(name: str, seed: int, starts: int) -> dict[str, Any]:
    """The costs of one initial state by three methods, each as LSODA has them, and what was wrong."""
    ocp, row = nocl.load_ocp(EXAMPLES[name]), {"problem": name}
    p, x0 = ocp.sample_parameters(1, seed)[0], ocp.initial_states.sample(1, seed)
    begin, of = time.perf_counter(), Optimum(ocp, p, starts)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        plans = of.plans(x0)
    solved = time.perf_counter() - begin
    for method, run in of.runs(x0[0], 0, plans, []).items():
        claimed = plans[method][0].cost[0] if method in plans and plans[method][0] is not None else None
        row[method] = {"cost": run.cost, "violation": run.violation, "of": run.of, "why": run.why, "claimed": claimed,
                       "T": None if run.t is None else float(run.t[-1])}
    return row | {"held": of.held(x0[0]), "seconds": [round(solved), round(time.perf_counter() - begin - solved)],
                  "warnings": sorted({str(one.message) for one in told})}


def shown(row: dict[str, Any]) -> str:
    """What `check` found, in lines."""
    lines = [f"{row['problem']}  ({row['seconds'][0]} s of NMPC and DDP, {row['seconds'][1]} s of collocation; a held "
             f"control {row['held']:.6g})"]
    for method in ("NMPC", "DDP", "collocation"):
        one = row[method]
        claimed = "" if one["claimed"] is None else f" (says {one['claimed']:.6g})"
        what = f"violates {one['of']!r} by {one['violation']:.2g}" if one["violation"] > 1e-3 else ""
        lines.append(f"  {method:12} {one['cost']:.7g}{claimed}  {one['why'] or what}")
    return "\n".join([*lines, *(f"  warning: {text}" for text in row["warnings"])])


def trained(ocp: nocl.OCP, args: argparse.Namespace, row: dict[str, Any]) -> CND | None:
    """The controller by nocl's own route, or None; what goes wrong, and how long it takes, stands in the row."""
    begin, busy, wrong, cnd = time.perf_counter(), _cpu(), row["wrong"], None
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        stages = RunFolder(ocp, Path(folder), args.seed, args.effort, None if ocp.is_free else args.minutes)
        try:
            cnd = stages.train(exact=True)
            row.update(_taken(begin, busy))
            stages.export(cnd, Path(folder) / "export", ("casadi", "c"), QUICK_PROOF)
        except Exception as error:
            wrong.append(f"{type(error).__name__}: {error}")
            traceback.print_exc()
    if cnd is None:
        row.update(_taken(begin, busy))
    texts = sorted({str(one.message) for one in told if issubclass(one.category, UserWarning)})
    row["told"] = [text for text in texts if any(words in text for words in STEPS_TOLD)]
    wrong += [text for text in texts if text not in row["told"]]
    return cnd


def _cpu() -> float:
    return sum(of.ru_utime + of.ru_stime for of in map(resource.getrusage,
                                                       (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def _taken(begin: float, busy: float) -> dict[str, float]:
    return {"wall minutes": (time.perf_counter() - begin) / 60, "cpu minutes": (_cpu() - busy) / 60}


def judged(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """The whole row of one problem."""
    ocp = nocl.load_ocp(EXAMPLES[name])
    row: dict[str, Any] = {"problem": name, "states": ocp.system.nx, "controls": ocp.system.nu, "wrong": [],
                           "effort": args.effort, "minutes": args.minutes, "n": args.n, "commit": provenance.STARTED}
    cnd = trained(ocp, args, row)
    if cnd is None:
        return row | {"clean": False}
    p = ocp.sample_parameters(args.n, args.seed + FRESH)
    x0, runs, best, held, by = ocp.initial_states.sample(args.n, args.seed + FRESH), [], [], [], Counter()
    policy = cnd.to_casadi()
    for rows in ([slice(0, args.n)] if not ocp.np else [slice(i, i + 1) for i in range(args.n)]):
        of = Optimum(ocp, p[rows][0], args.starts)
        plans = of.plans(x0[rows])
        for i, x in enumerate(x0[rows]):
            runs.append(of.judge.feedback(policy, x))
            own = [Guess.of_run(runs[-1])] if runs[-1].ends else []
            method, cost = best_of(of.runs(x, i, plans, own))
            by[method or "nobody"] += 1
            best.append(cost)
            held.append(of.held(x))
    row |= numbers(runs, np.array(best), np.array(held)) | {"best by": dict(by)}
    row["wrong"] += sorted({run.why for run in runs if not run.ends})
    return row | {"clean": not row["wrong"]}


def numbers(runs: list[Run], best: np.ndarray, held: np.ndarray) -> dict[str, Any]:
    """Gaps of the runs that hold, beside confirmed optima; violations of all that end."""
    J, ends, holds = (np.array([getattr(run, name) for run in runs]) for name in ("cost", "ends", "holds"))
    counted = holds & np.isfinite(best)
    lost, worst = (J - best)[counted], [run for run in runs if run.ends]
    about = (held - best)[counted]
    sensible = np.isfinite(about) & (about > 1e-3 * np.abs(best[counted]))
    worst.sort(key=lambda run: -run.violation)
    return {**_quantiles("gap", lost / np.abs(best[counted])), **_quantiles("gain", (lost / about)[sensible]),
            "unfinished": int((~ends).sum()), "violating": float((ends & ~holds).mean()),
            "worst violation": worst[0].violation if worst else None, "of": worst[0].of if worst else "",
            "no optimum": int((~np.isfinite(best)).sum()),
            "costs": [[_number(cost), _number(least), run.violation if run.ends else None]
                      for cost, least, run in zip(J, best, runs, strict=True)]}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _quantiles(name: str, share: np.ndarray) -> dict[str, float | None]:
    values = [float(np.median(share)), float(np.quantile(share, 0.95))] if len(share) else [None, None]
    return dict(zip((f"{name} median", f"{name} p95"), values, strict=True))


# All of them


def in_a_process(name: str, words: list[str], limit: float) -> dict[str, Any]:
    """The row that a process of its own writes; one that is late is ended, and costs this row alone."""
    with tempfile.TemporaryDirectory() as folder:
        path, log = Path(folder) / "row.json", Path(folder) / "log"
        command = [sys.executable, "-u", __file__, name, *words, "--row", str(path)]
        with log.open("w") as out:
            child = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)
            try:
                child.wait(60 * limit)
            except subprocess.TimeoutExpired:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
                return _failed(name, f"not done within {limit:g} minutes; the last it said: {_last(log)}")
        if not path.exists():
            return _failed(name, f"the process ended with {child.returncode}: {_last(log)}")
        return json.loads(path.read_text())


def _failed(name: str, why: str) -> dict[str, Any]:
    return {"problem": name, "clean": False, "wrong": [why], "commit": provenance.STARTED}


def _last(log: Path) -> str:
    return " ".join(log.read_text().split())[-400:]


def kept() -> dict[str, Any]:
    """Rows of former calls, by problem."""
    return json.loads(RESULTS.read_text())["rows"] if RESULTS.exists() else {}


def table(rows: dict[str, Any]) -> str:
    """In markdown, and how many meet what is wanted."""
    head = ("problem", "states", "clean", "min (wall / CPU)", "gap % median / p95", "of the gain %", "violating",
            "worst violation", "what went wrong")
    lines = [f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
    for name, row in sorted(rows.items()):
        wrong = "; ".join(row["wrong"]).replace("|", "/").replace("\n", " ")
        violating = "" if row.get("violating") is None else f"{100 * row['violating']:.0f} %"
        worst = "" if row.get("worst violation") is None else f"{row['worst violation']:.2g} {row['of']}"
        minutes = _pair(row, "{} minutes", 1, "wall", "cpu")
        gap, gain = (_pair(row, f"{of} {{}}", 100, "median", "p95") for of in ("gap", "gain"))
        cells = (name, str(row.get("states", "")), "yes" if row["clean"] else "no", minutes, gap, gain, violating,
                 worst, wrong if len(wrong) < SHOWN else wrong[:SHOWN] + " ...")
        lines.append(f"| {' | '.join(cells)} |")
    clean, met = sum(row["clean"] for row in rows.values()), sum(map(wanted, rows.values()))
    return "\n".join([*lines, "", f"clean: {clean} of {len(rows)}; all that is wanted: {met}"])


def _pair(row: dict[str, Any], form: str, times: float, *words: str) -> str:
    values = [row.get(form.format(word)) for word in words]
    return "" if None in values else " / ".join(f"{times * value:.3g}" for value in values)


def wanted(row: dict[str, Any]) -> bool:
    """Whether a row meets the goals."""
    limit = GOALS["minutes above 12 states" if row.get("states", 0) > WIDE else "minutes"]
    return bool(row["clean"] and row.get("gap median") is not None and row["gap median"] <= GOALS["gap median"]
                and row["gap p95"] <= GOALS["gap p95"] and row["wall minutes"] <= limit and row["violating"] <= 0.01)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAMES", help=f"of examples/: {', '.join(EXAMPLES)}; default: all")
    parser.add_argument("--minutes", type=float, help="of training; default: as long as default settings take")
    parser.add_argument("--effort", default="normal", choices=("quick", "normal", "best"))
    parser.add_argument("--n", type=int, default=16, help="fresh initial states")
    parser.add_argument("--starts", type=int, default=4, help="of NMPC for each optimum, twice as many of DDP")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=90.0, help="minutes after which a problem is given up")
    parser.add_argument("--check", action="store_true", help="one state by NMPC, DDP and collocation, nothing is kept")
    parser.add_argument("--table", action="store_true", help="print the rows that are kept, and run nothing")
    parser.add_argument("--row", type=Path, help=argparse.SUPPRESS)  # of a process for one problem
    args = parser.parse_args()
    if unknown := [name for name in args.names if name not in EXAMPLES]:
        parser.error(f"there is no example {', '.join(unknown)}; expected some of {', '.join(EXAMPLES)}")
    return args


def main() -> None:
    args = arguments()
    if args.table:
        return print(table(kept()))
    if args.row is not None:
        (name,) = args.names
        row = check(name, args.seed, args.starts) if args.check else judged(name, args)
        args.row.write_text(json.dumps(row))
        return None
    words = [word for word in sys.argv[1:] if word not in args.names]
    for name in args.names or EXAMPLES:
        row = in_a_process(name, words, args.limit)
        if args.check:
            print(shown(row) if "NMPC" in row else f"{name}: {row['wrong'][0]}", flush=True)
            continue
        rows = kept() | {name: row}
        provenance.write("strangers", rows, goals=GOALS)
        print(table({name: row}), flush=True)
    return None


if __name__ == "__main__":
    main()
