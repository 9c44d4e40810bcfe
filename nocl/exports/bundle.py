"""One way out: a controller or model as files for CasADi, L4CasADi, ONNX and C, with the proof that they are it."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nocl.definition.system import System
from nocl.exports import parity
from nocl.exports.c_code import load
from nocl.exports.casadi_forms import to_casadi
from nocl.exports.onnx_reader import from_onnx
from nocl.exports.onnx_writer import Session, to_onnx
from nocl.exports.parity import Certificate, ExportPart, Finding
from nocl.support import checks, compiler, store
from nocl.support.atomic import part_of, remove_parts
from nocl.support.checks import Array

STEPS = {"casadi": ("casadi",), "l4casadi": ("l4casadi",), "onnx": ("onnx",), "c": ("c", "c_float32")}  # of each form
FORMS = tuple(STEPS)
PROOF = "parity.json"
NEEDS = {"l4casadi": ("l4casadi",), "onnx": ("onnx", "onnxruntime")}  # packages


def parts_of(thing: Any) -> list[ExportPart]:
    """The functions of a controller or of learned dynamics (objects with `export_parts()`), or of a list of these.

    Raises ValueError for others, and for a list with two functions of one name or of different systems.
    """
    if isinstance(thing, (list, tuple)) and thing:
        parts = [part for one in thing for part in parts_of(one)]
        names, systems = [part.name for part in parts], {_system(one).name for one in thing}
        if len(set(names)) < len(names) or len(systems) > 1:
            raise ValueError(f"export: got the functions {', '.join(names)} of {', '.join(sorted(systems))}; expected "
                             "different ones of one system: export the others to another folder")
        return parts
    if hasattr(thing, "export_parts"):
        made: list[ExportPart] = thing.export_parts()
        return made
    raise ValueError(f"export: got a {type(thing).__name__}; expected a CND, LearnedDynamics or a list of them")


def export(thing: Any, folder: str | os.PathLike[str], to: Sequence[str] = ("casadi",), *,
           against: Sequence[str] | None = None, strict: bool = False) -> Certificate:
    """Write a CND, LearnedDynamics or a list of them to `folder` in the forms of `to`, and prove them equal to it.

        folder/NAME.casadi            to="casadi": ca.Function.load reads it
        folder/l4casadi/NAME.casadi   to="l4casadi", with what it needs in l4casadi/lib: do not move the folder
        folder/onnx/NAME.onnx         to="onnx", float32
        folder/c, folder/c_float32    to="c"
        folder/parity.json            the certificate

    Parameters
    ----------
    against : what the certificate compares beside native CasADi and the forms of `to`; default: every form whose
        package or compiler is there
    strict : raise ValueError where any form differs, and leave the folder as it was

    Returns the Certificate; str() of it is one line. A form that differs by more than its limit (float64 1e-12, float32
    1e-5, see nocl.exports.parity) is not written, nor is a former one kept, and the certificate says why (`refused`);
    the others are. Where none of `to` is left it raises ValueError, and the folder is as it was.
    """
    folder = Path(os.path.abspath(checks.folder(folder, "folder", "export")))
    for form in (*checks.words(to, "to", "export"), *(() if against is None else checks.words(against, "against",
                                                                                               "export"))):
        checks.word(form, FORMS, "the form", "export")
    missing = missing_backends()
    for form in to:
        if form in missing:
            raise ValueError(f"export: to={form!r} needs {missing[form]}")
    parts, there, new, lib = parts_of(thing), folder.exists(), _folder(folder), folder / "l4casadi" / "lib"
    before = set(lib.glob("*"))
    try:
        with tempfile.TemporaryDirectory(dir=compiler.own_folder()) as scratch:
            work = _Export(parts, new, lib, Path(scratch), _title(thing))
            certificate = work.run(to, against, missing)
        _check_refused(certificate, to, checks.flag(strict, "strict", "export"))
        store.write_json(new / PROOF, certificate.to_data())
        _merge(new, folder)
        work.drop_former(folder, certificate.refused)
    except BaseException:
        for path in set(lib.glob("*")) - before:
            path.unlink()
        if not there:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return certificate


def _system(thing: Any) -> System:
    found: System = thing.system if hasattr(thing, "system") else thing.ocp.system
    return found


def _title(thing: Any) -> tuple[str, str]:
    things = thing if isinstance(thing, (list, tuple)) else [thing]
    return _system(things[0]).name, "; ".join(repr(one).split("\n")[0] for one in things)


def missing_backends() -> dict[str, str]:
    """The forms that cannot be made here, with what they need."""
    missing = {form: f"the package(s) {', '.join(absent)}: pip install \"nocl[{form}]\"" for form, packages in
               NEEDS.items() if (absent := [p for p in packages if find_spec(p) is None])}
    try:
        compiler.command()
    except compiler.NoCompilerError as error:
        missing["c"] = f"a C compiler: {error}"
    return missing


def _folder(folder: Path) -> Path:
    """An empty folder beside `folder`."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_parts(folder.parent, folder.name)
        part = part_of(folder)
        part.mkdir()
        return part
    except OSError as error:
        raise ValueError(f"export: {folder} cannot be made ({error.strerror}): name another folder") from error


def _check_refused(certificate: Certificate, to: Sequence[str], strict: bool) -> None:
    """ValueError where nothing is left to be written, or anything differs that must not."""
    kept = [step for form in to for step in STEPS[form] if step not in certificate.refused]
    if certificate.refused and (strict or not kept):
        step, why = next(iter(certificate.refused.items()))
        raise ValueError(f"export: {why}; nothing was written: what {step} would be is not what was trained. A float32 "
                         "form may lack the digits for a function this steep: export float64 ones")


def _merge(new: Path, folder: Path) -> None:
    """Move all files in, each by one rename."""
    try:
        for path in sorted(p for p in new.rglob("*") if p.is_file()):
            target = folder / path.relative_to(new)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
    except OSError as error:
        raise ValueError(f"export: {folder} cannot be written ({error.strerror}): name another folder") from error


class _Export:
    """Files in `new`, or in `scratch` if only compared; what L4CasADi builds must stand where it stays, in `lib`."""

    def __init__(self, parts: list[ExportPart], new: Path, lib: Path, scratch: Path, title: tuple[str, str]) -> None:
        self.parts, self.new, self.lib, self.scratch, self.title = parts, new, lib, scratch, title
        self.findings: list[Finding] = []
        self.refused: dict[str, str] = {}
        self.z = {part.name: parity.samples(part) for part in parts}
        self.expected = {part.name: parity.reference_of(part, self.z[part.name]) for part in parts}

    def run(self, to: Sequence[str], against: Sequence[str] | None, missing: dict[str, str]) -> Certificate:
        compared = [f for f in FORMS if f in to or f == "casadi" or f in (FORMS if against is None else against)]
        left_out = {f: missing[f] for f in compared if f in missing}
        for step in (step for form in compared if form not in missing for step in STEPS[form]):
            self._step(step, step.split("_")[0] in to)
        points = min(len(z) for z in self.z.values())
        inputs = {name: part.labels[name] for part in self.parts for name in part.casadi.name_in()
                  if name in part.labels}
        return Certificate(self.findings, points, left_out, inputs, self.refused)

    def _step(self, step: str, keep: bool) -> None:
        """One kind of files, kept if they are equal to what was trained."""
        folder, before, libraries = self.scratch / step, len(self.findings), set(self.lib.glob("*"))
        folder.mkdir()
        {"casadi": self._casadi, "l4casadi": self._l4casadi, "onnx": self._onnx, "c": self._c,
         "c_float32": self._c_float32}[step](folder, self.lib if keep else folder)
        bad = [finding for finding in self.findings[before:] if not finding.ok]
        if bad:
            self.refused[step] = str(bad[0])
            del self.findings[before:]
            for path in set(self.lib.glob("*")) - libraries:
                path.unlink()
        elif keep:
            shutil.copytree(folder, self.new if step == "casadi" else self.new / step, dirs_exist_ok=True)

    def drop_former(self, folder: Path, refused: Iterable[str]) -> None:
        """What an earlier export left in the folder of forms that are refused now."""
        for step in refused:
            for part in self.parts:
                name = f"{self.title[0]}_{part.name}[._]*" if step in STEPS["c"] else f"{part.name}.*"
                for path in (folder if step == "casadi" else folder / step).glob(name):
                    path.unlink()

    def _compare(self, part: ExportPart, backend: str, dtype: str, values: parity.Rows,
                 slopes: parity.Rows | None = None) -> None:
        self.findings += parity.findings(part, backend, dtype, self.z[part.name], values, slopes,
                                         self.expected[part.name])

    def _casadi(self, folder: Path, _: Path) -> None:
        for part in self.parts:
            self._compare(part, "native CasADi", "float64", *parity.of_casadi(part.column))
            part.casadi.save(str(folder / f"{part.name}.casadi"))

    def _l4casadi(self, folder: Path, lib: Path) -> None:
        for part in self.parts:
            if part.net is not None:
                f = part.casadi
                built = to_casadi(part.net, backend="l4casadi", name=part.name, in_names=f.name_in(),
                                  out_names=f.name_out(), build_dir=lib)
                self._compare(part, "L4CasADi", "float32", *parity.of_casadi(built))
                built.save(str(folder / f"{part.name}.casadi"))

    def _onnx(self, folder: Path, _: Path) -> None:
        for part in self.parts:
            if part.net is not None:
                f = part.casadi
                path = to_onnx(part.net, folder / f"{part.name}.onnx", in_names=f.name_in(), out_names=f.name_out())
                session = Session(path)
                self._compare(part, "ONNX Runtime", "float32", _split(session, part))
                self._compare(part, "ONNX imported", "float32", *parity.of_casadi(from_onnx(path)))

    def _c(self, folder: Path, _: Path) -> None:
        for part in self.parts:
            self._by_c(part, folder, "float64")

    def _c_float32(self, folder: Path, _: Path) -> None:
        for part in self.parts:
            self._by_c(part, folder, "float32")

    def _by_c(self, part: ExportPart, folder: Path, dtype: str) -> None:
        """A function's C against its values; networks also get the C of their Jacobian, in passing."""
        prefix, note = self.title
        compiled = load(part.to_c(folder, prefix, dtype=dtype, note=note), f"{prefix}_{part.name}")
        slopes = None
        if part.net is not None:
            J = _jacobian(part)
            m, n = len(self.expected[part.name][1][0]), sum(part.sizes)
            of = _split(load(J.to_c(self.scratch / f"d_{dtype}", "d", dtype=dtype), f"d_{part.name}"), part)

            def slopes(z: Array) -> Array:
                return of(z).reshape(len(z), m, n)

        self._compare(part, "C", dtype, _split(compiled, part), slopes)


def _split(function: Any, part: ExportPart) -> parity.Rows:
    """A function of several arguments as one of rows."""
    ends = np.cumsum(part.sizes)[:-1]
    return lambda z: function(*np.split(z, ends, axis=1))


def _jacobian(part: ExportPart) -> ExportPart:
    """All first derivatives, row by row, as an ExportPart."""
    f = part.column
    args = f.mx_in()
    J = ca.horzcat(*(ca.jacobian(f(*args), a) for a in args))
    bounds = {name: part.bounds[name] for name in f.name_in()}
    column = ca.Function(part.name, args, [ca.vec(ca.densify(J).T)], f.name_in(), ["J"])
    return ExportPart(part.name, column, part.torch, bounds)
