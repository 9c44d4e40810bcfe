"""Every method that the command line knows, one entry each. A new one is its own file and a line here.

An entry names its function as text, and that is imported when the method is made: to list methods costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from nocl.ocp import OCP


@dataclass(frozen=True)
class Options:
    """Options of a method; it gets those that its entry names in `takes`."""

    intervals: int = 80  # of a plan's held controls
    seed: int = 0  # of what is random in the method
    substeps: int | None = None  # Runge-Kutta steps in each interval; None: chosen by what is solved first


@dataclass(frozen=True)
class Method:
    """An entry.

    `make` is called as make(ocp, **options) and returns feedback or a solver, as nocl.comparisons.methods has them.
    Where that takes long (a training, a grid), check(ocp) is called first: ValueError for a problem that the method is
    not for. Elsewhere making it is the check.
    """

    name: str  # at the command line, and of files
    title: str  # in reports
    about: str  # in the help
    make: str = ""  # "module:function"; "": the controller of the run itself
    check: str = ""  # "module:function"
    takes: tuple[str, ...] = ()  # fields of Options
    extra: str = ""  # of the package, where the method needs one
    modules: tuple[str, ...] = ()  # that the extra brings

    @property
    def missing(self) -> str:
        """What has to be installed for it, as one sentence; "" where it is there."""
        absent = [module for module in self.modules if find_spec(module) is None]
        return "" if not absent else \
            f"{self.name} ({self.about}) needs {', '.join(absent)}: pip install 'nocl[{self.extra}]'"

    def refuse(self, ocp: OCP, options: Options) -> None:
        """ValueError, without long work, where the method cannot be made for this problem."""
        if self.missing:
            raise ValueError(self.missing)
        if self.check:
            _function(self.check)(ocp)
        elif self.make:
            self.build(ocp, options)

    def build(self, ocp: OCP, options: Options) -> Any:
        """The method for this problem."""
        if self.missing:
            raise ValueError(self.missing)
        return _function(self.make)(ocp, **{option: getattr(options, option) for option in self.takes})


def _function(name: str) -> Callable[..., Any]:
    """What "module:function" names."""
    module, _, function = name.partition(":")
    found: Callable[..., Any] = getattr(import_module(module), function)
    return found


PLANS = ("intervals", "seed", "substeps")  # what plans take

METHODS: dict[str, Method] = {method.name: method for method in (
    Method("cnd", "CND", "the run's own controller"),
    Method("nmpc", "NMPC", "multiple shooting, in open loop", "nocl.solvers.nmpc.solver:NMPC",
           takes=PLANS),
    Method("lqr", "LQR", "linear feedback about the goal", "nocl.solvers.lqr:LQR"),
    Method("ddp", "DDP", "the best of many starts, in open loop", "nocl.solvers.ddp.global_search:global_ddp",
           takes=PLANS),
    Method("nmpc-loop", "NMPC-LOOP", "NMPC in closed loop", "nocl.solvers.nmpc.solver:closed_loop",
           takes=PLANS),
    Method("neural-oc", "NeuralOC", "a value network, trained for minutes to hours on the exact f",
           "nocl.solvers.neural_oc:train_neural_oc", check="nocl.solvers.neural_oc:applicable", takes=("seed",)),
    Method("level-sets", "level sets", "the HJB equation on a grid, up to 3 states",
           "nocl.solvers.levelset.solver:standard_solution", check="nocl.solvers.levelset.solver:standard",
           extra="levelset", modules=("hj_reachability", "jax")),
    Method("rrt-star", "RRT*", "shortest paths, of kinematic cars only", "nocl.solvers.rrt_star:standard",
           takes=("seed",), extra="ompl", modules=("ompl",)),
)}


def solvers() -> tuple[str, ...]:
    """Names of the methods that a problem alone makes."""
    return tuple(name for name, method in METHODS.items() if method.make)


def find(name: str) -> Method:
    """The method of a name, in upper or lower case; ValueError for others."""
    if name.lower() not in METHODS:
        raise ValueError(f"there is no method {name!r}; expected one of {', '.join(METHODS)}")
    return METHODS[name.lower()]
