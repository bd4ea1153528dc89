"""Detours: the escape from an obstacle that all motions around it take, and how it changes while that is dragged.

The motions of a hand (a body of one point) and of an arm (a body of many) choose alike: of all directions that with the
least detour, and the one that was chosen before while that costs little more. In a drag it turns at a limited rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from dt_viz.errors import check_between
from dt_viz.flows.fields import Array
from dt_viz.kernels.escape import detours, distinct
from dt_viz.obstacles.shapes import Obstacle, golden_spiral
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import scales

NEARBY = 0.1
"""Distance that an obstacle may move from one motion to the next for its detour to be kept, metres."""
OPPOSITE = -0.7
"""Cosine of the angle between two directions beyond which the one turns to the other through a third."""


@dataclass(frozen=True)
class DetourSettings:
    """Choice of the escape from an obstacle.

    Raises:
        FormatError: a number is negative or huge, or one is 0 that divides, or there are too few or many directions.
    """

    along: float = 2.0
    """Relative extra cost of a direction along the motion against one across it, which bends the path less."""
    below_table: float = 3.0
    """Cost of each metre by which an escape leads below the table, against a metre of detour."""
    staying: float = 1.5
    """Cost of the previous escape, relative to the least one, up to which it is kept."""
    turning: float = 5.0
    """Angle, rad, by which a detour turns while its obstacle moves by its radius."""
    on_the_way: float = scales(0.10)
    """Length of an escape, metres, beyond which nothing else obstructs it: the arm also turns as it moves. That of an
    arm scales with its reach, and is given for that of the JACO."""
    seconds_ahead: float = 1.5
    """Time for which the predicted poses of a moving obstacle count as occupied, s."""
    metres_ahead: float = 0.16  # largest distance of these places from where it is, metres
    stride: float = 0.04  # spacing of these places, metres
    num_directions: int = 128  # number of directions that are compared
    alike: float = 40.0  # largest angle between two directions of one escape, degrees
    selectivity: float = 0.03
    """Relative difference in cost over which a direction's share in its escape falls by e, for smooth drags."""

    def __post_init__(self) -> None:
        least = {"num_directions": 8.0, "stride": 1e-3, "selectivity": 1e-6}
        for field in fields(self):
            check_between(f"detour.{field.name}", getattr(self, field.name), least.get(field.name, 0.0), 1e4)


DETOUR = DetourSettings()


def escape_directions(
    points: Array,
    radius: Array,
    tangents: Array,
    obstacle: Obstacle | Union,
    margin: float = 0.0,
    *,
    num: int = 3,
    velocity: Array | None = None,
    previous: Array | None = None,
    plane: Array | None = None,
    settings: DetourSettings = DETOUR,
) -> list[Array]:
    """Find directions in which a body can escape, the one with the least detour first.

    The detour of a direction is the distance by which the whole body would have to be shifted until, at each sample,
    every sphere that covers it is clear of every ball that covers the obstacle.

    Args:
        points: (P, 3, M) centres of the spheres that cover the body, metres, at the M samples that collide.
        radius: (P,) radii of these spheres, metres.
        tangents: (K, 3) unit directions of the end effector's motion where the escape bends it.
        obstacle: obstacle to escape from.
        margin: required clearance, metres.
        num: largest number of directions.
        velocity: (3,) the obstacle's, m/s; None where it rests. Directions along it are costly: the obstacle
            would follow the body.
        previous: (3,) escape that was chosen just before. What is nearest to it comes first, or second where it costs
            more than `settings.staying` times the least.
        plane: (3, 2) orthonormal columns of the plane that escapes lie in; None is space.
        settings: costs of directions, and how the previous one is kept.

    Returns:
        Unit vectors (3,), one for each distinct escape; all of them where there is a previous one.
    """
    directions = directions_around(plane, settings.num_directions)
    centres, radii = obstacle.cover()
    if velocity is not None and (speed := float(np.linalg.norm(velocity))) > 0:
        ahead = np.arange(0, min(settings.seconds_ahead * speed, settings.metres_ahead), settings.stride)
        centres = (centres + ahead[:, None, None] * velocity / speed).reshape(-1, 3)
        radii = np.tile(radii, len(ahead))
    points, length = np.ascontiguousarray(points), float(settings.on_the_way)
    detour, below = detours(directions, points, radius, centres, radii, float(margin), length)
    parallel = np.abs(directions @ tangents.T).mean(axis=1)
    cost = detour * (1 + settings.along * parallel) + settings.below_table * below

    most = num if previous is None else len(directions)
    means, costs = distinct(directions, cost, math.cos(math.radians(settings.alike)), float(settings.selectivity), most)
    found = list(means)
    if previous is not None:
        kept = int(np.argmax(means @ previous))
        if kept:
            found.insert(0 if costs[kept] < settings.staying * costs[0] else 1, found.pop(kept))
    return found


def directions_around(plane: Array | None, num: int) -> Array:
    """Unit vectors (num, 3) all around, in space or in the plane of orthonormal columns (3, 2)."""
    if plane is None:
        return golden_spiral(num, 0.5)
    turn = np.linspace(0, 2 * np.pi, num, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn)], axis=1) @ plane.T


@dataclass(frozen=True, eq=False)
class Detour:
    """The escape from one obstacle that the motions around it take."""

    obstacle: Obstacle
    side: Array  # (3,) unit vector, the direction that was chosen
    direction: Array
    """(3,) unit vector, the escape direction of the motions: `side`, or turning to it from that of another side."""
    kept: bool = False
    """Whether there was a detour that was carried over from the obstacle's last pose."""
    length: float = 0.0  # longest displacement of a motion of the hand along `direction`, metres
    travelled: float | None = None
    """Distance by which the obstacle has moved since, metres, where the next detour turns from this one at a limited
    rate; None where it is at its side at once."""

    @property
    def arrived(self) -> bool:
        """Whether the motions escape to the side that was chosen."""
        return self.direction is self.side

    @property
    def offset(self) -> Array:
        """(3,) that motion's displacement, metres."""
        return self.length * self.direction

    def turned_from(self, previous: Detour, escapes: Sequence[Array], turning: float) -> Detour:
        """Turn from the previous detour, carried over, towards this one: by `turning`, rad, for each radius of travel.

        Of the escapes (3,) the best comes first; see `turned`.
        """
        angle = turning * (previous.travelled or 0.0) / self.obstacle.radius
        direction = turned(previous.direction, self.side, angle, escapes)
        return self if direction is self.side else replace(self, direction=direction)


def carried_over(
    detours: Sequence[Detour | None], obstacles: Sequence[Obstacle], *, turn: bool = True
) -> tuple[Detour | None, ...]:
    """Carry detours of the last motion over to the obstacles where they are now; None for those that nobody drags.

    Motions turn to other sides at a limited rate, as the obstacles move; without `turn` they are there at once.
    """
    if len(detours) != len(obstacles):
        return (None,) * len(obstacles)

    def carried(detour: Detour | None, obstacle: Obstacle) -> Detour | None:
        moved = math.inf if detour is None else travel(detour.obstacle, obstacle)
        if detour is None or moved >= NEARBY or not (moved > 0 or detour.kept):
            return None
        return replace(detour, travelled=moved if turn else None)

    return tuple(carried(detour, obstacle) for detour, obstacle in zip(detours, obstacles, strict=True))


def turned(start: Array, towards: Array, most: float, escapes: Sequence[Array] = ()) -> Array:
    """Turn the unit vector `start` (3,) towards another one by an angle of at most `most`, rad.

    To the opposite one it turns over the first of the `escapes` (3,) that is across both.
    """
    if start @ towards < OPPOSITE:
        towards = next((escape for escape in escapes if abs(start @ escape) < -OPPOSITE), towards)
    across = towards - (towards @ start) * start
    size = float(np.linalg.norm(across))
    angle = math.atan2(size, float(towards @ start))
    return towards if angle <= most else math.cos(most) * start + math.sin(most) / size * across


def travel(before: Obstacle, after: Obstacle) -> float:
    """Distance that an obstacle has moved, metres; infinite where it has also become another one."""
    if before.moved(after.position, after.wxyz) != after:
        return math.inf
    return float(np.linalg.norm(np.subtract(before.position, after.position)))
