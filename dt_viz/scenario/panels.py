"""Panels: systems that are shown beside the scene, each on a rectangle like the scene's slice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.learning.state import State
from dt_viz.obstacles.shapes import Point
from dt_viz.scenario.slices import Slice

GAP = 0.06
"""Distance between rectangles beside each other, metres."""
TITLE_ROOM = 0.07
"""Room for the title over each rectangle, metres."""


@dataclass(frozen=True)
class Panel:
    """What a panel shows: the base attractor, unless it says otherwise."""

    level: str = ""
    """Name of a level of the stack, from the imitation up."""
    generator: bool = False
    """Whether it shows the vector field that leads to this level from the one below it."""
    task: str = ""
    """Name of a task of which it shows the imitation."""
    state: State = "auto"
    """State in which that is learned, whichever the scene's own is."""

    @property
    def shown(self) -> Panel | None:
        """The panel of all of that imitation; None where it shows the scene's own."""
        return Panel(task=self.task, state=self.state) if self.task else None


BASE_PANEL = Panel()


def offsets(area: Slice, half_size: Array, num: int, camera: tuple[Point, Point]) -> Array:
    """Return where panels stand: in reading order, with the scene's own rectangle as the last one.

    Args:
        area: the scene's rectangle.
        half_size: (2,) half the size of the largest rectangle, metres.
        num: number of panels.
        camera: position (3,) and look-at (3,) of the camera that reads them, metres.

    Returns:
        (num, 3) offsets from the scene's rectangle, metres.
    """
    columns = num + 1 if num < 4 else -(-(num + 1) // 2)  # more than four are in two rows
    row, column = np.divmod(np.arange(num + 1), columns)
    # a last row that is not full ends with the scene, too
    column = np.where(row == row[-1], column + columns - 1 - column[-1], column)
    right, up = directions(area, camera)
    width, height = 2 * half_size + (GAP, GAP + TITLE_ROOM)
    return ((column[:-1] - columns + 1) * width)[:, None] * right + ((row[-1] - row[:-1]) * height)[:, None] * up


def directions(area: Slice, camera: tuple[Point, Point]) -> tuple[Array, Array]:
    """Return the unit vectors (3,) along a rectangle that point to the right and up for a camera; see `offsets`."""
    position, look_at = (np.asarray(place) for place in camera)
    right = np.cross(look_at - position, [0.0, 0.0, 1.0])
    up = np.cross(right, look_at - position)
    first, second = area.axes.T
    return first * (1 if right @ first >= 0 else -1), second * (1 if up @ second >= 0 else -1)
