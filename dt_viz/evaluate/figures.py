"""Figures of the measurements, drawn by matplotlib: motions beside their demonstrations, and curves along motions."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dt_viz.flows.fields import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES: Mapping[str, Mapping[str, Any]] = {
    "learned from": {"color": "#dedede", "linewidth": 1.0},
    "demonstration": {"color": "#7ecc8a", "linewidth": 4.0},
    "nearest start, shifted": {"color": "#e69628", "linewidth": 1.4, "linestyle": ":"},
    "mean, shifted": {"color": "#2460c8", "linewidth": 1.4, "linestyle": "--"},
    "learned": {"color": "#c81824", "linewidth": 1.5},
}
"""Look of each kind of path, the lowest first; demonstrations light green and rollouts dark red as in the paper."""


@dataclass(frozen=True)
class FigurePanel:
    """Motions of one shape."""

    title: str
    paths: Mapping[str, Sequence[Array]]
    """(T_i, d) of each kind of `STYLES`, in any unit."""


def panels(shapes: Sequence[FigurePanel], columns: int = 6) -> Figure:
    """Draw a panel for each shape, at most so many beside each other; a motion in space from its broadest side.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    columns = min(columns, len(shapes), ceil(1.25 * len(shapes) ** 0.5))
    rows = ceil(len(shapes) / columns)
    figure = Figure(figsize=(3 * columns, 3.3 * rows), layout="constrained")
    grid = [*figure.subplots(rows, columns, squeeze=False).flat]
    for axes in grid:
        axes.set_axis_off()
        axes.set_aspect("equal", "datalim")
    for axes, shape in zip(grid, shapes, strict=False):
        plane = widest_directions(np.concatenate(shape.paths["demonstration"]))
        for kind in (kind for kind in STYLES if kind in shape.paths):
            for path in shape.paths[kind]:
                axes.plot(*(path @ plane).T, label=kind, **STYLES[kind])
        axes.plot(*(shape.paths["learned"][0][-1] @ plane), "ko", markersize=5)
        axes.set_title(shape.title, fontsize="small")
    by_kind = {str(line.get_label()): line for line in grid[0].lines if line.get_label() in STYLES}
    figure.legend(by_kind.values(), by_kind.keys(), loc="outside lower center", ncols=len(by_kind), fontsize="small")
    return figure


def curves(title: str, by_method: Mapping[str, Array]) -> Figure:
    """Draw the paper's figure 6: distance to the demonstration and depth of the end effector along the way.

    Args:
        title: of the task.
        by_method: (N, 2), metres, at even distances along the path, by the method's title.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    both = figure.subplots(1, 2, sharex=True)
    for k, label in enumerate(("distance to the demonstration [m]", "depth of the end effector [m]")):
        for name, values in by_method.items():
            both[k].plot(np.linspace(0, 1, len(values)), values[:, k], label=name, linewidth=1.4)
        both[k].set(xlabel="normalised arc length", ylabel=label)
        both[k].grid(alpha=0.3)
    figure.suptitle(title)
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
    return figure


def can_draw() -> bool:
    """Whether matplotlib is installed; says so if it is not."""
    try:
        import matplotlib.figure  # noqa: F401, PLC0415
    except ImportError:
        print("no figures: matplotlib is not installed; pip install matplotlib", file=sys.stderr)
        return False
    return True


def save(figure: Figure, *paths: Path) -> None:
    """Write a figure to files, each in the format of its suffix."""
    for path in paths:
        figure.savefig(path, dpi=120)


def widest_directions(points: Array) -> Array:
    """Return orthonormal columns (d, 2): the axes of the plane, or in space the widest horizontal direction and up."""
    if points.shape[1] == 2:
        return np.eye(2)
    spread = points - points.mean(axis=0)
    across = np.linalg.eigh(spread[:, :2].T @ spread[:, :2])[1][:, 1]
    across *= 1 if across[np.abs(across).argmax()] > 0 else -1
    return np.stack([[*across, 0.0], [0.0, 0.0, 1.0]], axis=1)
