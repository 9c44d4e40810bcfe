"""The command line. Nothing heavy is imported before the arguments are checked; all output goes under --out."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from nocl.support.fields import EFFORTS

if TYPE_CHECKING:
    from nocl.ocp import OCP

METHODS = ("CND", "NMPC", "LQR", "DDP", "NMPC-LOOP")
SOLVERS = ("nmpc", "ddp", "lqr")
FORMS = ("casadi", "l4casadi", "onnx", "c")
QUICK_PROOF = ("casadi", "onnx", "c")  # of a run: L4CasADi takes half a minute to build
MOST = 1_000_000  # of anything counted on the command line
SEEDS = 2**62  # so that seeds made from one still fit in 64 bits
INTERRUPTED = 130  # 128 + SIGINT, as shells have it


class _Parser(argparse.ArgumentParser):
    """argparse with one line for an error."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; 0, or 2 after one line on stderr, or 130 after Ctrl-C."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        args = parser().parse_args(words)
        args.command(args)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("\nnocl: interrupted; the same command goes on from the last finished step", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # `nocl list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:  # the command line is where all errors end
        if "--debug" in words:
            traceback.print_exc()
        print(f"nocl: error: {_one_line(error)}", file=sys.stderr)
        return 2
    return 0


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, ValueError) and text:
        return text
    if isinstance(error, ImportError):
        return f"{text}: install it, or leave out what needs it"
    if isinstance(error, OSError):
        return f"{error.filename or ''}: {error.strerror or text}".removeprefix(": ")
    return f"unexpected {type(error).__name__}: {text or 'no message'} (--debug shows where)"


def parser() -> argparse.ArgumentParser:
    """The commands and their options."""
    top = _Parser(prog="nocl", description="Neural optimal control: one symbolic problem in, a checked controller out.",
                  epilog="A problem is the name of one that comes with nocl (`nocl list`), or the path of a Python "
                         "file that defines `ocp`. All output goes under --out, by default runs/NAME.")
    top.add_argument("--version", action="version", version=_version())
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(command=run)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        return sub

    command("list", _list, "the problems that come with nocl")
    sub = command("run", _run, "identify, train, export, solve by NMPC, compare and report, in one go")
    _add(sub, "problem", "out", "seed", "n", "exact", "effort", "quick", "intervals", "methods")
    sub = command("identify", _identify, "learn the dynamics, from the equations or from logged trajectories")
    _add(sub, "problem", "out", "seed", "effort", "quick")
    sub.add_argument("--data", type=Path, metavar="LOG", help="a .csv or .parquet file with columns t, states, "
                     "controls, and run: learn from it alone, test on a fifth of its runs")
    sub.add_argument("--known", type=_known, metavar="A=B,C=D", help="with --data: derivatives that are known, "
                     "like p=v,theta=omega: d p/dt = v; a number, or a state's or control's name")
    sub.add_argument("--control-affine", action="store_true", help="with --data: xdot = a(x) + B(x) u")
    sub.add_argument("--hold-controls", action="store_true", help="with --data: an empty control is the last before it")
    sub = command("train", _train, "train a controller and a value function, on learned dynamics unless --exact")
    _add(sub, "problem", "out", "seed", "exact", "effort", "quick")
    sub = command("solve", _solve, "solve the problem from many initial states")
    _add(sub, "problem", "out", "seed", "n", "intervals")
    sub.add_argument("--solver", choices=SOLVERS, default="nmpc", help="default: nmpc")
    sub.add_argument("--workers", type=_workers, default="auto", metavar="W",
                     help="of NMPC's processes or DDP's threads, auto, or a Dask scheduler's tcp://...; default: auto")
    sub = command("export", _export, "write a run's controller, value function and dynamics, proven equal to it")
    _add(sub, "run")
    sub.add_argument("--to", choices=FORMS, action="append", help="default: casadi and c; may be given several times")
    sub.add_argument("--against", type=_forms, metavar="A,B", help="what is compared beside them; default: all of "
                     f"{', '.join(FORMS)} that can be made here")
    sub.add_argument("--out", type=_folder, metavar="DIR", help="default: RUN/export")
    sub = command("compare", _compare, "compare a run's controller with other methods, initial state by initial state")
    _add(sub, "run", "n", "intervals", "methods")
    sub.add_argument("--seed", type=_seed, help="of the initial states; default: the seed of the run")
    sub.add_argument("--hold", type=_holds, metavar="K", help="judge feedback once more, held on K intervals; or K,L")
    sub.add_argument("--robust", action="store_true", help="also noise, kicks, late and held controls, wrong masses, "
                     "real time, and the region of initial states that works; takes minutes")
    sub.add_argument("--out", type=_folder, metavar="DIR", help="default: RUN/report")
    sub = command("reproduce", _nothing, "make a table of the paper again, its published numbers beside ours")
    _add_tables(sub)
    return top


def _add_tables(sub: argparse.ArgumentParser) -> None:
    """`nocl reproduce TABLE`: a subcommand each."""
    tables = sub.add_subparsers(title="tables", metavar="TABLE", required=True)

    def table(name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        def started(args: argparse.Namespace) -> None:
            args.out = args.out or Path("runs") / f"reproduce-{name}{'-quick' if args.quick else ''}"
            run(args)

        one = tables.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        one.set_defaults(command=started)
        one.add_argument("--debug", action="store_true", help="show the traceback of an error")
        one.add_argument("--out", type=_folder, metavar="DIR",
                         help=f"default: runs/reproduce-{name}, with --quick {name}-quick; what is finished there with "
                              "the same settings is not made again, what has others is replaced")
        one.add_argument("--quick", action="store_true", help="small budgets: to see whether it works, not how well")
        return one

    one = table("sysid", _reproduce_sysid, "Table I: the error of learned dynamics by activation and supervision")
    one.add_argument("--seeds", type=_count, metavar="K", help="networks a cell; default: 3, with --quick 1")
    one.add_argument("--iterations", type=_count, metavar="N",
                     help="of Adam in the paper's own ways; default: 50000, with --quick 1000")
    one.add_argument("--systems", type=_words, metavar="A,B", help="default: all four")
    one.add_argument("--ways", type=_words, metavar="A,B", help="rows, like sine-gradients,nocl; default: all nine")
    one = table("dubins", _reproduce_dubins, "a car round an obstacle: RRT*, NMPC, level sets, CND, the optimum")
    one.add_argument("--seeds", type=_count, default=1, metavar="K", help="sets of initial states; default: 1")
    one.add_argument("--n", type=_count, help="initial states; default: 1000, with --quick 20")
    one.add_argument("--iterations", type=_count, metavar="N",
                     help="of Adam in the paper's method; default: 1000, with --quick 20")
    one.add_argument("--grid", type=_grid, metavar="A,B,C", help="nodes of the level sets; default: 41,81,81")
    one.add_argument("--ways", type=_words, metavar="A,B", help="rows, like rrt-100,cnd; default: all eight")
    _add_control(table("gym", _reproduce_control, "acrobot and cart-pole by learned dynamics: CND, NMPC"))
    one = table("quadrotor", _reproduce_control, "the quadrotor, f known and not: CND, NeuralOC, NMPC, LQR")
    _add_control(one)
    one.add_argument("--oc-iterations", type=_count, metavar="N",
                     help="of Adam in NeuralOC; default: 6000 as published, with --quick 20")
    one.add_argument("--oc-batch", type=_count, metavar="N",
                     help="initial states in each of those; default: 1024 as published, with --quick 16")
    one = table("approaches", _reproduce_approaches, "which approach gives what: time and memory by number of states")
    one.add_argument("--problems", type=_words, metavar="A,B", help="default: six, of 2 to 12 states")


def _add_control(one: argparse.ArgumentParser) -> None:
    one.set_defaults(table=one.prog.split()[-1])
    one.add_argument("--seeds", type=_count, metavar="K",
                     help="of controllers, learned dynamics and initial states; default: 3, with --quick 1")
    one.add_argument("--n", type=_count, help="initial states of each seed; default: 1000, with --quick 8")
    one.add_argument("--iterations", type=_count, metavar="N",
                     help="of Adam in the paper's method; default: 1000, with --quick 10")
    one.add_argument("--ways", type=_words, metavar="A,B", help="rows, like cnd,nmpc; default: all that can be run")
    one.add_argument("--shipped", action="store_true",
                     help="nocl's default of seed 0 as it comes with nocl, instead of trained anew")


def _add(sub: argparse.ArgumentParser, *names: str) -> None:
    arguments: dict[str, tuple[str, dict[str, Any]]] = {
        "problem": ("problem", {"metavar": "NAME_OR_FILE", "help": "a problem's name, or a .py file with `ocp`"}),
        "run": ("run", {"type": _folder, "metavar": "RUN", "help": "the folder of a run, like runs/cartpole"}),
        "out": ("--out", {"type": _folder, "metavar": "DIR", "help": "default: runs/NAME"}),
        "seed": ("--seed", {"type": _seed, "default": 0, "help": "of all that is drawn; default: 0"}),
        "n": ("--n", {"type": _count, "default": 100, "help": "number of initial states; default: 100"}),
        "exact": ("--exact", {"action": "store_true", "help": "train on the exact dynamics, not on learned ones"}),
        "effort": ("--effort", {"choices": EFFORTS, "default": "normal", "help": "quick: to see whether it works, not "
                                "how well; best: what gave the best results, in several times the time; default: "
                                "normal"}),
        "quick": ("--quick", {"dest": "effort", "action": "store_const", "const": "quick",
                              "default": argparse.SUPPRESS, "help": "the same as --effort quick"}),
        "intervals": ("--intervals", {"type": _count, "default": 80, "metavar": "N",
                                      "help": "of NMPC and DDP; default: 80"}),
        "methods": ("--methods", {"type": _methods, "default": ("CND", "NMPC"), "metavar": "A,B",
                                  "help": f"of {', '.join(METHODS)}; default: CND,NMPC"})}
    for name in names:
        flag, options = arguments[name]
        sub.add_argument(flag, **options)


def _version() -> str:
    from nocl import __version__

    return f"nocl {__version__}"


def _count(text: str) -> int:
    return _whole(text, 1, MOST)


def _workers(text: str) -> int | str:
    return text if text == "auto" or "://" in text else _count(text)


def _seed(text: str) -> int:
    return _whole(text, 0, SEEDS - 1)


def _whole(text: str, least: int, most: int) -> int:
    """A number of least to most in the digits 0 to 9; int() alone also takes signs, underscores and other scripts."""
    digits = text.isascii() and text.isdecimal() and len(text) <= len(str(most))
    if not digits or not least <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least} and at most {most}")
    return int(text)


def _folder(text: str) -> Path:
    """A folder's name; a blank one, as of an unset variable, would be the current folder."""
    if not text.strip() or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} is no folder's name")
    return Path(text)


def _grid(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}; expected numbers of nodes, like 41,81,81") from None


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(","))


def _known(text: str) -> dict[str, str | float]:
    """States and what their derivatives are, p=v,theta=omega."""
    known: dict[str, str | float] = {}
    for word in text.split(","):
        name, equal, value = (part.strip() for part in word.partition("="))
        if not (name and equal and value) or name in known:
            raise argparse.ArgumentTypeError(f"{text!r}; expected different states with their derivatives, like "
                                             "p=v,theta=omega")
        try:
            known[name] = float(value)
        except ValueError:
            known[name] = value
    return known


def _holds(text: str) -> tuple[int | None, ...]:
    """Rates of feedback: continuous, and each number of intervals."""
    return (None, *(_count(word.strip()) for word in text.split(",")))


def _methods(text: str) -> tuple[str, ...]:
    names = tuple(word.strip().upper() for word in text.split(","))
    if not set(names) <= set(METHODS) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of different methods of {', '.join(METHODS)}")
    return names


def _forms(text: str) -> tuple[str, ...]:
    names = tuple(word.strip().lower() for word in text.split(","))
    if not set(names) <= set(FORMS):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of {', '.join(FORMS)}")
    return names


def _nothing(args: argparse.Namespace) -> None:
    """Of a command whose subcommands do the work."""


def _reproduce_sysid(args: argparse.Namespace) -> None:
    from nocl.comparisons.reproduce import sysid, sysid_tables

    seeds, iterations = args.seeds or (1 if args.quick else 3), args.iterations or (1000 if args.quick else 50_000)
    plan = sysid.Plan(iterations, seeds, args.systems or sysid.SYSTEMS, args.ways or sysid.Plan.ways, args.quick)
    _check_out(args.out)
    sysid.run(args.out, plan)
    cells = sysid.finished(args.out)
    paths = sysid_tables.write(args.out, cells)
    print(sysid_tables.markdown(sysid.table(cells)), end="")
    print("written:", ", ".join(map(str, paths)))


def _reproduce_dubins(args: argparse.Namespace) -> None:
    from dataclasses import replace

    from nocl.comparisons.reproduce import dubins, dubins_tables

    given = {"n": args.n, "seeds": args.seeds, "paper_iterations": args.iterations, "grid": args.grid,
             "ways": args.ways}
    plan = replace(dubins.PLANS[args.quick], **{name: value for name, value in given.items() if value is not None})
    _check_out(args.out)
    dubins.run(args.out, plan)
    cells = dubins.finished(args.out)
    paths = dubins_tables.write(args.out, cells)
    print(dubins_tables.markdown(dubins.table(cells)), end="")
    print("written:", ", ".join(map(str, paths)))


def _reproduce_control(args: argparse.Namespace) -> None:
    from nocl.comparisons.reproduce import control, control_tables

    given = {name: getattr(args, name, None)
             for name in ("n", "seeds", "iterations", "oc_iterations", "oc_batch", "ways")}
    chosen = {name: value for name, value in given.items() if value is not None}
    budgets = control.QUICK if args.quick else {}
    plan = control.Plan(args.table, quick=args.quick, shipped=args.shipped, **(budgets | chosen))
    _check_out(args.out)
    control.run(args.out, plan)
    cells = control.finished(args.out, plan.table)
    paths = control_tables.write(args.out, cells, plan.table)
    print(control_tables.markdown(control.table(cells, plan.table), plan.table), end="")
    print("written:", ", ".join(map(str, paths)))


def _reproduce_approaches(args: argparse.Namespace) -> None:
    from nocl.comparisons.reproduce import approaches

    plan = approaches.Plan(nodes=15 if args.quick else 31, problems=args.problems or approaches.PROBLEMS)
    _check_out(args.out)
    approaches.run(args.out, plan)
    cells = approaches.finished(args.out)
    paths = approaches.write(args.out, cells)
    print(approaches.markdown(cells), end="")
    print("written:", ", ".join(map(str, paths)))


def _list(args: argparse.Namespace) -> None:
    from nocl.systems import NAMES, load_ocp

    width = max(map(len, NAMES))
    print(f"{'name'.ljust(width)}  states  controls  horizon  problem")
    for name in NAMES:
        ocp = load_ocp(name)
        s = ocp.system
        print(f"{name.ljust(width)}  {s.nx:6d}  {s.nu:8d}  {ocp.horizon:7g}  {_about(name)}")


def _about(name: str) -> str:
    """The first line of a bundled problem's file, without its title."""
    from importlib import import_module

    first = (import_module(f"nocl.systems.{name}").__doc__ or "").strip().splitlines()[0]
    return first.partition(": ")[2] or first


def _problem(args: argparse.Namespace) -> tuple[OCP, Path]:
    """The problem and the folder for its output; ValueError before anything is written."""
    from nocl.systems import load_ocp

    ocp = load_ocp(args.problem)
    name = Path(args.problem).stem if args.problem.endswith(".py") else args.problem
    out = args.out if args.out is not None else Path("runs") / name
    _check_out(out)
    return ocp, out


def _check_out(out: Path) -> None:
    """Whether files can be written under `out`, without writing any."""
    for path in (out, *out.absolute().parents):
        if path.exists():
            if not path.is_dir():
                raise ValueError(f"{path} is a file; expected a folder for the output: name another --out")
            if not os.access(path, os.W_OK | os.X_OK):
                raise ValueError(f"{path} cannot be written to; expected a folder of yours: name another --out")
            return


def _run(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import Stages

    ocp, out = _problem(args)
    stages = Stages(ocp, out, args.seed, args.effort)
    stages.check(exact=args.exact)
    _other_methods(ocp, args.methods, args.intervals)
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
    from nocl.cli.run_folder import Stages

    ocp, out = _problem(args)
    stages = Stages(ocp, out, args.seed, args.effort)
    stages.check(exact=False)
    if args.data is not None:
        stages.identify_log(args.data, args.known, args.control_affine, args.hold_controls)
    elif args.known or args.control_affine or args.hold_controls:
        raise ValueError("--known, --control-affine and --hold-controls are for logs: name one by --data")
    else:
        stages.identify()


def _train(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import Stages

    ocp, out = _problem(args)
    stages = Stages(ocp, out, args.seed, args.effort)
    stages.check(exact=args.exact)
    stages.train(exact=args.exact)


def _solve(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import solve

    ocp, out = _problem(args)
    solve(ocp, out / "solutions", args.solver, args.n, args.seed, args.intervals, args.workers)


def _export(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import Stages, load_run

    run = args.run
    cnd = load_run(run)
    out = args.out if args.out is not None else run / "export"
    _check_out(out)
    Stages(cnd.ocp, run, 0).export(cnd, out, tuple(dict.fromkeys(args.to or ("casadi", "c"))), args.against)


def _compare(args: argparse.Namespace) -> None:
    from nocl.cli.run_folder import Stages, load_run

    run = args.run
    cnd = load_run(run)
    out = args.out if args.out is not None else run / "report"
    _check_out(out)
    _other_methods(cnd.ocp, args.methods, args.intervals)
    seed = int(cnd.card.get("seed", 0)) if args.seed is None else args.seed
    Stages(cnd.ocp, run, seed).compare(cnd, out, args.methods, args.n, args.intervals, args.hold, args.robust)


def _other_methods(ocp: OCP, methods: Sequence[str], intervals: int) -> None:
    """ValueError for methods that cannot be built for this problem, or not be judged on it, before long work."""
    from nocl.cli.run_folder import method

    if ocp.system.xdot is None:
        raise ValueError(f"the equations of {ocp.system.name!r} are not known (xdot=None), and methods are compared on "
                         "the exact f: give that System its equations, or take the controller to the plant itself "
                         "(nocl export) and see how far the model is right by nocl identify --data")
    for name in methods:
        if name != "CND":
            method(ocp, name, intervals)


if __name__ == "__main__":
    sys.exit(main())
