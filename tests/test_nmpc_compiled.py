"""Programs are built once: in memory by their content, on disk as compiled code."""

import os

import pytest

import nocl
from nocl.solvers import NMPC
from nocl.solvers.nmpc.solver import shared_program
from nocl.solvers.nmpc.transcription import Transcription


def counted(monkeypatch):
    """How often a nonlinear program is written out."""
    built, program = [], Transcription.program.func
    monkeypatch.setattr(Transcription, "program", property(lambda self: built.append(1) or program(self)))
    return built


def test_equal_problems_share_a_program(monkeypatch):
    """Two loads of one problem are two objects, and one program; what differs is built anew."""
    built = counted(monkeypatch)
    first = NMPC(nocl.load_ocp("pendulum"), 13, starts=1)
    assert first.solve([3.0, 0.0]).success[0]
    again = NMPC(nocl.load_ocp("pendulum"), 13, starts=4)
    assert again.program.solver is first.program.solver
    assert len(built) == 1
    others = [NMPC(nocl.load_ocp("pendulum"), 14), NMPC(nocl.load_ocp("pendulum"), 13, options={"fatrop.tol": 1e-7}),
              NMPC(nocl.load_ocp("pendulum"), 13, horizon=1.0, terminal=first.ocp.G)]
    assert len({first.key, *(other.key for other in others)}) == 4


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
def test_compiled_code_is_built_once_and_agrees(tmp_path, monkeypatch, solver):
    built, folder = counted(monkeypatch), tmp_path / "cache"
    ocp, x0 = nocl.load_ocp("pendulum"), [[3.0, 0.0], [3.2, 0.1]]
    options = {"intervals": 10, "starts": 2, "solver": solver, "substeps": 1, "compiled": folder}
    fast = NMPC(ocp, **options)
    solution = fast.solve(x0, gains=True)
    assert [p.suffix for p in folder.iterdir()] == [".so"]
    assert len(built) == 1
    shared_program.cache_clear()  # as in another process
    assert (NMPC(nocl.load_ocp("pendulum"), **options).solve(x0).u == solution.u).all()
    assert len(built) == 1
    plain = NMPC(ocp, 10, starts=2, substeps=1, solver=solver).solve(x0, gains=True)
    assert solution.cost == pytest.approx(plain.cost, rel=1e-9)
    assert solution.gain == pytest.approx(plain.gain, abs=1e-5)


def test_the_environment_names_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NOCL_CACHE", str(tmp_path / "named"))
    assert NMPC(nocl.load_ocp("double_integrator"), 6, starts=1, compiled=True).solve([1.0, 0.0]).success[0]
    assert len(os.listdir(tmp_path / "named")) == 1


def test_failures_of_compiled_programs_are_told(tmp_path):
    from test_nmpc import walled

    solution = NMPC(walled(u_max=0.1), 8, starts=1, compiled=tmp_path).solve([1.0, -3.0])
    assert "infeasible" in solution.message[0]


@pytest.mark.parametrize("compiled", [None, 3, ""])
def test_bad_compiled(compiled):
    with pytest.raises(ValueError, match=r"compiled \(True, False, or a folder\) is"):
        NMPC(nocl.load_ocp("double_integrator"), 6, compiled=compiled)
