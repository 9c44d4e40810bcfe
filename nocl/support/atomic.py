"""Files written whole or not at all: to a file beside, and then renamed."""

from __future__ import annotations

import os
import uuid
from pathlib import Path


def write_bytes(path: str | Path, content: bytes, durable: bool = True) -> Path:
    """Put `content` at `path`, all or nothing; an interrupted write leaves the former file as it was.

    durable: also after a power cut, for which the disk is waited for; False for what is quickly made again.
    Raises ValueError where the folder cannot be made or written to, with the remedy.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
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
