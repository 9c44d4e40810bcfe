"""to_jax: values equal CasADi's in float64, for every operation that SX has and for the bundled systems."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl import load_ocp
from nocl.systems import NAMES
from nocl.translate.instructions import BINARY, UNARY

jax = pytest.importorskip("jax")

from nocl.translate.jax_functions import to_jax  # noqa: E402

DOMAIN = {"OP_LOG": (0.1, 3), "OP_SQRT": (0.1, 3), "OP_ASIN": (-0.9, 0.9), "OP_ACOS": (-0.9, 0.9),
          "OP_ACOSH": (1.1, 3), "OP_ATANH": (-0.9, 0.9), "OP_LOG1P": (-0.9, 3), "OP_ERFINV": (-0.9, 0.9),
          "OP_POW": (0.1, 3), "OP_CONSTPOW": (0.1, 3)}  # (-2, 2) elsewhere


def same_as_casadi(function: ca.Function, *columns: np.ndarray, rtol: float = 1e-12) -> None:
    wanted = function.call([c.T for c in columns])
    with jax.enable_x64(True):
        got = to_jax(function)(*columns)
    for a, b in zip(got if isinstance(got, tuple) else (got,), wanted, strict=True):
        assert np.asarray(a).dtype == np.float64
        b = b.full().T
        np.testing.assert_allclose(np.asarray(a), b, rtol=rtol, atol=rtol * max(1.0, np.abs(b).max()))


@pytest.mark.parametrize("op", sorted((UNARY | BINARY) - {"OP_PRINTME"}))
def test_every_operation(op):
    z = ca.SX.sym("z", 2)
    e = ca.SX.unary(getattr(ca, op), z[0]) if op in UNARY else ca.SX.binary(getattr(ca, op), z[0], z[1])
    rng = np.random.default_rng(0)
    points = rng.uniform(*DOMAIN.get(op, (-2, 2)), (40, 2))
    if op in ("OP_EQ", "OP_NE", "OP_AND", "OP_OR", "OP_NOT", "OP_FMIN"):
        points[:5] = np.round(points[:5])  # ties, and 0
    same_as_casadi(ca.Function("f", [z], [ca.vertcat(e, 2 * e + z[1])]), points,
                   rtol=1e-5 if op == "OP_ERFINV" else 1e-12)  # CasADi's own erfinv is off by 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_bundled_systems(name):
    ocp = load_ocp(name)
    s, rng = ocp.system, np.random.default_rng(1)
    x, u = rng.uniform(s.lbx, s.ubx, (50, s.nx)), rng.uniform(s.lbu, s.ubu, (50, s.nu))
    for function in (s.f, ocp.L_soft):
        same_as_casadi(function, x, u)
    same_as_casadi(ca.Function("both", [s.x, s.u], [s.xdot, ocp.running]), x, u)


def test_axes_broadcast_and_misfits_are_refused():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    f = to_jax(ca.Function("f", [x, u], [ca.vertcat(x[0] * u, 3, x[1])]))
    assert f(np.ones((4, 1, 2)), np.ones((5, 1))).shape == (4, 5, 3)
    with pytest.raises(ValueError, match=r"expected \[2, 1\]"):
        f(np.ones(3), np.ones(1))
    with pytest.raises(ValueError, match="columns only"):
        to_jax(ca.Function("f", [x], [x @ x.T]))
    with pytest.raises(ValueError, match="expected a casadi"):
        to_jax(lambda x: x)


def test_parameters_and_time_are_inputs_like_the_others():
    """f, L, G and h of (x, u, t, p), each of what it holds."""
    x, u, t = ca.SX.sym("x", 2), ca.SX.sym("u"), nocl.time()
    mass, goal = nocl.parameter("mass", 1.0), nocl.parameter("goal", 0.0)
    s = nocl.System("cart", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], u / mass - ca.sin(t) * x[0]), lbu=[-1], ubu=[1],
                    lbx=[-3, -3], ubx=[3, 3])
    ocp = nocl.OCP(s, p=goal, horizon=2.0, running=u**2 + (x[0] - goal * ca.cos(t)) ** 2, terminal=(x[0] - goal) ** 2,
                   x_goal=ca.vertcat(goal, 0), u_goal=[0], initial_states=nocl.Gaussian([0, 0], [0.1, 0.1]),
                   parameters=nocl.Uniform([0.5, -1], [2, 1]), path_constraints={"wall": goal + 4 - x[0] + t})
    rng, of = np.random.default_rng(0), ocp.functions
    at = {"x": rng.uniform(-1, 1, (20, 2)), "u": rng.uniform(-1, 1, (20, 1)), "t": rng.uniform(0, 2, 20),
          "p": ocp.sample_parameters(20)}
    for function, arguments in ((of.f, of.arguments), (of.L, of.arguments), (of.h, of.node), (of.G, of.end)):
        same_as_casadi(function, *(np.asarray(c).T for c in arguments.columns(**at)))
