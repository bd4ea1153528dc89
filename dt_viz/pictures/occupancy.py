"""Learned occupancy of the obstacles on a slice, with their true outline (sec. 4.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array, Mask
from dt_viz.obstacles.occupancy import AvoidanceField
from dt_viz.obstacles.shapes import CloudObstacle, Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.scenario.slices import Slice, level_line

SPACING, COARSE_SPACING = 0.004, 0.010
"""Distances between neighbouring samples, metres."""
NEAR = 0.006
"""Largest distance from the slice of the labelled points that are shown on it, metres."""
MAX_POINTS = 300
"""Approximate largest number of these points."""


@dataclass(frozen=True)
class OccupancyPicture:
    """Learned occupancy on a slice."""

    area: Slice
    probability: Array
    """(n, m) p(o = 1 | s) along the first and second axes of the slice, from corner to corner."""
    level: Array
    """(K, 2, 3) segments of the line p = 1/2, metres."""
    outline: Array
    """(L, 2, 3) segments of the obstacles' true outline, metres."""
    points: Array
    """(K, 3) points of clouds near the slice, projected onto it, metres."""
    occupied: Mask
    """(K,) whether each of them is occupied."""


def occupancy_picture(area: Slice, obstacles: Sequence[Obstacle], *, coarse: bool) -> OccupancyPicture:
    """Compute the learned occupancy of all obstacles together.

    Args:
        area: the slice.
        obstacles: any number of obstacles.
        coarse: whether to use fewer samples, for a picture that is soon replaced.
    """
    world = area.grid(COARSE_SPACING if coarse else SPACING)
    points, shape = world.reshape(-1, 3), world.shape[:2]
    free = np.ones(len(points))
    for obstacle in obstacles:
        free *= 1 - learned_occupancy(obstacle, points)
    probability = 1 - free.reshape(shape)
    distance = Union(tuple(obstacles)).signed_distance(points).reshape(shape)
    return OccupancyPicture(
        area,
        probability,
        level_line(world, probability - 0.5),
        level_line(world, -np.minimum(distance, 1e3)),
        *_known(area, obstacles),
    )


def _known(area: Slice, obstacles: Sequence[Obstacle]) -> tuple[Array, Mask]:
    """Return points (K, 3) of clouds on the slice, and whether they are occupied (K,)."""
    clouds = [obstacle.labelled() for obstacle in obstacles if isinstance(obstacle, CloudObstacle)]
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in clouds)])
    occupied = np.concatenate([np.zeros(0, dtype=bool), *(labels for _, labels in clouds)])
    above, across = (points - area.centre) @ area.normal, area.across(points)
    near = np.flatnonzero((np.abs(above) < NEAR) & (np.abs(across) < area.half_size).all(axis=1))
    near = near[:: -(-len(near) // MAX_POINTS) or 1]
    return area.at(across[near]), occupied[near]


def learned_occupancy(obstacle: Obstacle, s: Array) -> Array:
    """Compute p(o = 1 | s), (N,), of the map learned from an obstacle, at world points `s` (N, 3)."""
    placed = obstacle.field("free-space", 1.0)
    assert isinstance(placed.inner, AvoidanceField)
    return placed.inner.occupancy.probability(placed.to_frame(s))
