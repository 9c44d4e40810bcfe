"""The trained controller u = pi(x, t) and value V(x, t): numpy in and out, CasADi and C out, files in and out.

Of a problem with parameters they are pi(x, t, p) and V(x, t, p), in all of these.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from nocl import records
from nocl.definition.ocp import OCP
from nocl.exports.bundle import export
from nocl.exports.casadi_forms import to_casadi
from nocl.exports.parity import Certificate, ExportPart
from nocl.judge.laws import dynamics_function
from nocl.nets import FeatureNet
from nocl.solvers.cnd.regression.features import at_rate, folded
from nocl.solvers.cnd.regression.labels import LONGEST
from nocl.solvers.cnd.unwrapped import Unwrapped
from nocl.solvers.safeguard.guarded import Safeguard
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.store import reading
from nocl.translate.arguments import Arguments
from nocl.translate.torch_functions import to_torch

KIND = "cnd"  # the name of its file in a folder
Build = str | os.PathLike[str] | None  # a folder for what L4CasADi compiles


class CND:
    """A feedback controller trained on an OCP, with the value function that goes with it where it was trained.

    Parameters
    ----------
    ocp : OCP
    policy : FeatureNet (x, t[, p]) -> u, or (x, t[, p], dt) -> u
        With dt it is optimal in continuous time at dt = 0, and held for dt at others: see `at_rate`.
    value : FeatureNet (x, t[, p]) -> V, optional
    card : mapping
        How it was made and how it scored: plain JSON data.
    """

    def __init__(self, ocp: OCP, policy: FeatureNet, value: FeatureNet | None = None,
                 card: Mapping[str, Any] | None = None) -> None:
        checks.problem(ocp, "CND", infinite=True, discrete=True)
        checks.instance(FeatureNet, policy, "policy", "CND", "as nocl.train makes it")
        if value is not None:
            checks.instance(FeatureNet, value, "value", "CND", "as nocl.train makes it, or None")
        if card is not None:
            checks.instance(Mapping, card, "card", "CND", "plain data")
        self.ocp, self.card = ocp, dict(card or {})
        policy.double().eval().requires_grad_(False)
        self._at_rates = policy if "dt" in policy.inputs.name_in() else None
        self.policy = policy if self._at_rates is None else at_rate(policy, 0.0)
        self.value_net = None if value is None else value.double().eval().requires_grad_(False)

    def __call__(self, x: ArrayLike, t: ArrayLike = 0.0, p: Any = None) -> Array:
        """u [nu] at a state [nx], or [B, nu] at [B, nx], and a time (one for all, or [B]).

        p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
        """
        rows, single = self._states(x)
        with torch.no_grad():
            u = self.policy(*self._tensors(rows, t, p)).numpy()
        return u[0] if single else u

    def at(self, p: Any) -> CND:
        """The controller u(x, t) at given parameters, [np] or by name, folded in as constants, of `ocp.at(p)`."""
        value = self.ocp.parameters_of(p, 1, "CND.at")[0]
        if not self.ocp.np:
            return self
        policy = folded(self._at_rates or self.policy, p=value)
        V = None if self.value_net is None else folded(self.value_net, p=value)
        card = self.card | {"p": dict(zip(self.ocp.parameter_names, value.tolist(), strict=True))}
        return CND(self.ocp.folded(value), policy, V, card)

    @property
    def continuous_angles(self) -> tuple[str, ...]:
        """Angles that it expects unwrapped: those in which the problem tells a turn from none."""
        s = self.ocp.system
        return tuple(s.state_names[i] for i in s.angle_indices if i not in self.ocp.periodic)

    def unwrapped(self) -> Unwrapped:
        """The same controller for angles in (-pi, pi], or in any other image: it follows them from call to call."""
        return Unwrapped(self, self.ocp)

    def unwrapped_to_casadi(self) -> ca.Function:
        """unwrapped:(x [nx], t[, p], last [nx]) -> (u [nu], continuous [nx]); `continuous` is the next call's `last`.
        """
        pi, s = self.to_casadi(), self.ocp.system
        at, last = Arguments.of(pi), ca.MX.sym("last", s.nx)
        x, turn = at["x"], 2 * np.pi
        for i in (s.state_names.index(name) for name in self.continuous_angles):
            step = ca.MX.zeros(s.nx)
            step[i] = turn * ca.floor((last[i] - at["x"][i]) / turn + 0.5)
            x = x + step
        return at.function("unwrapped", {"u": at.given(x=x).call(pi), "continuous": x}, last=last)

    def at_rate(self, dt: float) -> CND:
        """The same controller for a sampling time dt [s]: u(x, t) is asked at multiples of dt and held until the next.

        What comes back is a CND of (x, t) like any other: it is called, judged (`simulate(..., hold=K)`) and exported.
        dt = 0 is continuous feedback. Raises ValueError for dt beyond what was trained, or where none was.
        """
        if self._at_rates is None:
            raise ValueError(f"this controller of {self.ocp.system.name} knows one rate only; expected one for every "
                             "rate: train with TrainSettings(control_dt=True)")
        longest = self.ocp.horizon / LONGEST
        checks.between(dt, 0.0, longest * (1 + 1e-9), "dt", "CND.at_rate", f", the horizon over {LONGEST}, as trained")
        return CND(self.ocp, at_rate(self._at_rates, float(dt)), self.value_net, self.card | {"dt": float(dt)})

    def safeguarded(self, ocp: OCP | None = None, *, dt: float | None = None, steps: int = 40,
                    margin: float = 1e-3) -> Safeguard:
        """A law under a safeguard: `steps` controls held for dt are rolled out, and taken where they hold U and the
        constraints and arrive (nocl.solvers.safeguard.Safeguard).

        ocp : the problem whose constraints are held; default: that which it was trained on, which had none
        dt : default: as long as all `steps` together last the time in which training's solutions got to the goal
        """
        if dt is None:
            if "arrives_in" not in self.card:
                raise ValueError(f"safeguarded: the controller of {self.ocp.system.name!r} does not say how long runs "
                                 "take to the goal; expected dt, the time that a control is held for")
            dt = self.card["arrives_in"] / checks.whole(steps, "steps", "safeguarded", 1)
        return Safeguard(self.ocp if ocp is None else ocp, self, dt=dt, steps=steps, margin=margin)

    def value(self, x: ArrayLike, t: ArrayLike = 0.0, p: Any = None) -> Array:
        """V(x, t[, p]), the cost-to-go: a number at [nx], or [B] at [B, nx]."""
        rows, single = self._states(x)
        with torch.no_grad():
            V = self._value_net()(*self._tensors(rows, t, p)).numpy()[:, 0]
        return V[0] if single else V

    def value_gradient(self, x: ArrayLike, t: ArrayLike = 0.0, p: Any = None) -> Array:
        """dV/dx, the costate: [nx] at [nx], or [B, nx] at [B, nx]."""
        return self._value_slope(0, x, t, p)

    def value_gradient_by_p(self, x: ArrayLike, t: ArrayLike, p: Any) -> Array:
        """dV/dp: [np] at [nx], or [B, np] at [B, nx]; ValueError where the problem has no parameters."""
        if not self.ocp.np:
            raise ValueError(f"the problem on {self.ocp.system.name!r} has no parameters, so V has no gradient by them")
        return self._value_slope(2, x, t, p)

    def _value_slope(self, argument: int, x: ArrayLike, t: ArrayLike, p: Any) -> Array:
        rows, single = self._states(x)
        given = self._tensors(rows, t, p)
        given[argument].requires_grad_(True)
        (gradient,) = torch.autograd.grad(self._value_net()(*given).sum(), given[argument])
        return gradient[0].numpy() if single else gradient.numpy()

    def to_casadi(self, backend: str = "native", build_dir: Build = None) -> ca.Function:
        """policy:(x [nx], t) -> (u [nu]), a CasADi Function; backend "native" (MX, float64) or "l4casadi" (float32)."""
        return self._export(self.policy, "policy", "u", backend, build_dir)

    def value_to_casadi(self, backend: str = "native", build_dir: Build = None) -> ca.Function:
        """value:(x [nx], t) -> (V) as a CasADi Function."""
        return self._export(self._value_net(), "value", "V", backend, build_dir)

    def value_gradient_to_casadi(self, backend: str = "native", build_dir: Build = None) -> ca.Function:
        """value_gradient:(x [nx], t) -> (V_x [nx]), the costate, as a CasADi Function."""
        V = self.value_to_casadi(backend, build_dir)
        at = Arguments.of(V)
        return at.function("value_gradient", {"V_x": ca.densify(ca.jacobian(at.call(V), at["x"])).T})

    def gain_to_casadi(self, backend: str = "native", build_dir: Build = None) -> ca.Function:
        """gain:(x [nx], t) -> (K [nu, nx]), the linear feedback du = K dx of the closed loop, K = d pi / dx."""
        pi = self.to_casadi(backend, build_dir)
        at = Arguments.of(pi)
        return at.function("gain", {"K": ca.densify(ca.jacobian(at.call(pi), at["x"]))})

    def closed_loop_to_casadi(self, dynamics: Any = None, backend: str = "native",
                              build_dir: Build = None) -> ca.Function:
        """closed_loop:(x [nx], t[, p]) -> (xdot [nx]), xdot = f(x, pi(x, t)); in discrete time -> (x_next [nx]).

        dynamics: another f than the exact one, a casadi.Function (x, u) -> xdot or an object with `to_casadi()`.
        """
        pi, f = self.to_casadi(backend, build_dir), self.ocp.functions.on(dynamics_function(self.ocp, dynamics)).f
        at = Arguments.of(pi)
        if self.ocp.system.is_discrete:
            f = self.ocp.functions.sample
            return at.function("closed_loop", {"x_next": ca.densify(at.given(u=at.call(pi)).call(f)[0])})
        return at.function("closed_loop", {"xdot": ca.densify(at.given(u=at.call(pi)).call(f))})

    def export_parts(self) -> list[ExportPart]:
        """What is exported: policy, gain and closed loop, and value and value gradient where it has a value."""
        s, policy, value = self.ocp.system, self.policy, self.value_net
        box = {"x": (s.lbx, s.ubx), "t": (0.0, self.ocp.longest)}
        x, u = {"x": [s.unit(n) for n in s.state_names]}, [s.unit(n) for n in s.control_names]
        if self.ocp.np:
            box["p"], x["p"] = self.ocp.parameter_box, [self.ocp.unit(n) for n in self.ocp.parameter_names]
        slopes = [f"d {i} / d {j}" for i in s.control_names for j in s.state_names]
        made = [ExportPart("policy", self.to_casadi(), policy, box | {"u": (s.lbu, s.ubu)}, x | {"u": u}, policy),
                ExportPart("gain", self.gain_to_casadi(), lambda *at: _slopes(policy, *at), box, x | {"K": slopes},
                           lean=_lean(self.to_casadi(), "gain", "K"))]
        if s.xdot is not None:  # a plant that is not known has no closed loop to write down
            moved = {"x_next": [f"{i}+" for i in s.state_names]} if s.is_discrete else \
                {"xdot": [f"d {i} / dt" for i in s.state_names]}
            made.append(ExportPart("closed_loop", self.closed_loop_to_casadi(), self._closed_loop, box, x | moved))
        if value is not None:
            made += [ExportPart("value", self.value_to_casadi(), value, box, x | {"V": ["cost-to-go"]}, value),
                     ExportPart("value_gradient", self.value_gradient_to_casadi(),
                                lambda *at: _slopes(value, *at), box,
                                x | {"V_x": [f"d V / d {i}" for i in s.state_names]},
                                lean=_lean(self.value_to_casadi(), "value_gradient", "V_x"))]
        return made

    def to_c(self, folder: str | os.PathLike[str], *, dtype: str = "float64",
             only: Sequence[str] | None = None) -> Path:
        """C99 of the controller, its linear gain, the value and its gradient in `folder`; returns it.

        Each with header, test vectors and self-test, as SYSTEM_policy, SYSTEM_gain, ...; dtype "float64" or "float32";
        only: names of `parts()`.
        """
        place, there = checks.folder(folder, "folder", "to_c"), {part.name: part for part in self.export_parts()}
        wanted = [n for n in there if n != "closed_loop"] if only is None else checks.words(only, "only", "to_c")
        for name in wanted:
            checks.word(name, tuple(there), "only", "to_c")
            there[name].to_c(place, self.ocp.system.name, dtype=dtype, note=repr(self))
        return place

    def export(self, folder: str | os.PathLike[str], to: Sequence[str] = ("casadi",), **options: Any) -> Certificate:
        """Files of all `parts()` in `folder`, proven equal to this controller: see nocl.exports.bundle.export."""
        return export(self, folder, to, **options)

    def rounded(self) -> CND:
        """A copy with every weight rounded to 11 significant bits, whose file is half as large: score it anew."""
        nets = [copy.deepcopy(n) for n in (self._at_rates or self.policy, self.value_net) if n is not None]
        for p in (p for net in nets for p in net.parameters()):
            p.copy_(p.half())
        return CND(self.ocp, nets[0], nets[1] if self.value_net is not None else None, self.card)

    def plot_training(self, path: str | os.PathLike[str]) -> Path:
        """A picture of how it was trained, as a png at `path`: losses, and the gap on held-out states by round."""
        from nocl.solvers.cnd.plot import plot_training  # matplotlib

        return plot_training(self.card, Path(path), self.ocp.system.name)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write controller, value, problem and card as one data-only file in `folder`."""
        policy = self.policy if self._at_rates is None else self._at_rates
        nets = {"policy": _smallest(policy)} | ({} if self.value_net is None else {"value": _smallest(self.value_net)})
        return records.save(folder, KIND, nets=nets, card={"ocp": self.ocp.to_data(), "card": self.card})

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> CND:
        """What `save` wrote; raises ValueError for a missing, damaged or foreign file."""
        record = records.load(folder, KIND)
        with reading(folder, "a controller"):
            ocp, nets = OCP.from_data(record.card["ocp"]), record.nets
            _check_sizes(ocp, nets)
            return cls(ocp, nets["policy"], nets.get("value"), record.card["card"])

    def __repr__(self) -> str:
        facts = ", ".join(f"{k} {v}" for k, v in self.card.items() if isinstance(v, (str, int, float)))
        return f"CND on {self.ocp.system.name!r}: {facts or 'no card'}"

    def _states(self, x: ArrayLike) -> tuple[Array, bool]:
        return checks.states(x, self.ocp.system.nx, self.ocp.system.name, "x")

    def _closed_loop(self, x: Tensor, t: Tensor, *p: Tensor) -> Tensor:
        at = {"x": x, "u": self.policy(x, t, *p), "t": t, "p": p[0] if p else None}
        moved = self._f(*(at[name] for name in self.ocp.functions.arguments.names))
        return moved[0] if self.ocp.system.is_discrete else moved

    @cached_property
    def _f(self) -> Any:
        """f in torch; in discrete time (x+, the step's cost)."""
        return to_torch(self.ocp.functions.sample if self.ocp.system.is_discrete else self.ocp.functions.f)

    def _tensors(self, rows: Array, t: ArrayLike, p: Any) -> tuple[Tensor, ...]:
        times = checks.numeric(t, "t", self.ocp.system.name, f"one time or {len(rows)}")
        if times.shape not in ((), (len(rows),)) or not ((times >= 0) & (times <= self.ocp.longest * (1 + 1e-9))).all():
            raise ValueError(f"t is {np.array2string(times, threshold=4)}; expected one time or {len(rows)}, "
                             f"each in [0, {self.ocp.longest:g}]")
        values = self.ocp.parameters_of(p, len(rows), f"CND on {self.ocp.system.name!r}")
        given = [rows.copy(), np.broadcast_to(times, len(rows)).copy()[:, None], *([values] if self.ocp.np else [])]
        return tuple(torch.from_numpy(value) for value in given)

    def _value_net(self) -> FeatureNet:
        if self.value_net is None:
            raise ValueError(f"this controller of {self.ocp.system.name} was trained without a value function: "
                             "train with settings that have value=True")
        return self.value_net

    def _export(self, net: FeatureNet, name: str, out: str, backend: str, build_dir: Build) -> ca.Function:
        place = None if build_dir is None else checks.folder(build_dir, "build_dir", name)
        return to_casadi(net, backend=backend, name=name, build_dir=place,
                         in_names=self.ocp.functions.feedback().names, out_names=[out])


def _slopes(net: FeatureNet, x: Tensor, *more: Tensor) -> Tensor:
    """d net / dx [B, n_out * nx], row by row, differentiable."""
    with torch.enable_grad():
        x = x if x.requires_grad else x.detach().requires_grad_(True)
        y = net(x, *more)
        return torch.cat([torch.autograd.grad(y[:, i].sum(), x, create_graph=True)[0] for i in range(y.shape[1])], 1)


def _lean(f: ca.Function, name: str, out: str) -> ca.Function:
    """name:(x, t) -> d f / dx, row by row, by forward derivatives: backwards, CasADi's C copies every weight matrix to
    the stack (77 kB for cart-pole's gain instead of 3)."""
    at = Arguments.of(f)
    value, x = at.call(f), at["x"]
    columns = [ca.jtimes(value, x, ca.DM.eye(x.numel())[:, i]) for i in range(x.numel())]
    return at.function(name, {out: ca.vec(ca.densify(ca.horzcat(*columns)).T)})


def _smallest(net: FeatureNet) -> FeatureNet:
    """The same numbers in half the bytes, or a quarter, where fewer bits hold every weight exactly (`CND.rounded`)."""
    for dtype in (torch.float16, torch.float32):
        if all(bool((p == p.to(dtype).double()).all()) for p in net.parameters()):
            return copy.deepcopy(net).to(dtype)
    return net


def _check_sizes(ocp: OCP, nets: Mapping[str, FeatureNet]) -> None:
    """ValueError where a file's networks do not fit its own problem."""
    n, s = [ocp.system.nx, 1, *([ocp.np] if ocp.np else [])], ocp.system
    for name, outputs in (("policy", s.nu), ("value", 1)):
        if name not in nets:
            continue
        got, answer = [nets[name].inputs.size1_in(i) for i in range(nets[name].inputs.n_in())], nets[name].outputs
        if got not in (n, [*n, 1]) or answer.size1_out(0) != outputs:
            raise ValueError(f"the {name} takes {got} and gives {answer.size1_out(0)} numbers; {s.name!r} needs {n} -> "
                             f"{outputs}: the file does not fit its own problem, save it again")


def pretrained(name: str, dynamics: str = "exact") -> CND:
    """A controller that comes with nocl, trained on the exact f or on a learned one (dynamics="learned")."""
    checks.word(dynamics, ("exact", "learned"), "dynamics", "pretrained")
    shipped = Path(str(files("nocl"))) / "pretrained"
    folder = shipped / f"{name}-{dynamics}"
    if folder not in shipped.glob("*-*"):
        there = ", ".join(sorted(p.name for p in shipped.glob("*-*"))) or "none"
        raise ValueError(f"no pretrained controller {checks.shown(name)} on {dynamics} dynamics; there are: {there}. "
                         f"Train one: nocl.train(nocl.load_ocp(name))")
    return CND.load(folder)
