"""One run at a time in a folder; what a killed process leaves behind locks nobody out."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from nocl.cli import main
from nocl.solvers.nmpc.solver import NMPC
from nocl.support.lock import NAME, alone
from nocl.systems import load_ocp

HOLDS = ("import sys, time\nfrom pathlib import Path\nfrom nocl.support.lock import alone\n"
         "with alone(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n")


@pytest.fixture
def other(tmp_path):
    """A process that holds the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().strip() == "held"
    yield process
    process.kill()
    process.wait()


def test_two_runs_in_one_folder_are_told_apart(other, tmp_path):
    with pytest.raises(ValueError, match=rf"another run is at work in {tmp_path} \(process {other.pid}\)"), \
            alone(tmp_path):
        pass
    with alone(tmp_path / "another"):
        pass


def test_a_killed_process_frees_its_folder(other, tmp_path):
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert (tmp_path / NAME).exists()
    with alone(tmp_path):
        assert (tmp_path / NAME).read_text() == str(os.getpid())
    assert not (tmp_path / NAME).exists()


def test_threads_that_come_at_once_get_the_folder_one_at_a_time(tmp_path):
    inside, refused, most = [], [], []

    def work():
        for _ in range(200):
            try:
                with alone(tmp_path):
                    inside.append(1)
                    most.append(len(inside))
                    time.sleep(0)
                    inside.pop()
            except ValueError:
                refused.append(1)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1
    assert len(most) + len(refused) == 800


def test_a_solver_refuses_a_folder_in_which_another_is_at_work(tmp_path):
    ocp, out = load_ocp("double_integrator"), tmp_path / "run"
    x0 = ocp.initial_states.sample(2, 0)
    nmpc = NMPC(ocp, 10, starts=1, passes=0)
    first = nmpc.solve(x0, out=out, progress=False)
    with alone(out), pytest.raises(ValueError, match="another run is at work"):
        nmpc.solve(x0, out=out, progress=False)
    again = nmpc.solve(x0, out=out, progress=False)
    assert (again.cost == first.cost).all()


def test_folders_in_which_nothing_was_written_go_again(tmp_path):
    """Those that the lock made, and no others."""
    (tmp_path / "mine").mkdir()
    with alone(tmp_path / "mine" / "a" / "b"):
        pass
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]
    with alone(tmp_path / "mine" / "a" / "b"):
        (tmp_path / "mine" / "a" / "kept").touch()
    assert {path.name for path in tmp_path.rglob("*")} == {"mine", "a", "kept"}


def test_a_folder_that_cannot_be_made_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot be written .*name another one"), alone(tmp_path / "file" / "run"):
        pass


@pytest.mark.parametrize("words", [["solve", "double_integrator", "--n", "1"], ["run", "double_integrator", "--quick"],
                                   ["identify", "double_integrator"], ["train", "double_integrator", "--exact"]])
def test_a_command_in_a_folder_where_another_is_at_work_says_so(tmp_path, capsys, words):
    folder = tmp_path / "solutions" if words[0] == "solve" else tmp_path
    with alone(folder):
        assert main([*words, "--out", str(tmp_path)]) == 2
    assert "another run is at work" in capsys.readouterr().err
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == []  # nothing was written
