"""Every method that the command line knows, one entry each. A new one is its own file and a line here.

An entry names its function as text, and that is imported when the method is made: to list methods costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from nocl.definition.ocp import OCP


@dataclass(frozen=True)
class Options:
    """Options of a method; it gets those that its entry names in `takes`."""

    intervals: int | None = None  # of a plan's held controls; None: as many as the method has by itself
    seed: int = 0  # of what is random in the method
    substeps: int | None = None  # steps in each interval; None: chosen by what is solved first
    integrator: str | None = None  # of these steps; None: chosen with them


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
    p: str = "rows"  # "rows": it takes a p for each state; "each": it is made anew at each; "one": it is made for one p

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
        self.check_parameters(ocp)
        if self.p == "each":
            ocp = ocp.folded(ocp.nominal)
        if self.check:
            _function(self.check)(ocp)
        elif self.make:
            self.build(ocp, options)

    def check_parameters(self, ocp: OCP) -> None:
        """ValueError where it is made for one p, and the problem has many."""
        if self.p == "one" and ocp.np:
            raise ValueError(f"{self.name} ({self.about}) is made for one p, and the problem on {ocp.system.name!r} "
                             f"has the parameter(s) {', '.join(ocp.parameter_names)}; expected a problem without: "
                             f"ocp.at(p=...), at the command line {asked(ocp)}")

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


def asked(ocp: OCP) -> str:
    """The option that chooses one p, with the nominal ones for an example."""
    values = zip(ocp.parameter_names, ocp.nominal.tolist(), strict=True)
    return "--p " + ",".join(f"{name}={value:g}" for name, value in values)


PLANS = ("intervals", "seed", "substeps", "integrator")  # what plans take

METHODS: dict[str, Method] = {method.name: method for method in (
    Method("cnd", "CND", "the run's own controller"),
    Method("nmpc", "NMPC", "multiple shooting, in open loop", "nocl.solvers.nmpc.solver:NMPC",
           takes=PLANS),
    Method("lqr", "LQR", "linear feedback about the goal", "nocl.solvers.lqr:LQR", p="each"),
    Method("ddp", "DDP", "the best of many starts, in open loop", "nocl.solvers.ddp.global_search:global_ddp",
           takes=PLANS),
    Method("nmpc-loop", "NMPC-LOOP", "NMPC in closed loop", "nocl.solvers.nmpc.solver:closed_loop",
           takes=PLANS),
    Method("neural-oc", "NeuralOC", "a value network, trained for minutes to hours on the exact f",
           "nocl.solvers.neural_oc:train_neural_oc", check="nocl.solvers.neural_oc:applicable", takes=("seed",),
           p="one"),
    Method("level-sets", "level sets", "the HJB equation on a grid, up to 3 states",
           "nocl.solvers.levelset.solver:standard_solution", check="nocl.solvers.levelset.solver:standard",
           extra="levelset", modules=("hj_reachability", "jax"), p="one"),
    Method("rrt-star", "RRT*", "shortest paths, of kinematic cars only", "nocl.solvers.rrt_star:standard",
           takes=("seed",), extra="ompl", modules=("ompl",), p="each"),
)}


def solvers() -> tuple[str, ...]:
    """Names of the methods that a problem alone makes."""
    return tuple(name for name, method in METHODS.items() if method.make)


def find(name: str) -> Method:
    """The method of a name, in upper or lower case; ValueError for others."""
    if name.lower() not in METHODS:
        raise ValueError(f"there is no method {name!r}; expected one of {', '.join(METHODS)}")
    return METHODS[name.lower()]
