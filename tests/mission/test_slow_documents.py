"""Whole pages of the documentation run, their long blocks included."""

from __future__ import annotations

import sys

import pytest
from documents import ROOT, pages_with_python, python_of, write_log
from processes import run


@pytest.mark.parametrize("page", [p for p in pages_with_python(slow=True) if p.name != "README.md"],
                         ids=lambda p: p.name)
def test_a_page_runs(page, tmp_path):
    """The README's lines are those of users_view.py."""
    write_log(tmp_path)
    run([sys.executable, "-c", python_of(page, slow=True)], tmp_path)
    assert not list(ROOT.glob("log.csv"))
