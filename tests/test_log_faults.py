"""Logs that are wrong: in units, in scale, in labels, in form. Refused with the remedy, or read as they are meant."""

import dataclasses
import datetime
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.cli import main
from nocl.sysid import LogSettings, identify
from nocl.sysid.logs.log import Log

N, H = 60, 0.05
T = H * np.arange(N)
FAST = LogSettings(width=4, iterations=10, steps=1, window=4)


def plant(x=("theta", "omega"), u=("torque",), angles=("theta",), wide: float = 1.0) -> nocl.System:
    """Names and boxes alone: theta in [-pi, pi] for the pendulum, everything in [-8, 8] times `wide`."""
    x, u = (ca.vertcat(*map(ca.SX.sym, names)) for names in (x, u))
    box = 8 * wide * np.ones(x.numel())
    return nocl.System("plant", x=x, u=u, xdot=None, lbu=-3 * np.ones(u.numel()), ubu=3 * np.ones(u.numel()), lbx=-box,
                       ubx=box, angles=list(angles))


def swing(t: np.ndarray = T) -> tuple[np.ndarray, np.ndarray]:
    """theta = sin 2t, omega = 2 cos 2t; a control that jumps. [N, 2], [N, 1]"""
    return np.column_stack([np.sin(2 * t), 2 * np.cos(2 * t)]), np.random.default_rng(0).uniform(-2, 2, (len(t), 1))


X, U = swing()


def same(a: Log, b: Log) -> None:
    assert [r.run for r in a] == [r.run for r in b]
    for one, other in zip(a, b, strict=True):
        for name in ("t", "x", "u"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.xdot is None) == (other.xdot is None)
        if one.xdot is not None:
            np.testing.assert_array_equal(one.xdot, other.xdot)


# units and scales

def spoiled(place: str, value: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t, x, u = T.copy(), X.copy(), U.copy()
    {"t": t, "x": x[:, 1], "u": u[:, 0]}[place][30] = value
    return t, x, u


@pytest.mark.parametrize(("place", "value", "message"), [
    ("x", 1e308, "omega of sample 30 is 1e\\+308; expected a number of ordinary size"),
    ("x", -1.7e308, "omega of sample 30 is -1.7e"),
    ("x", 1e5, "omega of sample 30 is 1e\\+05, 1.25e\\+04 times as far from the middle as its box \\[-8, 8\\] reaches"),
    ("x", np.inf, "omega of sample 30 is inf"), ("u", 1e308, "torque of sample 30 is 1e\\+308"),
    ("u", -np.inf, "torque of sample 30 is -inf"), ("t", 1e308, "time goes from"), ("t", np.inf, "time of sample 30")])
def test_an_impossible_cell_is_refused(place, value, message):
    with pytest.raises(ValueError, match=message):
        Log.of(plant(), *spoiled(place, value))


@pytest.mark.parametrize(("t", "x", "u", "message"), [
    (T, X * 1e300, U, "theta of sample .* convert the unit"), (T, X * 1e-300, U, "theta never exceeds 1e-300"),
    (T, X, U * 1e-200, "torque never exceeds"), (T * 1e-300, X, U, "usual step of time is 5e-302"),
    (T * 1e-14, X, U, "choose another unit of time"), (T * 1e290, X, U, "usual step of time"),
    (1e15 + 1000 * T, X, U, r"times around 1e\+15 are known to 0.12 only, the usual step is 50"),
    (T, X * [1, 1e4], U, "omega of sample 0 is 2e\\+04")])
def test_impossible_scales_are_refused(t, x, u, message):
    with pytest.raises(ValueError, match=message):
        Log.of(plant(), t, x, u)


@pytest.mark.parametrize("unit", [1e300, 1e-300])
def test_numbers_whose_squares_overflow_are_refused_in_any_box(unit):
    with pytest.raises(ValueError, match=r"ordinary size|never exceeds"):
        Log.of(plant(wide=unit), T, X * unit, U)


@pytest.mark.parametrize("factor", [40.0, 1e-8])
def test_odd_scales_are_warned_of(factor):
    with pytest.warns(UserWarning, match=r"omega .* in another unit"):
        Log.of(plant(), T, X * [1, factor], U)


def test_a_log_of_ordinary_size_is_taken_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = Log.of(plant(), T, X, U)
        Log.of(plant(), T + 1.7e9, X, U)  # seconds since 1970
        Log.of(plant(), T, np.zeros((N, 2)), 0 * U)
    assert len(log) == N


# angles

@pytest.mark.parametrize("h", [0.02, 0.05, 0.2])
def test_degrees_are_not_unwrapped(h):
    t = h * np.arange(200)
    with pytest.raises(ValueError, match=r"the angle theta goes from .* is it in degrees"):
        Log.of(plant(wide=100), t, np.column_stack([90 * np.sin(2 * t), 180 * np.cos(2 * t)]), np.zeros(200))


def test_degrees_on_a_circle_are_refused():
    t = 0.02 * np.arange(300)
    turned = (100 * t + 180) % 360 - 180
    with pytest.raises(ValueError, match="is it in degrees"):
        Log.of(plant(wide=100), t, np.column_stack([turned, 0 * t + 100]), np.zeros(300))


def test_slow_degrees_are_warned_of():
    """Steps below pi: only the box tells."""
    t = 0.002 * np.arange(800)
    with pytest.warns(UserWarning, match="theta of sample .* another unit"):
        Log.of(plant(), t, np.column_stack([90 * np.sin(2 * t), np.cos(2 * t)]), np.zeros(800))


@pytest.mark.parametrize("low", [-np.pi, 0.0])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_radians_on_a_circle_are_unwrapped(low, noise):
    turns = 4 * T + 1
    seen = (turns - low) % (2 * np.pi) + low + noise * np.random.default_rng(1).standard_normal(N)
    log = Log.of(plant(), T, np.column_stack([seen, 0 * T + 4]), U)
    off = log.runs[0].x[:, 0] - turns
    assert np.abs(off - np.round(off[0] / (2 * np.pi)) * 2 * np.pi).max() <= 5 * noise + 1e-12


def test_a_guess_of_turns_is_warned_of():
    x = np.column_stack([np.random.default_rng(0).uniform(-np.pi, np.pi, N), X[:, 1]])
    with pytest.warns(UserWarning, match="which way is a guess"):
        Log.of(plant(), T, x, U)


def test_a_continuous_angle_stays_as_it_is():
    x = np.column_stack([4 * T + 1, 0 * T + 4])
    np.testing.assert_array_equal(Log.of(plant(), T, x, U).runs[0].x, x)


# known rows and logged derivatives against the log

@pytest.mark.parametrize(("scale", "rate", "message"), [
    (1e3, 1, "omega is 1000 times d theta/dt in the log.*is t in ms"), (1e6, 1, r"1e\+06 times.*is t in us"),
    (1 / 60, 1, "d theta/dt in the log is 60 times omega.*minutes"), (1, -1, "-1 times omega.*sign"),
    (1, 180 / np.pi, "omega is 57.3 times d theta/dt.*rate in degrees"), (1, 30 / np.pi, r"9\.55 times.*rpm"),
    (1, 3, "omega is 3 times")])
def test_known_rows_tell_the_units(scale, rate, message):
    log = Log.of(plant(wide=20), T * scale, X * [1, rate], U)
    with pytest.raises(ValueError, match=message):
        identify(plant(wide=20), data=log, known={"theta": "omega"}, settings=FAST, progress=False)


def test_known_rows_tell_the_units_through_noise_and_holes():
    x = X + 0.05 * np.random.default_rng(2).standard_normal(X.shape)
    x[10:14, 1], x[30, 0] = np.nan, np.nan
    with pytest.raises(ValueError, match="1000 times"):
        identify(plant(), data=Log.of(plant(), 1e3 * T, x, U), known={"theta": "omega"}, settings=FAST, progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        identify(plant(), data=Log.of(plant(), T, x, U), known={"theta": "omega"}, progress=False,
                 settings=LogSettings(width=8, iterations=100, steps=3, window=10))


def euler(first: str) -> Log:
    """theta'' = -10 sin theta + u in Euler's steps of 0.05: theta moves by the new omega, or by the old one."""
    rng, rows = np.random.default_rng(0), []
    for run in range(6):
        theta, omega, u = *rng.uniform(-1, 1, 2), 0.0
        for k in range(50):
            u = rng.uniform(-2, 2) if k % 5 == 0 else u
            rows.append([run, H * k, theta, omega, u])
            new = omega + H * (-10 * np.sin(theta) + u)
            theta, omega = theta + H * (new if first == "omega" else omega), new
    run, t, theta, omega, u = np.array(rows).T
    return Log.of(plant(), t, np.column_stack([theta, omega]), u, run=run)


@pytest.mark.parametrize("first", ["omega", "theta"])
def test_a_simulator_of_euler_steps_contradicts_its_kinematics(first):
    with pytest.warns(UserWarning, match=r"the log speaks against what is stated.*d theta/dt = omega misses the log"):
        model = identify(plant(), data=euler(first), known={"theta": "omega"}, settings=FAST, progress=False)
    assert "misses" in model.card["contradictions"][0]


def test_a_row_that_is_not_finite_on_the_log_is_refused():
    s = plant()
    for row in (ca.log(-1 - s.x[0] ** 2), ca.exp(1000 * s.x[1])):
        with pytest.raises(ValueError, match=r"d theta/dt = .* is (nan|inf) at t = 0 of run 0"):
            identify(s, data=Log.of(s, T, X, U), known={"theta": row}, settings=FAST, progress=False)


def test_a_wrong_row_is_told():
    with pytest.warns(UserWarning, match="the log speaks against"):
        identify(plant(), data=Log.of(plant(), T, X, U), known={"theta": "torque"}, settings=FAST, progress=False)


def test_logged_derivatives_in_other_units_are_refused():
    rates = np.column_stack([X[:, 1], -4 * X[:, 0]])
    Log.of(plant(), T, X, U, xdot=rates)
    with pytest.raises(ValueError, match=r"its column dtheta/dt is 1000 times d theta/dt in the log.*is t in ms"):
        Log.of(plant(), 1e3 * T, X, U, xdot=rates)
    with pytest.raises(ValueError, match=r"dtheta/dt at t = 0\.15 is 1e\+308"):
        Log.of(plant(), T, X, U, xdot=np.where(np.arange(N)[:, None] == 3, 1e308, rates))


# round trips

def cut() -> dict[str, Log]:
    """Logs that fall into pieces."""
    s, t, x, u = plant(), T[:40], X[:40], U[:40].copy()
    u[20] = np.nan
    gap = np.r_[t[:15], t[15:] + 1.0]
    rng = np.random.default_rng(3)
    uneven = np.cumsum(rng.uniform(0.02, 0.2, 40))
    holes = x.copy()
    holes[[0, 7, 8, 39], [0, 1, 1, 0]] = np.nan
    turning = np.column_stack([(6 * t + np.pi) % (2 * np.pi) - np.pi, 0 * t + 6])
    return {"missing control": Log.of(s, t, x, u), "gap": Log.of(s, gap, x, U[:40]), "holes": Log.of(s, t, holes, u),
            "max_gap": Log.of(s, gap, x, u, max_gap=50), "uneven": Log.of(s, uneven, x, u, max_gap=2.0),
            "runs": Log.of(s, np.r_[t, t], np.r_[x, x], np.r_[u, u], run=["a, b"] * 40 + ["01"] * 40),
            "angle": Log.of(s, np.r_[t, t + 30], np.r_[turning, turning], np.r_[u, u]),
            "xdot": Log.of(s, t, x, u, xdot=np.where(np.arange(80).reshape(40, 2) % 3, x[:, ::-1] * [1, -4], np.nan)),
            "split": Log.of(s, np.r_[t, t], np.r_[x, x], np.r_[u, u], run=np.repeat([1.5, 2.5], 40)).split(0.5)[0]}


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("name", list(cut()))
def test_a_log_in_pieces_is_read_as_it_was_written(name, kind, tmp_path):
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    log = cut()[name]
    again = Log.read(log.write(tmp_path / f"log.{kind}"), plant())
    same(again, log)
    same(Log.read(again.write(tmp_path / f"again.{kind}"), plant()), log)


def test_no_control_is_invented(tmp_path):
    log = cut()["missing control"]
    assert [len(r) for r in log] == [21, 19]
    again = Log.read(log.write(tmp_path / "log.csv"), plant())
    assert [len(r.u) for r in again] == [20, 18]


@pytest.mark.parametrize("names", [("t", "v"), ("run", "v"), ("run piece", "v"), ("x", "dx/dt"), ("x", " v")])
def test_names_of_the_format_are_refused(names, tmp_path):
    s = plant(names, angles=())
    log = Log.of(s, T, X, U)  # arrays have no columns
    with pytest.raises(ValueError, match="name its symbol differently"):
        log.write(tmp_path / "log.csv")
    (tmp_path / "log.csv").write_text("t,run\n")
    with pytest.raises(ValueError, match="name its symbol differently"):
        Log.read(tmp_path / "log.csv", s)
    assert list(tmp_path.iterdir()) == [tmp_path / "log.csv"]


# labels

@pytest.mark.parametrize("labels", [
    [1.0] * 30 + [np.nan] * 30, ["a"] * 30 + [None] * 30, ["a"] * 30 + [""] * 30, ["a"] * 30 + ["nan"] * 30,
    [1] * 30 + ["1"] * 30, ["a"] * 30 + [2.0] * 30, [" a"] * 60, [(1, 2)] * 60,
    np.datetime64("NaT") + np.zeros(60, "m8[s]"),
    np.where(np.arange(60) < 30, 1.0, np.nan)])
def test_labels_that_are_missing_or_mixed_are_refused(labels):
    with pytest.raises(ValueError, match=r"run of sample \d+ is"):
        Log.of(plant(), np.r_[T[:30], T[:30]], X, U, run=labels)


@pytest.mark.parametrize("labels", [[1] * 30 + [2] * 30, [1] * 30 + [2.5] * 30, ["a"] * 30 + ["b"] * 30,
                                    np.repeat([True, False], 30), [datetime.date(2024, 5, 1)] * 30 + ["x"] * 0
                                    + [datetime.date(2024, 5, 2)] * 30])
def test_labels_of_one_kind_are_taken(labels):
    log = Log.of(plant(), np.r_[T[:30], T[:30]], X, U, run=labels)
    assert [len(r) for r in log] == [30, 30]


def test_an_empty_label_in_a_file_is_refused(tmp_path):
    text = "".join(f"{'a' if k < 8 else ''},{H * k},0.1,{0.1 * k},0\n" for k in range(16))
    (tmp_path / "log.csv").write_text("run,t,theta,omega,torque\n" + text)
    with pytest.raises(ValueError, match="run of sample 8 is ''"):
        Log.read(tmp_path / "log.csv", plant())


@pytest.mark.parametrize("labels", [3, "ab", {1: 2}, [[1], [1, 2]], np.zeros((60, 1))])
def test_labels_of_another_shape_are_refused(labels):
    with pytest.raises(ValueError, match=r"run (has shape|of sample 0 is)"):
        Log.of(plant(), T, X, U, run=labels)


# controls that are logged when they change

def sparse() -> np.ndarray:
    u = np.full((N, 1), np.nan)
    u[::12] = U[::12]
    return u


def test_sparse_controls_get_advice_that_helps():
    with pytest.raises(ValueError, match=r"a control is missing in 55 of them.*hold_controls=True"):
        Log.of(plant(), T, X, sparse())
    log = Log.of(plant(), T, X, sparse(), hold_controls=True)
    np.testing.assert_array_equal(log.runs[0].u, np.repeat(U[::12], 12, axis=0)[: N - 1])


def test_half_a_log_does_not_go_without_a_word():
    u = U.copy()
    u[: 2 * N // 3] = np.nan
    with pytest.warns(UserWarning, match="40 of 60 samples are left out.*hold_controls"):
        Log.of(plant(), T, X, u)


def test_held_controls_stay_in_their_recording():
    u = sparse()
    u[30:36] = np.nan  # before the first change of the second recording nothing is known
    log = Log.of(plant(), np.r_[T[:30], T[:30]], X, u, run=np.repeat([0, 1], 30), hold_controls=True)
    assert [len(r) for r in log] == [30, 24]
    np.testing.assert_array_equal(log.runs[1].u[:12], np.repeat(U[36:37], 12, axis=0))


def test_held_controls_one_by_one():
    s = plant(u=("a", "b"))
    u = np.array([[0.0, 1], [np.nan, 2], [np.nan, np.nan], [1, np.nan], [np.nan, np.nan], [np.nan, 3], [2, 2]])
    log = Log.of(s, T[:7], X[:7], u, hold_controls=True)
    np.testing.assert_array_equal(log.runs[0].u, [[0, 1], [0, 2], [0, 2], [1, 2], [1, 2], [1, 3]])


# files as others write them

def text_of(separator: str, comma: str, times=T, head: str = "") -> str:
    rows = [["t", "theta", "omega", "torque", "remark"]]
    rows += [[t if isinstance(t, str) else repr(float(t)).replace(".", comma), *(repr(float(v)).replace(".", comma)
              for v in (*x, *u)), "ok"] for t, x, u in zip(times, X, U, strict=True)]
    return head + "\n".join(separator.join(row) for row in rows) + "\n"


def stamps(zone: str = "", space: str = "T", step: float = H) -> list[str]:
    start = datetime.datetime(2024, 5, 31, 23, 59, 59)
    return [(start + datetime.timedelta(seconds=step * k)).isoformat(space) + zone for k in range(N)]


@pytest.mark.parametrize(("text", "tolerance"), [
    (text_of(";", ","), 0), (text_of("\t", ","), 0), (text_of("\t", "."), 0), (text_of(";", "."), 0),
    (text_of(";", ",", head="sep=;\n"), 0), (text_of(",", ".", head="\ufeff"), 0),
    (text_of(",", ".").replace("\n", "\r\n"), 0), (text_of(",", ".", stamps()), 1e-9),
    (text_of(",", ".", stamps("Z", " ")), 1e-9), (text_of(";", ",", stamps("+02:00")), 1e-9)],
    ids=["semicolon, comma", "tab, comma", "tab", "semicolon", "sep=", "bom", "crlf", "iso", "iso utc", "iso zone"])
def test_files_of_spreadsheets_and_loggers(text, tolerance, tmp_path):
    (tmp_path / "log.csv").write_text(text, encoding="utf-8", newline="")
    log = Log.read(tmp_path / "log.csv", plant()).runs[0]
    np.testing.assert_allclose(log.t, T, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(log.x, X)
    np.testing.assert_array_equal(log.u, U[:-1])


@pytest.mark.parametrize(("text", "message"), [
    (text_of(",", ".").replace("ok\n", "s,rad,rad/s,Nm,-\n", 1).replace("remark\n0.0", "remark\n0.0"), "cells"),
    (text_of(",", ".").replace("remark\n", "remark\ns,rad,rad/s,Nm,-\n", 1), "no number.*remove lines of units"),
    (text_of(",", ".", [f"31.05.2024 12:00:{k:02d}" for k in range(N)]), "expected seconds, or timestamps like 2024"),
    (text_of(",", ".", ["12:00:00"] * N), "expected seconds, or timestamps"),
    (text_of(",", ".", [*stamps()[:-1], stamps("Z")[-1]]), "with a time zone, or all without"),
    (text_of(",", ".", [*stamps()[:-1], ""]), "the time of sample 59 is nan"),
    (text_of(",", ".", [*map(str, T[:-1]), "2024-05-31T12:00:00"]), "no number"),
    (text_of(",", ".").replace("ok\n", '"1,5"\n').replace("remark", "omega2").replace("omega,", "w,").replace(
        "omega2", "omega"), "column 'omega' holds what is no number.*separators of thousands"),
    (text_of(";", ",").replace(repr(float(X[5, 1])).replace(".", ","), "1.5"), "decimal commas and points"),
    (text_of(",", ".").replace(repr(float(X[5, 1])), "1_5"), "holds what is no number \\('1_5', sample 5\\)"),
    (text_of(",", ".").replace(repr(float(X[5, 1])), "#DIV/0!"), "holds what is no number")])
def test_files_that_cannot_be_read_name_the_remedy(text, message, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        Log.read(tmp_path / "log.csv", plant())


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "UTC"])
def test_timestamps_in_parquet(unit, zone, tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    times = np.datetime64("2024-05-31T23:59:59", unit) + (50 * np.arange(N)).astype("m8[ms]").astype(f"m8[{unit}]")
    columns = {"t": arrow.array(times, arrow.timestamp(unit, zone)), "theta": X[:, 0], "omega": X[:, 1],
               "torque": U[:, 0]}
    parquet.write_table(arrow.table(columns), tmp_path / "log.parquet")
    np.testing.assert_allclose(Log.read(tmp_path / "log.parquet", plant()).runs[0].t, T, rtol=0, atol=1e-9)


def test_times_as_python_has_them():
    start = datetime.datetime(2024, 5, 31)
    spans = [datetime.timedelta(seconds=float(s)) for s in T]
    stamped = [start + s for s in spans]
    for times in (stamped, spans, np.array(spans, "m8[us]"), np.array(stamped, "M8")):
        np.testing.assert_allclose(Log.of(plant(), times, X, U).runs[0].t, T, rtol=0, atol=1e-6)


@pytest.mark.parametrize("bad", [np.ma.masked_array(X, X > 1), X.astype(complex), X.astype(str), X > 0,
                                 X.astype("M8[s]"), [*X.tolist()[:-1], [1]], [[10**400, 0]] * N])
def test_what_are_no_numbers_is_refused(bad):
    with pytest.raises(ValueError, match=r"x .*expected an array of numbers"):
        Log.of(plant(), T, bad, U)


# the fit

def inverted_pendulum(share: int = 1) -> tuple[nocl.System, Log]:
    """Gymnasium's InvertedPendulum-v5, 40 recordings without noise, controls that jump each sample; 1 of `share`."""
    names = ("x", "theta", "v", "omega")
    s = nocl.System("inverted_pendulum", x=ca.vertcat(*map(ca.SX.sym, names)), u=ca.SX.sym("a"), xdot=None, lbu=[-3],
                    ubu=[3], lbx=[-1, -0.3, -4, -4], ubx=[1, 0.3, 4, 4], angles=["theta"])
    log = Log.read(Path(__file__).parent / "data" / "inverted_pendulum.csv", s)
    return s, dataclasses.replace(log, runs=log.runs[::share])


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_an_unstable_plant_under_jumping_controls():
    """The defaults; standing still is off by 33 % of the spread after one step, smoothed derivatives by 12 %."""
    s, log = inverted_pendulum()
    train, test = log.split(0.2)
    model = identify(s, data=train, known={"x": "v", "theta": "omega"}, control_affine=True, progress=False)
    result = model.validate(test, (1, 10))
    assert result.relative[0] < 0.004
    assert result.relative[1] < 0.02
    assert [stage["steps"] for stage in model.card["windows"]] == [2, 5, 10, 21]
    assert all(stage["taken"] for stage in model.card["windows"])


def test_windows_of_two_samples_first():
    """A small relative of it: the simulation error comes down where smoothed derivatives are poor."""
    s, log = inverted_pendulum(2)
    settings = LogSettings(width=6, iterations=40, steps=8, window=4)
    model = identify(s, data=log, known={"x": "v", "theta": "omega"}, control_affine=True, settings=settings,
                     progress=False)
    assert model.validate(log, (1,)).relative[0] < 0.005
    first = identify(s, data=log, known={"x": "v", "theta": "omega"}, control_affine=True, progress=False,
                     settings=dataclasses.replace(settings, steps=0))
    assert first.validate(log, (1,)).relative[0] > 0.05
    assert first.card["windows"] == []


def test_a_fit_without_progress_is_told():
    """White noise for states: nothing can be predicted."""
    rng = np.random.default_rng(0)
    log = Log.of(plant(angles=()), T, rng.standard_normal((N, 2)), U)
    with pytest.warns(UserWarning, match="no step lowered the simulation error|little better than standing still"):
        identify(plant(angles=()), data=log, settings=FAST, progress=False)


PROBLEM = """import casadi as ca
import nocl

theta, omega, torque = (ca.SX.sym(name) for name in ("theta", "omega", "torque"))
plant = nocl.System("plant", x=ca.vertcat(theta, omega), u=torque, xdot=None, lbu=[-3], ubu=[3], lbx=[-8, -8],
                    ubx=[8, 8], angles=["theta"])
ocp = nocl.OCP.quadratic(plant, horizon=2.0, x_goal=[0, 0], u_goal=[0], R=0.1,
                         initial_states=nocl.Gaussian(mean=[0.5, 0], std=[0.1, 0.1]))
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LogSettings, "EFFORT", {"quick": {"width": 4, "iterations": 10, "steps": 1, "window": 4}})
    (tmp_path / "plant.py").write_text(PROBLEM)
    return tmp_path


def test_the_command_line_refuses_in_one_line(here, capsys):
    """1e308 in a cell, states times 1e300, times times 1e-300, t in ms, flags without a log."""
    for k, (t, x) in enumerate([spoiled("x", 1e308)[:2], (T, X * 1e300), (T * 1e-300, X), (1e3 * T, X)]):
        lines = [f"{t[i]!r},{x[i, 0]!r},{x[i, 1]!r},{U[i, 0]!r}".replace("np.float64(", "").replace(")", "")
                 for i in range(N)]
        (here / "log.csv").write_text("\n".join(["t,theta,omega,torque", *lines]) + "\n")
        assert main(["identify", "plant.py", "--data", "log.csv", "--quick", "--out", "run", "--known",
                     "theta=omega"]) == 2, k
        err = capsys.readouterr().err
        assert err.startswith("nocl: error: ")
        assert err.count("\n") == 1
    for flags in (["--known", "theta=omega"], ["--control-affine"], ["--hold-controls"]):
        assert main(["identify", "plant.py", *flags]) == 2
        assert "name one by --data" in capsys.readouterr().err
    for known in ("theta", "theta=", "=omega", "theta=omega,theta=1", ""):
        assert main(["identify", "plant.py", "--data", "log.csv", "--known", known]) == 2
        assert "like p=v,theta=omega" in capsys.readouterr().err
    assert not (here / "run").exists()


def test_known_and_control_affine_at_the_command_line(here, capsys):
    rows = []
    for run in range(3):
        t = T + 10 * run
        for k, x in enumerate(swing(t)[0]):
            rows.append(f"{run},{H * k:.3f},{x[0]!r},{x[1]!r},{U[k, 0]!r}" if k % 3 == 0 else
                        f"{run},{H * k:.3f},{x[0]!r},{x[1]!r},")
    text = "\n".join(["run,t,theta,omega,torque", *rows]).replace("np.float64(", "").replace(")", "") + "\n"
    (here / "log.csv").write_text(text)
    command = ["identify", "plant.py", "--data", "log.csv", "--quick", "--out", "run", "--known", "theta=omega",
               "--control-affine", "--hold-controls"]
    assert main(command) == 0
    capsys.readouterr()
    model = nocl.sysid.LearnedDynamics.load(here / "run" / "dynamics")
    assert model.structure == "stated: d theta/dt = omega; affine in the controls; learned: d omega/dt"
    assert model.card["run"]["known"] == {"theta": "omega"}
    assert main(command) == 0
    assert "taken from" in capsys.readouterr().out
    assert main(["identify", "plant.py", "--data", "log.csv", "--known", "theta=speed", "--hold-controls"]) == 2
    assert "expected the name of a state or control" in capsys.readouterr().err
