"""What is installed: nocl and nothing beside it, whole, usable without L4CasADi; and what set-up promises."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"nocl": "nocl", "systems": "nocl/systems", "solvers": "nocl/solvers", "comparisons": "nocl/comparisons"}

TINY_RUN = """
import sys
sys.modules["l4casadi"] = None  # not installed
import casadi as ca
import nocl
from nocl import records
from nocl.nets import MLP, FeatureNet

assert nocl.__file__.startswith(sys.argv[1]), nocl.__file__
ocp = nocl.load_ocp("pendulum")
s = ocp.system
assert sys.modules[type(ocp).__module__].__file__.startswith(sys.argv[1])
x, t, y = ca.SX.sym("x", s.nx), ca.SX.sym("t"), ca.SX.sym("y", s.nu)
net = FeatureNet(ca.Function("i", [x, t], [ca.vertcat(x, t)], ["x", "t"], ["phi"]), [MLP([s.nx + 1, 4, s.nu])],
                 ca.Function("o", [x, t, y], [y], ["x", "t", "y"], ["u"])).double()
records.save_net("run", "controller", net)
policy = nocl.to_casadi(records.load_net("run", "controller"), name="policy")
print(policy, s.f(ocp.x_goal, policy(ocp.x_goal, 0)))
try:
    nocl.to_casadi(net, backend="l4casadi")
except ValueError as error:
    print(error)
"""


def run(*command: str | Path, cwd: Path) -> str:
    result = subprocess.run([str(c) for c in command], capture_output=True, text=True, cwd=cwd, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy, so that the checkout stays clean."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / file, source)
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
        "--disable-pip-version-check", "--wheel-dir", out, ".", cwd=source)
    (file,) = out.glob("nocl-*.whl")
    return file


def test_the_wheel_holds_nocl_whole_and_nothing_beside_it(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"nocl"}
    expected = {f"{target}/{path.relative_to(ROOT / folder).as_posix()}" for folder, target in FOLDERS.items()
                for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert "nocl/py.typed" in expected
    assert not expected - names, "name the package or its data in pyproject.toml"


def test_the_metadata_name_what_an_install_needs(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        (entries,) = (name for name in archive.namelist() if name.endswith(".dist-info/entry_points.txt"))
        message, scripts = Parser().parsestr(archive.read(metadata).decode()), archive.read(entries).decode()
    required = [r for r in message.get_all("Requires-Dist", []) if "extra ==" not in r]
    assert not any("l4casadi" in r for r in required)
    assert {"casadi", "torch", "numpy", "safetensors"} <= {r.split(">")[0].split("<")[0].strip() for r in required}
    assert "nocl = nocl.cli:main" in scripts


def test_importing_nocl_takes_neither_torch_nor_l4casadi():
    code = "import sys; sys.modules['torch'] = sys.modules['l4casadi'] = None; import nocl; nocl.System; dir(nocl)"
    run(sys.executable, "-c", code, cwd=ROOT)


def test_make_needs_no_second_set_up():
    """`make --dry-run test` after the set-up only lints and tests."""
    stamp = ROOT / ".venv/.set-up"
    if Path(sys.prefix) != ROOT / ".venv" or not stamp.exists():
        pytest.skip("this environment was not set up by make")
    if stamp.stat().st_mtime < (ROOT / "pyproject.toml").stat().st_mtime:
        pytest.skip("pyproject.toml was edited since: make sets up again, as it should")
    planned = run("make", "--dry-run", "test", cwd=ROOT)
    assert "pip install" not in planned
    assert "ruff" in planned
    assert "pytest" in planned


def test_the_makefile_and_the_extra_pin_the_same_l4casadi():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert f"L4CASADI ?= {extras['l4casadi'][0]}\n" in (ROOT / "Makefile").read_text()


@pytest.mark.slow
def test_an_installed_wheel_works_without_l4casadi(wheel, tmp_path):
    venv = tmp_path / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", venv, cwd=tmp_path)
    python = venv / "bin/python"
    (site,) = venv.glob("lib/python3*/site-packages")
    # casadi, torch and the rest from this environment, but not its editable nocl: its own .pth files are not read there
    (site / "others.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index",
        "--disable-pip-version-check", wheel, cwd=tmp_path)
    (tmp_path / "tiny.py").write_text(TINY_RUN)
    printed = run(python, "tiny.py", site / "nocl", cwd=tmp_path)
    assert "policy:(x[2],t)->(u)" in printed
    assert "pip install --no-build-isolation l4casadi==2.0.0" in printed.replace("then ", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "tiny.py", "venv"]
    assert "cartpole" in run(venv / "bin/nocl", "list", cwd=tmp_path)
