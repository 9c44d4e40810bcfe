"""The C compiler: found once for all of nocl, and its libraries kept in a cache whose entries are checked before use.

A library's file is called KIND-IDENTITY-CONTENT.so. IDENTITY tells what it was built from, by which compiler and for
which processor; CONTENT is the digest of its bytes. So a file that was cut off or altered is not what its name says,
is never loaded, and is built again. Files are moved in whole: two processes may build the same one at once.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

from nocl.support.atomic import HOST, lives, remove_parts, write_bytes
from nocl.support.fingerprint import fingerprint, sha256

CACHE_VARIABLE = "NOCL_CACHE"  # names a folder for libraries; without it they live as long as the process
OWN, LOCK = "nocl-libraries-", "lock"  # folders of processes, and the file that each holds locked while it lives
_ONCE = threading.Lock()


class NoCompilerError(ValueError):
    """There is no C compiler on this machine."""


class CompilerError(RuntimeError):
    """The compiler refused a source."""


def command() -> tuple[str, ...]:
    """The C compiler with its own arguments: $CC (like "gcc -m64"), or else gcc or cc; NoCompilerError without one."""
    named = os.environ.get("CC", "")
    try:
        words = shlex.split(named)
    except ValueError as error:
        raise NoCompilerError(f"CC is {named!r} ({error}); expected a command like 'gcc -m64': close its "
                              "quotes") from error
    for name, *arguments in [words] if words else [["gcc"], ["cc"]]:
        path = shutil.which(name)
        if path:
            return path, *arguments
    looked = f"CC={words[0]}" if words else "gcc, cc"
    raise NoCompilerError(f"no C compiler found (looked for {looked}): install gcc, or name one in the environment "
                          "variable CC")


def run(arguments: Sequence[str | os.PathLike[str]], what: str) -> None:
    """Run the compiler; CompilerError with its words where it refuses `what`."""
    words = [*command(), *(os.fspath(a) for a in arguments)]
    result = _ran(words)
    if result.returncode:
        raise CompilerError(f"{words[0]} could not compile {what}:\n{result.stderr.strip()[-2000:]}")


def shared_library(kind: str, identity: Sequence[Any], build: Callable[[Path], Path],
                   cache: str | os.PathLike[str] | None = None) -> Path:
    """The shared library that `build` makes, from the cache where a whole one is there.

    Parameters
    ----------
    kind : what the file's name begins with
    identity : all that the library depends on beside compiler and processor, for `fingerprint`
    build : writes sources to the folder it gets, and returns the library that it made there (by `run`)
    cache : the folder; default: see `cache_folder`

    Raises NoCompilerError, CompilerError, and ValueError for a folder that cannot be written to.
    """
    name = f"{kind}-{fingerprint(identity, command(), _version(command()), processor())}"
    folder = cache_folder(cache)
    found = whole_of(folder, name)
    if found is not None:
        return found
    with tempfile.TemporaryDirectory(dir=own_folder()) as scratch:  # a kill while building leaves the cache as it was
        content = build(Path(scratch)).read_bytes()
    path = write_bytes(folder / _file(name, content), content, durable=False)
    remove_parts(folder)
    return path


def cache_folder(named: str | os.PathLike[str] | None = None) -> Path:
    """The folder that is named, or the one that NOCL_CACHE names, or one that goes with the process."""
    return Path(named or os.environ.get(CACHE_VARIABLE) or own_folder())


def load(path: str | os.PathLike[str]) -> ctypes.CDLL:
    """A library that was built here; ValueError where the system does not load it."""
    try:
        return ctypes.CDLL(os.fspath(path))
    except OSError as error:
        raise ValueError(f"{path} cannot be loaded ({error}); expected a folder that programs may run from: name "
                         f"another one in {CACHE_VARIABLE} or TMPDIR, and see what CC adds to the compiler") from error


def _file(name: str, content: bytes) -> str:
    return f"{name}-{sha256(content)[:16]}.so"


def whole_of(folder: Path, name: str) -> Path | None:
    """A file of this name whose content is what it says. Others stay: someone may be replacing them right now."""
    for path in folder.glob(f"{name}-*.so"):
        try:
            whole = path.is_file() and path.name == _file(name, path.read_bytes())
        except OSError:  # unreadable, as good as none
            continue
        if whole:
            return path
    return None


@lru_cache
def _version(compiler: tuple[str, ...]) -> str:
    return _ran([compiler[0], "--version"]).stdout


def _ran(words: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise NoCompilerError(f"the C compiler {words[0]} cannot be run ({error.strerror}): install gcc, or name "
                              "another one in the environment variable CC") from error


@lru_cache
def processor() -> str:
    """What -march=native means here: code for one processor must not be loaded on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        flags = platform.processor()
    return platform.machine() + flags


def own_folder() -> Path:
    """A folder that goes with the process; what processes that were killed have left is removed first."""
    with _ONCE:
        return Path(_own_folder()[0].name)


@lru_cache
def _own_folder() -> tuple[tempfile.TemporaryDirectory[str], IO[bytes]]:
    remove_left()
    folder = tempfile.TemporaryDirectory(prefix=f"{OWN}{HOST}-{os.getpid()}-", ignore_cleanup_errors=True)
    part = Path(folder.name, "part")
    held = part.open("wb")  # kept open: the system lets the lock go when the process ends, whatever ends it
    fcntl.flock(held, fcntl.LOCK_EX)
    os.replace(part, part.with_name(LOCK))  # only now can others see it, locked
    return folder, held


def remove_left() -> None:
    for lock in Path(tempfile.gettempdir()).glob(f"{OWN}*/{LOCK}"):
        try:
            with lock.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.parent, ignore_errors=True)
        except OSError:  # its process lives, or it is another user's
            continue
    for folder in Path(tempfile.gettempdir()).glob(f"{OWN}{HOST}-*-*"):  # a kill while it was made, or removed
        process = folder.name.removeprefix(f"{OWN}{HOST}-").partition("-")[0]
        if process.isdigit() and not lives(int(process)):
            shutil.rmtree(folder, ignore_errors=True)
