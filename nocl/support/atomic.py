"""Files written whole or not at all: to a file beside, and then renamed."""

from __future__ import annotations

import glob
import os
import platform
import re
import shutil
import uuid
from pathlib import Path

from nocl.support.fingerprint import sha256

HOST = sha256(platform.node())[:12]
PART = re.compile(r"\.(?P<name>.+)\.(?P<host>[0-9a-f]{12})-(?P<pid>\d+)-[0-9a-f]{32}\.part")


def part_of(path: Path) -> Path:
    """A hidden name beside `path` for what is being written; it says by which process of which machine."""
    return path.with_name(f".{path.name}.{HOST}-{os.getpid()}-{uuid.uuid4().hex}.part")


def remove_parts(folder: Path, name: str = "") -> None:
    """Removes the parts (of one name) that processes of this machine were killed over."""
    for path in folder.glob(f".{glob.escape(name)}*.part"):
        found = PART.fullmatch(path.name)
        if found and found["host"] == HOST and name in ("", found["name"]) and not lives(int(found["pid"])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def lives(process: int) -> bool:
    """Whether there is a process of that number on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return True


def write_bytes(path: str | Path, content: bytes, durable: bool = True) -> Path:
    """Put `content` at `path`, all or nothing; an interrupted write leaves the former file as it was.

    durable: also after a power cut, for which the disk is waited for; False for what is quickly made again.
    Raises ValueError where the folder cannot be made or written to, with the remedy.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = part_of(path)
        if durable:
            remove_parts(path.parent, path.name)
    except OSError as error:
        raise ValueError(f"{path.parent} cannot be made ({error.strerror}); expected a folder to write to: "
                         "name another one") from error
    try:
        with open(part, "xb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise ValueError(f"{path} cannot be written ({error.strerror}); nothing was changed: make room or name "
                         "another folder") from error
    finally:
        part.unlink(missing_ok=True)
    return path
