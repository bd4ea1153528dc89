"""Which way out: the direction in which an arm escapes from an obstacle with the least detour."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Obstacle

NUM_DIRECTIONS = 128
SIDEWAYS = 2.0
"""How much more a direction along the motion costs than one across it, relatively: it bends the path sharply."""
TABLE_WEIGHT = 3.0
"""Cost of every metre that an escape would lead below the table, against a metre of detour."""
ON_THE_WAY = 0.10
"""Metres of escape after which what comes into the way does not count any more: the arm turns, too, as it goes."""
ALIKE = np.cos(np.deg2rad(40.0))
"""Cosine of the angle between directions up to which they are variants of one escape."""
SELECTIVITY = 0.03
"""Relative difference in cost that a variant's share in the escape falls by: it turns smoothly while one drags."""


def escape_directions(
    points: Array, radius: Array, tangents: Array, obstacle: Obstacle, margin: float = 0.0, *, num: int = 3
) -> list[Array]:
    """Directions in which the arm can escape, the one with the least detour first.

    For each direction the detour is how far the arm would have to be shifted, all of it alike, until every sphere that
    covers it is clear of every ball that covers the obstacle, at each sample.

    Args:
        points: (P, 3, M) middles of the spheres that cover the arm, metres, at the M samples that collide.
        radius: (P,) of these spheres.
        tangents: (K, 3) directions of the end effector's motion, unit vectors, wherever the escape bends it.
        obstacle: to escape from.
        margin: clearance that is wanted, metres.
        num: directions to return, at most.

    Returns:
        Unit vectors (3,), none an alike of another.
    """
    directions = _directions()
    centres, radii = obstacle.cover()
    offset = points - centres[:, None, :, None]  # (B, P, 3, M)
    squared, sum_of_radii = (offset**2).sum(axis=2), (radii[:, None] + margin + radius)[:, :, None]
    ball, point, sample = np.nonzero(squared < (sum_of_radii + 2 * ON_THE_WAY) ** 2)
    excess = (squared - sum_of_radii**2)[ball, point, sample]
    along = directions @ offset[ball, point, :, sample].T  # (D, pairs)
    under_root = along**2 - excess
    root = np.sqrt(np.maximum(under_root, 0))
    hit = (under_root > 0) & (root - along > 0) & (-along - root < ON_THE_WAY)
    shift = np.where(hit, root - along, 0)
    detour = shift.max(axis=1)
    height = (points[:, 2] - radius[:, None])[point, sample]
    below = np.maximum(-(height + shift * directions[:, 2:]), 0).max(axis=1)
    parallel = np.abs(directions @ tangents.T).mean(axis=1)
    cost = detour * (1 + SIDEWAYS * parallel) + TABLE_WEIGHT * below

    found: list[Array] = []
    while len(found) < num and np.isfinite(cost).any():
        best = directions[cost.argmin()]
        alike = directions @ best > ALIKE
        share = np.where(alike, np.exp((cost.min() - cost) / (SELECTIVITY * cost.min())), 0)
        escape = share @ directions
        found.append(escape / np.linalg.norm(escape))
        cost[alike] = np.inf
    return found


@lru_cache(maxsize=1)
def _directions() -> Array:
    """(K, 3) unit vectors, evenly spread: a Fibonacci lattice."""
    i = np.arange(NUM_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * i / NUM_DIRECTIONS, np.pi * (1 + np.sqrt(5)) * i
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
