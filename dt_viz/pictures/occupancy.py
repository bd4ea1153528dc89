"""What the occupancy maps believe of the obstacles, on a slice, beside their true outline (sec. 4.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array, Mask
from dt_viz.obstacles.occupancy import AvoidanceField, StretchedField
from dt_viz.obstacles.shapes import CloudObstacle, Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.scenario.slices import Slice, level_line

SPACING, COARSE_SPACING = 0.004, 0.010
"""Metres between neighbouring samples."""
NEAR = 0.006
"""Metres from the slice, within which labelled points are shown on it."""
MAX_POINTS = 300
"""That are shown."""


@dataclass(frozen=True)
class OccupancyPicture:
    """Learned occupancy on a slice."""

    area: Slice
    probability: Array
    """(n, m) p(o = 1 | s), along the first and the second axis of the slice, from corner to corner."""
    level: Array
    """(K, 2, 3) segments of the line p = 1/2, metres."""
    outline: Array
    """(L, 2, 3) segments of the obstacles' true outline, metres."""
    points: Array
    """(K, 3) what is known of obstacles from point clouds: points beside the slice, moved into it, metres."""
    occupied: Mask
    """(K,) their labels."""


def occupancy_picture(area: Slice, obstacles: Sequence[Obstacle], *, coarse: bool) -> OccupancyPicture:
    """The learned occupancy of all obstacles: what one of them is believed to occupy is occupied.

    Args:
        area: where to look.
        obstacles: any number.
        coarse: with fewer samples, for a picture that is replaced at once.
    """
    world = area.grid(COARSE_SPACING if coarse else SPACING)
    points, shape = world.reshape(-1, 3), world.shape[:2]
    free = np.ones(len(points))
    for obstacle in obstacles:
        free *= 1 - believed(obstacle, points)
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
    """Points (K, 3) of point clouds on the slice, and whether they are occupied (K,)."""
    clouds = [obstacle.labelled() for obstacle in obstacles if isinstance(obstacle, CloudObstacle)]
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in clouds)])
    occupied = np.concatenate([np.zeros(0, dtype=bool), *(labels for _, labels in clouds)])
    above, across = (points - area.centre) @ area.normal, area.across(points)
    near = np.flatnonzero((np.abs(above) < NEAR) & (np.abs(across) < area.half_size).all(axis=1))
    near = near[:: -(-len(near) // MAX_POINTS) or 1]
    return area.at(across[near]), occupied[near]


def believed(obstacle: Obstacle, s: Array) -> Array:
    """p(o = 1 | s) of the map learned from samples of the obstacle, at the world points `s` (N, 3), (N,)."""
    placed = obstacle.field("free-space", 1.0)
    own, inner = placed.to_frame(s), placed.inner
    if isinstance(inner, StretchedField):
        own, inner = inner.to_frame(own), inner.inner
    assert isinstance(inner, AvoidanceField)
    return inner.occupancy.probability(own)
