"""What knows nothing of control: checks of input, data-only files, processes, compilers, threads, Ctrl-C."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
