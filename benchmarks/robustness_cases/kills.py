"""Kills at random moments: the same call again has the answer of one that nobody killed, and nothing is left behind.

Each run is a process of its own with a folder for its temporary files. It is killed (SIGKILL) after a random part of
the time that a whole run takes, and run again.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

Case = tuple[str, Callable[[], str]]
EARLIEST = 0.4  # of a run: before that it only imports
LONGEST = 120.0  # seconds that a run may take
GONE = 20.0  # seconds that processes of a killed one have to end by themselves

HEAD = """
import os, sys
from pathlib import Path
import numpy as np
import nocl
from nocl.solvers import DDP, NMPC
from nocl.comparisons import compare
from nocl.support.fingerprint import sha256
out = Path(sys.argv[1])
ocp = nocl.load_ocp("double_integrator")
x0 = ocp.initial_states.sample(12, 0)
def said(*arrays):
    print(sha256(*(np.ascontiguousarray(a).tobytes() for a in arrays)))
"""
RUNS = {
    "NMPC": (12, "s = NMPC(ocp, 20, starts=4, passes=1).solve(x0, out=out / 'run', workers=1, progress=False)\n"
                 "said(s.cost, s.u)"),
    "NMPC in processes": (6, "s = NMPC(ocp, 20, starts=4, passes=1).solve(x0, out=out / 'run', workers=2, "
                             "progress=False)\nsaid(s.cost, s.u)"),
    "DDP": (10, "x0 = ocp.initial_states.sample(9000, 0)\n"
                "s = DDP(ocp, intervals=40, threads=1).solve(x0, out=out / 'run', workers=1, progress=False)\n"
                "said(s.cost, s.u)"),
    "comparison": (8, "law = nocl.pretrained('double_integrator')\n"
                      "nmpc = NMPC(ocp, 20, starts=1, passes=0)\n"
                      "r = compare(ocp, {'CND': law, 'NMPC': nmpc}, x0=x0, out=out / 'run', progress=False)\n"
                      "said(np.array([row['cost'] for row in r.rows()]))"),
    "export": (10, "law = nocl.pretrained('double_integrator')\n"
                   "law.to_c(out / 'c'); law.save(out / 'law'); law.export(out / 'export', ['casadi'], against=[])\n"
                   "said(nocl.CND.load(out / 'law')(x0), *(np.frombuffer(p.read_bytes(), np.uint8)\n"
                   "     for p in sorted((out / 'c').glob('*.[ch]'))))"),
    "kernel cache": (8, "s = DDP(ocp, intervals=12, threads=1, cache=out / 'cache').solve(x0, workers=1)\n"
                        "said(s.cost, np.array([len(list((out / 'cache').iterdir()))]))"),
}
PRETRAINED = "pendulum"  # where the double integrator has no controller that comes with nocl


def script(lines: str) -> str:
    code = HEAD + lines + "\n"
    if "pretrained" in lines:
        code = code.replace('"double_integrator"', f'"{PRETRAINED}"').replace("'double_integrator'", f"'{PRETRAINED}'")
    return code


def started(code: str, place: Path) -> subprocess.Popen[bytes]:
    temporary = place / "tmp"
    temporary.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "TMPDIR": str(temporary), "OMP_NUM_THREADS": "1"}
    environment.pop("NOCL_CACHE", None)
    with (place / "out").open("w") as out, (place / "err").open("w") as err:  # pipes would wait for workers, too
        return subprocess.Popen([sys.executable, "-c", code, str(place)], stdout=out, stderr=err, env=environment,
                                cwd=place, start_new_session=True)


def whole(code: str, place: Path) -> str:
    """What a run says that nobody kills."""
    process = started(code, place)
    if process.wait(timeout=LONGEST):
        raise ValueError(f"exit {process.returncode}: {(place / 'err').read_text()[-500:]}")
    return (place / "out").read_text().strip().splitlines()[-1]


def left(place: Path, session: int) -> str:
    """What is there that nobody needs: temporary files, parts of files, locks, processes."""
    parts = [p for p in place.rglob("*") if p.name.endswith(".part") or p.name.startswith(".export.") or
             p.name == ".nocl-lock"]
    parts += list((place / "tmp").iterdir())
    end = time.monotonic() + GONE
    while (alive := processes(session)) and time.monotonic() < end:
        time.sleep(0.1)
    return ", ".join([str(p.relative_to(place)) for p in parts] + [f"process {p}" for p in alive])


def processes(session: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                after = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it ended
                continue
            if int(after[3]) == session and after[0] != "Z":
                found.append(int(entry.name))
    return found


@dataclass(frozen=True, eq=False)
class Run:
    """A run, and what it says and takes when nobody kills it; that is found out when it is first asked for."""

    code: str
    place: Path

    @cached_property
    def right(self) -> str:
        return whole(self.code, self.place / "whole")

    @cached_property
    def usual(self) -> float:
        """Seconds, once everything has been read from the disk before."""
        right, begin = self.right, time.perf_counter()
        if whole(self.code, self.place / "again") != right:
            raise ValueError("two runs that nobody killed differ")
        return time.perf_counter() - begin

    def killed(self, number: int, part: float) -> str:
        after, place = part * self.usual, self.place / str(number)
        process = started(self.code, place)
        try:
            process.wait(timeout=after)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        again = whole(self.code, place)
        rest = left(place, process.pid)
        if again != self.right:
            return f"killed after {after:.2f} s: another answer"
        return f"killed after {after:.2f} s: left {rest}" if rest else ""


def kinds(rng: np.random.Generator, folder: Path) -> Iterator[tuple[str, list[Case]]]:
    for kind, (n, lines) in RUNS.items():
        run, parts = Run(script(lines), folder / kind.replace(" ", "-")), rng.uniform(EARLIEST, 1.0, n)
        yield kind, [(f"kill {i}", partial(run.killed, i, float(part))) for i, part in enumerate(parts)]
