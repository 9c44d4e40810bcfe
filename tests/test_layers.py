"""The layers of docs/design.md, read from the imports: core <- systems, solvers <- comparisons <- cli."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"systems": "nocl.systems", "solvers": "nocl.solvers", "comparisons": "nocl.comparisons"}
CHAIN = ["lqr", "nmpc", "ddp", "cnd"]  # a solver may use those before it
# files that are part of a link of the chain
PARTS = {**dict.fromkeys(("transcription", "guesses", "search", "pool", "sensitivity", "loop", "compiled"), "nmpc"),
         **dict.fromkeys(("ddp_kernel", "ddp_numpy", "ddp_batch", "bank", "global_search"), "ddp"),
         "levelset_scheme": "levelset"}
MAY_IMPORT = {"core": {"core"}, "systems": {"core", "systems"}, "solvers": {"core", "solvers"},
              "comparisons": {"core", "systems", "solvers", "comparisons"},
              "top": {"core", "systems", "solvers", "comparisons", "top"}}


def files() -> dict[str, Path]:
    """Every module of nocl by its dotted name."""
    found = {}
    for folder, package in {"nocl": "nocl", **PACKAGES}.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join([package, *(p for p in parts if p != "__init__")])] = path
    return found


FILES = files()


def imports(name: str, top_level: bool = False) -> Iterator[str]:
    """The modules that a module imports: everywhere, or only when it is itself imported."""
    todo: list[ast.AST] = [ast.parse(FILES[name].read_text())]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from from_import(name, node)
        elif not (top_level and (isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or is_type_checking(node))):
            todo.extend(ast.iter_child_nodes(node))


def from_import(name: str, node: ast.ImportFrom) -> list[str]:
    package = name if FILES[name].name == "__init__.py" else name.rpartition(".")[0]
    base = node.module or ""
    if node.level:
        base = ".".join([*package.split(".")[: len(package.split(".")) - node.level + 1], *filter(None, [node.module])])
    return [f"{base}.{a.name}" if f"{base}.{a.name}" in FILES else base for a in node.names]


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def layer(name: str) -> str:
    if name in ("nocl.cli", "nocl.stages", "nocl.__main__"):
        return "top"
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in PACKAGES else "core"


def solver(name: str) -> str:
    parts = name.split(".")
    return parts[2] if len(parts) > 2 else ""


def test_the_walk_sees_the_packages():
    assert {layer(n) for n in FILES} >= {"core", "systems", "solvers", "comparisons"}
    assert "nocl.checks" in set(imports("nocl.system"))


@pytest.mark.parametrize("name", FILES)
def test_imports_go_one_way(name):
    for target in imports(name, top_level=name == "nocl"):  # the package hands names of all layers on, lazily
        if target == "nocl" or not target.startswith("nocl."):
            continue
        assert layer(target) in MAY_IMPORT[layer(name)], f"{name} ({layer(name)}) imports {target} ({layer(target)})"


@pytest.mark.parametrize("name", FILES)
def test_packages_are_imported_by_their_nocl_name(name):
    bare = [t for t in imports(name) if t.partition(".")[0] in PACKAGES]
    assert not bare, f"{name} imports {bare}: write nocl.{bare[0]}"


@pytest.mark.parametrize("name", [n for n in FILES if layer(n) == "solvers"])
def test_among_solvers_only_the_chain_imports(name):
    """lqr <- nmpc <- ddp <- cnd; every other solver stands alone. The package itself hands names on, lazily."""
    own = solver(name)
    for target in {solver(t) for t in imports(name, top_level=not own) if layer(t) == "solvers"} - {"", own}:
        links = [PARTS.get(s, s) for s in (target, own)]
        if links[0] == links[1]:
            continue
        assert set(links) <= set(CHAIN), f"{name} imports the solver {target}, outside the chain {' <- '.join(CHAIN)}"
        assert CHAIN.index(links[0]) <= CHAIN.index(links[1]), f"{name} imports {target}, a later link of the chain"


def test_there_is_no_cycle():
    """Depth first over what importing a module imports; `import nocl` alone counts as its __init__."""
    state: dict[str, str] = {}

    def visit(name: str, path: list[str]) -> None:
        if state.get(name) == "done":
            return
        assert state.get(name) != "open", " -> ".join([*path, name])
        state[name] = "open"
        for target in imports(name, top_level=True):
            if target in FILES and target != name:
                visit(target, [*path, name])
        state[name] = "done"

    for name in FILES:
        visit(name, [])


@pytest.mark.parametrize("statement", ["import nocl", "import nocl; nocl.load_ocp('cartpole')"])
def test_the_light_part_leaves_torch_alone(statement):
    code = f"{statement}; import sys; print([m for m in ('torch', 'matplotlib', 'scipy') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
