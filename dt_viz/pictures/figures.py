"""Figures drawn by matplotlib: scenes for a paper, motions beside their demonstrations, and curves along motions."""

from __future__ import annotations

import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array, Mask
from dt_viz.scheduler import checkpoint

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
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
    paths: Mapping[str, Sequence[Array]]  # (T_i, d) of each kind of `STYLES`, in any unit


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
        check_installed()
    except FormatError as error:
        print(f"no figures: {error}", file=sys.stderr)
        return False
    return True


def check_installed() -> None:
    """Raise FormatError unless matplotlib is installed."""
    try:
        import matplotlib.figure  # noqa: F401, PLC0415
    except ImportError:
        raise FormatError("matplotlib", "not installed", "pip install 'dt-viz[figures]'") from None


def encoded(figure: Figure, suffix: str) -> bytes:
    """Return a figure as the content of a file with a suffix such as ".svg"; its text stays text."""
    from matplotlib import rc_context  # noqa: PLC0415 - an extra

    file = _Written()
    with rc_context({"svg.fonttype": "none", "pdf.fonttype": 42}):
        figure.savefig(file, format=suffix[1:], dpi=120)
    return file.getvalue()


class _Written(io.BytesIO):
    """A file in memory, with a checkpoint at each piece that is written: drawing a figure takes a second."""

    def write(self, content: Any, /) -> int:  # noqa: ANN401 - as that of io
        checkpoint()
        return super().write(content)


def save(figure: Figure, *paths: Path) -> None:
    """Write a figure to files, each in the format of its suffix."""
    for path in paths:
        path.write_bytes(encoded(figure, path.suffix))


def widest_directions(points: Array) -> Array:
    """Return orthonormal columns (d, 2): the axes of the plane, or in space the widest horizontal direction and up."""
    if points.shape[1] == 2:
        return np.eye(2)
    spread = points - points.mean(axis=0)
    across = np.linalg.eigh(spread[:, :2].T @ spread[:, :2])[1][:, 1]
    across *= 1 if across[np.abs(across).argmax()] > 0 else -1
    return np.stack([[*across, 0.0], [0.0, 0.0, 1.0]], axis=1)


@dataclass(frozen=True)
class Strokes:
    """Lines of one kind."""

    label: str  # name in the legend
    paths: Sequence[Array]  # (T_i, 2), metres
    colour: str
    width: float  # width of the lines, metres, as on the page
    dashed: bool
    heads: bool  # whether an arrow head in the middle of each line shows its direction
    starts: bool  # whether a dot marks where each line begins
    hidden: Sequence[Mask]  # which (T_i,) of the places of each path lie behind, or in, a body


@dataclass(frozen=True)
class Levels:
    """Level lines of a function, with their values written on them; or, where it is a body, its outline."""

    label: str  # name in the legend
    values: Array  # (n, m) to the right and up, from corner to corner; NaN where unknown
    levels: Sequence[float]
    colour: str
    lower: Array  # (2,) lower left corner, metres
    upper: Array  # (2,) upper right corner, metres
    is_body: bool = False


@dataclass(frozen=True)
class Arrows:
    """A vector field."""

    places: Array  # (N, 2), metres
    vectors: Array  # (N, 2) of any unit
    colour: str
    length: float  # length of the longest arrow, metres


@dataclass(frozen=True)
class Drawing:
    """A scene as it is seen in a plane; all places in metres."""

    title: str
    lower: Array  # (2,) lower left corner
    upper: Array  # (2,) upper right corner
    strokes: Sequence[Strokes]  # lines, the lowest first
    levels: Sequence[Levels]
    arrows: Arrows
    points: Mapping[str, tuple[Array, str]]
    """(N, 2) places and their colour, by their name in the legend."""


COLUMN, PAGE = 3.4, 7.0
"""Widths of a paper's column, of a figure with one panel, and of both columns, which several panels share; inches."""
MOST_COLUMNS = 3  # largest number of panels beside each other
TALLEST = 1.15  # largest height of a panel, relative to its width
TYPE = 8.0  # size of type, points; values on lines are smaller
THINNEST = 0.4  # width of the thinnest lines, points
BAR = 0.1  # length of the scale bar, metres
PROJECTION, HIDDEN = "projection", "dotted where hidden by an obstacle"
"""Notes below a figure, the second one where an obstacle hides a line, or has it inside."""


def scene_figure(drawings: Sequence[Drawing]) -> Figure:
    """Draw scenes side by side as wide as a paper's column, or as its page, with a scale bar and a legend."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    columns = len(drawings) if len(drawings) <= MOST_COLUMNS else min(MOST_COLUMNS, ceil(len(drawings) / 2))
    rows, whole = ceil(len(drawings) / columns), COLUMN if columns == 1 else PAGE
    extents = np.array([one.upper - one.lower for one in drawings])
    tall = min(float((extents[:, 1] / extents[:, 0]).max()), TALLEST)
    figure = Figure(
        figsize=(whole, rows * (whole / columns * tall + 0.2) + 0.65), layout="constrained", facecolor="white"
    )
    grid = [*figure.subplots(rows, columns, squeeze=False).flat]
    points_per_metre = 72 * whole / columns / float(extents[:, 0].max())
    named: dict[str, Any] = {}
    for axes, drawing in zip(grid, drawings, strict=False):
        checkpoint()
        axes.set(xlim=(drawing.lower[0], drawing.upper[0]), ylim=(drawing.lower[1], drawing.upper[1]), aspect="equal")
        axes.set_title(drawing.title, fontsize=TYPE)
        _draw(axes, drawing, points_per_metre, named)
        _add_scale_bar(axes, drawing)
    for axes in grid:
        axes.set_axis_off()
    is_hidden = any(mask.any() for drawing in drawings for strokes in drawing.strokes for mask in strokes.hidden)
    figure.legend(
        named.values(),
        named.keys(),
        title=f"{PROJECTION}; {HIDDEN}" if is_hidden else PROJECTION,
        title_fontsize=TYPE - 2,
        loc="outside lower center",
        ncols=2 * columns,
        fontsize=TYPE - 1,
        frameon=False,
        handlelength=1.6,
        columnspacing=1.2,
    )
    return figure


def _draw(axes: Axes, drawing: Drawing, points_per_metre: float, named: dict[str, Any]) -> None:
    """Draw a scene; `named` keeps a handle of each name in the legend."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 - an extra

    _draw_arrows(axes, drawing.arrows)
    for k, strokes in enumerate(drawing.strokes, 5):
        if not strokes.paths:
            continue
        width = max(THINNEST, strokes.width * points_per_metre)
        look: dict[str, Any] = {"color": strokes.colour, "linewidth": width, "dashes": (4, 2) if strokes.dashed else ()}
        _plot(
            axes, strokes.paths, [_widened(~mask) for mask in strokes.hidden], **look, zorder=k, solid_capstyle="round"
        )
        dots: dict[str, Any] = {"dashes": (0.2, 2.2), "dash_capstyle": "round", "linewidth": max(0.7 * width, 0.5)}
        _plot(axes, strokes.paths, strokes.hidden, **{**look, **dots}, zorder=k)
        named[strokes.label] = Line2D([], [], **{**look, "linewidth": max(width, 0.8)})
        if strokes.heads:
            _draw_heads(axes, [path for path in strokes.paths if len(path) > 2], strokes.colour, k)
        if strokes.starts:
            starts = np.array([path[0] for path in strokes.paths])
            axes.plot(*starts.T, "o", color=strokes.colour, markersize=2.4 * width, zorder=k)
    for one in drawing.levels:
        named[one.label] = _draw_levels(axes, one)
    for label, (places, colour) in drawing.points.items():
        named[label] = axes.plot(*places.T, "o", color=colour, markersize=5, zorder=30)[0]


def _widened(mask: Mask) -> Mask:
    """The places (T,) of a mask with their neighbours."""
    wide = mask.copy()
    wide[1:] |= mask[:-1]
    wide[:-1] |= mask[1:]
    return wide


def _plot(axes: Axes, paths: Sequence[Array], shown: Sequence[Mask], **look: Any) -> None:  # noqa: ANN401
    """Draw the parts of paths (T_i, 2) that are shown (T_i,), as one line with gaps."""
    parts = [np.where(mask[:, None], path, np.nan) for path, mask in zip(paths, shown, strict=True)]
    broken = np.concatenate([np.concatenate([part, np.full((1, 2), np.nan)]) for part in parts])
    if np.isfinite(broken).any():
        axes.plot(*broken.T, **look)


def _draw_levels(axes: Axes, one: Levels) -> Artist:
    """Draw level lines with their values, or a body; return what stands for them in the legend."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 - an extra
    from matplotlib.patches import Patch  # noqa: PLC0415

    across = [np.linspace(low, high, n) for low, high, n in zip(one.lower, one.upper, one.values.shape, strict=True)]
    values = np.ma.masked_invalid(one.values.T)
    if not one.levels[0] < values.max():
        return Line2D([], [], color=one.colour)
    lines = axes.contour(*across, values, levels=one.levels, colors=one.colour, linewidths=0.6, zorder=3)
    if not one.is_body:
        axes.clabel(lines, fmt="%g", fontsize=TYPE - 2, inline_spacing=2)
        return Line2D([], [], color=one.colour, linewidth=0.6)
    axes.contourf(*across, values, levels=[one.levels[0], np.inf], colors=one.colour, alpha=0.25, zorder=2)
    return Patch(facecolor=(one.colour, 0.25), edgecolor=one.colour, linewidth=0.6)


def _draw_arrows(axes: Axes, arrows: Arrows) -> None:
    if len(arrows.places):
        longest = float(np.linalg.norm(arrows.vectors, axis=1).max()) or 1.0
        look: dict[str, Any] = {"angles": "xy", "units": "xy", "scale_units": "xy", "width": 0.06 * arrows.length}
        look |= {"minlength": 0.0, "scale": longest / arrows.length}
        axes.quiver(*arrows.places.T, *arrows.vectors.T, color=arrows.colour, zorder=1, **look)


def _draw_heads(axes: Axes, paths: Sequence[Array], colour: str, zorder: int) -> None:
    """Draw an arrow head in the middle of each path (T_i, 2)."""
    middles = np.reshape([path[len(path) // 2] for path in paths], (-1, 2))
    ahead = middles - np.reshape([path[len(path) // 2 - 1] for path in paths], (-1, 2))
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    look: dict[str, Any] = {"angles": "xy", "units": "xy", "scale_units": "xy", "pivot": "mid"}
    head = {"headlength": 10, "headaxislength": 10, "headwidth": 7, "width": 0.001, "scale": 100}
    axes.quiver(*middles.T, *ahead.T, color=colour, zorder=zorder, **look, **head)


def _add_scale_bar(axes: Axes, drawing: Drawing) -> None:
    x, y = drawing.lower - (0.0, 0.03 * (drawing.upper - drawing.lower)[0])
    axes.plot([x, x + BAR], [y, y], color="black", linewidth=1.5, clip_on=False, solid_capstyle="butt")
    look: dict[str, Any] = {"va": "center", "fontsize": TYPE - 1, "annotation_clip": False}
    axes.annotate(f"{100 * BAR:g} cm", (x + BAR, y), (3, 0), textcoords="offset points", **look)
