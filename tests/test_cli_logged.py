"""A plant without equations at the command line: its log -> dynamics -> controller; what needs equations says so."""

import re

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import nocl
from nocl.cli.commands import main
from nocl.judge import simulate
from nocl.solvers.cnd import CND, TrainSettings
from nocl.sysid.identification import LearnedDynamics, LogSettings

PLANT = """import casadi as ca
import nocl

p, v, u = (ca.SX.sym(name) for name in "pvu")
plant = nocl.System("plant", x=ca.vertcat(p, v), u=u, xdot={xdot}, lbu=[-2], ubu=[2], lbx=[-2, -4], ubx=[2, 4])
ocp = nocl.OCP.quadratic(plant, horizon=2.0, x_goal=[0, 0], u_goal=[0], R=0.1,
                         initial_states=nocl.Gaussian(mean=[0.5, 0], std=[0.1, 0.1]))
"""
EXACT = "ca.vertcat(v, -4 * p - 0.4 * v + u)"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """plant.py without equations, exact.py with them, log.csv: five recordings under random held controls."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LogSettings, "EFFORT", {"quick": {"width": 6, "iterations": 40, "steps": 4, "window": 20}})
    monkeypatch.setattr(TrainSettings, "EFFORT", {"quick": {
        "seeds": 2, "starts": 2, "states": 12, "tails": 60, "visits": 40, "rounds": 1, "iterations": 80,
        "value_initial": 10, "value_tails": 60, "value_visits": 40, "value_iterations": 40, "held_out": 4}})
    (tmp_path / "plant.py").write_text(PLANT.format(xdot=None))
    (tmp_path / "exact.py").write_text(PLANT.format(xdot=EXACT))
    rng, h = np.random.default_rng(0), 0.05
    step = expm(np.array([[0.0, 1.0, 0.0], [-4.0, -0.4, 1.0], [0.0, 0.0, 0.0]]) * h)
    lines = ["run,t,p,v,u"]
    for run in range(5):
        x = rng.uniform(-1, 1, 2)
        for k in range(60):
            u, noisy = rng.uniform(-2, 2), x + 0.005 * rng.standard_normal(2)
            lines.append(f"{run},{h * k:.3f},{noisy[0]:.6f},{noisy[1]:.6f},{u:.6f}")
            x = step[:2, :2] @ x + step[:2, 2] * u
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:plant. the controller costs", "ignore:plant. V is")  # a tiny training
def test_from_a_log_to_a_controller_and_a_refusal(here, capsys):
    """identify -> train on the plant's name and box alone; the controller works on the equations that nobody showed."""
    assert main(["identify", "plant.py", "--data", "log.csv", "--quick", "--out", "run"]) == 0
    out = capsys.readouterr().out
    assert "5 pieces of 5 recordings" in out
    assert re.search(r"the optimum of the model of four fifths, on that of all: f_theta loses [\d.e-]+ % of what", out)
    model = LearnedDynamics.load(here / "run" / "dynamics")
    at = ca.DM([0.4, -0.3]), ca.DM([0.5])
    np.testing.assert_allclose(model.to_casadi()(*at).full().ravel(), [-0.3, -4 * 0.4 + 0.4 * 0.3 + 0.5], atol=0.1)
    assert main(["train", "plant.py", "--quick", "--out", "run"]) == 0
    out = capsys.readouterr().out
    assert "dynamics: taken from run/dynamics" in out
    assert "training on learned dynamics" in out
    cnd = CND.load(here / "run" / "cnd")
    assert cnd.ocp.system.xdot is None
    exact = nocl.load_ocp("exact.py")
    x0 = exact.initial_states.sample(3, 5)
    steered = simulate(exact, cnd, x0).cost
    assert (steered < 0.95 * simulate(exact, lambda x, t: np.zeros((len(x), 1)), x0).cost).all()

    before = sorted(here.rglob("*"))
    for command in ("compare run", "compare run --methods CND", "run plant.py --out run --quick"):
        assert main(command.split()) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.count("\n") == 1
        assert "the equations of 'plant' are not known (xdot=None)" in said.err
        assert "give that System its equations" in said.err
    assert sorted(here.rglob("*")) == before
