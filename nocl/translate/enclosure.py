"""What SX functions take on over boxes: enclosures by interval arithmetic, rounded outward.

Every operation gives an interval that holds all values of its arguments' intervals (Moore, Kearfott, Cloud (2009),
"Introduction to Interval Analysis"), so that what is said of an enclosure is proven for the function, rounding
included. An operation that is not known here, or that is not defined on all of its interval, has all numbers. What is
concluded from the enclosure of a derivative holds for functions that are smooth: CasADi's derivative of |x| or of a
condition knows nothing of the kink or the jump.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nocl.support.checks import Array
from nocl.translate.instructions import instructions

ULPS = 4 * np.finfo(np.float64).eps  # relative, by which results are rounded outward: libm's are good to one ulp
TINY = np.finfo(np.float64).tiny
Interval = tuple[Array, Array]  # (low, high), each [B]
SMOOTH = {f"OP_{name}" for name in (  # all that they are not smooth at has derivatives without a bound
    "INPUT", "OUTPUT", "CONST", "ASSIGN", "ADD", "SUB", "MUL", "DIV", "INV", "NEG", "SQ", "TWICE", "POW", "CONSTPOW",
    "SQRT", "EXP", "LOG", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SINH", "COSH", "TANH", "ASINH", "ACOSH",
    "ATANH", "LOG1P", "EXPM1", "ERF")}


def is_smooth(function: ca.Function) -> bool:
    """Whether all operations are smooth where their derivatives are bounded: no kink, no jump, no condition."""
    return all(i.op in SMOOTH for i in instructions(function))


def enclosure(function: ca.Function, low: Array, high: Array) -> Interval:
    """(low, high), each [outputs, B], of a function of one column [n] with one dense output, over boxes [n, B]."""
    work: dict[int, Interval] = {}
    found = np.empty((2, function.numel_out(0), low.shape[1]))
    with np.errstate(all="ignore"):
        for i in instructions(function):
            if i.op == "OP_OUTPUT":
                found[:, i.out[1]] = work[i.args[0]]
            elif i.op == "OP_INPUT":
                work[i.out[0]] = (low[i.args[1]], high[i.args[1]])
            elif i.op == "OP_CONST":
                work[i.out[0]] = (np.full(low.shape[1], i.value),) * 2
            else:
                work[i.out[0]] = _outward(_applied(i.op, [work[a] for a in i.args]))
    return found[0], found[1]


def _applied(op: str, given: list[Interval]) -> Interval:
    if op in EXACT:
        return EXACT[op](*given)
    if op in RISING:
        return RISING[op](given[0][0]), RISING[op](given[0][1])
    return np.full_like(given[0][0], -np.inf), np.full_like(given[0][0], np.inf)


def _outward(found: Interval) -> Interval:
    """Rounded outward; all numbers where it is not defined."""
    low, high = found
    low, high = low - (ULPS * np.abs(low) + TINY), high + (ULPS * np.abs(high) + TINY)
    unknown = np.isnan(low) | np.isnan(high)
    return np.where(unknown, -np.inf, low), np.where(unknown, np.inf, high)


def _hull(*values: Array) -> Interval:
    """NaN where one of them is."""
    return np.minimum.reduce(values), np.maximum.reduce(values)


def _times(a: Interval, b: Interval) -> Interval:
    return _hull(a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1])


def _over(a: Interval) -> Interval:
    """1 / a."""
    through = (a[0] <= 0) & (a[1] >= 0)
    return np.where(through, np.nan, 1 / a[1]), np.where(through, np.nan, 1 / a[0])


def _square(a: Interval) -> Interval:
    low, high = _hull(a[0] * a[0], a[1] * a[1])
    return np.where((a[0] <= 0) & (a[1] >= 0), 0.0, low), high


def _magnitude(a: Interval) -> Interval:
    low, high = _hull(np.abs(a[0]), np.abs(a[1]))
    return np.where((a[0] <= 0) & (a[1] >= 0), 0.0, low), high


def _power(a: Interval, b: Interval) -> Interval:
    """Whole powers that are constants; others of what is > 0."""
    n = b[0]
    whole = (b[0] == b[1]) & (n == np.round(n))
    positive = _hull(a[0]**b[0], a[0]**b[1], a[1]**b[0], a[1]**b[1])
    even, around = whole & (n % 2 == 0), (a[0] <= 0) & (a[1] >= 0)
    fits = np.where(whole, (n >= 0) | ~around, a[0] > 0)
    low = np.where(even & around, np.where(n == 0, 1.0, 0.0), positive[0])
    return np.where(fits, low, np.nan), np.where(fits, positive[1], np.nan)


def _sine(a: Interval, ahead: float = 0.0) -> Interval:
    """sin(a + ahead), the tops of which are at pi / 2 + 2 pi k - ahead."""
    low, high = _hull(np.sin(a[0] + ahead), np.sin(a[1] + ahead))
    slack = 8 * ULPS * (1 + np.abs(a[0]) + np.abs(a[1]))  # of where a top is, in floating point

    def holds(top: float) -> Any:
        return np.ceil((a[0] - slack - top) / (2 * np.pi)) <= np.floor((a[1] + slack - top) / (2 * np.pi))

    low, high = low - slack, high + slack
    return (np.where(holds(-np.pi / 2 - ahead), -1.0, np.maximum(low, -1.0)),
            np.where(holds(np.pi / 2 - ahead), 1.0, np.minimum(high, 1.0)))


def _tangent(a: Interval) -> Interval:
    inside = np.floor(a[0] / np.pi - 0.5) == np.floor(a[1] / np.pi - 0.5)
    inside &= np.cos(a[0]) * np.cos(a[1]) > 1e-12  # not so near a pole that rounding decides
    return np.where(inside, np.tan(a[0]), np.nan), np.where(inside, np.tan(a[1]), np.nan)


def _hyperbolic_cosine(a: Interval) -> Interval:
    b = _magnitude(a)
    return np.cosh(b[0]), np.cosh(b[1])


RISING: dict[str, Callable[[Array], Array]] = {
    "OP_ASSIGN": np.positive, "OP_EXP": np.exp, "OP_LOG": np.log, "OP_SQRT": np.sqrt, "OP_ASIN": np.arcsin,
    "OP_ATAN": np.arctan, "OP_SINH": np.sinh, "OP_TANH": np.tanh, "OP_ASINH": np.arcsinh, "OP_LOG1P": np.log1p,
    "OP_EXPM1": np.expm1, "OP_FLOOR": np.floor, "OP_CEIL": np.ceil, "OP_SIGN": np.sign, "OP_TWICE": lambda a: 2 * a}
EXACT: dict[str, Callable[..., Interval]] = {
    "OP_NEG": lambda a: (-a[1], -a[0]), "OP_ACOS": lambda a: (np.arccos(a[1]), np.arccos(a[0])),
    "OP_ADD": lambda a, b: (a[0] + b[0], a[1] + b[1]), "OP_SUB": lambda a, b: (a[0] - b[1], a[1] - b[0]),
    "OP_MUL": _times, "OP_DIV": lambda a, b: _times(a, _over(b)), "OP_INV": _over, "OP_SQ": _square,
    "OP_FABS": _magnitude, "OP_POW": _power, "OP_CONSTPOW": _power, "OP_SIN": _sine,
    "OP_COS": lambda a: _sine(a, np.pi / 2), "OP_TAN": _tangent, "OP_COSH": _hyperbolic_cosine,
    "OP_FMIN": lambda a, b: (np.minimum(a[0], b[0]), np.minimum(a[1], b[1])),
    "OP_FMAX": lambda a, b: (np.maximum(a[0], b[0]), np.maximum(a[1], b[1]))}
