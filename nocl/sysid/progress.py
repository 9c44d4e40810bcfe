"""What a long identification shows and keeps: progress, finished networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from nocl.definition.system import System
from nocl.support import store
from nocl.support.budget import ENDLESS, Budget
from nocl.support.progress import Bar
from nocl.support.progress import bar as progress_bar
from nocl.sysid import fitting
from nocl.sysid.settings import Settings

TRIAL = 0.1  # of the time that is left, for one


@dataclass(frozen=True)
class Progress:
    """A bar for each stage, with its error; and the time that the stages have."""

    name: str
    show: bool
    time: Budget = ENDLESS

    def stage(self, title: str, total: int) -> _Bar:
        return _Bar(progress_bar(total, f"identify {self.name}: {title}", self.show and total > 0))

    def trial(self, title: str) -> Progress:
        """Of fits beside the ones that stay."""
        return Progress(f"{self.name}, {title}", self.show, self.time.part(TRIAL))

    def part(self, share: float) -> Progress:
        """The same, with a share of the time that is left."""
        return replace(self, time=self.time.part(share))


@dataclass(frozen=True)
class _Bar:
    bar: Bar

    def __enter__(self) -> Callable[[float], None]:
        self.bar.__enter__()
        return self._report

    def _report(self, rms: float) -> None:
        self.bar.set_postfix_str(f"error={rms:.2g}", refresh=False)
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
        kept = {name: value for name, value in asdict(settings).items() if name != "minutes"}
        meta = {"system": system.to_data(), "seed": seed, "settings": kept, **of}
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
