"""Odd arguments of every kind to every public function: a finite answer of the right shape, or an error that helps."""

from __future__ import annotations

import warnings
from dataclasses import fields
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from odd import Call, fault, strange

import nocl
from nocl.comparisons import compare
from nocl.definition import measured
from nocl.nets import MLP, FeatureNet
from nocl.solvers import DDP, LQR, NMPC
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.settings import PaperSettings as PaperTraining
from nocl.solvers.ddp.solver import DDPSettings
from nocl.sysid import LogSettings, PaperSettings, Settings, identify
from nocl.sysid.logs.log import Log

REFUSED = ("train",)  # it, and identify, has one bad argument already: they would take long
FAST, ALL = 400, 10_000  # calls in all


def finite(answer: Any, *shape: int) -> bool:
    return np.shape(answer) == shape and bool(np.isfinite(answer).all())


def rows_of(answer: Any, *tail: int) -> bool:
    """[*tail] or [B, *tail]."""
    s = np.shape(answer)
    return (s == tail or s[1:] == tail) and bool(np.isfinite(answer).all())


@cache
def symbols() -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("tau")


def system(**changed: Any) -> nocl.System:
    theta, omega, tau = symbols()
    good = {"name": "swing", "x": ca.vertcat(theta, omega), "u": tau,
            "xdot": ca.vertcat(omega, 9.81 * ca.sin(theta) + tau), "lbu": [-5.0], "ubu": [5.0], "lbx": [-6.3, -8.0],
            "ubx": [6.3, 8.0], "angles": ["theta"], "units": {"theta": "rad"}}
    return nocl.System(**{**good, **changed})


@cache
def plant() -> nocl.System:
    return system()


def ocp_of(**changed: Any) -> nocl.OCP:
    theta, omega, tau = symbols()
    good = {"system": plant(), "horizon": 1.0, "running": 0.01 * tau**2, "terminal": theta**2 + omega**2,
            "x_goal": [0.0, 0.0], "u_goal": [0.0], "initial_states": nocl.Gaussian([0.3, 0.0], [0.1, 0.1]),
            "path_constraints": {"wall": 3 - theta}, "penalty": 300.0, "penalty_margin": 0.005}
    return nocl.OCP(**{**good, **changed})


@cache
def ocp() -> nocl.OCP:
    return ocp_of(path_constraints={})


@cache
def temporary() -> TemporaryDirectory[str]:
    return TemporaryDirectory()


@cache
def folder() -> Path:
    return Path(temporary().name)


@cache
def law() -> nocl.CND:
    def net(n_out: int, name: str) -> FeatureNet:
        x, t, phi = ca.SX.sym("x", 2), ca.SX.sym("t"), ca.SX.sym("phi", n_out)
        torch.manual_seed(0)
        return FeatureNet(ca.Function("inputs", [x, t], [ca.vertcat(x, t)], ["x", "t"], ["phi"]), [MLP([3, 4, n_out])],
                          ca.Function("outputs", [x, t, phi], [phi], ["x", "t", "y"], [name]))

    return nocl.CND(ocp(), net(1, "u"), net(1, "V"), {"method": "none"})


@cache
def anyrate() -> nocl.CND:
    """u(x, t, dt) = 0."""
    x, t, dt, phi = ca.SX.sym("x", 2), ca.SX.sym("t"), ca.SX.sym("dt"), ca.SX.sym("phi")
    ins = ca.Function("inputs", [x, t, dt], [ca.vertcat(x, t, dt)], ["x", "t", "dt"], ["phi"])
    out = ca.Function("outputs", [x, t, dt, phi], [phi], ["x", "t", "dt", "y"], ["u"])
    return nocl.CND(ocp(), FeatureNet(ins, [MLP([4, 2, 1])], out))


@cache
def log() -> Log:
    t = 0.05 * np.arange(20)
    return Log.of(plant(), t, np.c_[np.sin(2 * t), 2 * np.cos(2 * t)], np.cos(3 * t)[:, None])


@cache
def data() -> nocl.Dataset:
    return nocl.Dataset.sample(plant(), 16)


def written(kind: str) -> Path:
    return log().write(folder() / f"log.{kind}")


def bounded(s: nocl.System) -> bool:
    return s.nx == 2 and s.nu == 1 and all(np.isfinite(v).all() for v in (s.lbx, s.ubx, s.lbu, s.ubu))


def solved(answer: nocl.Solution) -> bool:
    """Each row is solved, with a finite cost, or says why not."""
    return len(answer) > 0 and all(np.isfinite(c) if ok else bool(m) for c, ok, m in zip(
        answer.cost, answer.success, answer.message, strict=True))


def judged(answer: Any) -> bool:
    return all(np.isfinite(c) if ok else bool(m) for c, ok, m in zip(answer.cost, answer.success, answer.message,
                                                                    strict=True))


def of_settings(kind: Any) -> Call:
    default = kind()
    good = {f.name: getattr(default, f.name) for f in fields(kind)}
    return Call(kind.__name__, kind, good, lambda s: isinstance(hash(repr(s)), int))


def constructors() -> list[Call]:
    theta, omega, tau = symbols()
    z = ca.vertcat(theta, omega)
    from_f = plant().f
    return [
        Call("System", system, {"name": "swing", "x": z, "u": tau, "xdot": ca.vertcat(omega, tau), "lbu": [-5.0],
             "ubu": [5.0], "lbx": [-6.3, -8.0], "ubx": [6.3, 8.0], "angles": ["theta"], "units": {"theta": "rad"}},
             bounded,
             {"x": [[theta, omega], (theta, 1), theta, ca.vertcat(theta, theta), ca.MX.sym("x", 2)],
              "xdot": [ca.vertcat(omega, ca.SX.sym("mass")), [omega, tau], ca.vertcat(1 / theta, 1e308 * tau), tau,
                       ca.vertcat(ca.log(-1 - theta**2), tau)], "name": ["a b", "1a", "é"]}),
        Call("System.from_casadi", nocl.System.from_casadi, {"f": from_f, "lbu": [-5.0], "ubu": [5.0],
             "lbx": [-6.3, -8.0], "ubx": [6.3, 8.0], "name": "swing", "states": ["a", "b"], "controls": ["c"]}, bounded,
             {"f": [from_f.wrap(), ocp().functions.L]}),
        Call("System.from_data", nocl.System.from_data, {"data": plant().to_data()}, bounded),
        Call("OCP", ocp_of, {"system": plant(), "horizon": 1.0, "running": 0.01 * tau**2, "terminal": theta**2,
             "x_goal": [0.0, 0.0], "u_goal": [0.0], "initial_states": nocl.Gaussian([0.3, 0.0], [0.1, 0.1]),
             "path_constraints": {"wall": 3 - theta}, "penalty": 300.0,
             "penalty_margin": 0.005, "constraints": {"power": (None, tau * omega, 4), "line": (0, theta + omega, 0)},
             "terminal_constraints": {"end": (0, theta, 0)}, "state_bounds": {"omega": (-3, 3)},
             "scales": {"power": 2.0}},
             lambda o: 0 < o.longest < np.inf and (o.functions.scales > 0).all() and (o.functions.end_scales > 0).all(),
             {"running": [tau, theta, ca.sqrt(theta), ca.log(theta) * 0, ca.SX.sym("w"), 1e308 * tau**2,
                          ca.norm_2(z)],
              "terminal": [tau, ca.norm_2(z), 1.0], "path_constraints": [{1: theta}, {"a": tau}, {"a": None}],
              "horizon": [nocl.Free(0.5, 2), nocl.Free], "state_bounds": [{"omega": 3}, {"omega": (1, None)}],
              "constraints": [{"a": (1, tau)}, {"a": (2, tau, 1)}, {"a": (0, tau, "1")}, {"a": 1.0}, {"wall": tau}],
              "terminal_constraints": [{"a": tau}, {"a": nocl.time()}, {"a": (theta, theta, theta)}],
              "scales": [{"power": -1}, {"a": 1}, {"power": "1"}]}),
        Call("Free", nocl.Free, {"low": 0.5, "high": 2.0}, lambda f: 0 < f.low < f.high < np.inf),
        Call("limit_rates", nocl.limit_rates, {"system": plant(), "rates": {"tau": 2.0}}, lambda s: s.nx == 3,
             {"rates": [{"tau": 0}, {"omega": 1}, {"tau": "1"}, {1: 1}]}),
        Call("OCP.quadratic", nocl.OCP.quadratic, {"system": plant(), "x_goal": [0.0, 0.0], "u_goal": [0.0], "R": 0.01,
             "P": [1.0, 1.0], "horizon": 1.0, "initial_states": nocl.Uniform([-1, -1], [1, 1])},
             lambda o: o.horizon > 0,
             {"R": [-1, [[1]], [[1, 2]]], "P": [[[1, 2], [0, 1]], -1]}),
        Call("OCP.from_data", nocl.OCP.from_data, {"data": ocp().to_data()}, lambda o: o.horizon > 0),
        Call("Gaussian", nocl.Gaussian, {"mean": [0.3, 0.0], "std": [0.1, 0.1]},
             lambda d: rows_of(d.mean, d.n) and rows_of(d.std, d.n)),
        Call("Uniform", nocl.Uniform, {"lb": [-1.0, -1.0], "ub": [1.0, 1.0]}, lambda d: rows_of(d.lb, d.n)),
        Call("Gaussian.sample", nocl.Gaussian([0, 1], [1, 2]).sample, {"n": 3, "seed": 0}, lambda x: rows_of(x, 2)),
        Call("Uniform.sample", nocl.Uniform([0, 1], [1, 2]).sample, {"n": 3, "seed": 0}, lambda x: rows_of(x, 2)),
        Call("Dataset", nocl.Dataset, {k: getattr(data(), k) for k in ("x", "u", "xdot", "A", "B")},
             lambda d: len(d.x) == len(d.u) == len(d.xdot)),
        Call("Dataset.sample", nocl.Dataset.sample, {"system": plant(), "n": 4, "seed": 0},
             lambda d: rows_of(d.xdot, 2) and rows_of(d.A, 2, 2)),
        Call("Dataset.label", nocl.Dataset.label, {"system": plant(), "x": data().x, "u": data().u},
             lambda d: rows_of(d.x, 2)),
        Call("split_controls", nocl.split_controls, {"system": plant(), "names": ["tau"]}),
        Call("smooth_abs", nocl.smooth_abs, {"e": theta, "width": 0.1}),
        Call("smooth_max", nocl.smooth_max, {"a": theta, "b": 0.0, "width": 0.1}),
    ]


def problems() -> list[Call]:
    s, o = plant(), ocp()
    return [
        Call("System.linearize", s.linearize, {"x": [0.1, 0.2], "u": [0.3]},
             lambda AB: finite(AB[0], 2, 2) and finite(AB[1], 2, 1)),
        Call("System.unit", s.unit, {"name": "theta"}),
        Call("System.difference", s.difference, {"other": system(), "equations": True}),
        Call("System.under", s.under, {"f": s.f.wrap()}),
        Call("OCP.from_goal", o.from_goal, {"x": [[0.1, 0.2]]}, lambda d: d.shape[-1] == 2 or d.shape == (2, 1)),
        Call("least", partial(measured.least, ocp_of()), {"x": np.zeros((2, 3, 2))}, lambda v: v.shape == (2, 1)),
        Call("violation", partial(measured.violation, ocp_of()), {"least": np.zeros((2, 1))},
             lambda v: v.ndim == 1 and not np.isnan(v).any()),
        Call("simulate", partial(nocl.simulate, o), {"controller": LQR(o), "x0": [0.1, 0.0], "f": s.f, "hold": 3,
             "nodes": 5, "kicks": [(0.5, [0.0, 0.1])], "delay": 0.0, "t0": 0.0, "rtol": 1e-6, "atol": 1e-6}, judged,
             {"controller": [np.zeros((1, 4, 1)), [[0.0]] * 3, lambda x, t: "a", lambda x, t: x * np.nan, law(),
                             lambda x, t: None],
              "kicks": [[(2.0, [0, 0])], [("a", [0, 0])], [(0.5, [0])], [(0.5,)], [0.5], [(0.5, np.ma.masked)]]}),
        Call("LQR", LQR, {"ocp": o, "infinite": False}),
        Call("LQR()", LQR(o), {"x": [0.1, 0.2], "t": 0.5}, lambda u: rows_of(u, 1)),
        Call("LQR.value", LQR(o).value, {"x": [0.1, 0.2], "t": 0.5}, lambda V: bool(np.isfinite(V).all())),
        Call("LQR.K", LQR(o).K, {"t": 0.5}, lambda K: finite(K, 1, 2)),
        Call("LQR.P", LQR(o).P, {"t": 0.5}, lambda K: finite(K, 2, 2)),
        Call("load_ocp", nocl.load_ocp, {"name_or_path": "double_integrator", "horizon": 2.0}, lambda p: p.horizon > 0),
        Call("load_ocp options", partial(nocl.load_ocp, "pendulum"), {"horizon": 2.0, "gravity": 9.81},
             lambda p: p.horizon > 0),
        Call("pretrained", nocl.pretrained, {"name": "pendulum", "dynamics": "exact"}),
        Call("to_torch", nocl.to_torch, {"function": s.f}),
        Call("to_torch()", lambda x, u: nocl.to_torch(s.f)(x, u), {"x": torch.zeros(3, 2), "u": torch.zeros(3, 1)},
             lambda y: bool(torch.isfinite(y).all()) and y.shape[-1] == 2),
        Call("to_casadi", nocl.to_casadi, {"module": torch.nn.Linear(2, 1), "n_in": 2, "backend": "native", "name": "f",
             "in_names": ["x"], "out_names": ["y"]}),
    ]


def controllers() -> list[Call]:
    c, x = law(), {"x": [0.1, 0.2], "t": 0.5}
    law().save(folder() / "law")
    return [
        Call("CND()", c, x, lambda u: rows_of(u, 1)),
        Call("CND.value", c.value, x, lambda V: bool(np.isfinite(V).all())),
        Call("CND.value_gradient", c.value_gradient, x, lambda V: rows_of(V, 2)),
        Call("CND", nocl.CND, {"ocp": ocp(), "policy": c.policy, "value": c.value_net, "card": {"a": 1}}),
        Call("CND.at_rate", anyrate().at_rate, {"dt": 0.01}),
        Call("CND.to_casadi", c.to_casadi, {"backend": "native", "build_dir": None}),
        Call("CND.value_to_casadi", c.value_to_casadi, {"backend": "native", "build_dir": None}),
        Call("CND.closed_loop_to_casadi", c.closed_loop_to_casadi, {"dynamics": plant().f}),
        Call("CND.to_c", c.to_c, {"folder": folder() / "c", "dtype": "float64", "only": ["policy"]}),
        Call("CND.save", c.save, {"folder": folder() / "law"}),
        Call("CND.load", nocl.CND.load, {"folder": folder() / "law"}),
    ]


def solvers() -> list[Call]:
    o = ocp()
    nmpc, ddp = NMPC(o, 4, starts=1, passes=0, time_limit=1.0), DDP(o, intervals=4, threads=1)
    start = nmpc.solve([0.1, 0.0], progress=False)
    return [
        Call("NMPC", partial(NMPC, o), {"intervals": 4, "dynamics": plant().f, "solver": "ipopt", "substeps": 1,
             "horizon": 1.0, "terminal": o.G, "starts": 1, "passes": 0, "neighbours": 1, "constraints": "hard",
             "seed": 0, "time_limit": 5.0, "options": {"ipopt.tol": 1e-6}, "compiled": False}),
        Call("NMPC.solve", partial(nmpc.solve, progress=False, workers=1), {"x0": [0.1, 0.0], "guesses": start,
             "t0": 0.0, "nodes": np.linspace(0, 1, 5), "starts": 1, "gains": False}, solved,
             {"guesses": [np.zeros((1, 4, 1)), np.zeros((1, 5, 1)), (np.zeros((1, 5, 2)), np.zeros((1, 4, 1))), law(),
                          LQR(o), [start, None], lambda x, t: [0.0], lambda x, t: "a"]}),
        Call("NMPC.solve workers", partial(nmpc.solve, [0.1, 0.0], progress=False), {"workers": 1}, solved),
        Call("NMPC.controller", nmpc.controller, {"hold": 4, "receding": False}),
        Call("DDP", partial(DDP, o), {"intervals": 4, "substeps": 1, "dynamics": None, "settings": DDPSettings(),
             "constraints": "hard", "threads": 1}),
        Call("DDP.solve", partial(ddp.solve, progress=False), {"x0": [0.1, 0.0], "t0": 0.0, "u": np.zeros((1, 4, 1)),
             "x": np.zeros((1, 5, 2)), "gain": np.zeros((1, 4, 1, 2)), "curvature": False, "workers": 1}, solved),
        Call("Solution()", start, {"t": 0.5}, lambda found: all(np.isfinite(v).all() for v in found)),
        Call("Solution.feedback", nmpc.with_gains(start).feedback, {"x": [[0.1, 0.0]], "t": 0.5},
             lambda u: finite(u, 1, 1)),
        Call("Solution[]", start.__getitem__, {"rows": 0}),
        Call("Solution.of_arrays", nocl.Solution.of_arrays, {"arrays": start.arrays()}),
        Call("train", partial(nocl.train, progress=False), {"ocp": None, "dynamics": None, "method": "default",
             "settings": None, "seed": 0}),
        Call("compare", partial(compare, progress=False), {"ocp": o, "methods": {"LQR": LQR(o)}, "n": 1,
             "x0": [[0.1, 0.0]], "seed": 1, "hold": 4, "workers": 1}, lambda report: len(report.rows()) > 0,
             {"methods": [{"a": None}, {1: LQR(o)}, {"": LQR(o)}, {"a": start}, {"a": lambda x, t: "no"}],
              "hold": [[4], [None, 4], ["a"], [0]]}),
    ]


def logs() -> list[Call]:
    r = log().runs[0]
    u = np.r_[r.u, r.u[-1:]]
    shots = nocl.Dataset(data().x, data().u, data().xdot)
    bad = {k: getattr(data(), k) for k in ("x", "u", "xdot", "A", "B")}

    def of_data(**changed: Any) -> Any:
        return identify(plant(), data=nocl.Dataset(**{**bad, **changed}), progress=False, method="none")

    def parquet(**changed: Any) -> Log:
        return Log.read(written("parquet"), plant(), **changed)

    return [
        Call("Log.of", partial(Log.of, plant()), {"t": r.t, "x": r.x, "u": u, "xdot": np.c_[r.x[:, 1], -4 * r.x[:, 0]],
             "run": ["a"] * 20, "max_gap": 1.5, "hold_controls": False}, lambda g: len(g) >= 5),
        Call("Log.of system", Log.of, {"system": plant(), "t": r.t, "x": r.x, "u": u}, lambda g: len(g) >= 5),
        Call("Log.read", Log.read, {"path": written("csv"), "system": plant(), "max_gap": 1.5, "hold_controls": False},
             lambda g: len(g) >= 5),
        Call("Log.read parquet", parquet, {"max_gap": 1.5, "hold_controls": False}, lambda g: len(g) >= 5),
        Call("Log.write", log().write, {"path": folder() / "again.csv"}, odd={"path": [folder() / "a.txt", folder()]}),
        Call("Log.split", log().split, {"share": 0.5, "seed": 0}),
        Call("Log.check", log().check, {"system": plant()}),
        Call("identify", partial(identify, progress=False), {"system": None, "data": shots, "method": "mlp",
             "gradients": False, "known": {"theta": "omega"}, "control_affine": False, "seed": 0, "settings": None},
             odd={"known": [{"theta": 1j}, {"theta": None}, {"phi": 1}, ["phi"], [[1]], {"theta": "phi"}]}),
        *(Call(f"identify data.{k}", of_data, {k: bad[k]}) for k in bad),
    ]


@cache
def moving() -> tuple[nocl.System, nocl.OCP]:
    """A double integrator of some mass, to some goal."""
    (theta, omega, tau), mass, goal = symbols(), nocl.parameter("mass", 1.0, "kg"), nocl.parameter("goal")
    s = nocl.System("moved", x=ca.vertcat(theta, omega), u=tau, p=mass, xdot=ca.vertcat(omega, tau / mass), lbu=[-5],
                    ubu=[5], lbx=[-6, -8], ubx=[6, 8])
    return s, nocl.OCP(s, p=goal, horizon=1.0, running=tau**2, terminal=(theta - goal)**2 + omega**2,
                       x_goal=[goal, 0], u_goal=[0], initial_states=nocl.Uniform([-1, -1], [1, 1]),
                       parameters=nocl.Uniform([0.5, -1], [2, 1]))


def parameters() -> list[Call]:
    (theta, _omega, tau), (s, o), at = symbols(), moving(), {"mass": 1.2, "goal": 0.3}
    odd = [{"mass": 1.2}, {**at, "weight": 1}, {"mass": [1, 2, 3], "goal": 0}, {"mass": "1", "goal": 0}, [1.2],
           [[1.2, 0.3]] * 3, [np.nan, 0], {"mass": 0.0, "goal": 0}, [1e300, -1e300]]
    ddp, nmpc = DDP(o, intervals=4, substeps=1), NMPC(o, 4, starts=1, substeps=1)
    return [
        Call("parameter", nocl.parameter, {"name": "mass", "nominal": 1.0, "unit": "kg"}, lambda p: p.is_scalar()),
        Call("System p", nocl.System, {"name": "moved", "x": s.x, "u": s.u, "p": s.p, "xdot": s.xdot, "lbu": [-5],
             "ubu": [5], "lbx": [-6, -8], "ubx": [6, 8]}, bounded,
             {"p": [s.x, nocl.time(), ca.vertcat(s.p, s.p), 2 * s.p, [s.p, 1]]}),
        Call("OCP p", partial(nocl.OCP, s), {"p": o.p, "horizon": 1.0, "running": tau**2, "terminal": o.terminal,
             "x_goal": [o.p, 0], "u_goal": [0], "initial_states": nocl.Uniform([-1, -1], [1, 1]),
             "parameters": nocl.Uniform([0.5, -1], [2, 1])}, lambda found: found.np == 2,
             {"p": [s.p, theta, nocl.time()], "x_goal": [[ca.SX.sym("q"), 0], [100 * o.p, 0], o.p],
              "parameters": [nocl.Uniform([-1, -1], [1, 1]), nocl.Uniform([1], [2])]}),
        Call("OCP.at", o.at, {"p": at}, lambda found: found.np == 0, {"p": odd}),
        Call("System.at", s.at, {"p": {"mass": 1.2}}, lambda found: found.np == 0, {"p": odd}),
        Call("System.linearize p", s.linearize, {"x": [0.1, 0.2], "u": [0.3], "t": 0.5, "p": [1.2]},
             lambda AB: finite(AB[0], 2, 2) and finite(AB[1], 2, 1), {"p": odd}),
        Call("simulate p", partial(nocl.simulate, o, lambda x, t, p: -x[:, :1], hold=4), {"x0": [0.1, 0.0], "p": at},
             judged, {"p": odd}),
        Call("DDP.solve p", ddp.solve, {"x0": [0.1, 0.0], "t0": 0.0, "p": at}, solved, {"p": odd}),
        Call("NMPC.solve p", partial(nmpc.solve, progress=False, workers=1), {"x0": [0.1, 0.0], "p": at}, solved,
             {"p": odd}),
    ]


def kinds_of_settings() -> list[Call]:
    kinds = (TrainSettings, PaperTraining, Settings, LogSettings, PaperSettings, DDPSettings)
    scaled = [Call(f"{k.__name__}.of", k.of, {"effort": "quick"}) for k in (TrainSettings, Settings, LogSettings)]
    return [*map(of_settings, kinds), *scaled]


GROUPS = {"constructors": constructors, "problems": problems, "controllers": controllers, "solvers": solvers,
          "logs": logs, "settings": kinds_of_settings, "parameters": parameters}
SHARES = {"constructors": 0.2, "problems": 0.15, "controllers": 0.15, "solvers": 0.15, "logs": 0.15, "settings": 0.1,
          "parameters": 0.1}


def hold(group: str, calls: int) -> None:
    """So many calls of a group, each answered well."""
    everything = GROUPS[group]()
    by_name = {call.name: call for call in everything}

    @settings(max_examples=calls, deadline=None, database=None, derandomize=True,
              suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(sorted(by_name)).flatmap(lambda name: st.tuples(st.just(name), strange(by_name[name]))))
    def one(drawn: tuple[str, dict[str, Any]]) -> None:
        name, changed = drawn
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wrong = fault(by_name[name], changed)
        assert not wrong, f"{name}({changed}): {wrong}"

    one()


@pytest.fixture(autouse=True)
def deep(tmp_path, monkeypatch):
    """Odd paths name files of the working folder, or of those above it."""
    (tmp_path / "a" / "b" / "c").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a" / "b" / "c")


@pytest.mark.parametrize("group", GROUPS)
def test_every_good_call_is_good(group):
    """Else the odd ones would show nothing."""
    for call in GROUPS[group]():
        if call.name not in REFUSED and not call.name.startswith("identify"):
            assert not fault(call, {}), call.name


@pytest.mark.parametrize("group", GROUPS)
def test_odd_arguments(group):
    hold(group, round(FAST * SHARES[group]))


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_ten_thousand_odd_calls(group):
    hold(group, round(ALL * SHARES[group]))
