"""The layers of docs/design.md, read from the imports: between folders they go one way, and files make no circle.

Every import counts, also those inside functions and those for type checkers. Only the lazy hand-on of public names in
an `__init__.py` does not, nor what starts the program, `__main__.py`.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"systems": "nocl.systems", "solvers": "nocl.solvers", "comparisons": "nocl.comparisons"}
MOST = 17  # files of a folder, __init__.py aside
START = "nocl.__main__"
HEAVY = {"torch", "matplotlib", "plotly", "jax", "hj_reachability", "onnx", "onnxruntime", "l4casadi", "gymnasium",
         "control", "do_mpc", "acados_template", "ompl", "pyarrow", "distributed", "joblib", "scipy", "pil",
         "pytorch_optimizer"}  # in small letters


def files() -> dict[str, Path]:
    """Every module of nocl by its dotted name."""
    found = {}
    for folder, package in {"nocl": "nocl", **PACKAGES}.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join([package, *(p for p in parts if p != "__init__")])] = path
    return found


FILES = files()


@cache
def tree_of(name: str) -> ast.Module:
    return ast.parse(FILES[name].read_text())


@cache
def nodes_of(name: str) -> list[ast.AST]:
    """All of a file's statements and expressions."""
    return list(ast.walk(tree_of(name)))


def is_package(name: str) -> bool:
    return FILES[name].name == "__init__.py"


def folder(name: str) -> str:
    return name if is_package(name) else name.rpartition(".")[0]


def module_of(name: str) -> str:
    """The module that a dotted name stands in."""
    while name not in FILES:
        name = name.rpartition(".")[0]
    return name


@cache
def imports(name: str) -> list[tuple[str, str]]:
    """(module, as written) of each import of nocl's, wherever it stands."""
    written = [w for node in nodes_of(name) for w in names_of(node) if w.partition(".")[0] == "nocl"]
    return [(module_of(w), w) for w in written]


def handed_on(name: str) -> bool:
    return is_package(name) or name == START


def graph() -> dict[str, set[str]]:
    return {name: {t for t, _ in imports(name)} - {name} for name in FILES if not handed_on(name)}


def circle(edges: Mapping[str, set[str]]) -> list[str]:
    """A path that comes back to where it started, or []."""
    done: set[str] = set()

    def visit(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node):], node]
        if node in done:
            return []
        for target in sorted(edges.get(node, ())):
            if found := visit(target, [*path, node]):
                return found
        done.add(node)
        return []

    return next((found for node in sorted(edges) if (found := visit(node, []))), [])


def test_the_walk_sees_the_imports():
    edges = graph()
    assert "nocl.support.checks" in edges["nocl.definition.system"]
    assert {folder(n) for n in FILES} >= {"nocl", "nocl.support", "nocl.solvers.ddp", "nocl.comparisons.report"}
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]


def test_no_circle_of_files():
    assert circle(graph()) == []


def test_imports_between_folders_go_one_way():
    edges: dict[str, set[str]] = {}
    for name, targets in graph().items():
        edges.setdefault(folder(name), set()).update({folder(t) for t in targets} - {folder(name)})
    assert circle(edges) == []


def test_no_folder_is_a_heap():
    for name in {folder(n) for n in FILES}:
        names = [p.stem for p in FILES[name].parent.glob("*.py") if p.name != "__init__.py"]
        assert len(names) <= MOST, f"{name} has {len(names)} files: make a folder of those of one subject"
        prefixed = [a for a in names for b in names if a.startswith(f"{b}_")]
        assert not prefixed, f"{name}: {prefixed} are named by a prefix: name them by their subject, or make a folder"


@pytest.mark.parametrize("name", [n for n in FILES if n.startswith("nocl.solvers.")])
def test_a_solver_never_imports_a_system(name):
    assert not [t for t, _ in imports(name) if t.startswith("nocl.systems")]


@pytest.mark.parametrize("name", [n for n in FILES if not handed_on(n)])
def test_names_come_from_the_module_that_defines_them(name):
    """Not from a package that hands them on: that would hide an import from this test."""
    through = [written for target, written in imports(name) if is_package(target) and target != written
               and not defined_in(target, written.rpartition(".")[2])]
    assert not through, f"{name} imports {through}: name the module that defines it"


def defined_in(package: str, name: str) -> bool:
    """Whether a package's own __init__.py defines a name, rather than handing it on."""
    body = tree_of(package).body
    defined = {n.name for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    assigned = {t.id for n in body if isinstance(n, ast.Assign) for t in n.targets if isinstance(t, ast.Name)}
    return name in defined | (assigned - {"__getattr__", "__dir__"})


@pytest.mark.parametrize("name", FILES)
def test_packages_are_imported_by_their_nocl_name(name):
    names = [a.name for n in nodes_of(name) if isinstance(n, ast.Import) for a in n.names]
    names += [n.module or "" for n in nodes_of(name) if isinstance(n, ast.ImportFrom) and not n.level]
    bare = [t for t in names if t.partition(".")[0] in PACKAGES]
    assert not bare, f"{name} imports {bare}: write nocl.{bare[0]}"


@cache
def loads(name: str) -> set[str]:
    """The heavy libraries that importing a module brings, by the imports at the top of it and of what it imports."""
    found, seen, left = set(), set(), [name]
    while left:
        seen.add(now := left.pop())
        libraries, modules = at_the_top(now)
        found |= libraries
        left += modules - seen
    return found


@cache
def at_the_top(name: str) -> tuple[set[str], set[str]]:
    """(heavy libraries, modules of nocl) that a module imports itself, outside functions."""
    body = tree_of(name).body
    nodes = [n for top in body for n in (top.body if isinstance(top, ast.Try) else [top])]
    written = [name for node in nodes for name in names_of(node)]
    own = {module_of(w) for w in written if w.partition(".")[0] == "nocl"}
    return {w.partition(".")[0].lower() for w in written} & HEAVY, own


def names_of(node: ast.AST) -> list[str]:
    """What an import statement imports, in full; [] for other statements."""
    if isinstance(node, ast.Import):
        return [a.name for a in node.names]
    return [f"{node.module}.{a.name}" for a in node.names] if isinstance(node, ast.ImportFrom) else []


def inside_functions(name: str) -> Iterator[tuple[str, str]]:
    """(what is imported, the comment behind it) of each import inside a function."""
    lines = FILES[name].read_text().splitlines()
    functions = [n for n in nodes_of(name) if isinstance(n, ast.FunctionDef)]
    for node in {n.lineno: n for f in functions for n in ast.walk(f) if names_of(n)}.values():
        for written in names_of(node):
            yield written, lines[node.lineno - 1].partition("#")[2].lower()


@pytest.mark.parametrize("name", FILES)
def test_an_import_inside_a_function_keeps_a_heavy_library_out_and_says_which(name):
    """The library's own import says it by itself; behind one of nocl's stands a comment."""
    for written, comment in inside_functions(name):
        library = written.partition(".")[0].lower()
        kept = {library} & HEAVY if library != "nocl" else {
            heavy for heavy in loads(module_of(written)) if re.search(rf"\b{heavy}\b", comment)}
        assert kept - loads(name), f"{name} imports {written} inside a function: do so at the top, or say what it saves"


@pytest.mark.parametrize("statement", ["import nocl", "import nocl; nocl.load_ocp('cartpole')"])
def test_the_light_part_leaves_torch_alone(statement):
    code = f"{statement}; import sys; print([m for m in ('torch', 'matplotlib', 'scipy') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", PACKAGES)
def test_editors_find_the_folders_at_the_top(name):
    """pyrightconfig.json looks in editor/, where nocl has them by their names."""
    link = ROOT / "editor/nocl" / name
    assert link.is_symlink()
    assert link.resolve() == ROOT / name
