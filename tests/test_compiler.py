"""One compiler: $CC as it is named, libraries checked before they are loaded, damaged ones built again."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.exports import bundle
from nocl.exports.c_code import load, to_c
from nocl.solvers import NMPC
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.solvers.nmpc.solver import shared_program
from nocl.support import compiler
from nocl.translate.kernels import Kernel

ROOT = Path(__file__).resolve().parents[1]
SOURCE = """
#include "lanes.h"
void run(int64_t first, int64_t last, const int64_t *index, double *y) { for (int i = 0; i < 3; ++i) y[i] = 41 + i; }
"""
CHILD = """
import sys
import numpy as np
from nocl.translate.kernels import Kernel
for cache in sys.argv[2:]:
    y = np.zeros(3)
    Kernel(sys.argv[1], cache)("run", np.arange(1), y)
    print(y.tolist())
"""
BUILDS = """
import os, sys
from pathlib import Path
from nocl.support import compiler
def build(folder):
    print(compiler.own_folder(), flush=True)
    sys.stdin.read()
compiler.shared_library("slow", [], build, sys.argv[1])
"""


def answer(cache) -> list[float]:
    y = np.zeros(3)
    Kernel(SOURCE, cache)("run", np.arange(1), y)
    return y.tolist()


def child(*caches: Path) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", CHILD, SOURCE, *map(str, caches)], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, cwd=ROOT)


def test_the_compiler_keeps_its_arguments_everywhere(tmp_path, monkeypatch):
    log = tmp_path / "calls"
    wrapper = tmp_path / "my cc"
    wrapper.write_text(f'#!/bin/sh\necho "$@" >> "{log}"\nexec gcc "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("CC", f"'{wrapper}' -DNAMED=1")
    assert compiler.command() == (str(wrapper), "-DNAMED=1")
    x = ca.SX.sym("x")
    to_c(ca.Function("f", [x], [2 * x], ["x"], ["y"]), tmp_path / "c", bounds={"x": (-1, 1)})
    ocp = nocl.load_ocp("double_integrator")
    for build in (lambda: answer(tmp_path / "cache"), lambda: load(tmp_path / "c")(0.5),
                  lambda: NMPC(ocp, 5, starts=1, compiled=tmp_path / "cache").solve([1.0, 0.0])):
        log.write_text("")
        build()
        calls = [call for call in log.read_text().splitlines() if call != "--version"]
        assert calls
        assert all(call.startswith("-DNAMED=1 ") for call in calls)


@pytest.mark.parametrize(("cc", "looked"), [("nosuchcc -m64", "CC=nosuchcc"), ("", "gcc, cc")])
def test_a_missing_compiler_is_missing_for_all(tmp_path, monkeypatch, cc, looked):
    x = ca.SX.sym("x")
    to_c(ca.Function("f", [x], [2 * x], ["x"], ["y"]), tmp_path / "c", bounds={"x": (-1, 1)})
    monkeypatch.setenv("CC", cc)
    if not cc:
        monkeypatch.setenv("PATH", "")
    ocp = nocl.load_ocp("double_integrator")
    for user in (lambda: answer(tmp_path), lambda: load(tmp_path / "c"),
                 lambda: NMPC(ocp, 7, compiled=tmp_path).solve([1.0, 0.0])):
        with pytest.raises(compiler.NoCompilerError, match=rf"no C compiler found \(looked for {looked}\): inst"):
            user()
    assert looked in bundle.missing_backends()["c"]


@pytest.mark.parametrize(("cc", "message"), [("gcc 'open", "close its quotes"), ("FILE", "cannot be run")])
def test_what_is_no_command_is_told(tmp_path, monkeypatch, cc, message):
    file = tmp_path / "FILE"
    file.write_bytes(b"\x7fELF and then nothing")
    file.chmod(0o755)
    monkeypatch.setenv("CC", cc.replace("FILE", str(file)))
    with pytest.raises(compiler.NoCompilerError, match=message):
        answer(tmp_path)


def test_ddp_does_without_what_cannot_be_run(monkeypatch, tmp_path):
    from nocl.solvers.ddp import without_compiler
    from nocl.solvers.ddp.solver import DDP

    monkeypatch.setenv("CC", "nosuchcc")
    without_compiler.say_once.cache_clear()
    with pytest.warns(UserWarning, match="looked for CC=nosuchcc"):
        assert isinstance(DDP(nocl.load_ocp("pendulum"), intervals=4).kernel, NumpyKernel)


def damages(content: bytes) -> dict[str, bytes]:
    middle, text = len(content) // 2, content.index(b"\x7fELF") + 64
    flipped = [content[:at] + bytes([content[at] ^ 4]) + content[at + 1:] for at in (4, 24, text, middle)]
    return {"empty": b"", "cut in the header": content[:40], "cut in half": content[:middle],
            "last byte missing": content[:-1], "one byte more": content + b"\0", "no ELF": b"x" * len(content),
            "zeros": bytes(len(content)), **{f"bit {i} flipped": c for i, c in enumerate(flipped)}}


def test_damaged_entries_are_built_again_and_never_loaded(tmp_path):
    """In a process of its own: if a damaged one were loaded, a signal would end it."""
    assert answer(tmp_path / "first") == [41, 42, 43]
    whole, = (tmp_path / "first").iterdir()
    content = whole.read_bytes()
    caches = []
    for i, damaged in enumerate(damages(content).values()):
        caches.append(tmp_path / str(i))
        caches[-1].mkdir()
        (caches[-1] / whole.name).write_bytes(damaged)
        assert compiler.whole_of(caches[-1], whole.name.rpartition("-")[0]) is None
    some = caches[::2]  # each is compiled again
    out, err = child(*some).communicate(timeout=300)
    assert out.split("\n")[:-1] == ["[41.0, 42.0, 43.0]"] * len(some), err
    for cache in some:
        assert [(p.name, p.read_bytes()) for p in cache.iterdir()] == [(whole.name, content)]


def test_two_processes_repair_a_damaged_entry_at_once(tmp_path):
    answer(tmp_path)
    whole, = tmp_path.iterdir()
    content = whole.read_bytes()
    os.replace(whole, tmp_path / "aside")  # a new file: this process has the whole one mapped
    whole.write_bytes(content[: len(content) // 3])
    (tmp_path / "aside").unlink()
    running = [child(tmp_path) for _ in range(3)]
    assert [p.communicate(timeout=300)[0].strip() for p in running] == ["[41.0, 42.0, 43.0]"] * 3
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [(whole.name, content)]


def test_a_damaged_program_of_nmpc_is_built_again(tmp_path):
    ocp, x0 = nocl.load_ocp("double_integrator"), [1.0, 0.0]
    first = NMPC(ocp, 9, starts=1, compiled=tmp_path).solve(x0)
    whole, = tmp_path.iterdir()
    content = whole.read_bytes()
    whole.rename(tmp_path / "aside")
    whole.write_bytes(content[:-9] + b"123456789")
    (tmp_path / "aside").unlink()
    shared_program.cache_clear()  # as in another process
    assert NMPC(ocp, 9, starts=1, compiled=tmp_path).solve(x0).cost == first.cost
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [content]


def test_a_kill_while_building_leaves_no_trace(tmp_path):
    """The cache is as it was at once, and the folder of the dead process goes with the next process that builds."""
    command = [sys.executable, "-c", BUILDS, str(tmp_path / "cache")]
    builder, other = (subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
                      for _ in range(2))
    left, living = (Path(p.stdout.readline().strip()) for p in (builder, other))
    builder.send_signal(signal.SIGKILL)
    builder.wait(timeout=300)
    assert left.is_dir()
    assert not (tmp_path / "cache").exists()
    compiler.remove_left()
    assert not left.exists()
    assert living.is_dir()  # its process lives
    other.communicate(timeout=300)
    assert not living.exists()


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ValueError, match=rf"{file}.*name another"):
        answer(file / "cache")
