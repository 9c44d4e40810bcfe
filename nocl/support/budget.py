"""Wall-clock time that work has to fit in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Budget:
    """So many seconds, from when it is made on; without a number there is no end."""

    seconds: float = math.inf
    clock: Callable[[], float] = time.monotonic
    spent_before: float = 0.0  # of these seconds
    begin: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "begin", self.clock() - self.spent_before)

    @property
    def limited(self) -> bool:
        return self.seconds < math.inf

    @property
    def spent(self) -> float:
        return self.clock() - self.begin

    @property
    def left(self) -> float:
        """Seconds, 0 at least."""
        return max(self.seconds - self.spent, 0.0)

    @property
    def share(self) -> float:
        """Of it that is spent, from 0 to 1."""
        return 0.0 if not self.limited else min(self.spent / max(self.seconds, 1e-9), 1.0)

    def part(self, share: float) -> Budget:
        """That share of what is left, from now on."""
        return Budget(self.left * share, self.clock) if self.limited else Budget(clock=self.clock)


ENDLESS = Budget()
