"""Logs: reading and refusing, smoothing, and models that are learned from noisy trajectories."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
import torch
from scipy.linalg import expm

import nocl
from nocl.cli.commands import main
from nocl.solvers.ddp.solver import DDP
from nocl.sysid.identification import LearnedDynamics, LogSettings, identify
from nocl.sysid.logs.coverage import Coverage
from nocl.sysid.logs.derivatives import dataset, noise
from nocl.sysid.logs.log import Log
from nocl.sysid.logs.validation import validate
from nocl.systems import cartpole, pendulum

FAST = LogSettings(width=6, iterations=30, steps=4, window=20)


def oscillator(known: bool = True) -> nocl.System:
    """p'' = -4 p - 0.4 p' + u"""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    xdot = ca.vertcat(v, -4 * p - 0.4 * v + u) if known else None
    return nocl.System("oscillator", x=ca.vertcat(p, v), u=u, xdot=xdot, lbu=[-2], ubu=[2], lbx=[-2, -4], ubx=[2, 4])


A, B = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([[0.0], [1.0]])


def linear_log(system: nocl.System, sigma: float, runs: int = 8, K: int = 75, h: float = 0.05, seed: int = 0) -> Log:
    """Runs of the oscillator under random held controls, exact between samples, normal noise on the states."""
    rng, M = np.random.default_rng(seed), expm(np.block([[A, B], [np.zeros((1, 3))]]) * h)
    x, u = np.zeros((runs, K + 1, 2)), rng.uniform(-2, 2, (runs, K + 1, 1))
    x[:, 0] = rng.uniform(-1, 1, (runs, 2))
    for k in range(K):
        x[:, k + 1] = x[:, k] @ M[:2, :2].T + u[:, k] @ M[:2, 2:].T
    x += sigma * rng.standard_normal(x.shape)
    return Log.of(system, np.tile(h * np.arange(K + 1), runs), x.reshape(-1, 2), u.reshape(-1, 1),
                  run=np.repeat(np.arange(runs), K + 1))


@pytest.fixture(scope="module")
def log() -> Log:
    return linear_log(oscillator(), 0.02)


@pytest.fixture(scope="module")
def model(log) -> LearnedDynamics:
    return identify(oscillator(False), data=log, known={"p": "v"}, control_affine=True, settings=FAST, progress=False)


def rows(n: int = 50, seed: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform(-1, 1, (n, 2))), torch.from_numpy(rng.uniform(-2, 2, (n, 1)))


# reading

@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_round_trip(kind, log, tmp_path):
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    again = Log.read(log.write(tmp_path / f"log.{kind}"), oscillator())
    assert len(again.runs) == len(log.runs)
    for a, b in zip(again, log, strict=True):
        assert a.run == b.run
        np.testing.assert_array_equal(a.t, b.t)
        np.testing.assert_array_equal(a.x, b.x)
        np.testing.assert_array_equal(a.u, b.u)


def write(path, text):
    path.write_text(text)
    return path


GOOD = "t,p,v,u\n" + "".join(f"{0.1 * k:.1f},{k},{-k},0\n" for k in range(8))


@pytest.mark.parametrize(("text", "message"), [
    (GOOD.replace("t,p,v,u", "t,p,w,u"), "no column v"),
    (GOOD.replace("0.3,3", "0.1,3"), "time goes from 0.2 to 0.1 at sample 3"),
    (GOOD.replace("0.3,3", "0.3,three"), "column 'p' holds what is no number"),
    (GOOD.replace("t,p,v,u", "t,p,p,u"), "occurs more than once"),
    (GOOD + "0.9,1\n", "line 10 has 2 cells"),
    ("t,p,v,u\n0,1,2,3\n0.1,1,2,3\n", "no piece of the 2 samples has 5 in a row"),
    (GOOD.replace("t,p,v,u", "t,p,v,u,dp/dt").replace(",0\n", ",0,1\n"), "expected all of dp/dt, dv/dt"),
    ("", "no column t, p, v, u")])
def test_bad_files_are_refused(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Log.read(write(tmp_path / "log.csv", text), oscillator())


def test_wrong_arrays_are_refused():
    s, t = oscillator(), np.arange(6.0)
    with pytest.raises(ValueError, match=r"x has shape \(6, 3\); expected \(6, 2\)"):
        Log.of(s, t, np.zeros((6, 3)), np.zeros(6))
    with pytest.raises(ValueError, match="run has shape"):
        Log.of(s, t, np.zeros((6, 2)), np.zeros(6), run=[1, 2])
    with pytest.raises(ValueError, match=r"no \.csv or \.parquet"):
        Log.read("log.txt", s)
    with pytest.raises(ValueError, match="time of sample 2 is nan"):
        Log.of(s, [0, 1, np.nan, 3, 4, 5], np.zeros((6, 2)), np.zeros(6))


def test_a_log_of_another_system_is_refused(log):
    with pytest.raises(ValueError, match="the log has p, v, u; 'cartpole' has"):
        identify(cartpole.system(), data=log)


def test_missing_samples_leave_holes_and_missing_controls_cut():
    s, n = oscillator(), 30
    x, u = np.arange(2.0 * n).reshape(n, 2), np.zeros(n)
    x[7, 1], u[15] = np.nan, np.nan
    first, second = Log.of(s, np.arange(n), x, u)
    assert (len(first), len(second)) == (16, 14)  # the control after sample 15 is not known
    assert np.isnan(first.x[7, 1])
    assert first.x[7, 0] == 14
    assert len(first.u) == 15


def test_a_gap_in_time_cuts_and_short_pieces_are_counted():
    t = np.r_[np.arange(10.0), 20 + np.arange(10.0), 40, 41]
    log = Log.of(oscillator(), t, np.zeros((22, 2)), np.zeros(22))
    assert [len(r) for r in log] == [10, 10]
    assert log.left_out == 2
    assert "2 pieces of 1 recording" in repr(log)


def test_angles_are_unwrapped():
    s = pendulum.system()
    theta = np.linspace(0, 12, 60)
    log = Log.of(s, np.arange(60) * 0.1, np.column_stack([np.angle(np.exp(1j * theta)), np.ones(60)]), np.zeros(60))
    np.testing.assert_allclose(log.runs[0].x[:, 0], theta, atol=1e-12)


def test_split_is_by_recording(log):
    train, test = log.split(0.25, seed=1)
    assert not {r.run for r in train} & {r.run for r in test}
    assert len(test.runs) == 2
    assert len(train) + len(test) == len(log)


# smoothing

def test_smoothing_finds_the_noise_and_the_derivative():
    t, rng = np.arange(400) * 0.02, np.random.default_rng(0)
    x = np.column_stack([np.sin(2 * t), 2 * np.cos(2 * t)])
    log = Log.of(oscillator(), t, x + 0.01 * rng.standard_normal(x.shape), np.zeros(400))
    assert noise(log) == pytest.approx([0.01, 0.01], rel=0.25)  # 5 standard deviations of 3.5 %; 6 % go with the curve
    xdot = dataset(log).xdot
    middle = t[:-1] + 0.01
    exact = np.column_stack([2 * np.cos(2 * middle), -4 * np.sin(2 * middle)])
    differences = np.diff(log.runs[0].x, axis=0) / 0.02  # off by 0.01 sqrt(2) / 0.02 = 0.7
    assert (xdot - exact)[20:-20].std() < 0.1 * (differences - exact)[20:-20].std()


def test_logged_derivatives_are_used():
    t = np.arange(20.0)
    log = Log.of(oscillator(), t, np.zeros((20, 2)), np.zeros(20), xdot=np.full((20, 2), 7.0))
    np.testing.assert_array_equal(dataset(log).xdot, 7.0)


# learning

def test_a_linear_system_from_noisy_logs(model):
    """A and B, as the linear part of f_theta over the logged states, to 6 % of the largest: noise is 4 % of x."""
    x, u = rows(400)
    x = x * torch.tensor([0.4, 0.8])
    z = torch.cat([x, u], 1).numpy()
    fitted = np.linalg.lstsq(z, model(x, u)[:, 1].numpy(), rcond=None)[0]
    np.testing.assert_allclose(fitted, [-4, -0.4, 1], atol=0.25)  # off by 0.02 to 0.11, by the log's noise
    A_B = np.hstack([A, B])
    error = model(x, u).numpy() - z @ A_B.T
    assert np.sqrt(np.square(error).mean()) < 0.2 * (z @ A_B.T).std()  # 0.02 to 0.07 of it


def test_simulation_error_beats_derivatives(log, model):
    first = identify(oscillator(False), data=log, known={"p": "v"}, control_affine=True, progress=False,
                     settings=dataclasses.replace(FAST, steps=0))
    test = linear_log(oscillator(), 0.0, runs=4, seed=9)
    before, after = (m.validate(test, (1, 20, 50)).relative for m in (first, model))
    assert after[1] < before[1]  # 4 to 10 times as near after 20 steps, 3 to 10 times after 50, by the log's noise
    assert after[2] < before[2]


def test_known_rows_are_exact_and_control_affine_is(model):
    x, u = rows()
    torch.testing.assert_close(model(x, u)[:, 0], x[:, 1], atol=0, rtol=0)
    low, middle, high = (model(x, torch.full_like(u, v)) for v in (-2, 0, 2))
    torch.testing.assert_close(low + high, 2 * middle, atol=1e-12, rtol=0)
    assert "d p/dt = v" in model.structure
    assert "affine in the controls" in model.structure


def test_same_seed_same_model(log, model):
    again = identify(oscillator(False), data=log, known={"p": "v"}, control_affine=True, settings=FAST, progress=False)
    assert torch.equal(again(*rows()), model(*rows()))


def test_saved_and_loaded(model, tmp_path):
    model.save(tmp_path)
    again = LearnedDynamics.load(tmp_path)
    assert torch.equal(again(*rows()), model(*rows()))
    assert again.system.xdot is None
    assert repr(again) == repr(model)
    far = np.array([[0.0, 0.0], [9.0, 0.0]])
    np.testing.assert_array_equal(again.outside(far), model.outside(far))


def test_an_unknown_plant_says_so(model):
    with pytest.raises(ValueError, match=r"validate\(log\)"):
        model.score()
    with pytest.raises(ValueError, match="equations of 'oscillator' are not known"):
        _ = model.system.f
    ocp = nocl.load_ocp("double_integrator")
    unknown = dataclasses.replace(ocp, system=dataclasses.replace(ocp.system, xdot=None))
    with pytest.raises(ValueError, match="equations of 'double_integrator' are not known"):
        DDP(unknown)
    assert "equations not known" in repr(model.system)


def test_a_problem_on_the_learned_system(model):
    system = model.to_system()
    x, u = rows()
    got = system.f(x.numpy().T, u.numpy().T).full().T
    np.testing.assert_allclose(got, model(x, u).numpy(), atol=1e-12)
    assert system.names == model.system.names


def test_a_problem_on_the_plant_itself_is_solved_on_the_model(model):
    """The same optimum from xdot=None with dynamics=model, and from the learned system's equations."""
    costs = []
    for system, dynamics in ((model.system, model), (model.to_system(), None)):
        ocp = nocl.OCP.quadratic(system, horizon=1.0, x_goal=[0, 0], u_goal=[0],
                                 initial_states=nocl.Gaussian(mean=[0.5, 0], std=[0.1, 0.1]))
        costs.append(DDP(ocp, intervals=20, dynamics=dynamics).solve([0.5, 0.0]).cost[0])
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_outside_warns(model):
    assert model.outside([[0.0, 0.0], [50.0, 0.0]]).tolist() == [False, True]
    with pytest.warns(UserWarning, match="1 of 2 initial states lie outside the logged data"):
        model.outside([[0.0, 0.0], [50.0, 0.0]], "initial states")


def test_coverage_counts_the_circle():
    s, theta = pendulum.system(), np.linspace(0, 4 * np.pi, 400)
    log = Log.of(s, theta, np.column_stack([theta, np.ones(400)]), np.zeros(400))
    assert Coverage.of(log, s).distance([100 * np.pi, 1.0])[0] < 1


def test_validation_of_the_exact_f(log):
    exact = linear_log(oscillator(), 0.0)
    f = nocl.to_torch(oscillator().f)
    result = validate(f, exact, (1, 10, 1000))
    assert result.steps == (1, 10)  # 1000 is longer than a run
    assert result.rms.max() < 1e-5  # of RK4
    assert result.start == "logged"
    assert result.still[1].max() > 0.1
    assert len(str(result).splitlines()) == 3
    assert result.plot().axes
    assert result.to_data()["steps"] == [1, 10]


def test_settings_and_stated_equations_that_cannot_be(log):
    s = oscillator()
    with pytest.raises(ValueError, match="known has 'q'"):
        identify(s, data=log, known={"q": "v"})
    with pytest.raises(ValueError, match="expected the name of a state or control"):
        identify(s, data=log, known={"p": "w"})
    with pytest.raises(ValueError, match="logs take 'default' only"):
        identify(s, data=log, method="paper")
    with pytest.raises(ValueError, match="takes LogSettings"):
        identify(s, data=log, settings=nocl.sysid.Settings())


@pytest.mark.filterwarnings("ignore:identify. the labels speak against:UserWarning")  # five steps
def test_known_rows_beside_labels():
    s = cartpole.system()
    settings = nocl.sysid.Settings(iterations=5, polish=1, samples=4000, structure=False)
    model = identify(s, known=["p", "theta"], control_affine=True, settings=settings, progress=False)
    data = nocl.Dataset.sample(s, 20, 1)
    got = model(torch.from_numpy(data.x), torch.from_numpy(data.u)).detach().numpy()
    np.testing.assert_array_equal(got[:, [0, 2]], data.x[:, [1, 3]])
    found = identify(s, known={"p": s.x[1]}, settings=nocl.sysid.Settings(iterations=5, polish=1, samples=4000),
                     progress=False)
    assert "d p/dt = v exact" in found.structure


# the command line

PLANT = """import casadi as ca
import nocl

p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
plant = nocl.System("plant", x=ca.vertcat(p, v), u=u, xdot=None, lbu=[-2], ubu=[2], lbx=[-2, -4], ubx=[2, 4])
ocp = nocl.OCP.quadratic(plant, horizon=2.0, x_goal=[0, 0], u_goal=[0], R=0.1,
                         initial_states=nocl.Gaussian(mean=[0.5, 0], std=[0.1, 0.1]))
"""


def test_identify_from_a_file(tmp_path, capsys):
    file = write(tmp_path / "plant.py", PLANT)
    data = linear_log(oscillator(), 0.02, runs=3, K=50).write(tmp_path / "log.csv")
    command = ["identify", str(file), "--data", str(data), "--out", str(tmp_path / "run"), "--quick"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "3 pieces of 3 recordings" in out
    assert "standing still" in out
    assert LearnedDynamics.load(tmp_path / "run" / "dynamics").system.xdot is None
    assert main(command) == 0
    assert "dynamics: taken from" in capsys.readouterr().out
    assert main(["identify", str(file), "--out", str(tmp_path / "other")]) == 2
    assert "equations of 'plant' are not known" in capsys.readouterr().err
