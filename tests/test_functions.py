"""The one door to a problem's functions: they are right, they follow their arguments, and nobody goes round them."""

import ast
from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.definition.hamiltonian import hamiltonian, minimiser
from nocl.solvers.ddp.kernel import ddp_source
from nocl.solvers.nmpc.sensitivity import Derivatives
from nocl.solvers.nmpc.transcription import Transcription
from nocl.translate.arguments import Arguments

ROOT = Path(__file__).resolve().parents[1]
DOOR = {  # files that may hold the symbols of a system and the expressions of a problem themselves
    "nocl/definition/system.py",  # where f is written
    "nocl/definition/ocp.py",  # where L, G and h are
    "nocl/definition/functions.py",  # the door
    "solvers/cnd/lifted.py",  # where a problem is written anew, p and t among its states
    "solvers/ddp/free.py",  # and where its horizon is one of them
    "solvers/ddp/smoothing.py",  # and where controls that H is linear in have a quadratic term
}
SYSTEM = {"x", "u", "p", "xdot"}  # what only they read of a System ...
OCP = {"running", "terminal"}  # ... and of an OCP
FUNCTIONS = {"equations", "f", "jacobian", "linearize"}  # of a System: whoever has a problem reads ocp.functions


def problem() -> nocl.OCP:
    """Nothing in it is linear, and everything is coupled."""
    a, b, u = ca.SX.sym("a"), ca.SX.sym("b"), ca.vertcat(ca.SX.sym("v"), ca.SX.sym("w"))
    s = nocl.System("coupled", x=ca.vertcat(a, b), u=u, xdot=ca.vertcat(ca.sin(b) + u[0] * a, u[1] - a * b + u[0]),
                    lbu=[-1, -2], ubu=[1, 2], lbx=[-2, -2], ubx=[2, 2])
    return nocl.OCP(s, horizon=1.0, running=ca.sumsqr(u) * (2 + a) + a**2 * b, terminal=a**4 + a * b, x_goal=[0, 0],
                    u_goal=[0, 0], initial_states=nocl.Gaussian([1, 0], [0.1, 0.1]),
                    path_constraints={"wall": 1 + a - b**2, "disc": a**2 + b**2 - 0.5}, penalty=7, penalty_margin=0.1)


@pytest.fixture
def ocp() -> nocl.OCP:
    return problem()


X, U = np.array([0.4, -0.3]), np.array([0.7, -1.1])
STEP = 1e-5


def slopes(value, z):
    """Central differences [n_out, nz]."""
    moved = [(np.ravel(value(z + d)) - np.ravel(value(z - d))) / (2 * STEP) for d in STEP * np.eye(len(z))]
    return np.stack(moved, axis=1)


def test_values_are_those_that_were_written(ocp):
    (a, b), (v, w), of = X, U, ocp.functions
    h = np.array([1 + a - b**2, a**2 + b**2 - 0.5])
    L = (v**2 + w**2) * (2 + a) + a**2 * b
    np.testing.assert_allclose(of.f(X, U).full().ravel(), [np.sin(b) + v * a, w - a * b + v], rtol=1e-14)
    np.testing.assert_allclose([float(of.L(X, U)), float(of.G(X))], [L, a**4 + a * b], rtol=1e-14)
    np.testing.assert_allclose(of.h(X).full().ravel(), h, rtol=1e-14)
    assert float(of.L_soft(X, U)) == pytest.approx(L + 7 * (np.maximum(0.1 - h, 0) ** 2).sum(), rel=1e-14)


def test_derivatives_are_those_of_differences(ocp):
    of, z, mu = ocp.functions, np.r_[X, U], np.array([0.3, -2.0])
    _, L_z, L_zz = (v.full() for v in of.L_derivatives(X, U))
    _, G_x, G_xx = (v.full() for v in of.G_derivatives(X))
    _, h_x, h_xx = (v.full() for v in of.h_derivatives(X, mu))
    AB = np.hstack([j.full() for j in of.jacobian(X, U)])
    pairs = [(AB, slopes(lambda z: of.f(z[:2], z[2:]), z)),
             (L_z.T, slopes(lambda z: of.L(z[:2], z[2:]), z)),
             (L_zz, slopes(lambda z: of.L_derivatives(z[:2], z[2:])[1], z)),
             (G_x.T, slopes(of.G, X)), (G_xx, slopes(lambda x: of.G_derivatives(x)[1], X)),
             (h_x, slopes(of.h, X)), (h_xx, slopes(lambda x: of.h_derivatives(x, mu)[1].T @ mu, X))]
    for exact, differences in pairs:
        np.testing.assert_allclose(exact, differences, atol=1e-8)


@pytest.mark.parametrize("soft", [True, False])
def test_a_step_and_the_hamiltonian_under_any_f(ocp, soft):
    """In SX under the own f, in MX under one that is called; the two agree, and with RK4 written out."""
    given = [ca.MX.sym("q", 2), ca.MX.sym("r", 2)]
    inner = ca.Function("inner", given, [ocp.system.f(*given)])
    assert inner.name_in() == ["i0", "i1"]  # a user's f, without our names
    own, other = ocp.functions, ocp.functions.on(inner)
    assert isinstance(own.stage.x, ca.SX)
    assert isinstance(other.stage.x, ca.MX)
    h, L, costate = 0.2, own.L_soft if soft else own.L, np.array([1.5, -0.4])
    k, at = [own.f(X, U)], [X]
    for reach in (h / 2, h / 2, h):
        at.append(X + reach * k[-1])
        k.append(own.f(at[-1], U))
    end = X + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3]).full().ravel()
    cost = h / 6 * sum(w * float(L(x, U)) for w, x in zip((1, 2, 2, 1), at, strict=True))
    H = float(L(X, U)) + costate @ own.f(X, U).full().ravel()
    for of in (own, other):
        got = of.step(soft=soft)(X, U, h)
        np.testing.assert_allclose(got[0].full().ravel(), end, rtol=1e-14)
        assert float(got[1]) == pytest.approx(cost, rel=1e-14)
        p = of.stage.sym("costate", 2)
        function = of.stage.function("H", {"H": of.stage.hamiltonian(p, soft=soft)}, costate=p)
        assert float(function(X, U, costate)) == pytest.approx(H, rel=1e-14)
    for mine, theirs in zip(own.jacobian(X, U), other.jacobian(X, U), strict=True):
        np.testing.assert_allclose(theirs.full(), mine.full(), rtol=1e-14)


def test_a_plant_that_is_not_known_has_costs_and_no_f(ocp):
    s = ocp.system
    unknown = nocl.System("unknown", x=s.x, u=s.u, xdot=None, lbu=s.lbu, ubu=s.ubu, lbx=s.lbx, ubx=s.ubx)
    of = nocl.OCP(unknown, horizon=1.0, running=ocp.running, terminal=ocp.terminal, x_goal=[0, 0], u_goal=[0, 0],
                  initial_states=ocp.initial_states).functions
    assert float(of.L(X, U)) == float(ocp.L(X, U))
    with pytest.raises(ValueError, match="not known"):
        of.step()
    np.testing.assert_array_equal(of.on(s.f).step(soft=False)(X, U, 0.1)[0], ocp.functions.step()(X, U, 0.1)[0])


def test_time_and_parameters_are_arguments_of_everything(ocp):
    """What the door gives, and what is built on it elsewhere, follows the problem's arguments by itself."""
    a, b, c, t = *map(nocl.parameter, "pqr"), nocl.time()
    s = ocp.system
    plant = nocl.System("more", x=s.x, u=s.u, p=a, xdot=s.xdot + a * t * s.x, lbu=s.lbu, ubu=s.ubu, lbx=s.lbx,
                        ubx=s.ubx)
    more = nocl.OCP(plant, p=ca.vertcat(b, c), horizon=1.0, running=ocp.running + b * t, terminal=ocp.terminal + c,
                    x_goal=[0, 0], u_goal=[0, 0], initial_states=ocp.initial_states, penalty=7, penalty_margin=0.1,
                    path_constraints=ocp.path_constraints, parameters=nocl.Uniform([-1] * 3, [1] * 3))
    program = Transcription(more, more.functions.f, 4)
    made = {"f": more.functions.f, "L": more.L, "jacobian": more.functions.jacobian, "step": more.functions.step(),
            "hamiltonian": hamiltonian(more), "minimiser": minimiser(more), "h": more.h, "G": more.G,
            "program": program.step, "slopes": Derivatives(program).second, "flow": Derivatives(program).flow,
            "end": Derivatives(program).end}
    first = {"h": ["x", "t", "p"], "G": ["x", "p"], "minimiser": ["x", "t", "p", "costate"], "end": ["x", "t", "p"]}
    last = {"step": ["h"], "program": ["h"], "slopes": ["h", "costate"], "hamiltonian": ["costate"],
            "flow": ["costate"]}
    for name, function in made.items():
        assert function.name_in() == first.get(name, ["x", "u", "t", "p", *last.get(name, [])]), name
    source = ddp_source(more)
    assert "#define ND 4\n#define TIMED 1\n#define NP 3" in source
    assert "stage_jacobian(const lane *i0, const lane *i1, const lane *i2, const lane *i3, lane *o0)" in source
    none = np.zeros(3)  # then it is the problem without them
    np.testing.assert_array_equal(made["minimiser"](X, 0.3, none, U)[0], minimiser(ocp)(X, U)[0])
    np.testing.assert_array_equal(made["step"](X, U, 0.3, none, 0.1)[0], ocp.functions.step()(X, U, 0.1)[0])


def test_arguments_are_found_by_name(ocp):
    at = Arguments.new(ca.SX, u=2, x=2)  # in another order than f's
    function = at.function("f", {"xdot": at.call(ocp.system.f)})
    np.testing.assert_array_equal(function(U, X), ocp.system.f(X, U))
    with pytest.raises(ValueError, match=r"f takes u; expected some of x"):
        at.but("u").call(ocp.system.f)
    step = ocp.functions.step()
    these = Arguments.of(step)
    assert these.names == ["x", "u", "h"]
    fixed = these.but("h").function("fixed", {"end": these.given(h=0.1).call(step)[0]})
    np.testing.assert_array_equal(fixed(X, U), step(X, U, 0.1)[0])


# who goes round the door


class Reader(ast.NodeVisitor):
    """What a file reads of systems and problems, and the functions of (x, u) or (x, t) that it makes itself."""

    def __init__(self, strict: bool) -> None:
        self.strict, self.found, self.known, self.tested = strict, list[str](), [dict[str, str]()], set[ast.AST]()

    def kind(self, node: ast.AST) -> str | None:
        """'ocp', 'system' (of one) or 'alone' (a System argument), by a name or by what it was assigned from."""
        if isinstance(node, ast.Attribute):
            return node.attr if node.attr in ("system", "ocp") else None
        if isinstance(node, ast.Name):
            return self.known[-1].get(node.id) or (node.id if node.id in ("system", "ocp") else None)
        return None

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        annotated = {a.arg: {"System": "alone", "OCP": "ocp"}[a.annotation.id] for a in node.args.args
                     if isinstance(a.annotation, ast.Name) and a.annotation.id in ("System", "OCP")}
        others = dict.fromkeys(a.arg for a in node.args.args)
        self.known.append({**self.known[-1], **others, **annotated})  # type: ignore[arg-type]
        self.generic_visit(node)
        self.known.pop()

    def visit_Assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            pairs = zip(target.elts, node.value.elts, strict=False) \
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple) else [(target, node.value)]
            for name, value in pairs:
                if isinstance(name, ast.Name):
                    self.known[-1][name.id] = self.kind(value)  # type: ignore[assignment]
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        if isinstance(node.ops[0], ast.Is | ast.IsNot):  # s.xdot is None: whether the equations are known
            self.tested.add(node.left)
        self.generic_visit(node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        kind = self.kind(node.value)
        of_system = SYSTEM | (FUNCTIONS if self.strict else set())
        forbidden = {"system": of_system, "alone": SYSTEM, "ocp": OCP}.get(kind or "", set())
        if node.attr in forbidden and node not in self.tested:
            self.found.append(f"line {node.lineno}: {ast.unparse(node)}")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        called = ast.unparse(node.func)
        if called.endswith(("constraints.values", "constraints.items")):
            self.found.append(f"line {node.lineno}: {ast.unparse(node)}")
        if called.endswith("ca.Function") and len(node.args) > 1:
            names = set(words(node.args[1])) | {w for arg in node.args[3:4] for w in words(arg)}
            if "x" in names and names & {"u", "t"}:
                self.found.append(f"line {node.lineno}: {ast.unparse(node)}")
        self.generic_visit(node)


def words(node: ast.AST) -> Iterator[str]:
    """Names, attributes and strings in an expression."""
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            yield part.id
        elif isinstance(part, ast.Attribute):
            yield part.attr
        elif isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value


def round_the_door(source: str, strict: bool = True) -> list[str]:
    reader = Reader(strict)
    reader.visit(ast.parse(source))
    return reader.found


FILES = [p.relative_to(ROOT).as_posix() for folder in ("nocl", "solvers", "comparisons")
         for p in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("path", [p for p in FILES if p not in DOOR])
def test_nobody_goes_round_the_door(path):
    found = round_the_door((ROOT / path).read_text(), not path.startswith("nocl/"))
    assert not found, f"{path} reads {found}: ask ocp.functions, its stage, node, end or feedback"


@pytest.mark.parametrize("source", [
    "ca.Function('f', [s.x, s.u], [y])", "ca.Function('f', [x, u, h], [y])",
    "ca.Function('f', a, b, ['x', 't'], ['u'])", "def g(ocp):\n    s, n = ocp.system, 3\n    return s.x",
    "def g(a: System):\n    return a.xdot", "ocp.system.equations",
    "self.ocp.running", "program.ocp.system.xdot[0]", "y = report.ocp.system.f(x, u)",
    "for h in ocp.path_constraints.values(): pass"])
def test_the_reader_sees_who_does(source):
    assert len(round_the_door(source)) == 1


@pytest.mark.parametrize("source", [
    "s.x", "def g(s):\n    return s.u", "if ocp.system.xdot is None: pass", "path.running + G(x)",
    "ocp.functions.f(x, u)", "def g(a: System):\n    return a.f(x, u)",
    "s = ocp.system\ns = j.simulation\ns.x", "ca.Function('f', [z], [y])", "len(ocp.path_constraints)"])
def test_and_leaves_others_alone(source):
    assert round_the_door(source) == []
