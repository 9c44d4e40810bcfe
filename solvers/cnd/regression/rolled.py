"""A policy as rollouts call it: many times, without gradients."""

from __future__ import annotations

from torch import Tensor

from nocl.nets import FeatureNet
from nocl.translate.in_c import InC


class Rolled:
    """The same policy as the network, with the maps at its ends in C where they are long, as control barriers are.

    The network may go on being trained.
    """

    def __init__(self, net: FeatureNet) -> None:
        self.net, self.inputs, self.outputs = net, InC(net.inputs), InC(net.outputs)

    def __call__(self, *args: Tensor) -> Tensor:
        phi = self.inputs(*args)
        features = phi if isinstance(phi, tuple) else (phi,)
        y = [net(one) for net, one in zip(self.net.nets, features, strict=True)]
        answer: Tensor = self.outputs(*args, *y)
        return answer
