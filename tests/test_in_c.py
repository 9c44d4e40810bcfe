"""Long functions on rows by C: the same as torch's, and torch's own wherever gradients are asked for."""

import pickle

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.solvers.cnd.regression import barrier
from nocl.translate import in_c
from nocl.translate.in_c import InC
from nocl.translate.torch_functions import to_torch


@pytest.fixture(scope="module")
def long():
    """The map of a cart's control barriers: conditions, roots, quotients."""
    p, v, u = (ca.SX.sym(name) for name in "pvu")
    system = nocl.System("cart", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-2], ubu=[2], lbx=[-2, -3],
                         ubx=[2, 3])
    ocp = nocl.OCP(system, horizon=4.0, running=u**2, terminal=p**2 + v**2, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Uniform([-1, -1], [1, 1]), state_bounds={"p": (-1.5, 1.5), "v": (-2, 2)})
    at = ocp.functions.feedback()
    return at.function("map", {"u": barrier.braked(ocp, at, u, ocp.longest)}, v=u)


def rows(function, n=300):
    rng = np.random.default_rng(0)
    return [torch.from_numpy(rng.uniform(-2, 2, (n, function.numel_in(i)))) for i in range(function.n_in())]


def test_values_are_those_of_torch_and_of_casadi(long):
    by_c, args = InC(long), rows(long)
    assert by_c.kernel is not None
    with torch.no_grad():
        values = by_c(*args)
    torch.testing.assert_close(values, to_torch(long)(*args), rtol=1e-12, atol=1e-12)
    by_casadi = long.call([ca.DM(a.numpy().T) for a in args])[0].full().T
    np.testing.assert_allclose(values.numpy(), by_casadi, rtol=1e-12, atol=1e-12)


def test_gradients_single_precision_and_other_shapes_are_torch_s_own(long, monkeypatch):
    by_c = InC(long)
    monkeypatch.setattr(InC, "_by_c", lambda *_: pytest.fail("C has no gradients"))
    args = [a.requires_grad_() for a in rows(long)]
    by_c(*args).sum().backward()
    assert all(a.grad is not None for a in args[:1])
    with torch.no_grad():
        assert by_c(*(a.float() for a in args)).dtype == torch.float32
        assert by_c(*(a[0] for a in args)).shape == (1,)


def test_one_row_serves_for_all_and_short_functions_stay_in_torch(long):
    by_c, args = InC(long), rows(long)
    with torch.no_grad():
        one = by_c(args[0][:1], *args[1:])
        torch.testing.assert_close(one, by_c(args[0][:1].expand(300, -1), *args[1:]))
    x = ca.SX.sym("x", 2)
    assert InC(ca.Function("short", [x], [ca.sin(x)])).kernel is None
    torch.testing.assert_close(pickle.loads(pickle.dumps(by_c))(*args), by_c(*args))


def test_without_a_compiler_it_is_torch(long, monkeypatch):
    def none(*_):
        raise in_c.NoCompilerError("no C compiler")

    monkeypatch.setattr(in_c, "Kernel", none)
    by_torch = InC(long)
    assert by_torch.kernel is None
    with torch.no_grad():
        torch.testing.assert_close(by_torch(*rows(long)), to_torch(long)(*rows(long)))
