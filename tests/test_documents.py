"""What README and docs say runs and exists: blocks of code, commands, files, modules and names."""

from __future__ import annotations

import ast
import re
import sys
from functools import reduce
from pathlib import Path

import pytest
from documents import PAGES, ROOT, blocks, pages_with_python, python_of, write_log
from processes import python, run

import nocl
from nocl.cli.commands import parser

VIEW = ROOT / "tests/mission/users_view.py"
SOURCES = [p for folder in ("nocl", "systems", "solvers", "comparisons", "benchmarks", "examples")
           for p in sorted((ROOT / folder).rglob("*.py"))]
FILES = {".py", ".md", ".json", ".h", ".js", ".css", ".html", ".png", ".toml", ".yml"}
MADE = {"runs", "build", "out", "cells", "tables", "figures", "export", "work", "report", "checkpoint"}  # by commands
COMMAND = re.compile(r"^(?:\$ )?nocl ([^#\n]*)", re.MULTILINE)


def test_the_readme_shows_the_lines_that_the_mission_runs():
    shown = next(b.code for b in blocks(ROOT / "README.md") if b.language == "python")
    lines = ast.parse(VIEW.read_text()).body[1:]  # after its docstring
    assert ast.dump(ast.parse(shown)) == ast.dump(ast.Module(lines, []))


@pytest.mark.parametrize("page", pages_with_python(slow=False), ids=lambda p: p.name)
def test_the_blocks_of_a_page_run(page, tmp_path):
    write_log(tmp_path)
    run([sys.executable, "-c", python_of(page, slow=False)], tmp_path)


def test_the_readme_of_a_c_export_runs(tmp_path):
    cnd = nocl.pretrained("pendulum")
    cnd.to_c(tmp_path)
    code = python_of(tmp_path / "README.md", slow=True)
    assert "nocl.exports.c_code.load" in code
    K = python(f"{code}\nimport json; print(json.dumps(gain([3.0, 0.1], 0.5).tolist()))", tmp_path)
    expected = cnd.gain_to_casadi()([3.0, 0.1], 0.5).full().ravel().tolist()
    assert expected == pytest.approx(K, abs=1e-12)


def commands() -> list[tuple[str, str]]:
    """(page, words) of each `nocl ...` line in a block without Python."""
    return [(page.name, words.strip()) for page in PAGES for b in blocks(page) if b.language != "python"
            for words in COMMAND.findall(b.code)]


def test_the_commands_are_found():
    assert len(commands()) > 10


@pytest.mark.parametrize(("page", "words"), commands())
def test_a_command_is_one(page, words):
    """Each of `nocl identify|train|...` is; where the line is whole, its options are, too."""
    first, *rest = words.split()
    for name in first.split("|"):
        if "|" in first or "..." in rest or any("|" in word for word in rest):
            with pytest.raises(SystemExit, match="0"):
                parser().parse_args([name, "--help"])
        else:
            parser().parse_args([name, *rest])


def test_the_choices_of_a_command_are_known():
    for _, words in commands():
        for choices in (word for word in words.split()[1:] if "|" in word):
            for choice in choices.split("|"):
                with pytest.raises(SystemExit, match="0"):
                    parser().parse_args([words.split()[0], choice, "--help"])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_files_and_links_are_there(page):
    text = page.read_text()
    linked = [page.parent / link.partition("#")[0] for link in re.findall(r"\]\(([^):]+)\)", text)]
    named = [ROOT / token.rstrip("/") for token in re.findall(r"`([\w.*-]+/[\w./*-]*)`", text)
             if token.partition("/")[0] not in MADE and (Path(token).suffix in FILES or token.endswith("/"))]
    missing = [str(p) for p in (*linked, *named) if not list(p.parent.glob(p.name))]
    assert not missing, f"{page.name} names {missing}: name files from the top of the repository"


OLD = {".to_c"}  # the mark of exported files, by which those of earlier versions are known too


@pytest.mark.parametrize("path", [*PAGES, *SOURCES], ids=lambda p: str(p.relative_to(ROOT)))
def test_names_of_nocl_are_there(path):
    """Dotted names in prose, docstrings and code: nocl.solvers.NMPC."""
    names = set(re.findall(r"(?<![\w./-])nocl((?:\.[a-zA-Z]\w*)+)(?![\w/])", path.read_text())) - OLD
    missing = sorted(name for name in names if not there(name[1:].split(".")))
    assert not missing, f"{path.name} names {['nocl' + m for m in missing]}"


def there(parts: list[str]) -> bool:
    try:
        reduce(getattr, parts, nocl)
    except AttributeError:
        return parts[0] == "cli" and (ROOT / "nocl" / "/".join(parts)).with_suffix(".py").is_file()  # not handed on
    return True
