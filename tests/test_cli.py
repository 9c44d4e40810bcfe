"""The command line: bad input is one line, exit code 2, nothing written; a run's stages go on from where they stand."""

import json
import os
import signal
import subprocess
import sys
import warnings
from dataclasses import asdict
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.cli import run_folder
from nocl.cli.commands import main
from nocl.cli.run_folder import beside
from nocl.exports import parity
from nocl.solvers import NMPC
from nocl.solvers.cnd import CND, TrainSettings
from nocl.sysid.identification import Settings

SYSTEM = """
import casadi as ca
import nocl

p, v, u = (ca.SX.sym(name) for name in "pvu")
cubic = nocl.System("cubic", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u - p**3),
                    lbu=[-3], ubu=[3], lbx=[-2, -2], ubx=[2, 2])
ocp = nocl.OCP.quadratic(cubic, horizon=2.0, x_goal=[0, 0], u_goal=[0],
                         initial_states=nocl.Gaussian(mean=[1, 0], std=[0.1, 0.1]))
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with a good problem, broken ones, and a file where a folder should be."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cubic.py").write_text(SYSTEM)
    (tmp_path / "moving.py").write_text(SYSTEM.replace("u - p**3", "u + 1"))  # its goal is no equilibrium
    (tmp_path / "empty.py").write_text("x = 1\n")
    (tmp_path / "broken.py").write_text("def ocp(:\n")
    (tmp_path / "raises.py").write_text("1 / 0\n")
    (tmp_path / "number.py").write_text("ocp = 3\n")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "report").write_text("mine")
    (tmp_path / "other" / "cnd").mkdir(parents=True)
    (tmp_path / "other" / "cnd" / "cnd.safetensors").write_text("not one")
    return tmp_path


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


BAD = [
    ("", "COMMAND"),
    ("frobnicate", "frobnicate"),
    ("run", "NAME_OR_FILE"),
    ("run nothing_of_the_kind", "no problem 'nothing_of_the_kind'"),
    ("run cartpol", "did you mean 'cartpole'"),
    ("run missing.py", "no file missing.py"),
    ("run notes.txt", "not a .py file"),
    ("run half", "not a .py file"),
    ("run empty.py", "defines no `ocp`"),
    ("run broken.py", "broken.py, line 1"),
    ("run raises.py", "ZeroDivisionError"),
    ("run number.py", "`ocp` is a int"),
    ("run cubic.py --n 0", "at least 1"),
    ("run cubic.py --n -3", "at least 1"),
    ("run cubic.py --n many", "at least 1"),
    ("run cubic.py --seed -1", "at least 0"),
    ("run cubic.py --seed 1.5", "at least 0"),
    ("run cubic.py --intervals 0", "at least 1"),
    ("run cubic.py --intervals 1", "intervals"),
    ("run cubic.py --integrator euler", "invalid choice: 'euler'"),
    ("run cubic.py --methods CND,MAGIC", "cnd, nmpc, lqr, ddp"),
    ("run cubic.py --methods CND,CND", "cnd, nmpc, lqr, ddp"),
    ("run cubic.py --methods=", "cnd, nmpc, lqr, ddp"),
    ("run cubic.py --out notes.txt", "is a file"),
    ("run cubic.py --out notes.txt/deeper", "is a file"),
    ("run cubic.py --out half", "is a file"),
    ("run cubic.py --out other", "cut off"),
    ("run cubic.py --frobnicate", "--frobnicate"),
    ("run cubic.py extra", "extra"),
    ("run moving.py --methods LQR --out new", "LQR"),
    ("identify nothing", "no problem"),
    ("identify cubic.py --out notes.txt", "is a file"),
    ("train cubic.py --out notes.txt", "is a file"),
    ("solve cubic.py --solver magic", "magic"),
    ("solve cubic.py --out notes.txt", "is a file"),
    ("export missing", "no folder missing"),
    ("export half", "holds no cnd.safetensors"),
    ("export other", "cut off"),
    ("export half --to cobol", "cobol"),
    ("export half --against cobol", "cobol"),
    ("compare missing", "no folder missing"),
    ("compare notes.txt", "no folder notes.txt"),
    ("compare half --hold 0", "at least 1"),
    ("run cubic.py --out=", "no folder's name"),
    ("identify cubic.py --out=", "no folder's name"),
    ("solve cubic.py --out=\0", "no folder's name"),
    ("export other --out=", "no folder's name"),
    ("compare other --out=", "no folder's name"),
    ("run cubic.py --seed 99999999999999999999999", "at most 4611686018427387903"),
    (f"identify cubic.py --seed {2**62}", "at most 4611686018427387903"),
    ("run cubic.py --n 99999999999999999999", "at most 1000000"),
    ("run cubic.py --n 1000001", "at most 1000000"),
    ("run cubic.py --n \uff12", "at least 1"),
    ("run cubic.py --n " + 5000 * "1", "at most 1000000"),
    ("compare half --seed \u0663", "at least 0"),
]


@pytest.mark.parametrize(("line", "said"), BAD)
def test_bad_input_is_one_line_and_nothing_is_written(here, capsys, line, said):
    before = tree(here)
    assert main(line.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("nocl: error: ")
    assert captured.err.count("\n") == 1
    assert said in captured.err
    assert "Traceback" not in captured.err
    assert tree(here) == before


@pytest.mark.parametrize("words", [["identify", "cubic.py", "--out", "  "], ["run", "cubic.py", "--out", ""],
                                   ["export", ""], ["compare", "\t"], ["export", "half", "--out", " "],
                                   ["compare", "half", "--out", " "]])
def test_a_blank_folder_is_not_the_current_one(here, capsys, words):
    before = tree(here)
    assert main(words) == 2
    assert "is no folder's name" in capsys.readouterr().err
    assert tree(here) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_of_others_is_told(here, capsys):
    (here / "theirs").mkdir(mode=0o500)
    assert main(["run", "cubic.py", "--out", "theirs"]) == 2
    assert "cannot be written to" in capsys.readouterr().err


def test_debug_shows_the_traceback(here, capsys):
    assert main(["run", "raises.py", "--debug"]) == 2
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert err.splitlines()[-1].startswith("nocl: error: ")


def test_an_unexpected_error_is_one_line_too(here, capsys, monkeypatch):
    def fails(*args):
        raise RuntimeError("something\nof CasADi's")

    monkeypatch.setattr(run_folder, "solve", fails)
    assert main(["solve", "cubic.py"]) == 2
    assert capsys.readouterr().err == \
        "nocl: error: unexpected RuntimeError: something of CasADi's (--debug shows where)\n"


def test_interruption_is_one_line_and_130(here, capsys, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(run_folder, "identify", interrupted)
    assert main(["run", "cubic.py"]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_help_needs_neither_torch_nor_matplotlib():
    code = ("import sys; from nocl.cli import main\ntry: main(['--help'])\nexcept SystemExit as end: code = end.code\n"
            "sys.exit(code or any(m in sys.modules for m in ('torch', 'matplotlib', 'scipy', 'tqdm')))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0
    for word in ("list", "run", "identify", "train", "solve", "export", "compare"):
        assert word in done.stdout


@pytest.mark.parametrize("command", ["run", "identify", "train", "solve", "export", "compare", "list"])
def test_each_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert "usage: nocl " + command in capsys.readouterr().out


def test_list(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:]] == list(nocl.systems.NAMES)
    assert lines[1].split()[1:4] == ["4", "1", "4"]


def test_version(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"nocl {nocl.__version__}\n"


@pytest.mark.parametrize("solver", ["nmpc", "ddp", "lqr"])
def test_solve_writes_solutions(here, capsys, solver):
    assert main(["solve", "cubic.py", "--solver", solver, "--n", "2", "--intervals", "10", "--out", "new"]) == 0
    assert f"2 of 2 {'simulated' if solver == 'lqr' else 'solved'}" in capsys.readouterr().out
    with np.load(here / "new" / "solutions" / f"{solver}.npz", allow_pickle=False) as data:
        np.testing.assert_array_equal(data["x0"], nocl.load_ocp("cubic.py").initial_states.sample(2, 1))
        assert data["success"].all()
        assert data["cost"].shape == (2,)
        assert np.isfinite(data["x"]).all()
    facts = json.loads((here / "new" / "solutions" / f"{solver}.json").read_text())
    assert facts["n"] == 2
    assert solver == "lqr" or all(hits <= starts for hits, starts in zip(facts["hits"], facts["starts"], strict=True))


def test_an_interrupted_solve_goes_on(here, monkeypatch):
    """DDP's stages and NMPC's states so far are kept until all is solved."""
    from nocl.solvers.ddp.solver import DDP

    command = ["solve", "cubic.py", "--solver", "ddp", "--n", "4", "--intervals", "9", "--substeps", "1",
               "--workers", "1", "--out", "new"]
    done, left, descend = [], [5], DDP.descend

    def counted(self, batch):
        if left == [len(done)]:
            left.clear()
            raise KeyboardInterrupt
        done.append(len(batch.x0))
        return descend(self, batch)

    monkeypatch.setattr(DDP, "descend", counted)
    assert main(command) == 130
    assert any((here / "new" / "solutions" / "checkpoint").iterdir())
    assert main(command) == 0
    resumed, done[:] = sum(done), []
    assert main([*command[:-1], "again"]) == 0
    assert resumed == sum(done)  # nothing was solved twice
    assert not (here / "new" / "solutions" / "checkpoint").exists()
    with np.load(here / "new" / "solutions" / "ddp.npz") as a, np.load(here / "again" / "solutions" / "ddp.npz") as b:
        np.testing.assert_array_equal(a["u"], b["u"])


FAST = """import casadi as ca
import nocl
x, z, u = ca.SX.sym("x"), ca.SX.sym("z"), ca.SX.sym("u")
lag = nocl.System("lag", x=ca.vertcat(x, z), u=u, xdot=ca.vertcat(z, 60 * (u - z)), lbu=[-1], ubu=[1], lbx=[-3, -2],
                  ubx=[3, 2])
ocp = nocl.OCP(lag, horizon=4.0, running=0.1 * u**2, terminal=5 * x**2 + z**2, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Gaussian(mean=[1, 0], std=[0.1, 0.1]))
"""
WALL = """import casadi as ca
import nocl
p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
mass = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-3, -3], ubx=[3, 3])
ocp = nocl.OCP(mass, horizon=4.0, running=0.1 * u**2, terminal=p**2 + v**2, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Gaussian(mean=[0.5, 1.5], std=[1e-3, 1e-3]), path_constraints={"wall": 1 - p})
"""


@pytest.mark.parametrize("solver", ["nmpc", "ddp"])
def test_solve_takes_the_substeps_that_the_plant_asks_for(here, capsys, solver):
    (here / "lag.py").write_text(FAST)
    command = ["solve", "lag.py", "--solver", solver, "--n", "2", "--intervals", "40", "--workers", "1"]
    with pytest.warns(UserWarning, match="so they are taken|are taken, and plan and plant agree"):
        assert main([*command, "--out", "own"]) == 0
    with np.load(f"own/solutions/{solver}.npz") as found:
        np.testing.assert_allclose(found["judged_cost"], found["cost"], rtol=1e-3)
        cost = found["cost"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main([*command, "--substeps", "16", "--out", "given"]) == 0
        assert main([*command, "--substeps", "2", "--integrator", "radau", "--out", "implicit"]) == 0
    for folder in ("given", "implicit"):
        with np.load(f"{folder}/solutions/{solver}.npz") as found:
            np.testing.assert_allclose(found["cost"], cost, rtol=1e-3)


@pytest.mark.parametrize("option", ["--substeps=2", "--integrator=radau"])
def test_solve_refuses_steps_for_a_method_without(here, capsys, option):
    assert main(["solve", "double_integrator", "--solver", "lqr", "--n", "2", option, "--out", "new"]) == 2
    assert f"--solver lqr makes no plans on a grid and takes no {option.split('=')[0]}" in capsys.readouterr().err


@pytest.mark.parametrize("solver", ["nmpc", "ddp"])
def test_solve_fails_where_nothing_was_solved(here, capsys, solver):
    """Braking from 1.5 takes 1.125, and the wall is 0.5 away."""
    (here / "wall.py").write_text(WALL)
    assert main(["solve", "wall.py", "--solver", solver, "--n", "2", "--intervals", "20", "--out", "new"]) == 2
    out, err = capsys.readouterr()
    assert f"{solver}: 0 of 2 solved" in out
    assert err.splitlines()[-1].startswith(f"nocl: error: {solver} solved none of 2 initial states; of the first: ")
    assert ("'wall'" if solver == "ddp" else "infeasible") in err
    assert err.count("nocl: ") == 1  # beside progress, where that takes long
    assert Path(f"new/solutions/{solver}.npz").exists()


@pytest.mark.parametrize("workers", ["0", "two", "-1"])
def test_bad_workers_are_refused(here, capsys, workers):
    assert main(["solve", "cubic.py", "--workers", workers]) == 2
    assert "workers" in capsys.readouterr().err


SMALL = TrainSettings(seeds=3, starts=2, states=6, tails=30, visits=20, rounds=0, iterations=40, value_initial=5,
                      value_tails=30, value_iterations=20, held_out=4, hidden=(8,))


def small(monkeypatch):
    monkeypatch.setattr(TrainSettings, "EFFORT", {"quick": asdict(SMALL)})
    monkeypatch.setattr(Settings, "EFFORT", {"quick": {"iterations": 20, "polish": 2, "samples": 500}})


RUN = ["run", "cubic.py", "--out", "out", "--quick", "--n", "2", "--intervals", "10"]


@pytest.mark.slow
def test_training_takes_the_steps_that_are_asked_for(here, monkeypatch):
    small(monkeypatch)
    train = ["train", "cubic.py", "--exact", "--out", "out", "--quick", "--intervals", "10"]
    assert main([*train, "--integrator", "radau"]) == 0
    assert CND.load(here / "out" / "cnd").card["integrator"] == "radau"


@pytest.mark.slow
def test_a_run_from_a_users_file_to_its_report(here, capsys, monkeypatch):
    small(monkeypatch)
    assert main(RUN) == 0
    out = capsys.readouterr().out
    run = here / "out"
    assert "report: out/report/report.html" in out
    assert "Within 5 % of the best known cost of 2 initial states: CND" in out
    assert {p.name for p in run.iterdir()} == {"dynamics", "cnd", "export", "report"}
    functions = ("policy", "gain", "closed_loop", "value", "value_gradient", "dynamics")
    assert {p.name for p in (run / "export").iterdir()} == {"c", "c_float32", "parity.json",
                                                            *(f"{name}.casadi" for name in functions)}
    proof = json.loads((run / "export" / "parity.json").read_text())
    assert proof["ok"]
    assert {f["part"] for f in proof["findings"]} == set(functions)
    assert {f["backend"] for f in proof["findings"]} == {"native CasADi", "ONNX Runtime", "ONNX imported", "C"}
    cnd = CND.load(run / "cnd")
    policy = ca.Function.load(str(run / "export" / "policy.casadi"))
    x = np.array([1.0, 0.1])
    np.testing.assert_allclose(policy(x, 0.5).full().ravel(), cnd(x, 0.5), rtol=1e-12)
    rows = json.loads((run / "report" / "summary.json").read_text())["summary"]
    assert [row["method"] for row in rows] == ["CND on f_theta", "NMPC", "reference"]

    before = {p: p.stat().st_mtime_ns for part in ("dynamics", "cnd") for p in (run / part).iterdir()}
    assert main([*RUN[:-3], "3", "--intervals", "10", "--methods", "cnd,lqr"]) == 0  # the same, on other states
    out = capsys.readouterr().out
    assert "dynamics: taken from out/dynamics" in out
    assert "controller: taken from out/cnd" in out
    assert {p: p.stat().st_mtime_ns for p in before} == before

    with monkeypatch.context() as patch:  # an export that fails does not cost the report
        patch.setitem(parity.LIMITS, "float64", 0.0)
        assert main([*RUN[:-3], "2", "--intervals", "10"]) == 0  # what does not pass is left out
        out, err = capsys.readouterr()
        assert "differs from torch" in out + err
        assert "report: out/report/report.html" in out

    damaged = run / "dynamics" / "dynamics.safetensors"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:50])
    before = {p: p.stat().st_mtime_ns for p in (run / "export").rglob("*")}
    assert main(["export", "out"]) == 2  # and nothing of what stands there is written anew
    assert {p: p.stat().st_mtime_ns for p in (run / "export").rglob("*")} == before
    damaged.write_bytes(whole)
    capsys.readouterr()

    assert main([*RUN, "--seed", "1", "--exact"]) == 0
    out = capsys.readouterr().out
    assert "controller: training on the exact dynamics (what is there was made for another" in out
    assert CND.load(run / "cnd").card["seed"] == 1

    before, changed = tree(run), run.stat().st_mtime_ns
    assert main(["compare", "out", "--n", "2", "--methods", "CND,DDP", "--hold", "20", "--out", "elsewhere"]) == 0
    assert (tree(run), run.stat().st_mtime_ns) == (before, changed)  # not even for a while
    assert not (here / "elsewhere" / "checkpoint").exists()
    out = capsys.readouterr().out
    assert "CND (20 holds)" in out  # trained on the exact dynamics by now
    assert "on 2 initial states, drawn with seed 2" in out  # one more than that of the run
    assert main(["compare", "out", "--n", "2", "--methods", "CND", "--seed", "7"]) == 0
    assert "drawn with seed 8" in capsys.readouterr().out
    assert (here / "elsewhere" / "report.html").is_file()
    assert main(["export", "out", "--to", "onnx", "--against", "casadi", "--out", "source"]) == 0
    assert {p.name for p in (here / "source").iterdir()} == {"onnx", "parity.json"}
    assert "parity ok: policy" in capsys.readouterr().out


@pytest.mark.slow
def test_a_controller_that_no_run_made_is_not_overwritten(here, capsys, monkeypatch):
    small(monkeypatch)
    ocp = nocl.load_ocp("cubic.py")
    nocl.train(ocp, settings=SMALL, progress=False).save("mine/cnd")
    before = tree(here)
    assert main(["run", "cubic.py", "--out", "mine", "--quick"]) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert tree(here) == before


@pytest.mark.slow
def test_an_interrupted_run_goes_on_from_the_last_finished_stage(here, capsys, monkeypatch):
    small(monkeypatch)
    with monkeypatch.context() as patched:
        def interrupted(*args, **options):
            raise KeyboardInterrupt

        patched.setattr(NMPC, "solve", interrupted)
        assert main(RUN) == 130
    assert not (here / "out" / "report").exists()
    capsys.readouterr()
    assert main(RUN) == 0
    out = capsys.readouterr().out
    assert "controller: taken from out/cnd" in out
    assert (here / "out" / "report" / "report.html").is_file()


def test_a_comparison_works_where_its_report_goes(here):
    assert beside(here / "run" / "report", here / "run") == here / "run"
    assert beside(Path("run/report"), here / "run") == here / "run"
    assert beside(here / "running", here / "run") == here / "running"


def test_output_that_cannot_be_printed(here):
    """A full disk and a closed output are one line, or none, and never a traceback."""
    def listed(redirection):
        return subprocess.run(f"{sys.executable} -m nocl list {redirection}", shell=True, cwd=here, text=True,
                              stderr=subprocess.PIPE, check=False)

    full = listed("> /dev/full")
    assert full.returncode == 2
    assert full.stderr.startswith("nocl: error: the output: No space left on device; make room")
    assert full.stderr.count("\n") == 1
    for fine in (">&-", "| head -n 1 > first"):
        assert not listed(fine).stderr


@pytest.mark.slow
def test_ctrl_c_in_a_real_process(here):
    process = subprocess.Popen([sys.executable, "-m", "nocl", "run", "cartpole", "--out", "out"],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=here)
    assert process.stdout.readline().startswith("dynamics: learning")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("nocl: interrupted")
    assert not list((here / "out").rglob("*.part"))
