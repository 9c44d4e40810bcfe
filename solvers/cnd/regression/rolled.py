"""A policy as rollouts call it: many times, without gradients."""

from __future__ import annotations

from torch import Tensor

from nocl.nets import FeatureNet
from nocl.solvers.cnd.regression.closed_loop import closed_loop
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.translate.in_c import InC


class Rolled:
    """The same policy as the network, with the maps at its ends in C where they are long, as control barriers are.

    With the problem that it acts on, `loop` is its runs there, in C, or None. The network may go on being trained.
    """

    def __init__(self, net: FeatureNet, on: InTorch | None = None) -> None:
        self.net, self.inputs, self.outputs = net, InC(net.inputs), InC(net.outputs)
        self.loop = None if on is None else closed_loop(net, on)

    def __call__(self, *args: Tensor) -> Tensor:
        phi = self.inputs(*args)
        features = phi if isinstance(phi, tuple) else (phi,)
        y = [net(one) for net, one in zip(self.net.nets, features, strict=True)]
        answer: Tensor = self.outputs(*args, *y)
        return answer
