"""Figures of what was learnt from demonstrations of `carry`: the cost over the table, and the chains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.algorithms.inverse import Carried
from manip_il.evaluation.figures import ARMS, CLONING, DAGGER, SOFT, Figure, drawing, to_figure
from manip_il.tasks.layout import THINGS

F64, I64 = NDArray[np.float64], NDArray[np.int64]
_PANELS = 3
_SIDE = 80  # points along a side of the map
_POINTS = 300  # of a chain's line


def cost_figure(carried: Sequence[Carried], planned: Sequence[I64], weights: F64) -> Figure:
    """Draw the cost of a metre over the table in the layouts with the most on it, with both paths.

    planned: nodes of the re-planned paths (n,). weights: (K,).
    """
    count = [len(one.grid.layout.places) + (one.grid.layout.edge is not None) for one in carried]
    chosen = np.argsort(-np.array(count), kind="stable")[:_PANELS].tolist()
    with drawing(len(chosen), size=(3.0, 3.1)) as (drawn, axes):
        for axis, number in zip(axes[0], chosen, strict=True):
            one = carried[number]
            image = _draw_cost(axis, one, weights)
            path = one.grid.points[planned[number]]
            axis.plot(*one.positions[:, :2].T, "-", color=DAGGER, lw=1.8, label="demonstrated")
            axis.plot(*path[:, :2].T, "--", color=CLONING, lw=1.6, label="re-planned")
            axis.plot(*one.grid.layout.goal[:2], "o", color=CLONING, ms=5)
            drawn.colorbar(image, ax=axis, location="bottom", shrink=0.8, pad=0.02)
            axis.set(title=f"episode {one.episode}", xticks=[], yticks=[], aspect="equal")
            axis.grid(visible=False)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside upper center", ncols=2)
        return to_figure(drawn, "Cost of a metre of path over the table, with demonstrated and re-planned paths")


def _draw_cost(axis: Any, one: Carried, weights: F64) -> Any:
    """The cost of a metre from above, at the height of the path's middle, and the things."""
    layout, points = one.grid.layout, one.grid.points
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x, y = (np.linspace(low[k], high[k], _SIDE) for k in (0, 1))
    height = float(np.median(one.positions[:, 2]))
    places = np.stack([*(part.ravel() for part in np.meshgrid(x, y)), np.full(_SIDE**2, height)], axis=1)
    cost = (layout.densities(places) @ weights).reshape(_SIDE, _SIDE)
    image = axis.imshow(cost, origin="lower", extent=(low[0], high[0], low[1], high[1]), cmap="Greens")
    for name, (px, py) in layout.places:
        half = layout.scale * np.array(THINGS[name].half)
        box_x, box_y = px + half[0] * np.array([-1, 1, 1, -1, -1]), py + half[1] * np.array([-1, -1, 1, 1, -1])
        axis.fill(box_x, box_y, color=SOFT, alpha=0.6, lw=0)
        axis.annotate(name, (px, py), ha="center", va="center", fontsize=6.5)
    return image


def trace_figure(draws: F64, names: Sequence[str]) -> Figure:
    """Draw the chains of every weight but the first, draws (C, N, K)."""
    rest = range(1, draws.shape[2])
    columns = min(4, len(rest))
    rows = -(-len(rest) // columns)
    shown = np.linspace(0, draws.shape[1] - 1, min(_POINTS, draws.shape[1])).round().astype(np.int64)
    with drawing(columns, rows, size=(2.3, 1.5)) as (drawn, axes):
        for axis, k in zip(axes.ravel(), rest, strict=False):
            for chain, colour in zip(draws[:, shown, k], ARMS, strict=False):
                axis.plot(shown, chain, color=colour, lw=0.5, alpha=0.8)
            top = float(np.quantile(draws[..., k], 0.995))
            axis.set(title=names[k].replace("_", " "), ylim=(0, top or 1.0), xticks=[])
        for axis in axes.ravel()[len(rest) :]:
            axis.remove()
        return to_figure(drawn, "Draws of every weight over that of length, chain by chain")
