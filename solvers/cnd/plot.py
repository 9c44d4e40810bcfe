"""A picture of a training run, from its card."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nocl.support import store

GAPS = {"gap_median": "median", "gap_p95": "95th percentile", "kicked_median": "median, kicked states",
        "kicked_p95": "95th percentile, kicked states", "held_median": "median, held controls"}


def plot_training(card: Mapping[str, Any], path: Path, name: str) -> Path:
    """Write a png: the losses, and the gap on held-out states round by round (the terms, for method="paper")."""
    history = card.get("history")
    if not history:
        raise ValueError(f"the card of this controller of {name} has no history; expected one of nocl.train's")
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    figure.suptitle(f"{name}: {card.get('method')} method, {card.get('dynamics')} dynamics, seed {card.get('seed')}")
    if isinstance(history, Mapping):
        _paper(left, right, history)
    else:
        _default(left, right, history, card.get("value", {}))
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return store.write_bytes(path, buffer.getvalue())


def _default(left: Any, right: Any, history: list[Mapping[str, Any]], value: Mapping[str, Any]) -> None:
    start = 0
    for row in history:
        losses = row.get("loss", [])
        left.semilogy(start + np.arange(len(losses)), losses, label=f"controller, round {row['round']}")
        start += len(losses)
    if value.get("loss"):
        left.semilogy(start + np.arange(len(value["loss"])), value["loss"], "--", label="value function")
    left.set(xlabel="share of training", ylabel="loss", xticks=[])
    left.legend(fontsize="small")
    rounds = [row["round"] for row in history]
    for key, label in GAPS.items():
        if all(key in row for row in history):
            right.plot(rounds, [100 * max(row[key], 1e-7) for row in history], "o-", label=label)
    right.set(xlabel="round", ylabel="gap to the optimum, %", yscale="log", xticks=rounds)
    right.legend(fontsize="small")


def _paper(left: Any, right: Any, history: Mapping[str, list[float]]) -> None:
    for axes, names in ((left, ("cost",)), (right, [n for n in history if n != "cost"])):
        for name in names:
            axes.semilogy(np.maximum(history[name], 1e-12), label=name, linewidth=0.8)
        axes.set(xlabel="iteration", ylabel="loss term")
        axes.legend(fontsize="small")
