"""Public names: all of them are there in a fresh process after `import nocl`, and none hides a module."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import pytest
from documents import ROOT

PACKAGES = ["nocl", *(f"nocl.{name}" for name in (
    "comparisons", "comparisons.report", "comparisons.reproduce", "definition", "exports", "exports.onnx_operations",
    "judge", "solvers", "solvers.cnd", "solvers.cnd.regression", "solvers.ddp", "solvers.levelset", "solvers.nmpc",
    "solvers.safeguard",
    "support", "sysid", "sysid.logs", "systems", "translate"))]
FOLDERS = {"comparisons", "solvers", "systems"}  # of nocl, from the top of the repository


def modules(package: str) -> set[str]:
    return {m.name for m in iter_modules(import_module(package).__path__)} | (FOLDERS if package == "nocl" else set())


def public(package: str) -> list[str]:
    return list(getattr(import_module(package), "__all__", ()))


@pytest.mark.parametrize("name", ["nocl.comparisons.compare", "nocl.solvers.NMPC", "nocl.systems.cartpole.ocp",
                                  "nocl.exports.c_code.load", "nocl.sysid.Log", "nocl.support.store"])
def test_a_name_is_there_in_a_fresh_process(name):
    subprocess.run([sys.executable, "-c", f"import nocl; {name}"], check=True)


def test_no_package_is_forgotten():
    initialised = {"nocl" if p.parent == ROOT / "nocl" else "nocl." + ".".join(
        q for q in p.parent.relative_to(ROOT).parts if q != "nocl")
        for folder in ("nocl", *FOLDERS) for p in (ROOT / folder).rglob("__init__.py")}
    assert initialised - {"nocl.cli"} == set(PACKAGES)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_and_module_is_there(package):
    found = import_module(package)
    assert set(public(package)) | modules(package) <= set(dir(found)) | {"__main__"}
    for name in public(package):
        assert getattr(found, name) is not None


@pytest.mark.parametrize("package", PACKAGES)
def test_no_public_name_is_a_modules_own(package):
    """Importing nocl.train.x would otherwise replace the function nocl.train by a module."""
    assert not (set(public(package)) & modules(package)) - FOLDERS


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_not_there_says_what_is(package):
    with pytest.raises(AttributeError, match=r"has no attribute 'nosuch'; it has \w+, "):
        _ = import_module(package).nosuch
