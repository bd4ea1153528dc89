"""Picture of learned motions over their demonstrations, one panel for each shape (the paper's fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dt_viz.flows.fields import Array

PANEL, LABEL, BORDER = 320, 30, 22
"""Side of a panel, height of its name, and margin around the motions, pixels."""
MAX_COLUMNS = 6
FINER = 3
"""Supersampling factor, for smooth lines."""
DEMONSTRATION, GENERATED, GOAL, INK = (126, 204, 138), (200, 24, 36), (20, 20, 20), (60, 60, 60)
"""Colours: light green and dark red as in the paper, which differ in lightness, too; and those of goal and text."""


@dataclass(frozen=True)
class Panel:
    """Motions of one shape."""

    name: str
    demonstrations: Sequence[Array]
    """(T_i, d)."""
    rollouts: Sequence[Array]
    """(T_i, d)."""


def draw_panels(path: Path, panels: Sequence[Panel]) -> None:
    """Write a PNG with a panel for each shape (a motion in space from its broadest side)."""
    columns = min(MAX_COLUMNS, ceil(len(panels) ** 0.5 * 1.25))
    rows = ceil(len(panels) / columns)
    size = (FINER * PANEL * columns, FINER * (PANEL + LABEL) * rows)
    image = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(FINER * 15)
    for k, panel in enumerate(panels):
        corner = FINER * np.array([k % columns * PANEL, k // columns * (PANEL + LABEL)])
        middle = corner + FINER * np.array([PANEL / 2, LABEL * 0.75])
        draw.text((float(middle[0]), float(middle[1])), panel.name, fill=INK, font=font, anchor="mm")
        _draw_motions(draw, panel, corner + FINER * np.array([0, LABEL]))
    image.resize((size[0] // FINER, size[1] // FINER), Image.Resampling.LANCZOS).save(path)


def _draw_motions(draw: ImageDraw.ImageDraw, panel: Panel, corner: Array) -> None:
    points = np.concatenate([*panel.demonstrations, *panel.rollouts])
    axes = widest_directions(np.concatenate(panel.demonstrations))
    flat = points @ axes
    lower, upper = flat.min(axis=0), flat.max(axis=0)
    scale = FINER * (PANEL - 2 * BORDER) / float((upper - lower).max())

    def pixels(path: Array) -> list[tuple[float, float]]:
        offset = (path @ axes - (lower + upper) / 2) * scale * [1, -1]
        return [(float(x), float(y)) for x, y in corner + FINER * PANEL / 2 + offset]

    for paths, colour, width in ((panel.demonstrations, DEMONSTRATION, 4.0), (panel.rollouts, GENERATED, 1.5)):
        for motion in paths:
            draw.line(pixels(motion), fill=colour, width=round(FINER * width), joint="curve")
    for motion in panel.rollouts:
        _disc(draw, pixels(motion[:1])[0], GENERATED, 3.0)
    _disc(draw, pixels(panel.rollouts[0][-1:])[0], GOAL, 5.0)


def _disc(draw: ImageDraw.ImageDraw, centre: tuple[float, float], colour: tuple[int, int, int], radius: float) -> None:
    (x, y), r = centre, FINER * radius
    draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)


def widest_directions(points: Array) -> Array:
    """Return orthonormal columns (d, 2): the axes of the plane, or in space the widest horizontal direction and up."""
    if points.shape[1] == 2:
        return np.eye(2)
    spread = points - points.mean(axis=0)
    across = np.linalg.eigh(spread[:, :2].T @ spread[:, :2])[1][:, 1]
    across *= 1 if across[np.abs(across).argmax()] > 0 else -1
    return np.stack([[*across, 0.0], [0.0, 0.0, 1.0]], axis=1)
