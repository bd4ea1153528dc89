"""Ways out of obstacles that motions take, remembered while an obstacle is dragged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Obstacle

TURNING = 5.0
"""Angle, rad, by which a way out turns while its obstacle moves by its radius."""
NEARBY = 0.1
"""Distance that an obstacle may move from one motion to the next for its way out to be remembered, metres."""
OPPOSITE = -0.7
"""Cosine of the angle between two ways out beyond which the one turns to the other through a third."""


@dataclass(frozen=True, eq=False)
class Way:
    """The way out of one obstacle that the motions around it take."""

    obstacle: Obstacle
    side: Array
    """(3,) unit vector, the direction that was chosen."""
    direction: Array
    """(3,) unit vector of the motions' way out: the same, or on its way there from another one."""
    kept: bool = False
    """Whether it was carried over from the way out at the obstacle's last pose."""
    length: float = 0.0
    """Longest displacement of a motion along `direction`, metres."""

    @property
    def is_there(self) -> bool:
        """Whether it has turned to its side."""
        return self.direction is self.side

    @property
    def offset(self) -> Array:
        """(3,) that motion's displacement, metres."""
        return self.length * self.direction

    def turned_from(self, before: Way, across: Sequence[Array]) -> Way:
        """The way on its way here from that before: farther by an angle for each metre that the obstacle has moved.

        Args:
            before: the way out of the same obstacle where it was just before.
            across: (3,) unit vectors over which it turns to the opposite, the first one that is across both.
        """
        start, towards = before.direction, self.side
        if start @ towards < OPPOSITE:
            towards = next((direction for direction in across if abs(start @ direction) < -OPPOSITE), towards)
        angle = TURNING * travel(before.obstacle, self.obstacle) / self.obstacle.radius
        direction = turned(start, towards, angle)
        return self if direction is self.side else replace(self, direction=direction)


def remembered(ways: Sequence[Way | None], obstacles: Sequence[Obstacle]) -> tuple[Way | None, ...]:
    """The ways out of obstacles that are dragged, or rest where a drag has ended; None for the others."""
    if len(ways) != len(obstacles):
        return (None,) * len(obstacles)

    def known(way: Way | None, obstacle: Obstacle) -> Way | None:
        moved = math.inf if way is None else travel(way.obstacle, obstacle)
        return way if way is not None and moved < NEARBY and (moved > 0 or way.kept) else None

    return tuple(known(way, obstacle) for way, obstacle in zip(ways, obstacles, strict=True))


def turned(start: Array, towards: Array, most: float) -> Array:
    """The unit vector `start` (3,), turned towards another one, not opposite, by an angle of at most `most`, rad."""
    across = towards - (towards @ start) * start
    size = float(np.linalg.norm(across))
    angle = math.atan2(size, float(towards @ start))
    return towards if angle <= most else math.cos(most) * start + math.sin(most) / size * across


def travel(before: Obstacle, after: Obstacle) -> float:
    """Distance that an obstacle has moved, metres; infinite where it has also become another one."""
    if before.moved(after.position, after.wxyz) != after:
        return math.inf
    return float(np.linalg.norm(np.subtract(before.position, after.position)))
