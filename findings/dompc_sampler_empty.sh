#!/usr/bin/env bash
# do-mpc 5.1.2, samples for an approximate MPC. AMPCSampler.default_sampling() in open loop (its default) of a controller
# that prints what IPOPT says (the default too) solves every sample, reports "Successfully sampled open loop data for
# ApproxMPC.", and keeps none: in the file of all samples every control and status is None, and the file of optimal
# ones, which is what a trainer reads, has no rows. With mpc.settings.supress_ipopt_output() called before setup() the
# very same samples are all there. So minutes or hours of solves are lost without a word, by a switch for what is printed.
# Guessed before: that what is printed changes nothing in the data.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check do-mpc==5.1.2 casadi==3.8.2 numpy==2.4.6 \
    torch==2.13.0 pandas==3.1.1
cat > "$folder/see.py" <<'P'
import contextlib
import os
import sys
import warnings
from pathlib import Path

warnings.simplefilter("ignore")
import do_mpc
import pandas as pd
from do_mpc.approximateMPC import AMPCSampler


def controller(quiet):
    model = do_mpc.model.Model("discrete")
    x, u = model.set_variable("_x", "x"), model.set_variable("_u", "u")
    model.set_rhs("x", 0.9 * x + 0.1 * u)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.set_param(n_horizon=5, t_step=1.0, store_full_solution=False)
    if quiet:
        mpc.settings.supress_ipopt_output()
    mpc.set_objective(mterm=(x - 5) ** 2, lterm=(x - 5) ** 2)
    mpc.set_rterm(u=1e-3)
    for kind, name, size in (("_u", "u", 100), ("_x", "x", 10)):
        mpc.bounds["lower", kind, name], mpc.bounds["upper", kind, name] = -size, size
    mpc.setup()
    return mpc


@contextlib.contextmanager
def silence():
    """Nothing printed, by IPOPT neither."""
    kept = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        sys.stdout.flush()
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            sys.stdout.flush()
            os.dup2(kept, 1)


def kept(quiet):
    """(samples that are optimal, samples whose control is None), of five."""
    sampler, folder = AMPCSampler(controller(quiet)), Path(sys.argv[1]) / f"quiet-{quiet}"
    sampler.settings.n_samples, sampler.settings.closed_loop_flag = 5, False
    sampler.settings.data_dir, sampler.settings.dataset_name = str(folder), "data"
    sampler.setup()
    with silence():
        sampler.default_sampling()
    optimal, every = (pd.read_pickle(next(folder.rglob(f"*_{which}.pkl"))) for which in ("opt", "all"))
    return len(optimal), int(every["u0"].isna().sum())


found = {quiet: kept(quiet) for quiet in (True, False)}
for quiet, (optimal, none) in found.items():
    print("IPOPT quiet" if quiet else "IPOPT as it comes", f"{optimal} of 5 kept, {none} controls None")
raise SystemExit(0 if found == {True: (5, 0), False: (0, 5)} else "this has changed")
P
"$folder/venv/bin/python" "$folder/see.py" "$folder"
