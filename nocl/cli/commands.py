"""The command line. Nothing heavy is imported before the arguments are checked; all output goes under --out."""

from __future__ import annotations

import argparse
import errno
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nocl import __version__
from nocl.cli import arguments, reproduce
from nocl.definition.substeps import INTEGRATORS, USUAL
from nocl.solvers import registry
from nocl.support.fields import EFFORTS
from nocl.support.lock import alone
from nocl.systems import NAMES, load_ocp

if TYPE_CHECKING:
    from nocl.definition.ocp import OCP

QUICK_PROOF = ("casadi", "onnx", "c")  # of a run: L4CasADi takes half a minute to build
SEED = ("of all that is drawn; the initial states that methods are run from are drawn with one more, "
        "so that they are not those of training")
REMEDIES = {errno.ENOSPC: "make room there, and the same command goes on from the last finished step",
            errno.EROFS: "name another --out", errno.EACCES: "name another --out, or one that is yours",
            errno.ENOENT: "name one that is there"}
INTERRUPTED = 130  # 128 + SIGINT, as shells have it


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; 0, or 2 after one line on stderr, or 130 after Ctrl-C."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        args = parser().parse_args(words)
        args.command(args)
        if sys.stdout is not None:
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("\nnocl: interrupted; the same command goes on from the last finished step", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # `nocl list | head`
        _give_up_output()
        return 0
    except Exception as error:  # the command line is where all errors end
        if "--debug" in words:
            traceback.print_exc()
        print(f"nocl: error: {_one_line(error)}", file=sys.stderr)
        _drop_unprintable()
        return 2
    return 0


def _drop_unprintable() -> None:
    """What cannot be printed would be tried again, and fail again, when the process ends."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        _give_up_output()


def _give_up_output() -> None:
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, ValueError) and text:
        return text
    if isinstance(error, ImportError):
        return f"{text}: install it, or leave out what needs it"
    if isinstance(error, OSError):
        remedy = REMEDIES.get(error.errno or 0, "see to it, and the same command goes on from the last finished step")
        return f"{error.filename or 'the output'}: {error.strerror or text}; {remedy}"
    return f"unexpected {type(error).__name__}: {text or 'no message'} (--debug shows where)"


def parser() -> argparse.ArgumentParser:
    """The commands and their options."""
    top = arguments.Parser(
        prog="nocl", description="Neural optimal control: one symbolic problem in, a checked controller out.",
        epilog="A problem is the name of one that comes with nocl (`nocl list`), or the path of a Python file that "
               "defines `ocp`. All output goes under --out, by default runs/NAME.")
    top.add_argument("--version", action="version", version=_version())
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(command=run)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        return sub

    command("list", _list, "the problems that come with nocl")
    sub = command("doctor", _doctor, "examine a problem in half a minute: goal, controllability, stiffness, optima")
    _add(sub, "problem", "p", "seed", "intervals")
    sub = command("run", _run, "identify, train, export, solve by NMPC, compare and report, in one go")
    _add(sub, "problem", "p", "out", "seed", "n", "exact", "effort", "quick", "minutes", "intervals", "integrator",
         "methods")
    sub = command("identify", _identify, "learn the dynamics, from the equations or from logged trajectories")
    _add(sub, "problem", "p", "out", "seed", "effort", "quick", "minutes")
    sub.add_argument("--data", type=Path, metavar="LOG", help="a .csv or .parquet file with columns t, states, "
                     "controls, and run: learn from it alone, test on a fifth of its runs")
    sub.add_argument("--known", type=arguments.known, metavar="A=B,C=D", help="with --data: derivatives that are "
                     "known, like p=v,theta=omega: d p/dt = v; a number, or a state's or control's name")
    sub.add_argument("--control-affine", action="store_true", help="with --data: xdot = a(x) + B(x) u")
    sub.add_argument("--hold-controls", action="store_true", help="with --data: an empty control is the last before it")
    sub = command("train", _train, "train a controller and a value function, on learned dynamics unless --exact")
    _add(sub, "problem", "p", "out", "seed", "exact", "effort", "quick", "minutes", "intervals", "integrator")
    sub = command("solve", _solve, "solve the problem from many initial states")
    _add(sub, "problem", "p", "out", "seed", "n", "intervals")
    sub.add_argument("--solver", choices=registry.solvers(), default="nmpc", metavar="NAME",
                     help=f"default: nmpc; {_told_of(registry.solvers())}")
    sub.add_argument("--substeps", type=arguments.count, metavar="S", help="steps in each interval of a plan; "
                     "default: 1, or as many as the first solutions ask for, held against the plant on far shorter "
                     "steps")
    _add(sub, "integrator")
    sub.add_argument("--workers", type=arguments.workers, default="auto", metavar="W",
                     help="processes or threads of the solver, auto, or a Dask scheduler's tcp://...; default: auto")
    sub = command("export", _export, "write a run's controller, value function and dynamics, proven equal to it")
    _add(sub, "run", "p")
    sub.add_argument("--to", choices=arguments.FORMS, action="append",
                     help="default: casadi and c; may be given several times")
    sub.add_argument("--against", type=arguments.forms, metavar="A,B",
                     help=f"what is compared beside them; default: all of {', '.join(arguments.FORMS)} that can be "
                          "made here")
    sub.add_argument("--strict", action="store_true",
                     help="write nothing where any form differs; default: the others, with a remark")
    sub.add_argument("--out", type=arguments.folder, metavar="DIR", help="default: RUN/export")
    sub = command("compare", _compare, "compare a run's controller with other methods, initial state by initial state")
    _add(sub, "run", "p", "n", "intervals", "methods")
    sub.add_argument("--seed", type=arguments.seed, help=SEED + "; default: the seed of the run")
    sub.add_argument("--hold", type=arguments.holds, metavar="K",
                     help="judge feedback once more, held on K intervals; or K,L")
    sub.add_argument("--robust", action="store_true", help="also noise, kicks, late and held controls, wrong masses, "
                     "real time, and the region of initial states that works; takes minutes")
    sub.add_argument("--out", type=arguments.folder, metavar="DIR", help="default: RUN/report")
    sub = command("reproduce", lambda _: None, "make a table of the paper again, its published numbers beside ours")
    reproduce.add_tables(sub)
    return top


def _add(sub: argparse.ArgumentParser, *names: str) -> None:
    known: dict[str, tuple[str, dict[str, Any]]] = {
        "problem": ("problem", {"metavar": "NAME_OR_FILE", "help": "a problem's name, or a .py file with `ocp`"}),
        "run": ("run", {"type": arguments.folder, "metavar": "RUN", "help": "the folder of a run, like runs/cartpole"}),
        "p": ("--p", {"type": arguments.parameters, "metavar": "A=1,B=2",
                      "help": "the problem at these parameters, each by name, like mass=1.2,goal=0.5; without it they "
                              "vary: a controller is for all of them, and each initial state has its own"}),
        "out": ("--out", {"type": arguments.folder, "metavar": "DIR", "help": "default: runs/NAME"}),
        "seed": ("--seed", {"type": arguments.seed, "default": 0, "help": SEED + "; default: 0"}),
        "n": ("--n", {"type": arguments.count, "default": 100, "help": "number of initial states; default: 100"}),
        "exact": ("--exact", {"action": "store_true", "help": "train on the exact dynamics, not on learned ones"}),
        "effort": ("--effort", {"choices": EFFORTS, "default": "normal", "help": "quick: to see whether it works, not "
                                "how well; best: what gave the best results, in several times the time; default: "
                                "normal"}),
        "quick": ("--quick", {"dest": "effort", "action": "store_const", "const": "quick",
                              "default": argparse.SUPPRESS, "help": "the same as --effort quick"}),
        "minutes": ("--minutes", {"type": arguments.minutes, "metavar": "M",
                                  "help": "of wall-clock time for identification and training together: they are made "
                                          "to fit it, and the best controller so far is taken; default: no limit"}),
        "intervals": ("--intervals", {"type": arguments.count, "metavar": "N", "help": "of plans, of training's too; "
                                      f"default: {USUAL}, and for training twice or four times as many where plans "
                                      "on these cost too much"}),
        "integrator": ("--integrator", {"choices": INTEGRATORS, "help": "of the steps in each interval: Runge and "
                                        "Kutta's, or implicit ones; default: the former, or the latter where they "
                                        "would be too many"}),
        "methods": ("--methods", {"type": arguments.methods, "default": ("cnd", "nmpc"), "metavar": "A,B",
                                  "help": f"default: cnd,nmpc; {_told_of(registry.METHODS)}"})}
    for name in names:
        flag, options = known[name]
        sub.add_argument(flag, **options)


def _told_of(names: Iterable[str]) -> str:
    """Methods by name, each with what it is."""
    return "; ".join(f"{name}: {registry.METHODS[name].about}" for name in names)


def _version() -> str:
    return f"nocl {__version__}"


def _list(args: argparse.Namespace) -> None:
    width = max(map(len, NAMES))
    print(f"{'name'.ljust(width)}  states  controls  horizon  problem")
    for name in NAMES:
        ocp = load_ocp(name)
        s = ocp.system
        print(f"{name.ljust(width)}  {s.nx:6d}  {s.nu:8d}  {ocp.longest:7g}  {_about(name)}")


def _about(name: str) -> str:
    """The first line of a bundled problem's file, without its title."""
    first = (import_module(f"nocl.systems.{name}").__doc__ or "").strip().splitlines()[0]
    return first.partition(": ")[2] or first


def _problem(args: argparse.Namespace) -> tuple[OCP, Path]:
    """The problem and the folder for its output; ValueError before anything is written."""
    ocp = load_ocp(args.problem)
    if args.p is not None:
        ocp = ocp.at(args.p)
    name = Path(args.problem).stem if args.problem.endswith(".py") else args.problem
    out = args.out if args.out is not None else Path("runs") / name
    arguments.check_out(out)
    return ocp, out


def _doctor(args: argparse.Namespace) -> None:
    ocp, doctor = load_ocp(args.problem), import_module("nocl.comparisons.diagnosis").doctor
    found = doctor(ocp if args.p is None else ocp.at(args.p), args.intervals or USUAL, args.seed)
    print(found)
    if not found.ok:
        raise ValueError(f"doctor: {sum(one.verdict == 'PROBLEM' for one in found.findings)} problem(s), named above")


def _check_learnable(ocp: OCP) -> None:
    """ValueError where dynamics are to be learned of a system that holds the time."""
    ocp.system.refuse_discrete("learning the dynamics", "to train on the equations: --exact")
    if ocp.system.uses_time:
        raise ValueError("learned dynamics are not implemented for the time t, which the system "
                         f"{ocp.system.name!r} holds; expected one without: train on the equations, --exact")


def _run(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import RunFolder  # torch

    ocp, out = _problem(args)
    if not args.exact:
        ocp.refuse_free("nocl run without --exact")
        _check_learnable(ocp)
    stages = RunFolder(ocp, out, args.seed, args.effort, args.minutes, args.intervals, args.integrator)
    stages.check(exact=args.exact)
    _refuse(ocp, args.methods, registry.Options(args.intervals, args.seed))
    with alone(out):
        cnd = stages.train(exact=args.exact)
        failed = _told(lambda: stages.export(cnd, out / "export", ("casadi", "c"), QUICK_PROOF))
        stages.compare(cnd, out / "report", args.methods, args.n, args.intervals)
    if failed:
        raise failed


def _told(stage: Callable[[], None]) -> ValueError | None:
    """The error of a stage that later ones do not need, told at once."""
    try:
        stage()
    except ValueError as error:
        print(_one_line(error), flush=True)
        return error
    return None


def _identify(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import RunFolder  # torch

    ocp, out = _problem(args)
    _check_learnable(ocp)
    stages = RunFolder(ocp, out, args.seed, args.effort, args.minutes)
    stages.check(exact=False)
    if args.data is not None and args.minutes is not None:
        raise ValueError("--minutes is not for logs: LogSettings has steps, windows and iterations; leave it out")
    if args.data is None and (args.known or args.control_affine or args.hold_controls):
        raise ValueError("--known, --control-affine and --hold-controls are for logs: name one by --data")
    with alone(out):
        if args.data is None:
            stages.identify()
        else:
            stages.identify_log(args.data, args.known, args.control_affine, args.hold_controls)


def _train(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import RunFolder  # torch

    ocp, out = _problem(args)
    if not args.exact:
        ocp.refuse_free("nocl train without --exact")
        _check_learnable(ocp)
    stages = RunFolder(ocp, out, args.seed, args.effort, args.minutes, args.intervals, args.integrator)
    stages.check(exact=args.exact)
    with alone(out):
        stages.train(exact=args.exact)


def _solve(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import solve  # torch

    ocp, out = _problem(args)
    takes = registry.find(args.solver).takes
    given = [name for name in ("substeps", "integrator") if getattr(args, name) is not None]
    if ignored := [name for name in given if name not in takes]:
        raise ValueError(f"nocl solve: --solver {args.solver} makes no plans on a grid and takes no --{ignored[0]}: "
                         "leave it out")
    with alone(out / "solutions"):
        options = registry.Options(args.intervals, args.seed, args.substeps, args.integrator)
        solve(ocp, out / "solutions", args.solver, args.n, options, args.workers, args.p)


def _export(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import RunFolder, load_run  # torch

    run = args.run
    cnd = load_run(run, args.p)
    out = args.out if args.out is not None else run / "export"
    arguments.check_out(out)
    forms = tuple(dict.fromkeys(args.to or ("casadi", "c")))
    RunFolder(cnd.ocp, run, 0).export(cnd, out, forms, args.against, args.strict)


def _compare(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import RunFolder, beside, load_run  # torch

    run = args.run
    cnd = load_run(run, args.p)
    out = args.out if args.out is not None else run / "report"
    arguments.check_out(out)
    seed = int(cnd.card.get("seed", 0)) if args.seed is None else args.seed
    _refuse(cnd.ocp, args.methods, registry.Options(args.intervals, seed))
    with alone(beside(out, run)):  # where outcomes so far are kept
        RunFolder(cnd.ocp, run, seed).compare(cnd, out, args.methods, args.n, args.intervals, args.hold,
                                              args.robust)


def _refuse(ocp: OCP, methods: Sequence[str], options: registry.Options) -> None:
    """ValueError for methods that cannot be built for this problem, or not be judged on it, before long work."""
    if ocp.system.xdot is None:
        raise ValueError(f"the equations of {ocp.system.name!r} are not known (xdot=None), and methods are compared on "
                         "the exact f: give that System its equations, or take the controller to the plant itself "
                         "(nocl export) and see how far the model is right by nocl identify --data")
    for name in methods:
        registry.METHODS[name].refuse(ocp, options)


if __name__ == "__main__":
    sys.exit(main())
