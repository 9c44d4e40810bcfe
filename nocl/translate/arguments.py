"""Named symbols in one standard order, and CasADi functions of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from nocl.support.checks import Array


class Arguments:
    """What a kind of function is a function of: names and symbols (or expressions), columns in SX or MX.

    Functions of x and u, say, are made and called through one such object, so that an argument that they gain is
    written where the object is made.
    """

    def __init__(self, symbols: Mapping[str, Any]) -> None:
        self.symbols = dict(symbols)

    @staticmethod
    def new(kind: Any, **sizes: int) -> Arguments:
        """New symbols of a kind, ca.SX or ca.MX, by name and size."""
        return Arguments({name: kind.sym(name, size) for name, size in sizes.items()})

    @staticmethod
    def of(function: ca.Function) -> Arguments:
        """New symbols for a function's inputs, under their names: SX for one in SX, else MX."""
        symbols = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
        return Arguments(dict(zip(function.name_in(), symbols, strict=True)))

    @property
    def names(self) -> list[str]:
        return list(self.symbols)

    @property
    def inputs(self) -> list[Any]:
        """The symbols, in order."""
        return list(self.symbols.values())

    def __getitem__(self, name: str) -> Any:
        return self.symbols[name]

    def but(self, *names: str) -> Arguments:
        """All but some."""
        return Arguments({name: symbol for name, symbol in self.symbols.items() if name not in names})

    def given(self, **values: Any) -> Arguments:
        """These with expressions in place of some, or with more."""
        return Arguments({**self.symbols, **values})

    def function(self, name: str, outputs: Mapping[str, Any], **more: Any) -> ca.Function:
        """(all of these, then `more`) -> outputs, everything by name."""
        inputs = {**self.symbols, **more}
        return ca.Function(name, list(inputs.values()), list(outputs.values()), list(inputs), list(outputs))

    def columns(self, **values: Any) -> list[Array]:
        """Values for these in their order, as CasADi has them, columns [n, B]; values of other names are left out.

        values : rows [B, n] by name, or [n] for all rows; of a scalar [B], or a number for all
        """
        return [_column(values[name], symbol.numel()) for name, symbol in self.symbols.items()]

    def call(self, function: ca.Function) -> Any:
        """The function at those of these that it takes, by its own names of them.

        Raises ValueError where it takes anything else.
        """
        unknown = [name for name in function.name_in() if name not in self.symbols]
        if unknown:
            raise ValueError(f"{function.name()} takes {', '.join(unknown)}; expected some of {', '.join(self.names)}: "
                             "give it these names, or values for the others by `given`")
        return function(*(self.symbols[name] for name in function.name_in()))


def _column(value: Any, size: int) -> Array:
    array = np.asarray(value, dtype=np.float64)
    return array.T if array.ndim == 2 else array.reshape(size, -1)
