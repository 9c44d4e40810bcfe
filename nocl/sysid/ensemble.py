"""Several models of the same plant: where they disagree, none is to be trusted.

Members differ by their random start only (Lakshminarayanan et al. 2017, "deep ensembles"). Their disagreement at
(x, u) is the root mean square distance of their answers from the mean, in the units of xdot. What is known exactly, or
in closed form, is the same in all, and adds nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from nocl.data import Dataset
from nocl.definition.system import System
from nocl.support import checks, store
from nocl.support.checks import Array
from nocl.sysid.from_log import first_states
from nocl.sysid.identification import LearnedDynamics, identify
from nocl.sysid.logs.coverage import share_of_nodes
from nocl.sysid.logs.log import Log

CARD = "ensemble.json"
USUAL = 0.99  # share of the samples that were learned from whose disagreement is below `usual`
FACTOR = 2.0  # times `usual`: more is doubtful
ROUNDING = 1e-9  # of the largest xdot: members that are the same formula differ by less


@dataclass(frozen=True, eq=False, repr=False)
class Ensemble:
    """Models of one system; `usual` is the disagreement that 99 % of the samples stay below that they learned from."""

    members: tuple[LearnedDynamics, ...]
    usual: float

    @staticmethod
    def identify(system: System, members: int = 4, *, seed: int = 0, data: Dataset | Log | None = None,
                 **options: Any) -> Ensemble:
        """nocl.identify with seeds seed, seed + 1, ...: the same data or the same box, other random starts."""
        if isinstance(members, bool) or not isinstance(members, int) or members < 2:
            raise ValueError(f"Ensemble: members is {members!r}; expected an integer >= 2")
        if options.get("checkpoint") is not None:
            raise ValueError("Ensemble: got a checkpoint; its members would share it: leave it out")
        models = tuple(identify(system, seed=seed + i, data=data, **options) for i in range(members))
        x, u = _seen(system, data, seed)
        return Ensemble(models, float(np.quantile(Ensemble(models, 0.0).disagreement(x, u), USUAL)))

    @property
    def model(self) -> LearnedDynamics:
        """The first member: what controllers are trained on."""
        return self.members[0]

    @property
    def system(self) -> System:
        return self.model.system

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        """The members' mean, torch rows."""
        return torch.stack([m(x, u) for m in self.members]).mean(dim=0)

    def disagreement(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Root mean square over members of ||f_i - mean||_2 at x [N, nx], u [N, nu], in the units of xdot: [N]."""
        return self._spread(x, u)[0]

    def _spread(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """(disagreement, ||mean||_2), both [N]."""
        s = self.system
        rows = [torch.tensor(checks.states(v, n, s.name, name)[0])
                for v, n, name in ((x, s.nx, "x"), (u, s.nu, "u"))]
        with torch.no_grad():
            f = torch.stack([m(*rows) for m in self.members])
        mean = f.mean(dim=0)
        return (f - mean).square().sum(dim=2).mean(dim=0).sqrt().numpy(), mean.norm(dim=1).numpy()

    def doubtful(self, x: ArrayLike, u: ArrayLike) -> Any:
        """Where not to trust the model: disagreement of more than twice the usual one (not of rounding alone). [N] bool
        """
        apart, size = self._spread(x, u)
        return apart > max(FACTOR * self.usual, ROUNDING * size.max(initial=0.0))

    def doubt(self, x: ArrayLike, u: ArrayLike) -> Array:
        """The share of each trajectory's nodes x [B, K+1, nx], u [B, K or K+1, nu] that is doubtful, for reports: [B].

        NaN where a trajectory has no finite node.
        """
        return share_of_nodes(self.doubtful, x, u)

    def to_casadi(self) -> ca.Function:
        """The first member's, which controllers are trained on: f:(x, u)->(xdot)."""
        return self.model.to_casadi()

    def save(self, folder: str | Path) -> Path:
        """Write folder/member-0, member-1, ... and ensemble.json, as data; returns the latter's path."""
        for i, member in enumerate(self.members):
            member.save(Path(folder) / f"member-{i}")
        return store.write_json(Path(folder) / CARD, {"members": len(self.members), "usual": self.usual})

    @staticmethod
    def load(folder: str | Path) -> Ensemble:
        """What `save` wrote; ValueError for a missing, altered or foreign file."""
        card = store.read_json(Path(folder) / CARD)
        if not isinstance(card, dict) or not {"members", "usual"} <= card.keys():
            raise ValueError(f"{Path(folder) / CARD} is no ensemble's; expected what Ensemble.save wrote")
        with store.reading(folder, "an ensemble"):
            members = tuple(LearnedDynamics.load(Path(folder) / f"member-{i}") for i in range(int(card["members"])))
            return Ensemble(members, float(card["usual"]))

    def __repr__(self) -> str:
        return f"Ensemble of {len(self.members)}, usual disagreement {self.usual:.3g}; the first is\n{self.model!r}"


def _seen(system: System, data: Dataset | Log | None, seed: int) -> tuple[Array, Array]:
    """States and controls that were learned from, at most some thousands."""
    if isinstance(data, Log):
        pairs: Sequence[tuple[Array, Array]] = [(x, run.u) for x, run in first_states(data)]
        x, u = (np.concatenate(p) for p in zip(*pairs, strict=True))
    elif data is not None:
        x, u = np.asarray(data.x, dtype=np.float64), np.asarray(data.u, dtype=np.float64)
    else:
        rng = np.random.default_rng((seed, 5))
        x, u = rng.uniform(system.lbx, system.ubx, (2000, system.nx)), rng.uniform(system.lbu, system.ubu,
                                                                                   (2000, system.nu))
    rows = np.random.default_rng((seed, 6)).permutation(len(x))[:4000]
    return x[rows], u[rows]
