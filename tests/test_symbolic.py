"""Functions as JSON data: what is read back is the same function."""

from __future__ import annotations

import json

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nocl.translate.instructions import BINARY, UNARY, expand, from_data, instructions, to_data

X, Y = ca.SX.sym("x"), ca.SX.sym("y")


def round_trip(function: ca.Function) -> ca.Function:
    return from_data(json.loads(json.dumps(to_data(function))))


def same(function: ca.Function, other: ca.Function, points: np.ndarray) -> None:
    """The same numbers, NaN and infinities included, to the last bit."""
    for row in points:
        np.testing.assert_array_equal(np.array(function(*row)), np.array(other(*row)))


@st.composite
def expressions(draw: st.DrawFn, depth: int = 5) -> ca.SX:
    """A random tree over every operation, without regard to domains."""
    if depth == 0 or draw(st.integers(0, 7)) == 0:
        number = st.floats(-3, 3).map(ca.SX)
        return draw(st.one_of(st.sampled_from([X, Y]), number))
    op = draw(st.sampled_from(sorted((UNARY | BINARY) - {"OP_PRINTME"})))
    args = [draw(expressions(depth - 1)) for _ in range(1 if op in UNARY else 2)]
    return (ca.SX.unary if op in UNARY else ca.SX.binary)(getattr(ca, op), *args)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(expressions(), min_size=1, max_size=3))
def test_random_expressions_come_back(outputs: list[ca.SX]) -> None:
    function = ca.Function("f", [X, Y], [ca.vertcat(*outputs)])
    same(function, round_trip(function), np.random.default_rng(0).uniform(-3, 3, (8, 2)))


@pytest.mark.parametrize("op", sorted(UNARY | BINARY - {"OP_PRINTME"}))
def test_each_operation_comes_back(op: str) -> None:
    e = ca.SX.unary(getattr(ca, op), X) if op in UNARY else ca.SX.binary(getattr(ca, op), X, Y)
    function = ca.Function("f", [X, Y], [e])
    same(function, round_trip(function), np.random.default_rng(1).uniform(-2, 2, (8, 2)))


def test_constants_names_and_sizes_come_back() -> None:
    x = ca.SX.sym("x", 2, 3)
    values = [0.1, 1 / 3, -0.0, np.inf, -np.inf, np.nan, 1e-320]
    outputs = [ca.SX(ca.DM(values)), x.T, ca.SX(0, 1)]
    function = ca.Function("f", [x, ca.SX.sym("t")], outputs, ["x", "t"], ["c", "xt", "e"])
    back = round_trip(function)
    assert str(back) == str(function)
    got = np.array(back(ca.DM(2, 3), 0)[0])[:, 0]
    assert np.array_equal(got, values, equal_nan=True)


def test_symbols_of_ones_own() -> None:
    z = ca.SX.sym("z")
    back = from_data(to_data(ca.Function("f", [X], [ca.sin(X)])), [z])
    assert float(back(0.5)) == np.sin(0.5)


def test_sparse_inputs_and_outputs_are_dense_after_expand() -> None:
    x = ca.SX.sym("x", ca.Sparsity.upper(2))
    dense = expand(ca.Function("f", [x], [2 * x]))
    assert dense.sparsity_in(0).is_dense()
    assert dense.sparsity_out(0).is_dense()
    assert np.array_equal(np.array(dense(ca.DM([[1, 2], [7, 3]]))), [[2, 4], [0, 6]])


def test_what_is_not_elementary_is_refused() -> None:
    m = ca.MX.sym("m")
    table = ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 4.0])
    with pytest.raises(ValueError, match="lookup contains OP_CALL"):
        to_data(ca.Function("lookup", [m], [table(m)]))
    with pytest.raises(ValueError, match="loose has the free symbols y"):
        to_data(ca.Function("loose", [X], [X * Y], {"allow_free": True}))


@pytest.mark.parametrize("damage", [
    {"code": [["OP_CALL", 0, 0]]}, {"code": [["__class__", 0, 0]]}, {"code": [["OP_SIN", 99, 0]]},
    {"code": [["OP_SIN", 0]]}, {"code": [[]]}, {"code": None}, {"work": "many"}, {"inputs": [["x", -1, 1]]},
    {"outputs": []}, {"name": "not a name"}, {"code": [["OP_CONST", 0, "one"]]}])
def test_damaged_data_is_refused(damage: dict[str, object]) -> None:
    data = to_data(ca.Function("f", [X], [ca.sin(X)]))
    with pytest.raises(ValueError, match=r"nocl|operation|hexadecimal|literal|unpack"):
        from_data({**data, **damage})


def test_instructions_name_casadis_operations() -> None:
    steps = list(instructions(ca.Function("f", [X], [ca.sin(X) + ca.SX(2)])))
    assert [s.op for s in steps] == ["OP_INPUT", "OP_SIN", "OP_CONST", "OP_ADD", "OP_OUTPUT"]
    assert next(s.value for s in steps if s.op == "OP_CONST") == 2.0
