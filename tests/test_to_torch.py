"""to_torch: values, first and second derivatives equal CasADi's, for every operation that SX has."""

from __future__ import annotations

import copy
import pickle

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacrev, vmap

from nocl.translate.instructions import BINARY, UNARY, instructions
from nocl.translate.torch_functions import BOOLEAN, COPIES, FLOAT_OPS, to_torch

F64 = torch.float64


def unary(op: str, x: ca.SX) -> ca.SX:
    return ca.SX.unary(getattr(ca, op), x)


def binary(op: str, x: ca.SX, y: ca.SX) -> ca.SX:
    return ca.SX.binary(getattr(ca, op), x, y)


def same_as_casadi(expression: ca.SX, z: ca.SX, points: np.ndarray, rtol: float = 1e-12) -> None:
    """Value, Jacobian and Hessian at rows of `points`, of each output where CasADi's are finite."""
    jacobian = ca.jacobian(expression, z)
    reference = ca.Function("reference", [z], [expression, jacobian, ca.jacobian(jacobian, z)])
    f = to_torch(ca.Function("f", [z], [expression]))
    rows = torch.tensor(points, dtype=F64)
    got = [f(rows), vmap(jacrev(f))(rows), vmap(jacrev(jacrev(f)))(rows)]
    m, n = expression.numel(), z.numel()
    for k, point in enumerate(points):
        value, first, second = (np.array(r) for r in reference(point))
        for ours, theirs in zip(got, [value, first, second.reshape(n, m, n).transpose(1, 0, 2)], strict=True):
            for a, b in zip(ours[k].reshape(m, -1).numpy(), theirs.reshape(m, -1), strict=True):
                if np.isfinite(b).all():  # else autograd has 0 * inf where CasADi has a structural zero
                    np.testing.assert_allclose(a, b, rtol, rtol * max(1.0, np.abs(b).max()), err_msg=str(point))


DOMAIN = {  # of the operands of each operation; (-2, 2) where not named
    "OP_LOG": (0.1, 3), "OP_SQRT": (0.1, 3), "OP_ASIN": (-0.9, 0.9), "OP_ACOS": (-0.9, 0.9), "OP_ACOSH": (1.1, 3),
    "OP_ATANH": (-0.9, 0.9), "OP_LOG1P": (-0.9, 3), "OP_ERFINV": (-0.9, 0.9), "OP_POW": (0.1, 3),
    "OP_CONSTPOW": (0.1, 3), "OP_TAN": (-1.5, 1.5),
}
TRANSLATED = sorted((UNARY | BINARY) - {"OP_PRINTME"})


def test_every_scalar_operation_of_casadi_is_known() -> None:
    assert FLOAT_OPS.keys() | BOOLEAN | COPIES | {"OP_IF_ELSE_ZERO", "OP_PRINTME"} == UNARY | BINARY


@pytest.mark.parametrize("op", TRANSLATED)
def test_operation(op: str) -> None:
    z = ca.SX.sym("z", 2)
    points = np.random.default_rng(0).uniform(*DOMAIN.get(op, (-2, 2)), (40, 2))
    plain = unary(op, z[0]) if op in UNARY else binary(op, z[0], z[1])
    rtol = 1e-5 if op == "OP_ERFINV" else 1e-12  # CasADi's is no better, see below
    same_as_casadi(plain, z, points, rtol)
    same_as_casadi(ca.sin(plain) * ca.exp(z[0]) * z[1], z, points, rtol)


@pytest.mark.parametrize("op", sorted(BINARY - {"OP_PRINTME"}))
@pytest.mark.parametrize("constant", [0.7, 2.0, 3.0])
def test_operation_with_a_constant(op: str, constant: float) -> None:
    x = ca.SX.sym("x")
    points = np.random.default_rng(1).uniform(*DOMAIN.get(op, (-2, 2)), (20, 1))
    same_as_casadi(ca.vertcat(binary(op, x, ca.SX(constant)), binary(op, ca.SX(constant), x)) * ca.cos(x), x, points)


X, Y = ca.SX.sym("x"), ca.SX.sym("y")
KINKS = {
    "fabs": ca.fabs(X), "sign": ca.sign(X), "fmin": ca.fmin(X, Y), "fmax": ca.fmax(X, Y), "fmax0": ca.fmax(X, 0),
    "fmin1": ca.fmin(1, X), "saturation": ca.fmax(ca.fmin(X, 1), -1), "copysign": ca.copysign(X, Y),
    "floor": ca.floor(X), "ceil": ca.ceil(X), "fmod": ca.fmod(X, Y), "remainder": ca.remainder(X, Y),
    "remainder2": ca.remainder(X, 2), "eq": X == Y, "and": ca.logic_and(X, Y), "hypot": ca.hypot(X, Y),
    "sqrt": ca.sqrt(X), "square": X**2, "cube": X**3, "pow1.5": X**1.5, "pow2.5": X**2.5, "pow": ca.fabs(X) ** Y,
    "norm": ca.norm_2(ca.vertcat(X, Y)), "atan2": ca.atan2(X, Y), "division": X / Y, "not": ca.logic_not(X),
    "if sqrt": ca.if_else(X > 0, ca.sqrt(X), Y), "if log": ca.if_else(X > 0, ca.log(X) * Y, X),
    "if division": ca.if_else(Y == 0, 1 - X**2 / 6, X / Y), "if number": ca.if_else(X, Y, 3 * Y),
}


@pytest.mark.parametrize("name", KINKS)
def test_kinks(name: str) -> None:
    grid = np.array([-3.0, -2.0, -1.0, -0.5, 0.0, 0.1, 0.5, 1.0, 2.0, 3.0, 5.0])
    points = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    same_as_casadi(KINKS[name], ca.vertcat(X, Y), points)


def test_fmod_where_the_quotient_rounds_up() -> None:
    same_as_casadi(ca.fmod(X, Y), ca.vertcat(X, Y), np.array([[1.0, 0.1], [0.3, 0.1], [-1.0, 0.1]]))


def test_erfinv_is_the_inverse_of_erf() -> None:
    """CasADi's own number is off by up to 3e-6 in parts of its domain, such as -0.95, 0.64, 0.7."""
    f, values = ca.Function("f", [X], [ca.erfinv(X)]), torch.linspace(-0.99, 0.99, 199, dtype=F64)[:, None]
    torch.testing.assert_close(to_torch(f)(values).erf(), values, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(to_torch(f)(values)[:, 0], np.array(f(values.T.numpy()))[0], rtol=1e-5, atol=1e-9)


def test_nan_of_one_operand_is_ignored_by_fmin_and_fmax() -> None:
    f = to_torch(ca.Function("f", [X, Y], [ca.fmin(X, Y), ca.fmax(X, Y), ca.fmax(X, 0.5)]))
    nan, one = torch.full((1, 1), torch.nan, dtype=F64), torch.ones(1, 1, dtype=F64)
    assert [y.item() for y in f(nan, one)] == [1.0, 1.0, 0.5]
    assert [y.item() for y in f(one, nan)][:2] == [1.0, 1.0]


@pytest.mark.parametrize("inner", [
    ca.sqrt(X), ca.log(X), 1 / X, X**1.5, ca.hypot(X, 0 * Y), ca.atan2(X, X), ca.sqrt(ca.if_else(X > -1, X, 0)),
    ca.if_else(X > 0.5, ca.sqrt(X), ca.log(X)), ca.exp(1000 * (1 - X)) / X])
def test_a_branch_that_is_off_leaks_no_nan(inner: ca.SX) -> None:
    """At x <= 0 only the other branch y^2 counts, in reverse mode too (where CasADi itself may give 0 * inf)."""
    f = to_torch(ca.Function("f", [X, Y], [ca.if_else(X > 0, inner, Y**2)]))
    x = torch.tensor([[0.0], [-1.0], [-2.0]], dtype=F64, requires_grad=True)
    y = torch.full_like(x, 3.0, requires_grad=True)
    gx, gy = torch.autograd.grad(f(x, y).sum(), (x, y), create_graph=True)
    gxx, gyy = torch.autograd.grad((gx + gy).sum(), (x, y), allow_unused=True)
    assert gx.tolist() == [[0.0]] * 3
    assert gy.tolist() == [[6.0]] * 3
    assert gyy.tolist() == [[2.0]] * 3
    assert gxx is None or gxx.tolist() == [[0.0]] * 3


def test_a_shared_operand_of_a_branch_keeps_its_value_outside() -> None:
    root = ca.sqrt(X + 1)
    nested = ca.if_else(X > 0, ca.if_else(Y > 0, root * Y, 1), Y)
    same_as_casadi(ca.vertcat(ca.if_else(X > 0, root, 0) + 2 * root, nested),
                   ca.vertcat(X, Y), np.random.default_rng(2).uniform(-0.9, 1, (30, 2)))


def bounded(op: str, args: list[ca.SX]) -> ca.SX:
    """The operation on args moved into its domain, and kept of moderate size."""
    if op in ("OP_LOG", "OP_SQRT", "OP_INV", "OP_LOG1P"):
        return unary(op, 0.5 + ca.sin(args[0]) ** 2)
    if op in ("OP_ASIN", "OP_ACOS", "OP_ATANH"):
        return unary(op, 0.8 * ca.sin(args[0]))
    if op == "OP_ACOSH":
        return unary(op, 2 + ca.sin(args[0]))
    if op in UNARY:
        return unary(op, ca.sin(args[0]) if op in ("OP_TAN", "OP_EXP", "OP_EXPM1", "OP_SINH", "OP_COSH") else args[0])
    if op in ("OP_POW", "OP_CONSTPOW"):
        return binary(op, 1.5 + ca.sin(args[0]), ca.cos(args[1]) if op == "OP_POW" else ca.SX(1.7))
    if op in ("OP_DIV", "OP_FMOD", "OP_REMAINDER", "OP_ATAN2", "OP_HYPOT"):
        return binary(op, args[0], 1.3 + ca.sin(args[1]))
    return binary(op, args[0], args[1])


OPERATIONS = [*(op for op in TRANSLATED if op != "OP_ERFINV"), "if_else"]


@st.composite
def expressions(draw: st.DrawFn, leaves: list[ca.SX], depth: int = 3) -> ca.SX:
    """A random tree over every operation; each level is a random operation on random subtrees."""
    if depth == 0 or draw(st.integers(0, 7)) == 0:
        return draw(st.sampled_from([*leaves, *leaves, ca.SX(0.37), ca.SX(-1.9), ca.SX(2.0)]))
    op = draw(st.sampled_from(OPERATIONS))
    args = [draw(expressions(leaves, depth - 1)) for _ in range(1 if op in UNARY else 3 if op == "if_else" else 2)]
    return ca.if_else(args[0] > 0.1, args[1], args[2]) if op == "if_else" else bounded(op, args)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.data(), st.integers(1, 3), st.integers(0, 10**6))
def test_random_expressions(data: st.DataObject, n: int, seed: int) -> None:
    z = ca.SX.sym("z", n)
    expression = ca.vertcat(*(data.draw(expressions(ca.vertsplit(z))) for _ in range(2)))
    same_as_casadi(expression, z, np.random.default_rng(seed).uniform(-2, 2, (5, n)), 1e-10)  # curvatures lose digits


def pendulum(nx: int = 2, nu: int = 1) -> ca.Function:
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    return ca.Function("pendulum", [x, u], [ca.sin(x) * u[0] + ca.cumsum(x) ** 2 + ca.sumsqr(u)], ["x", "u"], ["xdot"])


@pytest.mark.parametrize(("nx", "nu"), [(1, 1), (1, 3), (5, 1), (4, 2)])
@pytest.mark.parametrize("batch", [(), (1,), (7,), (3, 2), (0,), (2, 1, 4)])
def test_batch_shapes(nx: int, nu: int, batch: tuple[int, ...]) -> None:
    function = pendulum(nx, nu)
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(*batch, nx)), rng.normal(size=(*batch, nu))
    got = to_torch(function)(torch.tensor(x), torch.tensor(u))
    assert got.shape == (*batch, nx)
    for row in np.ndindex(batch):
        np.testing.assert_allclose(got[row], np.array(function(x[row], u[row]))[:, 0], rtol=1e-13)


def test_one_row_goes_with_every_row() -> None:
    f, x, u = to_torch(pendulum()), torch.randn(5, 2), torch.randn(1, 1)
    torch.testing.assert_close(f(x, u), f(x, u.expand(5, 1)))


def test_outputs_constant_empty_sparse_and_matrix() -> None:
    x, a = ca.SX.sym("x", 2), ca.SX.sym("a", 2, 3)
    sparse = ca.SX(3, 2)
    sparse[2, 1] = x[0]
    outputs = [ca.SX([1, 2, 3]), ca.SX(0, 1), sparse, a.T * x[1], ca.SX(0, 0), x.T, ca.SX(2, 1)]
    f = to_torch(ca.Function("f", [x, a], outputs))
    X, A = torch.randn(4, 2, dtype=F64), torch.randn(4, 2, 3, dtype=F64)
    constant, empty, dense, product, nothing, row, zeros = f(X, A)
    assert constant.tolist() == [[1, 2, 3]] * 4
    assert empty.shape == nothing.shape == (4, 0)
    assert torch.equal(dense[:, 2, 1], X[:, 0])
    assert dense.shape == (4, 3, 2)
    assert dense.count_nonzero() == 4
    torch.testing.assert_close(product, A.mT * X[:, 1, None, None])
    assert torch.equal(row, X[:, None, :])
    assert torch.equal(zeros, torch.zeros(4, 2, dtype=F64))


def test_unused_and_empty_inputs() -> None:
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p", 0)
    f = to_torch(ca.Function("f", [x, u, p], [2 * u]))
    assert f(torch.ones(3, 1), torch.ones(3, 1), torch.ones(3, 0)).tolist() == [[2.0]] * 3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_dtype_is_kept(dtype: torch.dtype) -> None:
    z = ca.vertcat(X, Y)
    f = to_torch(ca.Function("f", [z], [ca.vertcat(*KINKS.values(), 0.1)]))
    rows = torch.rand(6, 2, dtype=F64) + 0.5
    got = f(rows.to(dtype))
    assert got.dtype == dtype
    if dtype == torch.float32:
        torch.testing.assert_close(got.double(), f(rows.float().double()), rtol=1e-5, atol=1e-5)


def test_mx_is_expanded_and_equal_scalars_are_written_once() -> None:
    m = ca.MX.sym("m", 2)
    f = to_torch(ca.Function("f", [m], [ca.sin(ca.mtimes(ca.DM([[1, 2], [3, 4]]), m))]))
    rows = torch.randn(3, 2, dtype=F64)
    torch.testing.assert_close(f(rows), torch.sin(rows @ torch.tensor([[1.0, 3], [2, 4]], dtype=F64)))
    twice = to_torch(ca.Function("g", [X], [ca.vertcat(ca.sin(X) * 2, ca.sin(X) * 3)]))
    assert twice.source.count(".sin()") == 1


def test_dead_code_is_not_written() -> None:
    f = to_torch(ca.Function("f", [X, Y], [ca.if_else(ca.SX(1), X, ca.exp(Y))]))
    assert "exp" not in f.source


def test_nothing_of_the_callers_is_changed() -> None:
    f = to_torch(ca.Function("f", [X, Y], [ca.vertcat(*KINKS.values())]))
    x, y = torch.rand(5, 1, dtype=F64) + 0.5, torch.rand(5, 1, dtype=F64) + 0.5
    before = x.clone(), y.clone()
    x.requires_grad_()
    f(x, y).sum().backward()
    assert torch.equal(x.detach(), before[0])
    assert torch.equal(y, before[1])
    assert x._version == y._version == 0


def test_output_is_not_a_view_of_the_input() -> None:
    x = torch.ones(2, 1)
    to_torch(ca.Function("f", [X], [X]))(x).zero_()
    assert x.tolist() == [[1.0], [1.0]]


def test_gradgradcheck() -> None:
    f = to_torch(pendulum())
    x = torch.randn(3, 2, dtype=F64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    u = torch.full((3, 1), 0.3, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(f, (x, u))
    assert torch.autograd.gradgradcheck(f, (x, u))


def test_forward_mode() -> None:
    f, x, u = to_torch(pendulum()), torch.randn(2, dtype=F64), torch.randn(1, dtype=F64)
    torch.testing.assert_close(torch.func.jacfwd(f)(x, u), jacrev(f)(x, u))


def test_copies() -> None:
    f, x, u = to_torch(pendulum()), torch.randn(4, 2), torch.randn(4, 1)
    for g in (pickle.loads(pickle.dumps(f)), copy.deepcopy(f)):
        assert torch.equal(f(x, u), g(x, u))


def test_printme_is_refused() -> None:
    with pytest.raises(ValueError, match="noisy contains OP_PRINTME"):
        to_torch(ca.Function("noisy", [X, Y], [binary("OP_PRINTME", X, Y)]))


def test_a_call_that_cannot_be_expanded_is_refused() -> None:
    m = ca.MX.sym("m", 2)
    table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 4.0])
    with pytest.raises(ValueError, match="lookup contains OP_CALL"):
        to_torch(ca.Function("lookup", [m], [table(m[0])]))
    with pytest.raises(ValueError, match="solver cannot be written in SX"):
        to_torch(ca.Function("solver", [m], [ca.solve(ca.blockcat([[m[0], 1], [1, 2]]), m)]))
    with pytest.raises(ValueError, match="loose has the free symbols y"):
        to_torch(ca.Function("loose", [X], [X + Y], {"allow_free": True}))
    with pytest.raises(ValueError, match="f has no inputs"):
        to_torch(ca.Function("f", [], [ca.SX(1)]))


@pytest.mark.parametrize(("args", "message"), [
    ((torch.ones(3, 2),), "got 1 arguments, expected 2: pass x, u"),
    ((torch.ones(3, 3), torch.ones(3, 1)), r"x has shape \(3, 3\), expected \[B, 2\]"),
    ((torch.ones(3, 2), torch.tensor(1.0)), r"u has shape \(\), expected \[B, 1\]"),
    ((torch.ones(3, 2), torch.ones(4, 1)), r"batch shapes x \[3\], u \[4\]"),
    ((torch.ones(3, 2), torch.ones(3, 1, dtype=F64)), "u is torch.float64"),
    ((torch.ones(3, 2), torch.ones(3, 1, dtype=torch.int64)), "u is torch.int64, expected a tensor of floats"),
    ((np.ones((3, 2)), torch.ones(3, 1)), "x is ndarray, expected a tensor"),
])
def test_arguments_that_do_not_fit(args: tuple[Tensor, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        to_torch(pendulum())(*args)


def test_instruction_of_a_unary_operation_reads_one_operand() -> None:
    for op in UNARY - COPIES:
        steps = list(instructions(ca.Function("f", [X], [unary(op, X)])))
        found = [len(s.args) for s in steps if s.op == op]
        assert found == [1] or (op == "OP_TWICE" and not found)  # CasADi 3.7 writes 2 x


@pytest.mark.slow
def test_torch_compile_gives_one_graph() -> None:
    f, x, u = to_torch(pendulum()), torch.randn(4, 2), torch.randn(4, 1)
    torch.testing.assert_close(torch.compile(f.__call__, fullgraph=True, backend="aot_eager")(x, u), f(x, u))
