"""Ensembles: they disagree where there are no data, agree where all is known, and come back from disk."""

import dataclasses

import numpy as np
import pytest
import torch

import nocl
from nocl.sysid.ensemble import Ensemble
from nocl.sysid.identification import Settings
from nocl.systems import dubins, pendulum, van_der_pol

SMALL = Settings(iterations=150, polish=15, polish_batch=512, width=12)


@pytest.fixture(scope="module")
def ensemble() -> Ensemble:
    """Of van der Pol's oscillator, taught at x < 0 only."""
    system = van_der_pol.system()
    half = dataclasses.replace(system, ubx=[0.0, system.ubx[1]])
    data = nocl.Dataset.sample(half, 800, 0)
    return Ensemble.identify(system, 3, data=nocl.Dataset(data.x, data.u, data.xdot), settings=SMALL, progress=False)


def grid(system: nocl.System, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    x = rng.uniform([low, system.lbx[1]], [high, system.ubx[1]], (200, 2))
    return x, rng.uniform(system.lbu, system.ubu, (200, 1))


@pytest.mark.slow
def test_members_disagree_where_there_are_no_data(ensemble):
    s = ensemble.system
    known, unknown = grid(s, s.lbx[0], 0), grid(s, 0.5 * s.ubx[0], s.ubx[0])
    assert np.median(ensemble.disagreement(*unknown)) > 5 * np.median(ensemble.disagreement(*known))
    assert ensemble.doubtful(*known).mean() < 0.05
    assert ensemble.doubtful(*unknown).mean() > 0.5


def test_disagreement_is_the_spread_of_the_members(ensemble):
    x, u = grid(ensemble.system, -1, 1)
    rows = torch.from_numpy(x), torch.from_numpy(u)
    answers = np.stack([m(*rows).detach().numpy() for m in ensemble.members])
    expected = np.sqrt(answers.var(axis=0).sum(axis=1))
    np.testing.assert_allclose(ensemble.disagreement(x, u), expected, rtol=1e-9)
    np.testing.assert_allclose(ensemble(*rows).detach().numpy(), answers.mean(axis=0), rtol=1e-12)


def test_doubt_is_a_share_of_nodes(ensemble):
    s = ensemble.system
    x = np.zeros((2, 5, 2))
    x[:, :, 0] = s.lbx[0] / 2
    x[1, 3:, 0] = 10 * s.ubx[0]  # two of five nodes far away
    x[0, 4] = np.nan
    doubt = ensemble.doubt(x, np.zeros((2, 5, 1)))
    assert doubt.tolist() == [0.0, 0.4]
    assert ensemble.model.doubt(x, np.zeros((2, 5, 1))).tolist() == [0.0, 0.4]  # of a member alone: outside the box
    assert np.isnan(ensemble.doubt(np.full((1, 5, 2), np.nan), np.zeros((1, 4, 1)))).all()


def test_closed_forms_agree():
    ensemble = Ensemble.identify(dubins.system(), 2, progress=False)
    s, rng = ensemble.system, np.random.default_rng(0)
    x, u = rng.uniform(s.lbx, s.ubx, (50, s.nx)), rng.uniform(s.lbu, s.ubu, (50, s.nu))
    assert ensemble.disagreement(x, u).max() < 1e-12
    assert not ensemble.doubtful(x, u).any()


def test_saved_and_loaded(ensemble, tmp_path):
    ensemble.save(tmp_path)
    again = Ensemble.load(tmp_path)
    x, u = grid(ensemble.system, -1, 1)
    np.testing.assert_array_equal(again.disagreement(x, u), ensemble.disagreement(x, u))
    assert again.usual == ensemble.usual
    assert repr(again) == repr(ensemble)


def test_bad_arguments():
    with pytest.raises(ValueError, match="members is 1; expected an integer >= 2"):
        Ensemble.identify(pendulum.system(), 1)
    with pytest.raises(ValueError, match="leave it out"):
        Ensemble.identify(pendulum.system(), 2, checkpoint="folder")


def test_figures(ensemble):
    titles = [axes.get_title() for axes in ensemble.model.plot().axes]
    assert len(titles) == 3  # two derivatives and the errors
    assert titles[-1] == "share of the box"
