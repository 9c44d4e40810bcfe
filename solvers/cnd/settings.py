"""Settings of both training methods, the default's and those of method="paper", and what tells a training by them from
another: a checkpoint is taken up by the very same call only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch

from nocl import hjb
from nocl.definition.ocp import OCP
from nocl.definition.substeps import INTEGRATORS, RADAU, USUAL
from nocl.nets import ACTIVATIONS, FeatureNet
from nocl.support import checks
from nocl.support.fields import Checked, Scaled, choice, coefficients, count, flag, nonnegative, positive, widths
from nocl.support.fingerprint import fingerprint, json_text
from nocl.translate.instructions import to_data
from nocl.translate.rk4 import rk4_cost

AUTO = "auto"
STEPS: dict[str, hjb.Step] = {"rk4": rk4_cost, "euler": hjb.euler_cost}


@dataclass(frozen=True)
class TrainSettings(Scaled):
    """The default method's settings; `TrainSettings.of("best", seeds=40)` scales what belongs together."""

    EFFORT: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"seeds": 6, "starts": 6, "states": 60, "tails": 300, "visits": 200, "rounds": 1, "iterations": 400,
                  "value_tails": 400, "value_visits": 200, "value_iterations": 300, "held_out": 16},
        # what was enough for a wide set of initial states, where the defaults are not: docs/experiments.md
        "best": {"seeds": 80, "states": 3000, "tails": 6000, "visits": 6000, "rounds": 5, "least_rounds": 3,
                 "iterations": 3000, "hidden": (128, 128, 128), "value_initial": 3000, "value_tails": 12_000,
                 "value_visits": 6000, "value_iterations": 10_000, "value_error": 1e-3, "held_out": 128,
                 "gap_median": 5e-5, "gap_p95": 2.5e-4}}

    # by how much more of each a problem with parameters takes, for each of them; MOST: as many parameters at most
    MORE: ClassVar[Mapping[str, float]] = {"seeds": 1 / 2, "states": 1 / 2, "tails": 1 / 8, "visits": 1 / 8,
                                           "rounds": 1 / 4, "iterations": 1 / 16, "hidden": 1 / 16}
    MOST: ClassVar[int] = 8
    BRANCHES: ClassVar[int] = 2  # with parameters: optima of other kinds are the rule then

    @property
    def grid(self) -> int:
        """The intervals, or as many as are usual."""
        return self.intervals or USUAL

    @classmethod
    def of(cls, effort: str, *, parameters: int = 0, **changes: Any) -> TrainSettings:
        """The settings of an effort, "quick", "normal" or "best", with changes of single fields.

        parameters : how many the problem has (OCP.np): the more, the more labels and rounds (as long as they
            pay), the longer and wider the regression; with any, BRANCHES
        """
        n = min(checks.whole(parameters, "parameters", "TrainSettings.of", 0), cls.MOST)
        usual = asdict(super().of(effort))
        more = {name: _times(usual[name], 1 + n * share) for name, share in cls.MORE.items()}
        if n:
            more["branches"] = max(usual["branches"], cls.BRANCHES)
        return cls(**{**usual, **more, **changes})

    intervals: int | None = count(None, "held controls of each labelled solution", none="80, or two or four times as "
                                  "many where plans on these cost too much more than the optimum in continuous time")
    substeps: int | None = count(None, "steps in each interval", none="as many as a few solutions ask for, held "
                                 "against the plant on far shorter steps; the card says how many")
    integrator: str = choice(AUTO, "of these steps: Runge-Kutta's, implicit ones (Radau), or, auto, "
                             "implicit ones where substeps are left to nocl and explicit ones would be too many",
                             (AUTO, *INTEGRATORS))
    seeds: int = count(20, "initial states solved globally, from cold starts")
    starts: int = count(16, "cold starts of each")
    states: int = count(400, "further initial states, solved from their neighbours", least=0)
    tails: int = count(3000, "optimal tails from the tube", least=0)
    width: float = positive(0.25, "of the tube, in units of each state's spread along the solutions")
    visits: int = count(2000, "visited states solved in each round")
    kick: float = positive(0.1, "pushes on the visiting policy, in units of each state's spread")
    rounds: int = count(3, "of visited states, at most", least=0)
    least_rounds: int = count(2, "and at least: the gap is met sooner than under disturbances", least=0)
    iterations: int = count(2000, "of each regression; twice as many from the round on that may be the last")
    batch: int = count(1024, "labels in a step of a regression")
    lr: float = positive(4e-3, "of SOAP")
    hidden: tuple[int, ...] = widths((64, 64, 64), "of the hidden layers of u and of V")
    branches: int = count(1, "answers that the network chooses among: more than 1 where optima of several kinds meet")
    control_dt: bool = flag(False, "True: u(x, t, dt), optimal in continuous time and held for dt; see CND.at_rate")
    value: bool = flag(True, "whether to train V(x, t) too")
    value_initial: int = count(1500, "initial states solved for V, from the nearest solutions and the policy's answers")
    value_tails: int = count(6000, "tails solved for V, from the tube")
    value_visits: int = count(3000, "more of them, from states that the policy visits under kicks")
    value_iterations: int = count(7000, "of each fit of V")
    value_rounds: int = count(3, "fits of V at most: each further one on as many labels more")
    value_error: float = positive(2.5e-3, "stop once met: mean of |V - J*| / (J* + a tenth of a usual J*) at held-out "
                                  "initial, tube and kicked states")
    held_out: int = count(64, "initial states that tell when to stop")
    gap_median: float = positive(2e-4, "stop once both are met: (J - J*) / J*, median over the held-out states")
    gap_p95: float = positive(1e-3, "and its 95th percentile")
    violating: float = nonnegative(0.01, "and this: the share of held-out runs that violate a constraint")
    minutes: float | None = positive(None, "of wall-clock time that labels, rounds and fits are planned within",
                                     none="as long as they take")


def _times(value: Any, factor: float) -> Any:
    """A count that many times; widths of layers in steps of 8."""
    return tuple(8 * round(w * factor / 8) for w in value) if isinstance(value, tuple) else round(value * factor)


@dataclass(frozen=True)
class PaperSettings(Checked):
    """Settings of method="paper"; the defaults are the paper's wherever it says."""

    hidden: Sequence[int] = widths((64, 64), "of the controller")
    value_hidden: Sequence[int] = widths((64, 64), "of the value function")
    activation: str = choice("tanh", "of the hidden layers", ACTIVATIONS)
    time_input: bool = flag(False, "True: u(x, t), which a finite horizon's optimum needs; the paper has u(x)")
    near_goal: float | None = positive(None, "the controller starts at u*, its last layer's random weights times this",
                                       none="weights as random as the others'")
    sin_cos: bool = flag(True, "sin and cos of declared angles as inputs, beside their values")
    intervals: int = count(40, "K: steps of a rollout")
    step: str = choice(AUTO, "of a rollout: 'rk4'; 'euler' as published; 'radau', implicit ones; auto: 'rk4', or "
                       "'radau' where f is so fast at initial states that Runge-Kutta's would be unstable",
                       (AUTO, *STEPS, RADAU))
    hold: bool = flag(False, "False: feedback inside RK4's stages, as in a neural ODE; True: held over intervals")
    fused: bool = flag(True, "held RK4 steps of the exact f as compiled C on the CPU; False: in torch, same gradients")
    iterations: int = count(1000, "of Adam, after the race")
    batch: int = count(64, "initial states an iteration")
    learning_rate: float = positive(0.01, "of Adam")
    decay: float = positive(0.01, "the learning rate falls exponentially to this share of its start; 1: no decay",
                            most=1)
    weights: tuple[float, float, float, float] = coefficients(
        (1.0, 1.0, 0.01, 0.01), "of L_cost, L_HJB, L_final, L_hamil", nonzero=1)
    clip: float | None = positive(1.0, "the gradient's norm, of u and of V each", none="not clipped")
    detach: bool = flag(False, "True: L_HJB, L_final, L_hamil see the trajectory's states as constants")
    race: int = count(8, "random initial controllers that start side by side; 1: no race")
    race_iterations: int = count(200, "of L_cost alone, for each of them")
    race_batch: int = count(16, "initial states an iteration, for each of them")
    patience: int | None = count(None, "stop after so many of the 40 checks without a lower held-out cost",
                                 none="never")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.hold and self.step == "euler":
            raise ValueError(f"PaperSettings: step is {self.step!r} with hold=False; expected step='rk4', 'radau' or "
                             "'auto', which feedback in continuous time is integrated by")


def identity(ocp: OCP, settings: Any, seed: int, f: Any, **more: str) -> str:
    """What tells one training from another, as text: problem, settings but the time, seed and dynamics; f: the torch
    dynamics that training uses."""
    return json_text([ocp.to_data(), {k: v for k, v in asdict(settings).items() if k != "minutes"}, seed, _dynamics(f),
                      more])


def _dynamics(f: Any) -> str:
    """A fingerprint of a network's maps and weights; the name of the function where f is none, as the exact f."""
    net = getattr(f, "net", f)
    if not isinstance(net, torch.nn.Module):
        return "exact" if net is f else type(net).__name__
    maps = [to_data(net.inputs), to_data(net.outputs)] if isinstance(net, FeatureNet) else [type(net).__name__]
    return fingerprint(maps, *(parameter.detach().double().cpu().numpy() for parameter in net.parameters()))
