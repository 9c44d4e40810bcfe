"""The controllers that come with nocl are as near the optimum as they were, and the search finds what it found."""

from __future__ import annotations

import json

import numpy as np
import pytest
from gaps import FILE, PROBLEMS, costs, searched, shipped

KEPT = json.loads(FILE.read_text())


@pytest.mark.parametrize("problem", PROBLEMS)
def test_gaps_on_fixed_states_are_unchanged(problem):
    kept, laws = KEPT[problem], shipped(problem)
    assert set(laws) == set(kept["gap"])
    for name, law in laws.items():
        gap = costs(problem, law, np.array(kept["x0"])) / kept["best"] - 1
        np.testing.assert_allclose(gap, kept["gap"][name], rtol=0, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_search_finds_what_it_found(problem):
    """One-sided: a better search may find more."""
    kept = KEPT[problem]
    assert (searched(problem, np.array(kept["x0"])) <= np.array(kept["searched"]) * (1 + 1e-6)).all()
