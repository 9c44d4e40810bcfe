"""What learned dynamics lose: against Riccati's answers on a plant that is not what was learned."""

import importlib
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from lq import A, B, riccati

import nocl
from nocl.cli import main, run_folder
from nocl.cli.commands import parser
from nocl.comparisons.learned import ModelLoss, Yardstick, good_enough, held_out_loss, model_loss
from nocl.sysid import Settings
from nocl.systems import double_integrator

learned = importlib.import_module("nocl.comparisons.learned")
K, T = 20, 2.0


def model_of(mass):
    """The double integrator of another mass, in closed form, that claims to be that of 1 kg."""
    model = nocl.identify(double_integrator.system(mass=mass), progress=False)
    return replace(model, system=double_integrator.system())


def costs(x0, mass):
    """Of Riccati's feedback for a mass, on the plant of 1 kg, held on K intervals."""
    R, P, h = 0.01 * np.eye(1), np.eye(2), T / K
    gains = riccati(A, B / mass, R, P, T, K)[1]
    _, _, F, G = riccati(A, B, R, P, T, K)
    x, J = x0, np.zeros(len(x0))
    for k in range(K):
        u = x @ gains[k].T
        J += h * 0.01 * u[:, 0] ** 2
        x = x @ F.T + u @ G.T
    return J + np.square(x).sum(axis=1)


def test_a_wrong_mass_loses_what_riccati_says():
    yard = Yardstick.of(nocl.load_ocp("double_integrator"), 4, K)
    best, wrong = costs(yard.starts.x, 1.0), costs(yard.starts.x, 1.5)
    assert yard.best == pytest.approx(best, rel=1e-6)
    loss, _ = yard.loss(model_of(1.5))
    assert loss.gaps == pytest.approx(wrong / best - 1, rel=1e-3)
    assert loss.lost * yard.gain == pytest.approx(wrong - best, rel=1e-3)
    assert loss.gap > 0.01
    assert "of what control is about (median" in str(loss)
    assert f"gap {100 * loss.gap:.2g} %" in str(loss)


def test_a_model_of_some_recordings_loses_on_that_of_all_what_riccati_says():
    """The plant itself is not known."""
    of = nocl.load_ocp("double_integrator")
    s = of.system
    unknown = nocl.System(s.name, x=s.x, u=s.u, xdot=None, lbu=s.lbu, ubu=s.ubu, lbx=s.lbx, ubx=s.ubx)
    ocp = replace(of, system=unknown)
    loss = held_out_loss(ocp, model_of(1.0), model_of(1.5), n=4, intervals=K)
    yard = Yardstick.of(of, 4, K)
    assert loss.gaps == pytest.approx(costs(yard.starts.x, 1.5) / costs(yard.starts.x, 1.0) - 1, rel=1e-3)
    assert abs(held_out_loss(ocp, model_of(1.0), model_of(1.0), n=4, intervals=K).gap) < 1e-6


def test_the_right_mass_loses_nothing_and_is_left_alone():
    ocp, model = nocl.load_ocp("double_integrator"), model_of(1.0)
    best, loss = good_enough(ocp, model, 2e-4, Settings(), intervals=K)
    assert best is model
    assert abs(loss.gap) < 1e-6


def test_a_plant_that_is_not_known_is_refused():
    ocp = nocl.load_ocp("double_integrator")
    unknown = nocl.System("plant", x=ocp.system.x, u=ocp.system.u, xdot=None, lbu=[-1], ubu=[1], lbx=[-1] * 2,
                          ubx=[1] * 2)
    problem = nocl.OCP.quadratic(unknown, horizon=1.0, R=1.0, P=1.0, x_goal=[0, 0], u_goal=[0],
                                 initial_states=ocp.initial_states)
    with pytest.raises(ValueError, match="are not known; expected an exact f"):
        model_loss(problem, model_of(1.0))


@pytest.fixture
def taught(monkeypatch):
    """Models are numbers, of a loss each; what was done to them is written down."""
    done = []

    class Yard:
        starts = None

        def loss(self, model):
            return ModelLoss(np.array([model]), np.array([model])), None

    def along(_, model, *rest):
        done.append("refined")
        return model * along.factor

    def anew(_, *, settings, **rest):
        done.append(f"width {settings.width}")
        return 1e-3

    monkeypatch.setattr(learned.Yardstick, "of", lambda *args, **options: Yard())
    monkeypatch.setattr(learned, "_along", along)
    monkeypatch.setattr(learned, "identify", anew)
    monkeypatch.setattr(learned, "_has_networks", lambda model: True)
    monkeypatch.setattr(learned, "_wider", lambda model, settings: replace(settings, width=48))
    return along, done


@pytest.mark.parametrize(("factor", "left", "does"), [
    (1e-3, 1e-5, ["refined"]), (0.1, 1e-4, ["refined", "refined"]),
    (0.9, 9e-4, ["refined", "refined", "width 48", "refined"]),
    (2.0, 2e-3, ["refined", "refined", "width 48", "refined"])])
def test_a_model_is_taught_again_until_it_is_good_enough_and_the_best_is_kept(taught, factor, left, does):
    along, done = taught
    along.factor = factor
    best, loss = good_enough(nocl.load_ocp("double_integrator"), 1e-2, 1.01e-3, Settings())
    assert done == does
    assert loss.gap == best == pytest.approx(left)


def test_a_run_says_what_its_dynamics_lose_and_offers_the_exact_ones(tmp_path, monkeypatch, capsys):
    folder = run_folder.RunFolder(nocl.load_ocp("double_integrator"), tmp_path, 0)
    monkeypatch.setattr(run_folder, "good_enough",
                        lambda ocp, model, *rest, **options: (model, ModelLoss(np.array([0.37]), np.array([0.5]))))
    model = model_of(1.0)
    model = replace(model, card={**model.card, run_folder.KEY: {"problem": "x"}})
    better = folder._good_enough(model)
    said = capsys.readouterr().out
    assert "f_theta loses 37 % of what control is about" in said
    assert "--exact trains on the exact f" in said
    assert (better.card["control_loss"], better.card["control_gap"]) == (0.37, 0.5)
    assert json.loads(json.dumps(dict(nocl.LearnedDynamics.load(tmp_path / "dynamics").card)))["control_gap"] == 0.5
    assert folder._good_enough(better) is better


def test_a_row_is_named_by_the_dynamics_that_it_was_trained_on():
    for dynamics, title in (("learned", "CND on f_theta"), ("exact", "CND")):
        assert run_folder.trained_on("CND", SimpleNamespace(card={"dynamics": dynamics})) == title


@pytest.mark.parametrize("command", ["run", "train", "identify"])
def test_minutes_at_the_command_line(command, capsys):
    assert parser().parse_args([command, "pendulum", "--minutes", "2.5"]).minutes == 2.5
    assert parser().parse_args([command, "pendulum"]).minutes is None
    for wrong in ("0", "-1", "soon", "inf"):
        assert main([command, "pendulum", f"--minutes={wrong}"]) == 2
        assert "is not a number of minutes > 0" in capsys.readouterr().err


def test_minutes_of_a_run_are_those_that_identification_leaves(monkeypatch, tmp_path):
    folder = run_folder.RunFolder(nocl.load_ocp("double_integrator"), tmp_path, 0, minutes=5.0, begin=100.0)
    monkeypatch.setattr(run_folder.time, "monotonic", lambda: 160.0)
    assert folder._minutes_left() == 4.0
    assert folder._minutes_left(0.5) == 2.0
    assert folder._made_from()["minutes"] == 5.0
    assert "minutes" not in replace(folder, minutes=None)._made_from()
