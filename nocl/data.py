"""What flows between the parts: labels, trajectories, solutions. B is the batch dimension, K the intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl.definition.sampling import Seed
from nocl.definition.system import System
from nocl.support import checks
from nocl.support.checks import Array

SAME = 1e-3  # costs closer than this, relative, count as the same optimum
TINY = 1e-10  # ... and of the usual cost: below that, costs are equal
ROUNDING = 1e-9  # of the time that a solution spans


class _RowsError(ValueError, IndexError):
    """Rows that are not there: also an IndexError, by which Python ends a loop over the rows."""


class Controller(Protocol):
    """u = pi(x, t): numpy rows x [B, nx] at one time t give u [B, nu]."""

    def __call__(self, x: Array, t: float = 0.0) -> Array: ...


@dataclass(frozen=True, eq=False)
class Dataset:
    """Labels of the dynamics: xdot = f(x, u) with its Jacobians, or without (logged data)."""

    x: Array  # [N, nx]
    u: Array  # [N, nu]
    xdot: Array  # [N, nx]
    A: Array | None = None  # [N, nx, nx], df/dx
    B: Array | None = None  # [N, nx, nu], df/du

    def __post_init__(self) -> None:
        x = checks.array(self.x, [None, None], "x", "Dataset")
        N, nx = x.shape
        u = checks.array(self.u, [N, None], "u", "Dataset")
        given = {"x": x, "u": u, "xdot": checks.array(self.xdot, [N, nx], "xdot", "Dataset")}
        for name, n in (("A", nx), ("B", u.shape[1])):
            if getattr(self, name) is not None:
                given[name] = checks.array(getattr(self, name), [N, nx, n], name, "Dataset")
        for name, value in given.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.x)

    @staticmethod
    def sample(system: System, n: int, seed: Seed = 0) -> Dataset:
        """n uniform samples of the box X x U with exact labels."""
        checks.instance(System, system, "system", "Dataset.sample", "of an OCP, pass ocp.system")
        n, rng = checks.whole(n, "n", "Dataset.sample", 1), checks.generator(seed, "Dataset.sample")
        x = rng.uniform(system.lbx, system.ubx, (n, system.nx))
        return Dataset.label(system, x, rng.uniform(system.lbu, system.ubu, (n, system.nu)))

    @staticmethod
    def label(system: System, x: Array, u: Array) -> Dataset:
        """Exact labels at given rows x [N, nx], u [N, nu]."""
        checks.instance(System, system, "system", "Dataset.label", "of an OCP, pass ocp.system")
        system.refuse_parameters("Dataset")
        x = checks.array(x, [None, system.nx], "x", "Dataset.label")
        n = len(x)
        u = checks.array(u, [n, system.nu], "u", "Dataset.label")
        A, B = (j.full() for j in system.jacobian(x.T, u.T))
        return Dataset(x, u, system.f(x.T, u.T).full().T, _blocks(A, n), _blocks(B, n))


def _blocks(side_by_side: Array, n: int) -> Array:
    """CasADi's [r, n * c] as rows [n, r, c]."""
    rows, columns = side_by_side.shape
    return side_by_side.reshape(rows, n, columns // max(n, 1)).transpose(1, 0, 2)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States at nodes, controls held between them."""

    t: Array  # [K+1]
    x: Array  # [B, K+1, nx]
    u: Array  # [B, K, nu], held over [t_k, t_{k+1})


@dataclass(frozen=True, eq=False)
class Solution:
    """Solutions of B optimal control problems, a row each, by any solver; a failed one has success False and says why.

    A row as feedback is u = u_k + gain_k (x - x_k) on [t_k, t_k+1), from every solver: `gain` is du/dx, and 0 for a
    control that a bound holds. `LQR.K` alone has its field's sign, u = u* - K (x - x*). V, V_x, V_xx are the cost-to-go
    at the nodes and its derivatives in x, V_p is dJ*/dp. NaN stands for what a solver does not know or was not asked
    for.

    Rows: `solution[rows]`, `Solution.join`, `put`. In time: `solution(t)`, `solution.feedback(x, t)`.
    """

    t: Array  # [B, K+1], the nodes; where the horizon is free, each row has its own
    x: Array  # [B, K+1, nx]; of a failed row NaN, or where its solver ended
    u: Array  # [B, K, nu], held over [t_k, t_k+1)
    gain: Array  # [B, K, nu, nx], du/dx; NaN also where there is no strict optimum
    V: Array  # [B, K+1]
    V_x: Array  # [B, K+1, nx]
    cost: Array  # [B], inf where the solve failed
    success: NDArray[np.bool_]  # [B]
    message: NDArray[np.str_]  # [B]
    seconds: Array  # [B], of all that was tried; a batch that was solved as one is shared out evenly
    iterations: NDArray[np.int64]  # [B], of all that was tried
    V_xx: Array | None = None  # [B, K+1, nx, nx]
    tried: Array | None = None  # [B, n], the cost that each start ended at: inf, it failed; NaN, there were fewer
    unit: Array | None = None  # [B], what costs of the problem usually are
    clearance: Array | None = None  # [B], min of all constraints at the nodes, as Simulation has it; inf: there is none
    dense: Array | None = None  # [B, K, 4, 2 nx]: (x, costate) at both ends of intervals, their time derivatives
    p: Array | None = None  # [B, np], the parameters of each problem; None where it has none
    V_p: Array | None = None  # [B, np], dJ*/dp; None where there are no parameters
    slack: Array | None = None  # [B, K+1, n], by how much each of NMPC's n soft constraints is exceeded, in its scale
    cut: NDArray[np.bool_] | None = None  # [B], whether constraints are left between nodes; None where nobody looked

    def __len__(self) -> int:
        return len(self.cost)

    @property
    def parameters(self) -> Array:
        """p [B, np], with no columns where the problem has none."""
        return np.zeros((len(self), 0)) if self.p is None else self.p

    @staticmethod
    def blank(t: Array, nx: int, nu: int, p: Array | None = None) -> Solution:
        """Rows without a solution yet, on the nodes t [B, K+1]; p [B, np], where the problem has parameters."""
        known = {} if p is None or not p.shape[1] else {"p": p.copy(), "V_p": np.full(p.shape, np.nan)}
        B, K = len(t), t.shape[1] - 1
        x, u, gain, V = (np.full((B, *shape), np.nan) for shape in ((K + 1, nx), (K, nu), (K, nu, nx), (K + 1,)))
        return Solution(t, x, u, gain, V, x.copy(), np.full(B, np.inf), np.zeros(B, dtype=bool),
                        np.full(B, "not tried"), np.zeros(B), np.zeros(B, dtype=np.int64), **known)

    @property
    def rank(self) -> NDArray[np.int64]:
        """[B], by which solutions are chosen before their costs: 0; 1 of those that cut corners; 2 of failed ones."""
        cut = np.zeros(len(self), dtype=bool) if self.cut is None else self.cut
        return np.where(np.isposinf(self.cost), 2, cut)

    @property
    def costate(self) -> Array:
        """V_x by its other name."""
        return self.V_x

    @property
    def starts(self) -> NDArray[np.int64]:
        """How many starts were tried [B]."""
        return (~np.isnan(self._tried)).sum(axis=1)

    @property
    def hits(self) -> NDArray[np.int64]:
        """How many of them ended at the best cost, SAME apart at most [B]."""
        return hits(self._tried, self.cost, self._unit)

    @property
    def optima(self) -> list[Array]:
        """The costs of the local optima found, rising, and how many starts ended at each: [n, 2] for each row."""
        return [distinct(costs, unit) for costs, unit in zip(self._tried, self._unit, strict=True)]

    @property
    def _tried(self) -> Array:
        return self.cost[:, None] if self.tried is None else self.tried

    @property
    def _unit(self) -> Array:
        """The usual cost of each row; where it is not known, the largest that was found."""
        found = np.abs(self._tried)
        most = found[np.isfinite(found)].max(initial=0.0)
        return np.full(len(self), most) if self.unit is None else np.where(np.isnan(self.unit), most, self.unit)

    def __getitem__(self, rows: Any) -> Solution:
        """The solutions of some rows: a number, a slice, a mask or indices."""
        try:
            chosen = np.atleast_1d(np.arange(len(self))[rows])
        except Exception:  # whatever its own conversion raises
            raise _RowsError(f"solution[rows]: rows is {checks.shown(rows)}; expected a number, a slice, a mask or "
                           f"indices of its {len(self)} rows") from None
        return Solution(**{name: value[chosen] for name, value in self.arrays().items()})

    @staticmethod
    def join(parts: Iterable[Solution]) -> Solution:
        """Several batches as one, without what one of them lacks."""
        batches = list(parts)
        most = max(batch._tried.shape[1] for batch in batches)

        def column(name: str) -> Array | None:
            values = [getattr(batch, name) for batch in batches]
            if any(value is None for value in values):
                return None
            return np.concatenate([_widened(v, most) for v in values] if name == "tried" else values)

        return Solution(**{name: column(name) for name in vars(batches[0])})  # type: ignore[arg-type]

    def put(self, rows: Any, other: Solution) -> None:
        """Overwrite some rows with another batch, in place; what it lacks becomes NaN there, or False."""
        for name, value in self.arrays().items():
            new = getattr(other, name)
            if name == "message":  # arrays of text are as wide as their longest
                value = value.astype(np.promote_types(value.dtype, new.dtype), copy=False)
            elif name == "tried":
                most = max(value.shape[1], other._tried.shape[1])
                value, new = _widened(value, most), _widened(other._tried, most)
            lacking = False if value.dtype == bool else np.nan
            value[rows] = lacking if new is None else new
            object.__setattr__(self, name, value)

    def arrays(self) -> dict[str, Any]:
        """Its fields as plain arrays, for a file; those that it lacks are left out."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @staticmethod
    def of_arrays(arrays: dict[str, Any]) -> Solution:
        """The solution of `arrays()`; ValueError where they are not those of a Solution."""
        checks.instance(Mapping, arrays, "arrays", "Solution.of_arrays", "what arrays() gave")
        try:
            return Solution(**arrays)
        except TypeError as error:
            raise ValueError(f"{', '.join(arrays)} are not the arrays of a Solution ({error}); expected what this "
                             "version of nocl wrote: solve again") from error

    def feedback(self, x: Array, t: float = 0.0) -> Array:
        """u_k + gain_k (x - x_k) [B, nu] at states x [B, nx] of time t, one for each row; not clipped to U.

        NaN where there is no gain; ValueError where no row has one.
        """
        x, t = checks.states(x, self.x.shape[2], "the Solution", "x")[0], checks.number(t, "t", "Solution.feedback")
        if len(x) != len(self):
            raise ValueError(f"x has {len(x)} rows; expected {len(self)}, one for each row of the Solution")
        if np.isnan(self.gain).all():
            raise ValueError("this Solution has no `gain`: take that of NMPC.solve(x0, gains=True), or "
                             "DDP's")
        b, k = np.arange(len(self)), self._interval(np.array([t]))[:, 0]
        return self.u[b, k] + np.einsum("bij,bj->bi", self.gain[b, k], x - self.x[b, k])

    def __call__(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """(x, u, costate) at time t, [B, n], or at several times, [B, len(t), n]: cubic Hermite polynomials in `dense`.

        Raises ValueError for times outside the nodes' and where `dense` is missing.
        """
        times = checks.numeric(t, "t", "Solution", "a time or a list of times")
        if self.dense is None:
            raise ValueError("this Solution has no `dense`, which solution(t) interpolates: NMPC.solve gives it, "
                             "in continuous time")
        first, last = self.t[:, 0].max(), self.t[:, -1].min()
        if times.ndim > 1 or not ((times >= first) & (times <= last)).all():
            raise ValueError(f"t is {checks.shown(t)}; expected a time or a list of times in [{first:g}, {last:g}]")
        b, k = np.arange(len(self))[:, None], self._interval(np.atleast_1d(times))
        h = np.diff(self.t)[b, k]
        s = (np.atleast_1d(times) - self.t[b, k]) / h
        ends, slopes = [(1 + 2 * s) * (1 - s) ** 2, s**2 * (3 - 2 * s)], [h * s * (1 - s) ** 2, h * s**2 * (s - 1)]
        z = np.einsum("bken,bke->bkn", self.dense[b, k], np.stack([*ends, *slopes], axis=-1))
        found = z[..., : self.x.shape[2]], self.u[b, k], z[..., self.x.shape[2]:]
        x, u, costate = found if times.ndim else (value[:, 0] for value in found)
        return x, u, costate

    def _interval(self, times: Array) -> NDArray[np.int64]:
        """The interval that each of n times lies in, for each row [B, n]; a node's, up to rounding, is the next one."""
        slack = ROUNDING * (self.t[:, -1] - self.t[:, 0])
        k = np.stack([np.searchsorted(nodes, times + s, side="right") for nodes, s in zip(self.t, slack, strict=True)])
        return np.clip(k - 1, 0, self.u.shape[1] - 1)


def distinct(costs: Array, unit: float) -> Array:
    """(cost, how many reached it) of each local optimum among costs, rising [n, 2]; inf and NaN stand for none.

    unit : the usual cost
    """
    found = np.sort(costs[np.isfinite(costs)])
    if not found.size:
        return np.zeros((0, 2))
    first = np.r_[True, np.diff(found) > np.maximum(SAME * np.abs(found[1:]), TINY * unit)]
    return np.c_[found[first], np.diff(np.r_[np.flatnonzero(first), len(found)])]


def hits(tried: Array, best: Array, unit: Array | float) -> NDArray[np.int64]:
    """How many of the costs tried [B, n] are the best [B]; unit: the usual cost."""
    near = tried <= (best + np.maximum(SAME * np.abs(best), TINY * unit))[:, None]
    return (near & np.isfinite(tried)).sum(axis=1)


def _widened(tried: Array, columns: int) -> Array:
    return np.pad(tried, ((0, 0), (0, columns - tried.shape[1])), constant_values=np.nan)
