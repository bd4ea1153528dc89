"""Escape directions: how an arm leaves an obstacle with the least detour."""

from __future__ import annotations

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.kernels.detours import detours, distinct
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.surfaces import golden_spiral
from dt_viz.obstacles.union import Union

NUM_DIRECTIONS = 128
SIDEWAYS = 2.0
"""Relative extra cost of a direction along the motion against one across it: it would bend the path sharply."""
COMING, STRIDE = 1.5, 0.04
"""Time (s) for which a moving obstacle is in the way also of where it will be, and spacing (m) of these places."""
FARTHEST = 0.16
"""Largest distance of these places from where it is, metres."""
TABLE_WEIGHT = 3.0
"""Cost of each metre by which an escape leads below the table, against a metre of detour."""
ON_THE_WAY = 0.10
"""Length of an escape, metres, beyond which nothing new is in its way: the arm also turns as it moves."""
ALIKE = np.cos(np.deg2rad(40.0))
"""Cosine of the largest angle between two directions of one escape."""
SELECTIVITY = 0.03
"""Relative difference in cost over which a direction's share in its escape falls by a factor e, for smooth drags."""
STAYING = 1.5
"""Cost of the way out that was chosen before, relative to the least one, up to which it is kept."""


def escape_directions(
    points: Array,
    radius: Array,
    tangents: Array,
    obstacle: Obstacle | Union,
    margin: float = 0.0,
    *,
    num: int = 3,
    velocity: Array | None = None,
    before: Array | None = None,
) -> list[Array]:
    """Find directions in which the arm can escape, the one with the least detour first.

    The detour of a direction is the distance by which the whole arm would have to be shifted until, at each sample,
    every sphere that covers it is clear of every ball that covers the obstacle.

    Args:
        points: (P, 3, M) centres of the spheres that cover the arm, metres, at the M samples that collide.
        radius: (P,) radii of these spheres, metres.
        tangents: (K, 3) unit directions of the end effector's motion where the escape bends it.
        obstacle: obstacle to escape from.
        margin: required clearance, metres.
        num: largest number of directions.
        velocity: (3,) the obstacle's, m/s; None where it rests. Directions along it are costly: the obstacle
            would follow the arm.
        before: (3,) escape that was chosen just before. What is nearest to it comes first, or second where it costs
            more than `STAYING` times the least.

    Returns:
        Unit vectors (3,), one for each distinct escape; all of them where there is one `before`.
    """
    directions = golden_spiral(NUM_DIRECTIONS, 0.5)
    centres, radii = obstacle.cover()
    if velocity is not None and (speed := float(np.linalg.norm(velocity))) > 0:
        ahead = np.arange(0, min(COMING * speed, FARTHEST), STRIDE)
        centres = (centres + ahead[:, None, None] * velocity / speed).reshape(-1, 3)
        radii = np.tile(radii, len(ahead))
    detour, below = detours(directions, np.ascontiguousarray(points), radius, centres, radii, float(margin), ON_THE_WAY)
    parallel = np.abs(directions @ tangents.T).mean(axis=1)
    cost = detour * (1 + SIDEWAYS * parallel) + TABLE_WEIGHT * below

    most = num if before is None else len(directions)
    means, costs = distinct(directions, cost, float(ALIKE), SELECTIVITY, most)
    found = list(means)
    if before is not None:
        kept = int(np.argmax(means @ before))
        if kept:
            found.insert(0 if costs[kept] < STAYING * costs[0] else 1, found.pop(kept))
    return found
