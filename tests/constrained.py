"""Constrained problems with their optima by IPOPT, written without nocl's solvers: multiple shooting on the same nodes,
RK4 and zero-order hold; gains from the tails' KKT systems.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from scipy.optimize import nnls

import nocl
from nocl.data import Solution
from nocl.solvers.ddp.constraints import Block, ConstraintRows

WARM = {"ipopt.mu_init": 1e-8, "ipopt.bound_push": 1e-9, "ipopt.bound_frac": 1e-9, "ipopt.slack_bound_push": 1e-9,
        "ipopt.slack_bound_frac": 1e-9, "ipopt.warm_start_init_point": "yes", "ipopt.warm_start_bound_push": 1e-9,
        "ipopt.warm_start_slack_bound_push": 1e-9, "ipopt.warm_start_mult_bound_push": 1e-9}
TIGHT = {"ipopt.tol": 1e-11, "ipopt.constr_viol_tol": 1e-12, "ipopt.compl_inf_tol": 1e-12, "ipopt.dual_inf_tol": 1e-9,
         "ipopt.acceptable_iter": 0, "ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes",
         "ipopt.fixed_variable_treatment": "make_parameter", "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 500}
ACTIVE = 1e-7  # of a scale, and of a usual multiplier


@dataclass
class Problem:
    """An OCP with rows: (name, expression, scale), >= 0 at stages and at the end, or = 0 at the end."""

    ocp: nocl.OCP
    stage: list[tuple[str, ca.SX, float]]
    end: list[tuple[str, ca.SX, float]] = field(default_factory=list)
    equal: list[tuple[str, ca.SX, float]] = field(default_factory=list)

    @property
    def rows(self) -> ConstraintRows:
        return ConstraintRows(block(self.stage, []), block(self.end, self.equal))


def block(unequal: list[tuple[str, ca.SX, float]], equal: list[tuple[str, ca.SX, float]]) -> Block:
    names, c, scales = zip(*unequal, *equal, strict=True)
    return Block.of(ca.vertcat(*c), [False] * len(unequal) + [True] * len(equal), list(names), list(scales))


def cartpole() -> Problem:
    ocp = nocl.load_ocp("cartpole")
    p, v = ocp.system.x[0], ocp.system.x[1]
    rows = [("track", 0.6 - p, 0.6), ("track", p + 0.6, 0.6), ("speed", 2 - v, 2.0), ("speed", v + 2, 2.0)]
    return Problem(ocp, rows, rows)


def dubins() -> Problem:
    ocp = nocl.load_ocp("dubins")
    rows = [("obstacle", ocp.path_constraints["obstacle"], 0.5)]
    return Problem(ocp, rows, rows)


def point() -> Problem:
    """A point with thrust, at most 1 fast, round a disc, to rest at the origin."""
    px, py, vx, vy, ax, ay = (ca.SX.sym(name) for name in ("px", "py", "vx", "vy", "ax", "ay"))
    system = nocl.System("point", x=ca.vertcat(px, py, vx, vy), u=ca.vertcat(ax, ay), xdot=ca.vertcat(vx, vy, ax, ay),
                         lbu=[-2, -2], ubu=[2, 2], lbx=[-4, -4, -2, -2], ubx=[4, 4, 2, 2])
    ocp = nocl.OCP(system, horizon=5.0, running=0.1 * (ax**2 + ay**2), terminal=ca.SX(0), x_goal=[0] * 4,
                   u_goal=[0, 0], initial_states=nocl.Uniform([-3, -1, -0.3, -0.3], [-2, 1, 0.3, 0.3]))
    rows = [("disc", (px + 1)**2 + (py - 0.1)**2 - 0.25, 0.25), ("speed", 1 - vx**2 - vy**2, 1.0)]
    thrust = ("thrust", 1.5**2 - ax**2 - ay**2, 1.5**2)
    return Problem(ocp, [*rows, thrust], rows, [("at goal", x, 1.0) for x in ca.vertsplit(system.x)])


def planar_quadrotor() -> Problem:
    """Mass 1 kg, inertia 0.02 kg m^2, arm 0.2 m, g 9.81; thrusts in [0, 10] N, together at most 14 N."""
    x, z, phi, vx, vz, w = symbols = [ca.SX.sym(name) for name in ("x", "z", "phi", "vx", "vz", "w")]
    left, right = ca.SX.sym("left"), ca.SX.sym("right")
    thrust, g, goal = left + right, 9.81, [1, 1, 0, 0, 0, 0]
    system = nocl.System(
        "planar_quadrotor", x=ca.vertcat(*symbols), u=ca.vertcat(left, right),
        xdot=ca.vertcat(vx, vz, w, -thrust * ca.sin(phi), thrust * ca.cos(phi) - g, (right - left) * 10),
        lbu=[0, 0], ubu=[10, 10], lbx=[-4, -4, -1.5, -6, -6, -6], ubx=[4, 4, 1.5, 6, 6, 6], angles=["phi"])
    ocp = nocl.OCP(system, horizon=3.0, running=0.01 * ((left - g / 2)**2 + (right - g / 2)**2), terminal=ca.SX(0),
                   x_goal=goal, u_goal=[g / 2, g / 2],
                   initial_states=nocl.Gaussian(mean=[-1, 0, 0, 0, 0, 0], std=[0.3, 0.3, 0.1, 0.1, 0.1, 0.1]))
    rows = [("tilt", 0.5 - phi, 0.5), ("tilt", phi + 0.5, 0.5), ("speed", 4 - vx**2 - vz**2, 4.0),
            ("disc", x**2 + (z - 0.3)**2 - 0.16, 0.16)]
    there = [("at goal", x - to, 1.0) for x, to in zip(symbols, goal, strict=True)]
    return Problem(ocp, [*rows, ("thrust", 14 - thrust, 14.0)], rows, there)


PROBLEMS = {"cartpole": cartpole, "dubins": dubins, "point": point, "planar_quadrotor": planar_quadrotor}


class Shooting:
    """The nonlinear program of a problem from (x0, h); its variables are u_0, x_1, u_1, ... x_K."""

    def __init__(self, problem: Problem, intervals: int, solver: str = "ipopt") -> None:
        self.problem, self.K = problem, intervals
        system = problem.ocp.system
        self.n, self.m = system.nx, system.nu
        self.step = rk4_step(problem.ocp)
        x, u = system.x, system.u
        mixed = [c / scale for _, c, scale in problem.stage]
        self.stage = ca.Function("stage", [x, u], [ca.vertcat(ca.SX(0, 1), *mixed)])
        self.first = ca.Function("first", [x, u], [ca.vertcat(ca.SX(0, 1), *(c for c in mixed if holds_control(c, u)))])
        self.end = ca.Function("end", [x], [ca.vertcat(ca.SX(0, 1), *(c / scale for _, c, scale in problem.end))])
        self.equal = ca.Function("equal", [x], [ca.vertcat(ca.SX(0, 1), *(c / s for _, c, s in problem.equal))])
        self._build()

    def _build(self) -> None:
        x0, h = ca.MX.sym("x0", self.n), ca.MX.sym("h")
        z = ca.MX.sym("z", self.K * (self.n + self.m))
        cost, x, g, lower, upper = ca.MX(0), x0, [], [], []
        self.node = []  # of each row of g: k for what follows from (x_k, u_k)
        for k in range(self.K):
            u, after = self.parts(z, k)
            rows = (self.first if k == 0 else self.stage)(x, u)
            following, c = self.step(x, u, h)
            cost += c
            for part, top in ((after - following, 0.0), (rows, np.inf)):
                g.append(part)
                lower += [0.0] * part.numel()
                upper += [top] * part.numel()
                self.node += [k] * part.numel()
            x = after
        for part, top in ((self.end(x), np.inf), (self.equal(x), 0.0)):
            g.append(part)
            lower += [0.0] * part.numel()
            upper += [top] * part.numel()
            self.node += [self.K] * part.numel()
        cost += self.problem.ocp.G(x)
        self.z, self.x0, self.h, self.cost, self.g = z, x0, h, cost, ca.vertcat(*g)
        self.lower, self.upper = np.array(lower), np.array(upper)

    def parts(self, z: ca.MX, k: int) -> tuple[ca.MX, ca.MX]:
        at = k * (self.n + self.m)
        return z[at:at + self.m], z[at + self.m:at + self.m + self.n]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        s, free = self.problem.ocp.system, np.full(self.n, np.inf)
        return np.tile(np.r_[s.lbu, -free], self.K), np.tile(np.r_[s.ubu, free], self.K)

    def solve(self, x0: np.ndarray, h: float, x: np.ndarray, u: np.ndarray) -> Optimum:
        """From a guess x [K+1, n], u [K, m]; AssertionError where IPOPT fails."""
        if not hasattr(self, "program"):
            program = {"x": self.z, "p": ca.vertcat(self.x0, self.h), "f": self.cost, "g": self.g}
            self.program = ca.nlpsol("program", "ipopt", program, {**TIGHT, **WARM})
        low, high = self.bounds
        p = np.r_[x0, h]
        got = self.program(x0=np.c_[u, x[1:]].ravel(), p=p, lbx=low, ubx=high, lbg=self.lower, ubg=self.upper)
        assert self.program.stats()["success"], self.program.stats()["return_status"]
        z = got["x"].full().reshape(self.K, -1)
        return Optimum(self, p, float(got["f"]), np.vstack([x0, z[:, self.m:]]), z[:, :self.m],
                       got["lam_g"].full().ravel(), got["lam_x"].full().ravel())


@dataclass
class Optimum:
    """What IPOPT found."""

    program: Shooting
    p: np.ndarray
    cost: float
    x: np.ndarray  # [K+1, n]
    u: np.ndarray  # [K, m]
    lam_g: np.ndarray
    lam_x: np.ndarray

    def costate(self) -> np.ndarray:
        """dJ*/dx_k for k = 1 ... K [K, n]: minus the multipliers of the gaps."""
        s, node = self.program, np.array(self.program.node)
        return np.array([-self.lam_g[np.flatnonzero(node == k)[:s.n]] for k in range(s.K)])

    def gain(self, k: int) -> np.ndarray:
        """du_k/dx_k of the problem that begins at node k [m, n]: its KKT system, the active rows as equalities.

        NaN where the active rows leave no freedom there, so that no plan holds them from beside x_k.
        """
        H, J = self.derivatives
        s, node = self.program, np.array(self.program.node)
        at = k * (s.n + s.m)
        before, free = slice(at - s.n, at), np.ones(len(H) - at, dtype=bool)
        free[np.abs(self.lam_x[at:]) > ACTIVE] = False
        active = (s.lower == s.upper) | (np.abs(self.lam_g) > ACTIVE)
        rows = np.flatnonzero(active & (node >= k) & (np.abs(J[:, at:]).max(axis=1) > 0))
        A, W = J[rows][:, at:][:, free], H[at:, at:][free][:, free]
        if len(A) > free.sum() or np.linalg.svd(A, compute_uv=False).min(initial=1.0) < 1e-7:
            return np.full((s.m, s.n), np.nan)
        KKT = np.block([[W, A.T], [A, np.zeros((len(A), len(A)))]])
        right = np.vstack([H[at:, before][free], J[rows][:, before]])
        slopes = np.zeros((len(free), s.n))
        slopes[free] = -np.linalg.solve(KKT, right)[:free.sum()]
        return slopes[:s.m]

    @cached_property
    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        """The Hessian of the Lagrangian and the Jacobian of the rows."""
        s = self.program
        if not hasattr(s, "second"):
            lam = ca.MX.sym("lam", s.g.numel())
            H = ca.hessian(s.cost + ca.dot(lam, s.g), s.z)[0]
            s.second = ca.Function("second", [s.z, ca.vertcat(s.x0, s.h), lam], [H, ca.jacobian(s.g, s.z)])
        z = np.c_[self.u, self.x[1:]].ravel()
        H, J = s.second(z, self.p, self.lam_g)
        return H.full(), J.full()


def holds_control(c: ca.SX, u: ca.SX) -> bool:
    return bool(ca.depends_on(c, u))


def rk4_step(ocp: nocl.OCP) -> ca.Function:
    """(x, u, h) -> (x after h, its cost), one step with u held."""
    x, u, h = ca.SX.sym("x", ocp.system.nx), ca.SX.sym("u", ocp.system.nu), ca.SX.sym("h")
    of = ca.Function("of", [ocp.system.x, ocp.system.u], [ca.vertcat(ocp.system.xdot, ocp.running)])

    def slope(z):
        return of(z[:-1], u)

    z = ca.vertcat(x, 0)
    k1 = slope(z)
    k2 = slope(z + h / 2 * k1)
    k3 = slope(z + h / 2 * k2)
    k4 = slope(z + h * k3)
    z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("step", [x, u, h], [z[:-1], z[-1]]).expand()


def kkt_residual(problem: Problem, s: Solution, i: int, p: np.ndarray | None = None) -> float:
    """How far row i of a solution is from the first-order conditions, its V_x the costates, relative to them.

    At each node some multipliers >= 0 of the rows that are active there, and of controls at their limits, must make up
    what is left of the Lagrangian's slope: the best ones are found by least squares.
    """
    ocp, h, worst = problem.ocp, s.t[i, 1] - s.t[i, 0], 0.0
    z, u, system = ca.vertcat(ocp.system.x, ocp.system.u), ocp.system.u, ocp.system
    step = rk4_step(ocp)
    after, cost = step(system.x, u, h)
    slopes = ca.Function("slopes", [z], [ca.jacobian(after, z), ca.gradient(cost, z)])
    stage, end = (rows_and_slopes(part, z, ocp.p) for part in (problem.stage, problem.end + problem.equal))
    p = np.zeros(0) if p is None else p
    here = np.r_[s.x[i, -1], np.zeros(system.nu)]
    G_x = ca.Function("G_x", [system.x], [ca.gradient(ocp.terminal, system.x)])(s.x[i, -1]).full().ravel()
    left = np.r_[G_x - s.V_x[i, -1], np.zeros(system.nu)]
    worst = unexplained(left, *end(here, p), len(problem.equal))
    for k in range(s.u.shape[1]):
        here = np.r_[s.x[i, k], s.u[i, k]]
        F, l_z = (d.full() for d in slopes(here))
        left = l_z.ravel() + F.T @ s.V_x[i, k + 1] - np.r_[s.V_x[i, k], np.zeros(system.nu)]
        c, C = stage(here, p)
        push = np.hstack([np.zeros((system.nu, system.nx)), np.eye(system.nu)])
        c = np.r_[c.full().ravel(), s.u[i, k] - system.lbu, system.ubu - s.u[i, k]]
        C = np.vstack([C.full(), push, -push])
        if k == 0:
            c = np.where(np.abs(C[:, system.nx:]).max(axis=1) > 0, c, np.inf)
        worst = max(worst, unexplained(left, c, C, 0))
    return worst / np.abs(s.V_x[i]).max()


def rows_and_slopes(rows: list[tuple[str, ca.SX, float]], z: ca.SX, p: ca.SX) -> ca.Function:
    c = ca.vertcat(ca.SX(0, 1), *(c / scale for _, c, scale in rows))
    return ca.Function("rows", [z, p], [ca.densify(c), ca.densify(ca.jacobian(c, z))])


def unexplained(slope: np.ndarray, c, C, equalities: int) -> float:
    """|slope - C'a| for the best multipliers a of active rows, >= 0 but for the last ones, equalities."""
    c, C = np.array(c).ravel(), np.array(C).reshape(-1, len(slope))
    active = C[np.abs(c) < ACTIVE]
    both = C[len(C) - equalities:]
    return float(nnls(np.vstack([active, both, -both]).T, slope)[1]) if len(active) else float(np.linalg.norm(slope))
