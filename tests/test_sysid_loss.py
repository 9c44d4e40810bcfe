"""The paper's loss: its definition by finite differences, its gradient by autograd, compiled and in torch."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from nocl.nets import ACTIVATIONS, MLP
from nocl.sysid.identification import PaperSettings, identify
from nocl.sysid.loss import Loss
from nocl.systems import cartpole

ROWS = torch.tensor([3, 0, 7, 7, 11, 2, 19, 5, 4])  # an odd number, one twice


def labels(nz: int, nx: int) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(1)
    return tuple(torch.randn(*s, generator=g, dtype=torch.float64) for s in ((20, nz), (20, nx), (20, nx, nz)))


def network(sizes: list[int], activation: str) -> MLP:
    torch.manual_seed(0)
    return MLP(sizes, activation).double()


def eager(mlp: MLP, z: Tensor, f: Tensor, jacobian: Tensor | None, scale: Tensor, power: int = 1) -> Tensor:
    """The definition, with the Jacobian by automatic differentiation."""
    error = ((mlp(z) - f) * scale[:, 0]).norm(dim=1).pow(power).mean()
    if jacobian is None:
        return error
    residual = (torch.func.vmap(torch.func.jacrev(mlp))(z) - jacobian) * scale[:, 1:]
    return error + residual.flatten(1).norm(dim=1).pow(power).mean()


def test_the_loss_is_the_papers():
    """Mean over the batch of ||f_theta - f|| + ||grad f_theta - grad f||, with finite differences."""
    mlp, (z, f, J), h = network([3, 8, 8, 2], "sine"), labels(3, 2), 1e-6
    z, f, J = z[ROWS], f[ROWS], J[ROWS]
    columns = [(mlp(z + h * e) - mlp(z - h * e)) / (2 * h) for e in torch.eye(3).double()]
    want = (mlp(z) - f).norm(dim=1).mean() + (torch.stack(columns, 2) - J).flatten(1).norm(dim=1).mean()
    theta = parameters_to_vector(mlp.parameters()).detach()
    got = Loss([3, 8, 8, 2], "sine", *labels(3, 2), compiled=True)(ROWS, theta, torch.empty_like(theta))
    assert got == pytest.approx(float(want.detach()), rel=1e-7)


@pytest.mark.parametrize(("gradients", "squared"), [(True, False), (False, False), (True, True)])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(("sizes", "compiled"), [([5, 13, 13, 3], True), ([5, 13, 13, 3], False), ([4, 6, 2], False),
                                                 ([7, 6, 6, 6, 5], False), ([16, 8, 8, 12], True)])
def test_the_gradient_is_that_of_autograd(sizes, compiled, activation, gradients, squared):
    mlp, (z, f, J) = network(sizes, activation), labels(sizes[0], sizes[-1])
    scale = torch.rand(sizes[-1], 1 + sizes[0], generator=torch.Generator().manual_seed(2), dtype=torch.float64) + 0.5
    want = eager(mlp, z[ROWS], f[ROWS], J[ROWS] if gradients else None, scale, 1 + squared)
    theta = parameters_to_vector(mlp.parameters()).detach()
    parts = torch.autograd.grad(want, list(mlp.parameters()), allow_unused=True, materialize_grads=True)
    loss = Loss(sizes, activation, z, f, J if gradients else None, compiled=compiled, scale=scale,
                squared=squared)
    got = torch.empty_like(theta)
    assert loss(ROWS, theta, got) == pytest.approx(float(want.detach()), rel=1e-12)
    torch.testing.assert_close(got, torch.cat([p.flatten() for p in parts]), rtol=1e-12, atol=1e-14)


def test_single_precision_many_tiles():
    """float32, over more rows than one tile holds."""
    sizes, rows = [5, 64, 64, 4], torch.arange(1037) % 20
    z, f, J = labels(5, 4)
    theta = parameters_to_vector(network(sizes, "sine").parameters()).detach()
    exact, single = torch.empty_like(theta), torch.empty(len(theta))
    a = Loss(sizes, "sine", z, f, J, compiled=False)(rows, theta, exact)
    b = Loss(sizes, "sine", z.float(), f.float(), J.float(), compiled=True)(rows, theta.float(), single)
    assert a == pytest.approx(b, rel=1e-6)
    torch.testing.assert_close(single.double(), exact, rtol=1e-4, atol=1e-6)


def test_a_perfect_fit_has_no_gradient():
    mlp, (z, _, _) = network([5, 4, 4, 3], "tanh"), labels(5, 3)
    f, J = mlp(z).detach(), torch.func.vmap(torch.func.jacrev(mlp))(z).detach()
    theta = parameters_to_vector(mlp.parameters()).detach()
    for compiled in (True, False):
        gradient = torch.full_like(theta, np.nan)
        assert Loss([5, 4, 4, 3], "tanh", z, f, J, compiled=compiled)(ROWS, theta, gradient) < 1e-12
        assert torch.isfinite(gradient).all()


def test_other_depths_and_no_compiler(monkeypatch):
    """Two layers of weights train in torch; so do three where there is no compiler, and it is said."""
    settings = PaperSettings(width=8, layers=2, iterations=30, samples=2000)
    two = identify(cartpole.system(), method="paper", settings=settings, progress=False)
    assert np.isfinite(two.score().mean)
    settings = PaperSettings(width=8, iterations=30, samples=2000)
    compiled = identify(cartpole.system(), method="paper", settings=settings, progress=False)
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.warns(UserWarning, match="trains in torch"):
        torch_only = identify(cartpole.system(), method="paper", settings=settings, progress=False)
    assert torch_only.score().mean == pytest.approx(compiled.score().mean, rel=1e-3)
