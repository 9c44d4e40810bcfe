"""The other way into CasADi: L4CasADi (an optional extra) compiles a library that calls torch, in float32."""

from __future__ import annotations

import copy
import re
import tempfile
import uuid
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

from nocl.nets import FeatureNet
from nocl.support import compiler

TOLERANCE = 1e-4  # relative; float32 keeps 1e-6 or so on well scaled networks


class _Rows(nn.Module):
    """One row [1, sum of sizes] -> the module's row, its inputs cut out of the row where it takes several."""

    def __init__(self, module: nn.Module, sizes: Sequence[int]) -> None:
        super().__init__()
        self.module, self.sizes = module, list(sizes)

    def forward(self, z: Tensor) -> Tensor:
        if isinstance(self.module, FeatureNet):
            return self.module(*torch.split(z, self.sizes, dim=1))
        return self.module(z)


def build(module: nn.Module, sizes: Sequence[int], name: str, build_dir: str | Path | None, in_names: Sequence[str],
          out_names: Sequence[str]) -> ca.Function:
    """A ca.Function (float32 inside) of a copy of `module` in eval mode; `to_casadi` describes the arguments.

    The files it needs lie in build_dir, under a name of their own for each build.
    """
    library = _import()
    folder, unique = _folder(build_dir), f"{name}_{uuid.uuid4().hex[:12]}"
    rows = _Rows(copy.deepcopy(module).float().cpu().eval(), sizes)
    try:
        column = _compiled(library, rows, folder, unique, sum(sizes))
        args = [ca.MX.sym(i, n) for i, n in zip(in_names, sizes, strict=True)]
        result = column(ca.vertcat(*args).T).T  # torch is given one row
        function = ca.Function(name, args, [result], list(in_names), list(out_names))
        _check(function, rows, sizes)
    except Exception:
        for path in folder.glob(f"*{unique}*"):
            path.unlink()
        raise
    return function


def _import() -> ModuleType:
    try:
        import l4casadi
    except ImportError as error:
        raise ValueError(
            f"backend='l4casadi' needs the package l4casadi, which cannot be imported ({error}): in the environment "
            "that holds torch, run pip install \"cmake<4\" ninja scikit-build setuptools wheel, then pip install "
            "--no-build-isolation l4casadi==2.0.0; or use backend='native'") from error
    return l4casadi


def _folder(build_dir: str | Path | None) -> Path:
    """The build folder, absolute; without one, one that goes with the process."""
    if build_dir is None:
        return Path(tempfile.mkdtemp(prefix="l4casadi-", dir=compiler.own_folder()))
    folder = Path(build_dir).absolute()
    if re.search(r'["\\\n]', str(folder)):
        raise ValueError(f"build_dir is {str(folder)!r}; expected a path without quotes, backslashes and line breaks, "
                         "as it is compiled into the library: name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"build_dir {folder} cannot be made ({error.strerror}): name another folder") from error
    return folder


def _compiled(library: Any, rows: nn.Module, folder: Path, unique: str, n: int) -> Any:
    class Quiet(library.L4CasADi):  # type: ignore[misc]
        def compile(self) -> None:  # its own goes through a shell, where a path with a blank falls apart
            _compile(library, folder, unique)

    # jac_jac gives exact Hessians inside an NLP; with the adjoint ones present CasADi asks for more than there is
    model = Quiet(rows, name=unique, build_dir=str(folder), generate_adj1=False, generate_jac_adj1=False,
                  generate_jac_jac=True)
    with _float32(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's on tracing; what is missing is an error below
        try:
            model.build(ca.MX.sym("z", 1, n))
        except ValueError:
            raise
        except Exception as error:  # whatever torch raises on a module that it cannot trace
            raise ValueError(f"to_casadi: L4CasADi cannot trace {type(getattr(rows, 'module', rows)).__name__} "
                             f"({type(error).__name__}: {error}); expected a module of tensor operations on rows "
                             f"[1, {n}]: check n_in, and that no branch depends on values") from error
    for trace, what in ((f"jac_{unique}.pt", "the Jacobian"), (f"jac_jac_{unique}.pt", "the Hessian")):
        if not (folder / trace).is_file():
            raise ValueError(f"to_casadi: L4CasADi cannot trace {what} of the module; expected twice differentiable "
                             "tensor operations: use others")
    model._load_built_library_as_external_cs_fun()
    return model._cs_fun


def _compile(library: Any, folder: Path, unique: str) -> None:
    package = Path(library.__file__).parent
    arguments = ["-fPIC", "-shared", str(folder / f"{unique}.cpp"), "-o", str(folder / f"lib{unique}.so"),
               f"-I{package / 'include'}", f"-L{package / 'lib'}", f"-Wl,-soname,lib{unique}.so", "-ll4casadi",
               "-lstdc++", "-std=c++17", f"-D_GLIBCXX_USE_CXX11_ABI={int(torch._C._GLIBCXX_USE_CXX11_ABI)}"]
    try:
        compiler.run(arguments, "what L4CasADi wrote")
    except compiler.CompilerError as error:
        raise ValueError(f"to_casadi: {error}; expected a C++ compiler too: install g++") from error


@contextmanager
def _float32() -> Iterator[None]:
    """L4CasADi traces on zeros of torch's default type, and runs the traces in float32."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def _check(function: ca.Function, rows: nn.Module, sizes: Sequence[int]) -> None:
    """Compare with torch at some points: a branch on values is traced at zero and would be wrong elsewhere."""
    z = np.random.default_rng(0).uniform(-1, 1, (8, sum(sizes))).astype(np.float32)
    with torch.no_grad():
        expected = np.vstack([rows(torch.from_numpy(row[None])).numpy() for row in z])
    got = np.vstack([function.call(list(np.split(row, np.cumsum(sizes)[:-1])))[0].full().ravel() for row in z])
    finite = np.isfinite(expected)
    if not (np.isfinite(got) == finite).all() or not finite.any():
        raise ValueError("to_casadi: what L4CasADi compiled, or the module, is NaN or inf where the other is not, or "
                         "everywhere, at points of [-1, 1]: expected a module that is finite there")
    error = np.abs(got - expected)[finite].max() / (1 + np.abs(expected[finite]).max())
    if not error <= TOLERANCE:
        raise ValueError(f"to_casadi: what L4CasADi compiled differs from the module by {error:.2g}, expected at most "
                         f"{TOLERANCE:g}: check that no branch of the module depends on values")
