"""nocl.train beside do-mpc's ApproxMPC: the same problems, the same minutes, one judge that is neither's.

    python benchmarks/approx_mpc.py fishing quadruple_tank --python PYTHON     # one with do-mpc 5.1.2
    python benchmarks/approx_mpc.py --table                                    # the rows that are kept, in markdown

do-mpc is asked for what nocl is asked for: the cheapest way from (x, t) to the end of the horizon T. Its laws know no
time, so the time to go is a state of its model, constant over a plan, and a plan's time is counted in shares of it:
"intervals" held controls up to T from wherever it starts, so its law is u(x, T - t). Running costs are one more state,
integrated by do-mpc's own collocation, since do-mpc sums point values. All else is its default or its example's:
AMPCSampler's sampling, a network of three layers of 50, MSE, Adam, the example's schedule of learning rates.

nocl.train has --minutes of wall-clock time; do-mpc then has as many minutes of CPU as that took, its workers included
(a shared machine's clock counts its neighbours): on two idle cores, more of wall-clock time than nocl's. It has them
twice, once for each way of sampling, and the better one counts:
box     AMPCSampler as it is: uniform in a box, here that of optimal runs from 32 initial states, a tenth wider
tube    AMPCSampler, its plan overwritten: states of those runs with their times, moved by up to a tenth of the box
The runs are nocl's NMPC's and are not counted: do-mpc gets them as a gift. Half of its minutes go into samples, the
rest into training.

All laws then act as continuous feedback from the same fresh initial states under benchmarks/independent.py's LSODA.
"gap" is (J - J*) / |J*| as in benchmarks/strangers.py, J* the best that NMPC, DDP and collocation find from several
starts, those of all three laws' runs among them. "closer" is do-mpc's gap over nocl's; a gap of nocl's below RESOLUTION
counts as that. Rows go to benchmarks/results/approx_mpc.json, those of problems that are not run are kept.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from joblib.externals.loky import get_reusable_executor

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from independent import Guess, Run
from strangers import EXAMPLES, FRESH, Optimum, _cpu, _taken, best_of, numbers

import nocl
from nocl.solvers import NMPC

DO_MPC = "5.1.2"
WAYS = ("box", "tube")
RUNS, STATES, ROOM = 32, 10_000, 0.1  # of the tube; the third as a share of its box
RESOLUTION = 1e-5  # of |J*|: no gap is known better
LEAST = 0.02  # of the horizon, the shortest time to go that do-mpc samples
DEFAULT = ("fishing", "quadruple_tank", "exothermic_reactor", "hiv_therapy", "pendulum", "cartpole")


# The problem in words of do-mpc


def bounds_of(ocp: nocl.OCP) -> dict[str, list[float]]:
    """Of states, along the way and at the end; ValueError for what do-mpc's bounds do not express."""
    s = ocp.system
    if ocp.is_free or ocp.is_infinite or ocp.np or ocp.uses_time:
        raise ValueError(f"{s.name}: only fixed horizons without parameters and times are compared")
    found = {f"{side} {where}": [sign * np.inf] * s.nx for side, sign in (("low", -1), ("high", 1)) for where in
             ("x", "end")}
    for where, held in (("x", ocp.held), ("end", (*ocp.held, *ocp.held_at_end))):
        for one in held:
            i = [ca.is_equal(one.expression, x, 2) for x in ca.vertsplit(s.x)].index(True)
            for side in ("low", "high"):
                found[f"{side} {where}"][i] = float(getattr(one, side))
    return found


def tube_of(ocp: nocl.OCP, seed: int, starts: int) -> tuple[np.ndarray, float]:
    """Nodes (x, time to go) of optimal runs [n, nx + 1], and a usual |J|."""
    found = NMPC(ocp, starts=starts).solve(ocp.initial_states.sample(RUNS, seed), workers=1, progress=False)
    z = [np.c_[found.x[i], found.t[i][-1] - found.t[i]] for i in np.flatnonzero(found.success)]
    return np.vstack(z), float(np.mean(np.abs(found.cost[found.success])))


def task_of(ocp: nocl.OCP, args: argparse.Namespace) -> dict[str, Any]:
    """All that do-mpc's side is told, but its way and minutes."""
    s, bounds = ocp.system, bounds_of(ocp)
    tube, usual = tube_of(ocp, args.seed, args.starts)
    x = tube[:, :-1]
    room = ROOM * np.ptp(x, axis=0) + 1e-6
    low = np.maximum(np.maximum(x.min(axis=0) - room, s.lbx), bounds["low x"])
    high = np.minimum(np.minimum(x.max(axis=0) + room, s.ubx), bounds["high x"])
    rng = np.random.default_rng(args.seed)
    z = tube[rng.integers(len(tube), size=STATES)]
    z[:, :-1] = np.clip(z[:, :-1] + rng.uniform(-room, room, (STATES, s.nx)), low, high)
    z[:, -1] = np.maximum(z[:, -1], LEAST * ocp.horizon)
    return {"nx": s.nx, "nu": s.nu, "T": float(ocp.horizon), "intervals": args.intervals, "seed": args.seed,
            "usual cost": usual, "size": np.maximum(abs(low), abs(high)).tolist(), "least": LEAST,
            "size of u": np.maximum(abs(s.lbu), abs(s.ubu)).tolist(), "low u": s.lbu.tolist(),
            "high u": s.ubu.tolist(), "low": low.tolist(), "high": high.tolist(), "tube": z.tolist(), **bounds}


def of_do_mpc(ocp: nocl.OCP, task: dict[str, Any], python: str) -> dict[str, Any]:
    """What benchmarks/do_mpc_side.py has learned, in a process of its own."""
    s = ocp.system
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ca.Function("rate", [s.x, s.u], [s.equations, ocp.running]).save(str(folder / "rate.casadi"))
        ca.Function("terminal", [s.x], [ocp.terminal]).save(str(folder / "terminal.casadi"))
        (folder / "task.json").write_text(json.dumps(task))
        side = Path(__file__).with_name("do_mpc_side.py")
        done = subprocess.run([python, side, folder], capture_output=True, text=True, check=False, cwd=folder)
        if done.returncode:
            raise RuntimeError(f"do-mpc's side ended with {done.returncode}: {done.stderr[-2000:]}")
        return json.loads((folder / "law.json").read_text())


def law_of(found: dict[str, Any], task: dict[str, Any]) -> ca.Function:
    """ApproxMPC's network as u(x, t); it is held against its own make_step."""
    law = found["law"]
    z = y = ca.SX.sym("z", task["nx"] + 2)
    y = (y - ca.DM(law["x_shift"])) / ca.DM(law["x_range"])
    for k, (W, b) in enumerate(zip(law["W"], law["b"], strict=True)):
        y = ca.DM(W) @ y + ca.DM(b)
        y = ca.tanh(y) if k + 1 < len(law["W"]) else y
    u = ca.Function("u", [z], [y * ca.DM(law["y_range"]) + ca.DM(law["y_shift"])])
    at, own = found["check"]
    low, high = np.array(task["low u"]), np.array(task["high u"])
    off = abs(np.clip(u(at).full().ravel(), low, high) - own) / (high - low)
    assert off.max() < 1e-5, f"the law differs from make_step by {off.max():.2g} of the box"
    x, t = ca.SX.sym("x", task["nx"]), ca.SX.sym("t")
    left = ca.fmax(task["T"] - t, LEAST * task["T"])
    return ca.Function("law", [x, t], [u(ca.vertcat(x, left, 0))])


# One problem


def judged(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """The whole row of one problem."""
    ocp = nocl.load_ocp(EXAMPLES.get(name, name))
    task = task_of(ocp, args)
    begin, busy = time.perf_counter(), _cpu()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        cnd = nocl.train(ocp, minutes=args.minutes, seed=args.seed, progress=False)
    get_reusable_executor().shutdown()  # what workers took is told once they have ended
    taken = _taken(begin, busy)
    row = {"problem": name, "states": ocp.system.nx, "controls": ocp.system.nu, "commit": provenance.STARTED,
           "seed": args.seed, "n": args.n, "intervals": args.intervals, "minutes": args.minutes,
           "nocl": taken | {"told": sorted({str(one.message) for one in told})}}
    laws = {"nocl": cnd.to_casadi()}
    for way in WAYS:
        found = of_do_mpc(ocp, task | {"way": way, "minutes": taken["cpu minutes"]}, args.python)
        laws[way] = law_of(found, task)
        row[way] = {key: value for key, value in found.items() if key not in ("law", "check")}
    scores = scored(ocp, laws, args)
    for way, score in scores.items():
        row[way] |= score
    return row | compared(row)


def scored(ocp: nocl.OCP, laws: dict[str, ca.Function], args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Each law's gaps from the same fresh states, beside the same optima."""
    x0, of = ocp.initial_states.sample(args.n, args.seed + FRESH), Optimum(ocp, np.zeros(0), args.starts)
    runs = {way: [of.judge.feedback(law, x) for x in x0] for way, law in laws.items()}
    plans, best = of.plans(x0), []
    for i, x in enumerate(x0):
        guesses = [Guess.of_run(one[i]) for one in runs.values() if one[i].ends]
        best.append(best_of(of.runs(x, i, plans, guesses))[1])
    none = np.full(args.n, np.inf)
    return {way: _without_gain(numbers(own, np.array(best), none)) | {"missed": _missed(own)}
            for way, own in runs.items()}


def _without_gain(score: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in score.items() if not key.startswith("gain")}


def _missed(runs: list[Run]) -> list[str]:
    return sorted({run.why for run in runs if not run.ends})


def compared(row: dict[str, Any]) -> dict[str, Any]:
    """How many times closer to the optimum nocl is than do-mpc's better way, which has the lower median."""
    able = [way for way in WAYS if row[way]["gap median"] is not None]
    if not able or row["nocl"]["gap median"] is None:
        return {"better way": able[0] if able else None, "closer": None}
    way = min(able, key=lambda one: row[one]["gap median"])
    of = {of: row[way][f"gap {of}"] / max(row["nocl"][f"gap {of}"], RESOLUTION) for of in ("median", "p95")}
    return {"better way": way, "closer": of}


# All of them


def kept() -> dict[str, Any]:
    path = provenance.RESULTS / "approx_mpc.json"
    return json.loads(path.read_text())["rows"] if path.exists() else {}


def table(rows: dict[str, Any]) -> str:
    """In markdown; percentages of |J*|, median / 95th percentile."""
    head = ("problem", "states", "CPU min each", "nocl: gap %", *(f"do-mpc, {way}: gap %" for way in WAYS),
            *(f"samples, {way}" for way in WAYS), "violating, nocl / box / tube", "times closer")
    lines = [f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
    for name, row in sorted(rows.items()):
        laws = ("nocl", *WAYS)
        gaps = [_pair(100, row[way]["gap median"], row[way]["gap p95"]) for way in laws]
        wrong = " / ".join(f"{100 * row[way]['violating']:.0f} %" for way in laws)
        closer = _pair(1, *row["closer"].values()) if row["closer"] else ""
        cells = (name, str(row["states"]), f"{row['nocl']['cpu minutes']:.2g}", *gaps,
                 *(str(row[way]["solved"]) for way in WAYS), wrong, closer)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _pair(times: float, *values: float | None) -> str:
    return "" if None in values else " / ".join(f"{times * value:.2g}" for value in values)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=DEFAULT, metavar="NAMES", help="of examples/, or bundled")
    parser.add_argument("--python", default=sys.executable, help=f"an interpreter with do-mpc[full]=={DO_MPC}")
    parser.add_argument("--minutes", type=float, default=3.0, help="of nocl.train")
    parser.add_argument("--intervals", type=int, default=40, help="of do-mpc's plans")
    parser.add_argument("--n", type=int, default=16, help="fresh initial states")
    parser.add_argument("--starts", type=int, default=4, help="of NMPC for each optimum, twice as many of DDP")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", action="store_true", help="print the rows that are kept, and run nothing")
    return parser.parse_args()


def main() -> None:
    args = arguments()
    if args.table:
        return print(table(kept()))
    found = subprocess.run([args.python, "-c", "import do_mpc.approximateMPC"], capture_output=True, check=False)
    if found.returncode:
        sys.exit(f"{args.python} has no do-mpc: pip install \"do-mpc[full]=={DO_MPC}\", or name another by --python")
    for name in args.names:
        rows = kept() | {name: judged(name, args)}
        provenance.write("approx_mpc", rows)
        print(table({name: rows[name]}), flush=True)
    return None


if __name__ == "__main__":
    main()
