"""The controllers that come with nocl are as near the optimum as they were, and the search finds what it found."""

from __future__ import annotations

import json

import numpy as np
import pytest
from gaps import DYNAMICS, FILE, PROBLEMS, costs, searched

KEPT = json.loads(FILE.read_text())


@pytest.mark.parametrize("dynamics", DYNAMICS)
@pytest.mark.parametrize("problem", PROBLEMS)
def test_gaps_on_fixed_states_are_unchanged(problem, dynamics):
    kept = KEPT[problem]
    gap = costs(problem, dynamics, np.array(kept["x0"])) / kept["best"] - 1
    np.testing.assert_allclose(gap, kept["gap"][dynamics], rtol=0, atol=1e-6)


@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_search_finds_what_it_found(problem):
    """One-sided: a better search may find more."""
    kept = KEPT[problem]
    assert (searched(problem, np.array(kept["x0"])) <= np.array(kept["searched"]) * (1 + 1e-6)).all()
