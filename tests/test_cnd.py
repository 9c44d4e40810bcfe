"""The controller object: shapes, values, gradients, limits, export, files, and what it refuses. Nothing is trained."""

import shutil

import numpy as np
import pytest
import torch

import nocl
from nocl.judge import simulate
from nocl.solvers import cnd as package
from nocl.solvers.cnd import CND
from nocl.solvers.cnd.regression.features import policy_net
from nocl.solvers.cnd.regression.labels import Labels
from nocl.solvers.cnd.value import ValueLabels, value_net

SIZES = (8, 8)


def untrained(name, seed=0, loud=1.0):
    """A CND on a bundled problem with random weights, scaled by made-up labels; `loud` multiplies its answers."""
    ocp, rng = nocl.load_ocp(name), np.random.default_rng(seed)
    s, n = ocp.system, 400
    x, t = ocp.initial_states.sample(n, rng) + 0.3 * rng.standard_normal((n, s.nx)), rng.uniform(0, ocp.horizon, n)
    u = rng.uniform(s.lbu, s.ubu, (n, s.nu))
    labels = Labels(x, t, np.zeros((n, 0)), u, np.ones(n), np.zeros(n))
    values = ValueLabels(x, t, np.zeros((n, 0)), rng.uniform(0.1, 2.0, n), rng.standard_normal((n, s.nx)))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        policy, _ = policy_net(ocp, labels, SIZES)
        value = value_net(ocp, values, SIZES)
    with torch.no_grad():
        for p in list(policy.parameters())[-2:]:
            p *= loud
    return CND(ocp, policy, value, {"method": "none", "seed": seed})


@pytest.fixture(scope="module")
def cnd():
    return untrained("pendulum")


def states(cnd, n=20, seed=1):
    rng = np.random.default_rng(seed)
    s = cnd.ocp.system
    return rng.uniform(s.lbx, s.ubx, (n, s.nx)), rng.uniform(0, cnd.ocp.horizon, n)


@pytest.mark.parametrize("name", ["pendulum", "quadrotor"])
def test_single_batch_and_times_agree(name):
    cnd = untrained(name)
    nx, nu = cnd.ocp.system.nx, cnd.ocp.system.nu
    x, t = states(cnd)
    for method, tail in ((cnd, (nu,)), (cnd.value, ()), (cnd.value_gradient, (nx,))):
        rows = method(x, t)
        assert rows.shape == (len(x), *tail)
        assert rows.dtype == np.float64
        one_by_one = np.array([method(row, time) for row, time in zip(x, t, strict=True)])
        assert one_by_one == pytest.approx(rows, rel=1e-12, abs=1e-12)
        assert np.array_equal(method(x, 0.5), method(x, np.full(len(x), 0.5)))
        assert np.array_equal(method(x), method(x, 0.0))
        assert method(x.tolist(), 0.0) == pytest.approx(method(x))
    assert np.shape(cnd.value(x[0])) == ()


def test_value_gradient_is_the_derivative_of_the_value(cnd):
    x, t = states(cnd)
    gradient, step = cnd.value_gradient(x, t), 1e-5
    for i in range(x.shape[1]):
        d = step * np.eye(x.shape[1])[i]
        assert gradient[:, i] == pytest.approx((cnd.value(x + d, t) - cnd.value(x - d, t)) / (2 * step), rel=1e-6,
                                               abs=1e-8)


def test_a_call_leaves_its_arguments_alone(cnd):
    x, t = states(cnd)
    before = x.copy(), t.copy()
    cnd(x, t), cnd.value(x, t), cnd.value_gradient(x, t)
    assert np.array_equal(x, before[0])
    assert np.array_equal(t, before[1])


def test_controls_are_clipped_to_U():
    cnd = untrained("acrobot", loud=100.0)
    s = cnd.ocp.system
    u = cnd(*states(cnd, 200))
    assert (u >= s.lbu).all()
    assert (u <= s.ubu).all()
    for i in range(s.nu):
        assert {s.lbu[i], s.ubu[i]} <= set(u[:, i])


@pytest.mark.parametrize("name", ["pendulum", "acrobot", "quadrotor", "dubins"])
def test_casadi_answers_as_torch(name):
    cnd = untrained(name)
    x, t = states(cnd)
    policy, value = cnd.to_casadi(), cnd.value_to_casadi()
    assert (policy.name_in(), policy.name_out()) == (["x", "t"], ["u"])
    assert (value.name_in(), value.name_out()) == (["x", "t"], ["V"])
    V = cnd.value(x, t)
    for i in range(len(x)):
        assert policy(x[i], t[i]).full()[:, 0] == pytest.approx(cnd(x[i], t[i]), rel=1e-12, abs=1e-12)
        assert float(value(x[i], t[i])) == pytest.approx(V[i], rel=1e-12, abs=1e-12)
    gradient = value.jacobian()(x[0], t[0], 0)[0].full()[0]
    assert gradient == pytest.approx(cnd.value_gradient(x[0], t[0]), rel=1e-10, abs=1e-12)


def test_the_judge_runs_it_as_continuous_feedback(cnd):
    x0 = cnd.ocp.initial_states.sample(2, 0)
    run = simulate(cnd.ocp, cnd, x0, nodes=11)
    assert run.success.all()
    assert run.u[0] == pytest.approx(cnd(run.x[0], run.t), abs=1e-9)


def test_save_and_load_bit_by_bit(cnd, tmp_path):
    cnd.save(tmp_path / "run")
    again = CND.load(tmp_path / "run")
    x, t = states(cnd)
    for a, b in ((cnd, again), (cnd.value, again.value), (cnd.value_gradient, again.value_gradient)):
        assert np.array_equal(a(x, t), b(x, t))
    assert again.card == cnd.card
    assert again.ocp.to_data() == cnd.ocp.to_data()
    assert repr(again) == repr(cnd)


def test_rounded_weights_make_half_the_file(cnd, tmp_path):
    small = cnd.rounded()
    x, t = states(cnd)
    assert small(x, t) == pytest.approx(cnd(x, t), abs=0.02)
    assert not np.array_equal(small.value(x, t), cnd.value(x, t))
    files = [c.save(tmp_path / name).stat().st_size for name, c in (("small", small), ("whole", cnd))]
    weights = sum(p.numel() for net in (cnd.policy, cnd.value_net) for p in net.parameters())
    assert files[1] - files[0] == pytest.approx(2 * weights, abs=100)
    again = CND.load(tmp_path / "small")
    assert np.array_equal(again(x, t), small(x, t))
    assert np.array_equal(again.value(x, t), small.value(x, t))


def test_without_a_value_it_says_so(cnd, tmp_path):
    CND(cnd.ocp, cnd.policy).save(tmp_path)
    bare = CND.load(tmp_path)
    x = cnd.ocp.initial_states.sample(3, 0)
    assert np.array_equal(bare(x), cnd(x))
    for ask in (lambda: bare.value(x), lambda: bare.value_gradient(x), bare.value_to_casadi):
        with pytest.raises(ValueError, match="trained without a value function"):
            ask()


def test_files_that_are_no_controller_are_refused(cnd, tmp_path):
    with pytest.raises(ValueError, match="is not a folder"):
        CND.load(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"holds no cnd\.safetensors"):
        CND.load(tmp_path / "empty")
    path = cnd.save(tmp_path / "cut")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="cut off"):
        CND.load(tmp_path / "cut")
    foreign = nocl.records.save(tmp_path / "foreign", "dynamics", nets={"net": cnd.policy})
    shutil.move(foreign, foreign.with_name("cnd.safetensors"))
    with pytest.raises(ValueError, match="is a 'dynamics' of nocl's"):
        CND.load(tmp_path / "foreign")
    nocl.records.save(tmp_path / "odd", "cnd", nets={"policy": cnd.policy}, card={"ocp": cnd.ocp.to_data()})
    with pytest.raises(ValueError, match="'card' is missing"):
        CND.load(tmp_path / "odd")


def test_pretrained_names_what_there_is(monkeypatch, tmp_path, cnd):
    with pytest.raises(ValueError, match="no pretrained controller 'nonesuch' on exact dynamics; there are: "):
        package.pretrained("nonesuch")
    with pytest.raises(ValueError, match="expected 'exact' or 'learned'"):
        package.pretrained("cartpole", dynamics="true")
    monkeypatch.setattr("nocl.solvers.cnd.controller.files", lambda package: tmp_path)
    cnd.save(tmp_path / "pretrained" / "pendulum-learned")
    with pytest.raises(ValueError, match="there are: pendulum-learned"):
        package.pretrained("pendulum")
    x = cnd.ocp.initial_states.sample(2, 0)
    assert np.array_equal(package.pretrained("pendulum", dynamics="learned")(x), cnd(x))


@pytest.mark.parametrize(("x", "message"), [
    (np.zeros(3), r"x has shape \(3,\); pendulum has nx = 2"), (np.zeros((4, 3)), r"x has shape \(4, 3\)"),
    (np.zeros((2, 2, 2)), r"shape \(2, 2, 2\)"), ([0.0, np.nan], "expected finite numbers"),
    ([[0.0, 0.0], [np.inf, 0.0]], r"x\[1\]"), (0.0, r"shape \(\)"), ("upright", "pass numbers")])
def test_bad_states_are_refused(cnd, x, message):
    for method in (cnd, cnd.value, cnd.value_gradient):
        with pytest.raises(ValueError, match=message):
            method(x)


@pytest.mark.parametrize("t", [-0.1, 3.1, np.nan, np.inf, np.zeros(3), np.zeros((2, 1)), [0.0, 4.0]])
def test_bad_times_are_refused(cnd, t):
    for method in (cnd, cnd.value, cnd.value_gradient):
        with pytest.raises(ValueError, match=r"expected one time or 2, each in \[0, 3\]"):
            method(np.zeros((2, 2)), t)


def test_the_end_of_the_horizon_is_inside(cnd):
    T = cnd.ocp.horizon
    assert np.isfinite(cnd(np.zeros(2), T)).all()
    assert np.isfinite(cnd(np.zeros(2), np.nextafter(T, np.inf))).all()
    assert np.isfinite(cnd.value_gradient(np.zeros((3, 2)), [0.0, T / 2, T])).all()
