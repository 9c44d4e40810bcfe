"""What a long identification shows and keeps: progress bars, finished networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nocl.support import store
from nocl.sysid import fitting
from nocl.sysid.settings import Settings
from nocl.system import System


class Progress:
    """One tqdm bar a stage, with the loss and the time left."""

    def __init__(self, name: str, show: bool) -> None:
        self.name, self.show = name, show

    def stage(self, title: str, total: int) -> _Bar:
        return _Bar(f"identify {self.name}: {title}", total, self.show and total > 0)


class _Bar:
    def __init__(self, title: str, total: int, show: bool) -> None:
        self.bar = tqdm(total=total, desc=title, disable=not show, mininterval=0.5)

    def __enter__(self) -> Callable[[float], None]:
        return self._report

    def _report(self, rms: float) -> None:
        if not self.bar.disable:
            self.bar.set_postfix(error=f"{rms:.2g}", refresh=False)
            self.bar.update()

    def __exit__(self, *_: object) -> None:
        self.bar.close()


@dataclass(frozen=True)
class Checkpoint:
    """Finished networks in a folder, or nowhere."""

    folder: Path | None
    meta: Mapping[str, Any]

    @staticmethod
    def at(folder: str | Path, system: System, seed: int, settings: Settings, of: Mapping[str, Any]) -> Checkpoint:
        """Of networks for the same call, and what it found so far."""
        meta = {"system": system.to_data(), "seed": seed, "settings": asdict(settings), **of}
        return Checkpoint(Path(folder), meta)

    def _path(self, index: int) -> Path:
        assert self.folder is not None
        return self.folder / f"dynamics-{index}.safetensors"

    def get(self, index: int) -> fitting.Weights | None:
        """The finished network, None where there is none; ValueError where it is of another call."""
        if self.folder is None or not self._path(index).is_file():
            return None
        state, meta = store.load_checkpoint(self._path(index))
        if meta != self.meta:
            raise ValueError(f"{self._path(index)} is of another system, data, seed or settings; expected the same "
                             "call as the one that is resumed: use another checkpoint folder")
        return list(state)

    def put(self, index: int, weights: fitting.Weights) -> None:
        if self.folder is not None:
            store.save_checkpoint(self._path(index), list(weights), self.meta)
