"""One run at a time in a folder: a lock that the system releases when a process ends, however it ends."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NAME = ".nocl-lock"


@contextmanager
def alone(folder: Path | None) -> Iterator[None]:
    """While it lasts no other run works in `folder` (made if missing); ValueError where one is at work there already.

    None stands for no folder, which needs no lock. The lock's file is gone afterwards, and so are folders that were
    made for it where nothing was written; after a kill they may stay, and hold no lock.
    """
    if folder is None:
        yield
        return
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        file = _locked(folder / NAME)
    except OSError as error:
        raise ValueError(f"{folder} cannot be written ({error.strerror}); expected a folder for a run: make room, or "
                         "name another one") from error
    try:
        yield
    finally:
        (folder / NAME).unlink(missing_ok=True)  # while it is still held: whoever waits for it then makes a new one
        os.close(file)
        _remove_empty(new)


def _remove_empty(folders: list[Path]) -> None:
    """Removes those that are empty, the innermost first."""
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:  # it holds something, or another run has begun there
            return


def _locked(path: Path) -> int:
    """An open descriptor that holds the lock of the file that `path` names at this moment."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
        except FileNotFoundError:  # a run that ended removed the empty folder in between
            continue
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = os.read(file, 32).decode(errors="replace").strip()
            os.close(file)
            raise ValueError(f"another run is at work in {path.parent} (process {who or 'unknown'}): wait until it "
                             "is done, or name another folder") from None
        if _is_still(path, file):
            os.ftruncate(file, 0)
            os.write(file, str(os.getpid()).encode())
            return file
        os.close(file)  # its owner removed it between our opening and locking it


def _is_still(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(file))
    except FileNotFoundError:
        return False
