"""`nocl reproduce TABLE`: the paper's tables, each with its budgets. A table is imported when it is asked for."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from nocl.cli import arguments

# type, metavar, and what it is, of each flag; a table's own words follow
FLAGS: dict[str, tuple[Any, str | None, str]] = {
    "--seeds": (arguments.count, "K", ""), "--n": (arguments.count, None, "initial states of each seed; "),
    "--iterations": (arguments.count, "N", "of Adam in the paper's method; "),
    "--problems": (arguments.words, "A,B", ""), "--ways": (arguments.words, "A,B", "rows, like "),
    "--grid": (arguments.grid, "A,B,C", "nodes of the level sets; "),
    "--oc-iterations": (arguments.count, "N", "of Adam in NeuralOC; "),
    "--oc-batch": (arguments.count, "N", "initial states in each of those; ")}


@dataclass(frozen=True)
class TableCommand:
    """A table at the command line: where it is defined, as "module:NAME", and its flags in words."""

    made_by: str
    text: str
    flags: Mapping[str, str]
    shipped: bool = False  # whether it can take the controllers that come with nocl


CONTROL = {"--seeds": "of controllers, learned dynamics and initial states; default: 3, with --quick 1",
           "--n": "default: 1000, with --quick 8", "--iterations": "default: 1000, with --quick 10",
           "--ways": "cnd,nmpc; default: all that can be run"}
TABLES = {
    "sysid": TableCommand("nocl.comparisons.reproduce.sysid:TABLE",
                          "Table I: the error of learned dynamics by activation and supervision",
                          {"--seeds": "networks a cell; default: 3, with --quick 1",
                           "--iterations": "default: 50000, with --quick 1000",
                           "--problems": "systems; default: all four",
                           "--ways": "sine-gradients,nocl; default: all nine"}),
    "dubins": TableCommand("nocl.comparisons.reproduce.dubins:TABLE",
                           "a car round an obstacle: RRT*, NMPC, level sets, CND, the optimum",
                           {"--seeds": "sets of initial states; default: 1", "--n": "default: 1000, with --quick 20",
                            "--iterations": "default: 1000, with --quick 20", "--grid": "default: 41,81,81",
                            "--ways": "rrt-100,cnd; default: all eight"}),
    "gym": TableCommand("nocl.comparisons.reproduce.control:GYM_TABLE",
                        "acrobot and cart-pole by learned dynamics: CND, NMPC",
                        {**CONTROL, "--problems": "acrobot, cartpole; default: both"}, shipped=True),
    "quadrotor": TableCommand("nocl.comparisons.reproduce.control:QUADROTOR_TABLE",
                              "the quadrotor, f known and not: CND, NeuralOC, NMPC, LQR",
                              {**CONTROL, "--oc-iterations": "default: 6000 as published, with --quick 20",
                               "--oc-batch": "default: 1024 as published, with --quick 16"}, shipped=True),
    "approaches": TableCommand("nocl.comparisons.reproduce.approaches:TABLE",
                               "which approach gives what: time and memory by number of states",
                               {"--problems": "default: six, of 2 to 12 states"}),
    "goals": TableCommand("nocl.comparisons.reproduce.goals:TABLE",
                          "one controller for every goal, mass and obstacle: the paper's future work",
                          {"--seeds": "controllers and sets of (x0, p); default: 1",
                           "--n": "default: 200, with --quick 8", "--problems": "default: all seven",
                           "--ways": "exact,learned; default: both"})}
ALIASES = {"sysid": {"--problems": "--systems"}}  # other names of flags


def add_tables(sub: argparse.ArgumentParser) -> None:
    """A subcommand for each table."""
    tables = sub.add_subparsers(title="tables", metavar="TABLE", required=True)
    for name, table in TABLES.items():
        one = tables.add_parser(name, help=table.text, description=table.text[0].upper() + table.text[1:] + ".")
        one.set_defaults(command=run, table=name)
        one.add_argument("--debug", action="store_true", help="show the traceback of an error")
        one.add_argument("--out", type=arguments.folder, metavar="DIR",
                         help=f"default: runs/reproduce-{name}, with --quick {name}-quick; what is finished there with "
                              "the same settings is not made again, what has others is replaced")
        one.add_argument("--quick", action="store_true", help="small budgets: to see whether it works, not how well")
        if table.shipped:
            one.add_argument("--shipped", action="store_true", default=None,
                             help="nocl's default of seed 0 as it comes with nocl, instead of trained anew")
        for flag, text in table.flags.items():
            kind, metavar, what = FLAGS[flag]
            names = [flag, *([ALIASES[name][flag]] if flag in ALIASES.get(name, {}) else [])]
            one.add_argument(*names, type=kind, metavar=metavar, help=what + text)


def table_of(name: str) -> Any:
    """The table itself, a nocl.comparisons.reproduce.table.PaperTable."""
    module, _, variable = TABLES[name].made_by.partition(":")
    return getattr(import_module(module), variable)


def run(args: argparse.Namespace) -> None:
    """Make a table's cells, write what the folder holds, and print it."""
    table = table_of(args.table)
    given = {flag.removeprefix("--").replace("-", "_") for flag in (*TABLES[args.table].flags, "--shipped")}
    plan = table.plan(args.quick, **{field: getattr(args, field, None) for field in given})
    table.places(plan)
    out = args.out or Path("runs") / f"reproduce-{args.table}{'-quick' if args.quick else ''}"
    arguments.check_out(out)
    table.run(out, plan)
    cells = table.finished(out)
    paths = table.write(out, cells)
    print(table.markdown(table.entries(cells)), end="")
    print("written:", ", ".join(map(str, paths)))
