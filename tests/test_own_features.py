"""Features of the user's own: seen by policy and value, at every p and t, and refused where they cannot be."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from movers import mover

import nocl
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.regression.features import features, own_features
from nocl.solvers.cnd.regression.labels import Problems

QUICK = replace(TrainSettings.of("quick"), seeds=20, states=0, tails=20, visits=20, rounds=0, iterations=60,
                hidden=(8,), value_tails=20, value_iterations=40, value_rounds=1)


def places(ocp, n=200):
    found = Problems.initial(ocp, n, np.random.default_rng(0))
    return replace(found, t=np.random.default_rng(1).uniform(0, ocp.horizon, n))


def test_they_are_those_expressions_scaled():
    ocp = mover()
    (x, v), p = ca.vertsplit(ocp.system.x), ca.vertcat(ocp.system.p, ocp.p)
    own = own_features(ocp, [x * p[0], v - p[1] * nocl.time(), 7 + 1e-3 * x])
    labels = places(ocp)
    at = ocp.functions.feedback().columns(x=labels.x, t=labels.t, p=labels.p)
    plain, more = (features(ocp, labels, own=f)(*at).full() for f in (None, own))
    np.testing.assert_array_equal(more[:len(plain)], plain)
    (x, v), (m, goal) = labels.x.T, labels.p.T
    raw = np.array([x * m, v - goal * labels.t, 7 + 1e-3 * x])
    scaled = (raw - raw.mean(axis=1, keepdims=True)) / raw.std(axis=1, keepdims=True)
    np.testing.assert_allclose(more[len(plain):], scaled, rtol=0, atol=0.05)
    assert own_features(ocp, None) is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_controller_sees_them_and_is_saved_and_exported(tmp_path):
    ocp = nocl.load_ocp("double_integrator")
    x = ocp.system.x
    plain = nocl.train(ocp, settings=QUICK, progress=False)
    cnd = nocl.train(ocp, settings=QUICK, progress=False, features=[x[0] * ca.fabs(x[0]), ca.sin(nocl.time())])
    for mine, theirs in ((cnd.policy, plain.policy), (cnd.value_net, plain.value_net)):
        assert mine.inputs.numel_out(0) == theirs.inputs.numel_out(0) + 2
    assert cnd.card["features"] == 2
    assert "features" not in plain.card
    cnd.save(tmp_path)
    again, x0 = nocl.CND.load(tmp_path), ocp.initial_states.sample(5, 0)
    np.testing.assert_array_equal(again(x0, 0.3), cnd(x0, 0.3))
    np.testing.assert_allclose(cnd.to_casadi()(x0.T, 0.3).full().T, cnd(x0, 0.3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(cnd.value_to_casadi()(x0.T, 0.3).full().ravel(), cnd.value(x0, 0.3), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_checkpoint_with_other_features_is_left_aside(tmp_path):
    ocp = nocl.load_ocp("double_integrator")
    x = ocp.system.x
    first, second, again = (nocl.train(ocp, settings=QUICK, out=tmp_path / str(i), progress=False, features=f)
                            for i, f in enumerate(([x[0]**3], [x[1]**3], [x[0]**3])))
    x0 = ocp.initial_states.sample(3, 0)
    np.testing.assert_array_equal(first(x0), again(x0))
    other = nocl.train(ocp, settings=QUICK, out=tmp_path / "0", progress=False, features=[x[1]**3])
    np.testing.assert_array_equal(other(x0), second(x0))
    assert not np.array_equal(other(x0), first(x0))


def test_refusals():
    ocp, turning = nocl.load_ocp("double_integrator"), turning_pendulum()
    x, u = ocp.system.x, ocp.system.u
    for given, match in ((3, "features is 3; expected SX expressions"), ([], r"features is \[\]; expected SX"),
                         ([u], "features contains"), ([ca.SX.sym("z")], "features contains"),
                         (["x"], "expected SX expressions")):
        with pytest.raises(ValueError, match=match):
            nocl.train(ocp, features=given)
    with pytest.raises(ValueError, match="'paper' has the paper's own"):
        nocl.train(ocp, method="paper", features=[x[0]])
    with pytest.raises(ValueError, match="number 1 changes with a whole turn of theta"):
        own_features(turning, [ca.sin(turning.system.x[0]), turning.system.x[0]])
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="NaN or inf at some labels"):
        features(ocp, places(ocp), own=own_features(ocp, [ca.sqrt(-1 - x[0]**2)]))


def turning_pendulum():
    theta, omega, u = (ca.SX.sym(name) for name in ("theta", "omega", "u"))
    s = nocl.System("turning", x=ca.vertcat(theta, omega), u=u, xdot=ca.vertcat(omega, ca.sin(theta) + u), lbu=[-1],
                    ubu=[1], lbx=[-7, -5], ubx=[7, 5], angles=["theta"])
    return nocl.OCP(s, horizon=3.0, running=0.1 * u**2, terminal=2 * (1 - ca.cos(theta)) + omega**2, x_goal=[0, 0],
                    u_goal=[0], initial_states=nocl.Gaussian([np.pi, 0], [0.1, 0.1]))
