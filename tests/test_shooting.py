"""The simulation error: its sensitivities, its Gauss-Newton step, windows with holes."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from nocl.sysid.from_log import initial
from nocl.sysid.labels import box_of
from nocl.sysid.logs.log import Log
from nocl.sysid.logs.shooting import WindowFit, WindowProblem, Windows, first_noise, lengths
from nocl.sysid.networks import assemble
from nocl.sysid.settings import LogSettings
from nocl.sysid.stated import Stated
from nocl.systems import pendulum

SMALL = LogSettings(width=3, window=4)


def problem(substeps: int = 1, ridge: float = 0.0, n: int = 12, m: int = 4) -> WindowProblem:
    """A small random network on a short log with a hole and a window that is cut off."""
    system, rng = pendulum.system(), np.random.default_rng(0)
    x = np.column_stack([np.sin(0.3 * np.arange(n)), np.cos(0.3 * np.arange(n))]) + 0.1 * rng.standard_normal((n, 2))
    x[5, 1] = np.nan
    log = Log.of(system, 0.1 * np.arange(n), x, rng.uniform(-1, 1, (n, 1)))
    parts = Stated.of(system, None, False).plain(box_of(system))
    weights = initial(parts, SMALL, 0)
    weights[0][2] = torch.from_numpy(0.3 * rng.standard_normal(weights[0][2].shape))
    net = assemble(parts, weights, True)
    unit = torch.from_numpy(rng.uniform(0.5, 2.0, sum(p.numel() for p in net.parameters())))
    windows = Windows.of(log, [r.smooth.x for r in log], m, 100, rng, first_noise(log))
    return WindowProblem(net, unit, windows, substeps, ridge)


def theta_of(p: WindowProblem) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(p.net.parameters()).detach() / p.unit


@pytest.mark.parametrize("substeps", [1, 2])
def test_sensitivities_are_autograds(substeps):
    p = problem(substeps)
    theta, w = theta_of(p), p.windows
    R, D, r = p.sensitivities(theta, w, w.start)

    def residuals(theta, start):
        return w.residuals(w.paths(p.f(theta), start, substeps)).reshape(len(w), -1)

    torch.testing.assert_close(r, residuals(theta, w.start), atol=1e-10, rtol=1e-10)
    by_theta, by_start = torch.autograd.functional.jacobian(residuals, (theta, w.start))
    torch.testing.assert_close(R, by_theta, atol=1e-9, rtol=1e-9)
    own = torch.stack([by_start[i, :, i] for i in range(len(w))])
    torch.testing.assert_close(D, own, atol=1e-9, rtol=1e-9)


def test_the_projected_step_is_the_whole_least_squares_step():
    p = problem()
    theta, w = theta_of(p), p.windows
    JJ, Jr, a, A = p.normal(theta, w.start)
    R, D, r = p.sensitivities(theta, w, w.start)
    W, rows, nx = D.shape
    whole = torch.zeros(W * rows, len(theta) + W * nx, dtype=torch.float64)
    whole[:, : len(theta)] = R.reshape(W * rows, -1)
    for i in range(W):
        whole[i * rows: (i + 1) * rows, len(theta) + i * nx: len(theta) + (i + 1) * nx] = D[i]
    damp = 1e-3  # of theta alone
    damped = whole.T @ whole / p.count
    damped[: len(theta), : len(theta)] += damp * torch.eye(len(theta))
    expected = -torch.linalg.solve(damped, whole.T @ r.reshape(-1) / p.count)
    step = -torch.linalg.solve(JJ + damp * torch.eye(len(theta)), Jr)
    near = {"atol": 3e-3 * float(expected.abs().max()), "rtol": 0.0}  # J'J is summed in single precision
    torch.testing.assert_close(step, expected[: len(theta)], **near)
    torch.testing.assert_close((a + A @ step).reshape(-1), expected[len(theta):], **near)


def test_windows_hold_every_sample_and_count_holes_out():
    w = problem(n=12).windows
    assert w.u.shape == (3, 4, 1)
    assert float(w.there.sum()) == 2 * (12 + 2) - 1  # the windows share two samples, one value is missing
    assert w.h[2].ravel().tolist() == pytest.approx([0.1, 0.1, 0.1, 0.0])


def test_the_noise_is_what_the_fit_leaves_but_for_the_starts_freedom():
    """Of simulations by the very network, with noise: windows of two steps, whose starts take a third of the rows."""
    p = problem(n=401, m=2)
    theta, w = theta_of(p), p.windows
    sigma = torch.tensor([0.02, 0.005], dtype=torch.float64)
    noise = sigma * torch.randn(w.x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    p.windows = w = dataclasses.replace(w, x=(w.paths(p.f(theta), w.start, 1) + noise) * w.there)
    start = w.start
    for _ in range(3):  # Gauss-Newton steps of the starts alone
        start = start + p.normal(theta, start)[2]
    np.testing.assert_allclose(p.noise(theta, start), sigma, rtol=0.15)  # of 400 degrees of freedom: 3.5 %
    naive = w.residuals(w.paths(p.f(theta), start, 1)).square().mean(dim=(0, 1)).sqrt() * w.noise
    assert (naive < 0.95 * sigma).all()  # sqrt(2 / 3) of it, and four times those 3.5 %


def test_each_step_lowers_the_error():
    p, seen = problem(ridge=1e-6), []
    theta, start, stage = p.minimise(theta_of(p), 8, 1e-4, seen.append)
    assert seen == sorted(seen, reverse=True)
    assert stage.last == seen[-1] < stage.first
    assert stage.taken == len(seen)
    assert p.loss(theta, start) ** 0.5 == pytest.approx(stage.last, rel=1e-12)
    assert not stage.failed


def test_no_step_is_a_failure_unless_the_noise_is_reached():
    p = problem(ridge=1e-6)
    stage = p.minimise(theta_of(p), 0, 1e-4, lambda _: None)[2]
    assert stage.first > 1
    assert stage.failed
    assert not WindowFit(4, 0.9, 0.9, 0).failed
    assert WindowFit(2, math.inf, math.inf, 0).failed
    assert WindowFit(2, math.nan, math.nan, 0).failed


def test_windows_grow_to_the_longest_run():
    system = pendulum.system()
    log = Log.of(system, 0.1 * np.arange(23), np.zeros((23, 2)), np.zeros(23))
    for window, expected in ((40, [2, 5, 11, 22]), (16, [2, 4, 8, 16]), (3, [3]), (2, [2]), (1, [1])):
        assert lengths(window, log) == expected


def test_the_next_windows_start_at_the_states_that_were_fitted():
    p = problem()
    start, states = p.windows.start + 1.0, [np.zeros((12, 2))]
    p.put(states, theta_of(p), start)
    with torch.no_grad():
        paths = p.windows.paths(p.f(theta_of(p)), start, 1).numpy()
    np.testing.assert_array_equal(states[0][:8].reshape(2, 4, 2), paths[:2, :4])
    np.testing.assert_array_equal(states[0][8:], paths[2, :4])  # the last window has three steps
