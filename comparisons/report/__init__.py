"""What a comparison found: rows, summary, sentences, tables, pictures, a page."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
