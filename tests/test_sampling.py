"""Distributions of states: moments, seeds, checks, and their plain data."""

import json

import numpy as np
import pytest

from nocl import Gaussian, Uniform
from nocl.definition import sampling

N = 200_000


def test_gaussian_has_its_mean_and_standard_deviation():
    x = Gaussian(mean=[1.0, -2.0, 3.0], std=[0.5, 2.0, 0.0]).sample(N, seed=1)
    np.testing.assert_allclose(x.mean(0), [1, -2, 3], atol=5 * 2.0 / np.sqrt(N))
    np.testing.assert_allclose(x.std(0), [0.5, 2, 0], rtol=0.01)
    np.testing.assert_allclose(np.corrcoef(x[:, :2].T)[0, 1], 0, atol=5 / np.sqrt(N))
    assert (x[:, 2] == 3).all()


def test_uniform_fills_its_box_evenly():
    x = Uniform(lb=[-1.0, 2.0, 5.0], ub=[1.0, 6.0, 5.0]).sample(N, seed=1)
    assert (x >= [-1, 2, 5]).all()
    assert (x <= [1, 6, 5]).all()
    counts, _ = np.histogram(x[:, 1], bins=10, range=(2, 6))
    np.testing.assert_allclose(counts / N, 0.1, atol=5 * np.sqrt(0.09 / N))
    assert (x[:, 2] == 5).all()


@pytest.mark.parametrize("d", [Gaussian([0.0, 1.0], [1.0, 2.0]), Uniform([0.0, 1.0], [1.0, 2.0])])
class TestBoth:
    def test_seeds(self, d):
        np.testing.assert_array_equal(d.sample(7, seed=3), d.sample(7, seed=3))
        assert not np.array_equal(d.sample(7, seed=3), d.sample(7, seed=4))
        rng = np.random.default_rng(3)
        np.testing.assert_array_equal(np.vstack([d.sample(7, rng), d.sample(2, rng)])[:7], d.sample(7, seed=3))

    def test_shape_and_size(self, d):
        assert d.n == 2
        assert d.sample(5).shape == (5, 2)
        assert d.sample(0).shape == (0, 2)
        np.testing.assert_allclose(d.centre, d.sample(N, 0).mean(0), atol=0.03)

    def test_data_round_trip(self, d):
        back = sampling.from_data(json.loads(json.dumps(sampling.to_data(d))))
        assert type(back) is type(d)
        np.testing.assert_array_equal(back.sample(9, 5), d.sample(9, 5))

    def test_frozen(self, d):
        with pytest.raises(ValueError, match="read-only"):
            next(iter(vars(d).values()))[0] = 9.0
        with pytest.raises(AttributeError):
            d.n = 3


def test_the_callers_arrays_are_copied():
    mean = np.zeros(2)
    d = Gaussian(mean, [1.0, 1.0])
    mean[0] = 99.0
    assert d.mean.tolist() == [0.0, 0.0]
    assert mean.flags.writeable


@pytest.mark.parametrize(("kind", "a", "b", "message"), [
    (Gaussian, [0.0, 0.0], [1.0], r"std has shape \(1,\), expected \(2,\)"),
    (Gaussian, [0.0], [-1.0], "std is .*-1"),
    (Gaussian, [np.nan], [1.0], "mean .* NaN"),
    (Gaussian, [0.0], [np.inf], "finite"),
    (Gaussian, 0.0, 1.0, r"mean has shape \(\), expected a vector"),
    (Gaussian, [], [], r"mean has shape \(0,\)"),
    (Gaussian, ["a"], [1.0], "expected a vector: pass one number"),
    (Gaussian, [[0.0], [1.0, 2.0]], [1.0], "expected a vector"),
    (Uniform, [1.0], [0.0], "lb is .*1.0.*ub is .*0.0"),
    (Uniform, [0.0], [np.inf], "finite"),
    (Uniform, [0.0, 0.0], [1.0], "ub has shape"),
])
def test_bad_input_is_explained(kind, a, b, message):
    with pytest.raises(ValueError, match=message):
        kind(a, b)


def test_unknown_data_is_refused():
    with pytest.raises(ValueError, match="kind of a distribution is 'Cauchy'"):
        sampling.from_data({"kind": "Cauchy"})
