"""NMPC beside what else a user would pick: the same problem, discretisation, start and tolerance, in one go.

    python benchmarks/nmpc.py --others /path/to/venv/bin/python   # with do-mpc, rockit-meco and casadi in that venv
    python benchmarks/nmpc.py --acados /path/to/other/bin/python  # with comma-deps-acados, then casadi in that venv
    python benchmarks/nmpc.py --sections share --problems dubins  # best of 32 IPOPT starts against NMPC's search
    python benchmarks/nmpc.py --sections parallel                 # 1,000 cart-pole states on one and on two cores

Every tool runs in a process of its own and gets the problem as serialised CasADi functions: f, L, G, h, and RK4's step.
Cold: x held at x0, u = u*. Warm: a state nearby, from the solution of the first. Every cost is that of the tool's own
controls, rolled out by the common step. CPU time beside the clock's: the first stands where others use the machine.
Results go to --out, JSON, each section with its command, commit, versions, machine and seeds.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import provenance

ROOT = Path(__file__).resolve().parents[1]
PROBLEMS = ("cartpole", "acrobot", "quadrotor", "dubins")
OTHERS = ("do-mpc", "rockit ipopt", "rockit fatrop")
ACADOS = "acados sqp"
TOOLS = ("nocl ipopt", "nocl fatrop", "nocl fatrop compiled", "opti ipopt", *OTHERS, ACADOS)
TOL, MAX_ITER = 1e-9, 500
SAME = 1e-3  # relative: costs this close are the same optimum
KICK = 0.01  # of the spread of initial states: how far the warm-started state is from the solved one
IPOPT = {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": TOL, "ipopt.max_iter": MAX_ITER, "print_time": False}


class Problem:
    """An OCP on N intervals, from plain data."""

    def __init__(self, data: dict) -> None:
        self.name, self.T, self.N = data["name"], data["T"], data["N"]
        self.f, self.L, self.G, self.h, self.step = (
            ca.Function.deserialize(data[k]) for k in ("f", "L", "G", "h", "step"))
        self.lbu, self.ubu, self.u_goal, self.x0, self.warm = (
            np.array(data[k]) for k in ("lbu", "ubu", "u_goal", "x0", "warm"))
        self.nx, self.nu, self.n_path = len(self.x0[0]), len(self.lbu), self.h.numel_out(0)

    def cost(self, x0, u) -> float:
        x, total = x0, 0.0
        for k in range(self.N):
            x, stage = self.step(x, np.clip(u[k], self.lbu, self.ubu), self.T / self.N)
            total += float(stage)
        return total + float(self.G(x))

    def cold(self, x0):
        return np.tile(x0, (self.N + 1, 1)), np.tile(self.u_goal, (self.N, 1))


def tool_nocl(p: Problem, solver: str, **options):
    """solve(x0, (x, u), warm) -> (x, u, success)."""
    import nocl
    from nocl.solvers import NMPC

    nmpc = NMPC(nocl.load_ocp(p.name), p.N, solver=solver, options={f"{solver}.tol": TOL}, **options)
    t = np.linspace(0, p.T, p.N + 1)
    nmpc.program.solver, nmpc.program.warm.solver  # noqa: B018

    def solve(x0, guess, warm):
        answer = (nmpc.program.warm if warm else nmpc.program).solve(x0, t, *guess)
        return answer.x, answer.u, answer.success

    return solve


def tool_opti(p: Problem):
    """What one writes by hand: CasADi's Opti, multiple shooting, IPOPT, expanded."""
    opti, h = ca.Opti(), p.T / p.N
    X, U, x0 = opti.variable(p.nx, p.N + 1), opti.variable(p.nu, p.N), opti.parameter(p.nx)
    cost = p.G(X[:, p.N])
    opti.subject_to(X[:, 0] == x0)
    for k in range(p.N):
        end, stage = p.step(X[:, k], U[:, k], h)
        opti.subject_to(X[:, k + 1] == end)
        opti.subject_to(opti.bounded(p.lbu, U[:, k], p.ubu))
        if p.n_path:
            opti.subject_to(p.h(X[:, k + 1]) >= 0)
        cost += stage
    opti.minimize(cost)
    opti.solver("ipopt", {"expand": True, **IPOPT})

    def solve(x, guess, _):
        opti.set_value(x0, x)
        opti.set_initial(X, guess[0].T)
        opti.set_initial(U, guess[1].T)
        try:
            solution, ok = opti.solve(), True
        except RuntimeError:
            solution, ok = opti.debug, False
        return (np.reshape(solution.value(X), (p.nx, -1)).T, np.reshape(solution.value(U), (p.nu, -1)).T, ok)

    return solve


def tool_dompc(p: Problem):
    """do-mpc with a discrete model: x+ and the stage cost are the common RK4 step's."""
    import do_mpc

    model = do_mpc.model.Model("discrete", "SX")
    x, u = model.set_variable("_x", "x", (p.nx, 1)), model.set_variable("_u", "u", (p.nu, 1))
    model.set_rhs("x", p.step(x, u, p.T / p.N)[0])
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step, mpc.settings.n_robust = p.N, p.T / p.N, 0
    mpc.settings.nlpsol_opts = IPOPT
    x, u = model.x["x"], model.u["u"]
    mpc.set_objective(lterm=p.step(x, u, p.T / p.N)[1], mterm=p.G(x))
    mpc.set_rterm(u=np.zeros((p.nu, 1)))
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = p.lbu, p.ubu
    for i in range(p.n_path):
        mpc.set_nl_cons(f"h{i}", -p.h(x)[i], ub=0)
    mpc.setup()

    def solve(x0, guess, _):
        for k in range(p.N + 1):
            mpc.opt_x_num["_x", k, 0, -1] = guess[0][k]
        for k in range(p.N):
            mpc.opt_x_num["_u", k, 0] = guess[1][k]
        mpc.make_step(np.reshape(x0, (-1, 1)))
        got = mpc.opt_x_num
        states = np.array([np.array(got["_x", k, 0, -1]).ravel() for k in range(p.N + 1)])
        controls = np.array([np.array(got["_u", k, 0]).ravel() for k in range(p.N)])
        return states, controls, bool(mpc.solver_stats["success"])

    return solve


def tool_rockit(p: Problem, solver: str):
    """rockit: MultipleShooting(intg='rk'), the integral as a quadrature of the same steps."""
    import rockit

    ocp = rockit.Ocp(T=p.T)
    x, u, x0 = ocp.state(p.nx), ocp.control(p.nu), ocp.parameter(p.nx)
    ocp.set_der(x, p.f(x, u))
    ocp.subject_to(ocp.at_t0(x) == x0)
    ocp.subject_to(p.lbu <= (u <= p.ubu))
    if p.n_path:
        ocp.subject_to(p.h(x) >= 0, include_first=False)
    ocp.add_objective(ocp.integral(p.L(x, u)))
    ocp.add_objective(ocp.at_tf(p.G(x)))
    fatrop = {"expand": True, "structure_detection": "auto", "fatrop.print_level": 0, "fatrop.tol": TOL,
              "fatrop.max_iter": MAX_ITER, "print_time": False}
    ocp.solver(solver, fatrop if solver == "fatrop" else {"expand": True, **IPOPT})
    ocp.method(rockit.MultipleShooting(N=p.N, M=1, intg="rk"))
    ocp.set_value(x0, p.x0[0])
    states, controls = ocp.sample(x, grid="control")[1], ocp.sample(u, grid="control-")[1]
    function = ocp.to_function("solve", [x0, states, controls], [states, controls])  # its fast way to repeat

    def solve(start, guess, _):
        try:
            got = function(start, guess[0].T, guess[1].T)
        except RuntimeError:  # a solve that fails raises
            return *guess, False
        return got[0].full().T, got[1].full().T, True

    return solve


def acados_template():
    """acados' Python interface, of its own distribution or of the wheel comma-deps-acados.

    That wheel is for an own venv (it ships a casadi, which pip install casadi replaces); it looks for its libraries by
    environment variables, and for its templates in a folder that its wheel does not have: hence the link.
    """
    try:
        import acados_template as found
    except ImportError:
        import acados
        os.environ |= {"ACADOS_SOURCE_DIR": acados.DIR, "TERA_PATH": acados.TERA_PATH}
        for library in ("blasfeo", "hpipm", "qpOASES_e", "acados"):
            ctypes.CDLL(f"{acados.LIB_DIR}/lib{library}.so", mode=ctypes.RTLD_GLOBAL)
        link = Path(acados.DIR, "interfaces", "acados_template", "acados_template")
        if not link.exists():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(acados.TEMPLATE_DIR)
        import acados.acados_template as found
        sys.modules["acados_template"] = found
    return found


def tool_acados(p: Problem, folder: str):
    """acados: SQP with HPIPM, exact Hessians made convex by mirroring, the common RK4 step as discrete dynamics."""
    at = acados_template()
    ocp, x, u, h = at.AcadosOcp(), ca.SX.sym("x", p.nx), ca.SX.sym("u", p.nu), p.T / p.N
    end, stage = p.step(x, u, h)
    m = ocp.model
    m.name, m.x, m.u, m.disc_dyn_expr = "problem", x, u, end
    m.cost_expr_ext_cost, m.cost_expr_ext_cost_e = stage / h, p.G(x)  # acados multiplies stage costs by h
    ocp.cost.cost_type = ocp.cost.cost_type_e = "EXTERNAL"
    c, o = ocp.constraints, ocp.solver_options
    c.lbu, c.ubu, c.idxbu, c.x0 = p.lbu, p.ubu, np.arange(p.nu), p.x0[0]
    if p.n_path:  # at inner nodes and at the end; the other tools leave out the first node, which x0 fixes
        m.con_h_expr = m.con_h_expr_e = p.h(x)
        c.lh = c.lh_e = np.zeros(p.n_path)
        c.uh = c.uh_e = np.full(p.n_path, 1e9)
    ocp.dims.N, o.tf, o.integrator_type, o.nlp_solver_type = p.N, p.T, "DISCRETE", "SQP"
    o.qp_solver, o.hessian_approx, o.regularize_method = "PARTIAL_CONDENSING_HPIPM", "EXACT", "MIRROR"
    o.globalization, o.nlp_solver_max_iter, o.tol = "MERIT_BACKTRACKING", MAX_ITER, 1e-6
    ocp.code_export_directory = f"{folder}/acados"
    with contextlib.chdir(folder):
        solver = at.AcadosOcpSolver(ocp, json_file=f"{folder}/acados.json")

    def solve(x0, guess, _):
        solver.reset()
        solver.constraints_set(0, "lbx", x0)
        solver.constraints_set(0, "ubx", x0)
        for k in range(p.N + 1):
            solver.set(k, "x", guess[0][k])
        for k in range(p.N):
            solver.set(k, "u", guess[1][k])
        status = solver.solve()
        return (np.array([solver.get(k, "x") for k in range(p.N + 1)]),
                np.array([solver.get(k, "u") for k in range(p.N)]), status == 0)

    return solve


def build(tool: str, p: Problem, cache: str):
    name, _, rest = tool.partition(" ")
    if name == "nocl":
        return tool_nocl(p, rest.split()[0], **({"compiled": cache} if "compiled" in rest else {}))
    if tool == ACADOS:
        return tool_acados(p, cache)
    return tool_opti(p) if name == "opti" else tool_dompc(p) if name == "do-mpc" else tool_rockit(p, rest)


def child(tool: str, source: str, target: str, cache: str) -> None:
    """One tool on one problem, in this process: times in s, costs, success, by state."""
    warnings.simplefilter("ignore")
    p = Problem(json.loads(Path(source).read_text()))
    begin = time.perf_counter()
    solve = build(tool, p, cache)
    result: dict = {"build": time.perf_counter() - begin, "cold": [], "warm": [], "cold cpu": [],
                    "warm cpu": [], "cost": [], "ok": [], "warm_cost": [],
                    "warm_ok": []}
    begin = time.perf_counter()
    solve(p.x0[0], p.cold(p.x0[0]), False)
    result["first"] = time.perf_counter() - begin
    for x0, warm in zip(p.x0, p.warm, strict=True):
        guess = p.cold(x0)
        for start, kind in ((x0, ""), (warm, "warm_")):
            begin, cpu = time.perf_counter(), time.process_time()
            *guess, ok = solve(start, guess, bool(kind))
            result["warm cpu" if kind else "cold cpu"].append(time.process_time() - cpu)
            result["warm" if kind else "cold"].append(time.perf_counter() - begin)
            result[f"{kind}cost"].append(p.cost(start, guess[1]))
            result[f"{kind}ok"].append(bool(ok))
    names = {"nocl": ("casadi", "numpy"), "opti": ("casadi",), "do-mpc": ("do-mpc", "casadi"),
             "rockit": ("rockit-meco", "casadi"), "acados": ("comma-deps-acados", "casadi")}[tool.split()[0]]
    result["versions"] = {n: importlib.metadata.version(n) for n in names}
    Path(target).write_text(json.dumps(result))


def problem_data(name: str, states: int, N: int, seed: int) -> dict:
    import nocl
    from nocl.solvers import NMPC

    ocp = nocl.load_ocp(name)
    s, x0 = ocp.system, ocp.initial_states.sample(states, seed)
    spread = ocp.initial_states.sample(1000, 0).std(axis=0)
    warm = x0 + KICK * spread * np.random.default_rng(seed).standard_normal(x0.shape)
    step = NMPC(ocp, N).program.step
    return {"name": name, "T": ocp.horizon, "N": N, "lbu": s.lbu.tolist(), "ubu": s.ubu.tolist(),
            "u_goal": ocp.u_goal.tolist(), "x0": x0.tolist(), "warm": warm.tolist(),
            **{k: g.serialize() for k, g in (("f", s.f), ("L", ocp.L), ("G", ocp.G), ("h", ocp.h), ("step", step))}}


def tools(args: argparse.Namespace, name: str) -> dict:
    """Times and optima of all tools on one problem; best known: the least cost of any tool or of NMPC's search."""
    import nocl
    from nocl.solvers import NMPC

    data, rows = problem_data(name, args.states, args.intervals, args.seed), {}
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "problem.json"), Path(folder, "result.json")
        source.write_text(json.dumps(data))
        for tool in args.tools:
            python = args.others if tool in OTHERS else args.acados if tool == ACADOS else sys.executable
            if python is None:
                rows[tool] = {"skipped": "no --acados PYTHON" if tool == ACADOS else "no --others PYTHON"}
                continue
            target.unlink(missing_ok=True)
            run = subprocess.run([python, __file__, "--child", tool, str(source), str(target), folder],
                                 capture_output=True, text=True, timeout=args.timeout, check=False)
            rows[tool] = json.loads(target.read_text()) if target.exists() else {"skipped": run.stderr[-400:]}
            print(f"  {tool}: {'skipped' if 'skipped' in rows[tool] else 'done'}", flush=True)
    begin = time.perf_counter()
    searched = NMPC(nocl.load_ocp(name), args.intervals).solve(np.array(data["x0"]), workers=1, progress=False)
    search = {"seconds": time.perf_counter() - begin, "cost": searched.cost.tolist(), "ok": searched.success.tolist()}
    return summary(rows, search)


def summary(rows: dict, search: dict) -> dict:
    found = [np.where(r["ok"], r["cost"], np.inf) for r in [*rows.values(), search] if "skipped" not in r]
    best = np.min(found, axis=0)

    def share(r: dict) -> float:
        return float(np.mean(np.array(r["ok"]) & (np.array(r["cost"]) <= best * (1 + SAME) + 1e-9)))

    table = {"nocl, search (8 starts, neighbours)": {
        "ms a state": 1e3 * search["seconds"] / len(best), "mean cost": float(np.mean(search["cost"])),
        "share at best": share(search), "solved": float(np.mean(search["ok"]))}}
    for tool, r in rows.items():
        table[tool] = r if "skipped" in r else {
            "build s": r["build"], "first solve ms": 1e3 * r["first"],
            **{f"{kind} ms {what}": 1e3 * float(np.percentile(r[kind], q))
               for kind in ("cold", "warm", "cold cpu", "warm cpu") for what, q in (("median", 50), ("p95", 95))},
            "mean cost": float(np.mean(np.array(r["cost"])[r["ok"]])), "solved": float(np.mean(r["ok"])),
            "share at best": share(r), "versions": r["versions"]}
    times = {tool: r["warm cpu ms median"] for tool, r in table.items() if "warm cpu ms median" in r}
    ours = min((v for k, v in times.items() if k.startswith("nocl")), default=np.nan)
    return {"tools": table, "best known mean cost": float(best.mean()),
            "warm cpu time over nocl's best": {k: v / ours for k, v in times.items()}}


def share(args: argparse.Namespace, name: str) -> dict:
    """How often NMPC's search is within 0.1 % of the best of 32 IPOPT starts, on states of another seed."""
    import nocl
    from nocl.solvers import NMPC

    ocp = nocl.load_ocp(name)
    x0 = ocp.initial_states.sample(args.states, args.seed + 777)
    reference = NMPC(ocp, args.intervals, solver="ipopt", starts=32, passes=0, seed=1000).solve(
        x0, workers=args.workers, progress=None)
    ours = NMPC(ocp, args.intervals).solve(x0, workers=args.workers, progress=None)
    excess = ours.cost / reference.cost - 1
    return {"states": args.states, "share within 0.1 %": float(np.mean(excess <= SAME)), "worst": float(excess.max()),
            "better by 0.1 %": float(np.mean(excess < -SAME)), "starts": float(ours.starts.mean()),
            "reference's hits of 32": float(reference.hits.mean()),
            "reference's optima a state": float(np.mean([len(o) for o in reference.optima])),
            "seconds": [float(ours.seconds.sum()), float(reference.seconds.sum())]}


def parallel(args: argparse.Namespace) -> dict:
    """Cart-pole states with multi-start on one core and on two; the processes start with the first call."""
    import nocl
    from nocl.solvers import NMPC

    ocp = nocl.load_ocp("cartpole")
    nmpc, x0, seconds, costs = NMPC(ocp, args.intervals), ocp.initial_states.sample(args.many, args.seed), {}, []
    nmpc.program.solver  # noqa: B018
    for workers in (1, 2):
        begin = time.perf_counter()
        costs.append(nmpc.solve(x0, workers=workers, progress=None).cost)
        seconds[workers] = time.perf_counter() - begin
    return {"states": args.many, "seconds": seconds, "speed-up": seconds[1] / seconds[2],
            "same costs": bool(np.array_equal(*costs))}


def environment() -> dict:
    def git(*command):
        return subprocess.run(["git", *command], capture_output=True, text=True, cwd=ROOT, check=False).stdout.strip()

    cpu = next((line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
                if line.startswith("model name")), platform.processor())
    packages = ("nocl", "casadi", "numpy", "joblib")
    return {"command": provenance.command(), "commit": git("rev-parse", "HEAD"),
            "changed files": git("status", "--short").splitlines(), "python": platform.python_version(), "cpu": cpu,
            "cores": os.cpu_count(), "load": os.getloadavg(), "when": time.strftime("%Y-%m-%d %H:%M:%S %z"),
            "versions": {p: importlib.metadata.version(p) for p in packages}}


def show(section: str, result: dict) -> None:
    if section != "tools":
        print(f"\n{section}: {json.dumps(result, indent=1)}")
        return
    columns = ("build s", "cold ms median", "cold ms p95", "warm ms median", "warm ms p95", "warm cpu ms median",
               "mean cost", "share at best")
    for name, part in result.items():
        print(f"\n{name}\n{'':38}" + "".join(f"{c:>19}" for c in columns))
        for tool, row in part["tools"].items():
            print(f"{tool:38}" + "".join(f"{row[c]:19.4g}" if c in row else f"{'-':>19}" for c in columns))


def write(path: Path, section: str, result: dict, args: argparse.Namespace) -> None:
    """Put a section into the file of results; the others there stay, each with what it was run by."""
    settings = {k: v for k, v in vars(args).items() if k in ("states", "many", "intervals", "seed", "workers")}
    path.parent.mkdir(parents=True, exist_ok=True)
    there = json.loads(path.read_text()) if path.exists() else {}
    there[section] = {"environment": environment(), "settings": settings, "results": result}
    path.write_text(json.dumps(there, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sections", nargs="+", default=["tools", "share"], choices=["tools", "share", "parallel"])
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=PROBLEMS)
    parser.add_argument("--tools", nargs="+", default=list(TOOLS), choices=TOOLS)
    parser.add_argument("--others", help="a Python that has do-mpc, rockit-meco and casadi")
    parser.add_argument("--acados", help="a Python that has acados_template (or comma-deps-acados) and casadi")
    parser.add_argument("--states", type=int, default=40)
    parser.add_argument("--many", type=int, default=1000, help="states of the section parallel")
    parser.add_argument("--intervals", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes of the section share")
    parser.add_argument("--timeout", type=float, default=1800.0, help="seconds for one tool on one problem")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "nmpc.json")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        child(*args.child)
        return
    for section in args.sections:
        if section == "parallel":
            result = parallel(args)
        else:
            result = {}
            for name in args.problems:
                print(f"{section}: {name}", flush=True)
                result[name] = (tools if section == "tools" else share)(args, name)
        show(section, result)
        write(args.out, section, result, args)
    print(f"\nwritten to {args.out}")


if __name__ == "__main__":
    main()
