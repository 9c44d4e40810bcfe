"""What a killed process leaves is cleared away by the next one; what was damaged meanwhile is found again."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import nocl
from nocl.solvers import NMPC
from nocl.support import atomic, compiler, pool
from nocl.support.atomic import part_of, remove_parts, write_bytes

WORKER = """
import os, sys, time
from nocl.support.pool import _end_with
child = os.fork()
if not child:
    _end_with(os.getppid())
    time.sleep(60)
print(child, flush=True)
time.sleep(60)
"""


def dead() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def part(path, process, host=atomic.HOST):
    other = part_of(path)
    name = other.name.replace(f"-{os.getpid()}-", f"-{process}-").replace(atomic.HOST, host)
    return other.with_name(name)


def test_parts_of_dead_processes_go_with_the_next_write(tmp_path):
    path, gone = tmp_path / "a.json", dead()
    left, folder = part(path, gone), part(path, gone)
    stays = [part(path, os.getpid()), part(path, gone, "0" * 12), part(tmp_path / "b.json", gone),
             tmp_path / ".a.json.part"]
    folder.mkdir()
    (folder / "inside").write_text("")
    for other in (left, *stays):
        other.write_text("half")
    write_bytes(path, b"whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, *stays])  # a living one's, another machine's and file's, others
    remove_parts(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([path, *stays[:2], stays[3]])


def test_a_worker_ends_with_the_process_that_it_works_for():
    parent = subprocess.Popen([sys.executable, "-c", WORKER], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    os.kill(child, 0)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    for _ in range(600):
        try:
            with open(f"/proc/{child}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":  # nobody has asked for its end yet
                    return
        except FileNotFoundError:
            return
        time.sleep(0.1)
    pytest.fail("the worker lives on")


def test_folders_for_libraries_go_with_their_process(tmp_path, monkeypatch):
    """Also where it was killed before its lock was there, or after that was gone."""
    monkeypatch.setattr(compiler.tempfile, "tempdir", str(tmp_path))
    left, lives, older = (tmp_path / f"{compiler.OWN}{name}" for name in (
        f"{atomic.HOST}-{dead()}-abc", f"{atomic.HOST}-{os.getpid()}-abc", "abc"))
    for folder in (left, lives, older):
        folder.mkdir()
        (folder / "library.so").write_text("")
    compiler.remove_left()
    assert set(tmp_path.iterdir()) == {lives, older}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(solve, folder, the solution) of a small run."""
    ocp, out = nocl.load_ocp("double_integrator"), tmp_path_factory.mktemp("run") / "out"
    nmpc = NMPC(ocp, 8, starts=1, passes=0)
    x0 = ocp.initial_states.sample(2, 0)

    def solve():
        return nmpc.solve(x0, out=out, workers=1, progress=False)

    return solve, out, solve()


@pytest.mark.parametrize("damage", [lambda b: b"", lambda b: b[:-1], lambda b: b[: len(b) // 2], lambda b: b"x" * 500,
                                    lambda b: b[:300] + bytes([b[300] ^ 1]) + b[301:], lambda b: b[:-pool.DIGEST]])
def test_a_damaged_outcome_is_found_again(run, damage):
    solve, out, right = run
    path = sorted((out / pool.TASKS).iterdir())[0]
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    found = solve()
    assert np.array_equal(found.u, right.u)
    assert path.read_bytes() != damage(whole)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"key": ', "3", "null", "[" * 5000, "{}"])
def test_a_damaged_manifest_is_refused(run, text):
    solve, out, _ = run
    manifest = out / pool.MANIFEST
    whole = manifest.read_text()
    manifest.write_text(text)
    with pytest.raises(ValueError, match=r"manifest\.json cannot be read .*expected the manifest of a run of NMPC"):
        solve()
    manifest.write_text(json.dumps({**json.loads(whole), "key": 3}))
    with pytest.raises(ValueError, match="holds another run"):
        solve()
    manifest.write_text(whole)
