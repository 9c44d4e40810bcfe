"""Whatever stands here is slow, and of the mission: `make mission` runs it, `make test` and `make test-slow` do not."""

from __future__ import annotations

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.mission)
            item.add_marker(pytest.mark.slow)
