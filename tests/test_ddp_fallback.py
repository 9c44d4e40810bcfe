"""DDP without a compiler: the same numbers as the compiled kernel's, the warning said once; the sanitized kernel."""

import warnings

import numpy as np
import pytest
from test_ddp import random_model

import nocl
from nocl.solvers.ddp import without_compiler
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.ddp.without_compiler import NumpyKernel

FIELDS = ("cost", "x", "u", "gain", "V", "V_x", "V_xx", "success", "message", "iterations")


def both(name, K, n, dynamics=None, **guess):
    ocp = nocl.load_ocp(name)
    compiled, slow = (DDP(ocp, intervals=K, dynamics=dynamics, constraints="soft", threads=1) for _ in range(2))
    slow.kernel = NumpyKernel(ocp, dynamics)
    x0, t0 = ocp.initial_states.sample(n, 3), np.linspace(0, ocp.horizon / 2, n)
    return [d.solve(x0, t0, curvature=True, **guess) for d in (compiled, slow)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "learned"), [("pendulum", False), ("acrobot", False), ("dubins", False),
                                               ("quadrotor", False), ("cartpole", True)])
def test_numbers_are_the_compiled_ones(name, learned):
    compiled, slow = both(name, 24, 3, random_model(name) if learned else None)
    assert compiled.success.all()
    assert slow.success.all()
    np.testing.assert_allclose(slow.cost, compiled.cost, rtol=1e-9)
    for field in ("x", "u", "V", "V_x"):  # J is flat about its minimum: what it does not fix differs more
        a, b = getattr(slow, field), getattr(compiled, field)
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6 * np.abs(b).max(), err_msg=field)


@pytest.mark.parametrize("name", ["acrobot", "dubins", "quadrotor"])
@pytest.mark.parametrize("mu", [0.0, 3.0])
def test_one_sweep_and_one_rollout_equal_the_compiled_ones(name, mu):
    from nocl.solvers.ddp.solver import Work

    ocp, K, B = nocl.load_ocp(name), 10, 5
    s, rng = ocp.system, np.random.default_rng(4)
    u = rng.uniform(s.lbu, s.ubu, (B, K, s.nu))
    u[:, ::3] = np.where(rng.random((B, len(u[0, ::3]), s.nu)) < 0.5, s.lbu, s.ubu)  # controls at their limits
    results = []
    for slow in (False, True):
        d = DDP(ocp, intervals=K, substeps=1, constraints="soft", threads=1)
        if slow:
            d.kernel = NumpyKernel(ocp)
        work = Work(d, ocp.initial_states.sample(B, 0), np.zeros(B), u, None, None)
        work.mu[:] = mu
        V, V_x, V_xx = np.zeros((B, K + 1)), np.zeros((B, K + 1, s.nx)), np.zeros((B, K + 1, s.nx, s.nx))
        work.backward(np.arange(B), V, V_x, V_xx)
        work.alpha[:] = 0.25
        work.rollout(np.arange(B), work.x, work.u, work.gain)
        results.append([V, V_x, V_xx, work.k, work.gain, work.slope, work.curve, work.positive, work.new_x, work.new_J])
    sound = results[0][7] > 0
    assert np.array_equal(results[0][7], results[1][7])
    for a, b in zip(*results, strict=True):
        if sound.any():
            np.testing.assert_allclose(a[sound], b[sound], rtol=1e-9, atol=1e-9 * np.abs(a[sound]).max())


def test_it_is_chosen_by_itself_and_said_once(monkeypatch):
    monkeypatch.setenv("CC", "no-such-cc")
    without_compiler.say_once.cache_clear()
    ocp = nocl.load_ocp("pendulum")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solvers = [DDP(ocp, intervals=10, substeps=1) for _ in range(2)]
    assert all(isinstance(d.kernel, NumpyKernel) for d in solvers)
    assert [str(w.message)[:19] for w in said] == ["no C compiler found"]
    solution = solvers[0].solve([[1.0, 0.0], [1e140, 0.0]])
    assert solution.success.tolist() == [True, False]
    assert "no descent" in solution.message[1]
    assert len(solvers[0].solve(np.zeros((0, 2)))) == 0


def test_a_failing_compiler_is_an_error_not_a_fallback(monkeypatch):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(RuntimeError, match="could not compile"):
        DDP(nocl.load_ocp("pendulum"), intervals=3)
