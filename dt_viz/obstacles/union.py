"""Unions of obstacles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array, Sum
from dt_viz.numerics import unit
from dt_viz.obstacles.occupancy import Generator
from dt_viz.obstacles.shapes import Obstacle, golden_spiral, nearest
from dt_viz.obstacles.solids import with_slopes

MAX_STEPS, SHORTEST = 100, 1e-4
"""Largest number of steps along a line, and the smallest one, metres: bounds the overshoot beyond the surface."""


@dataclass(frozen=True)
class Union:
    """The union of any number of obstacles, possibly none."""

    parts: tuple[Obstacle, ...] = ()

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the nearest surface, (*B,), metres, negative inside; analytic in `s`.

        Inside more than one it may be smaller than the depth of the union. Infinite where there is no obstacle.
        """
        return nearest(self.parts, s)

    def distance_and_normal(self, s: Array) -> tuple[Array, Array]:
        """Signed distance (N,), metres, of points `s` (N, 3), and unit vectors (N, 3) away from the nearest surface.

        A vector is zero where the distance has no slope; without an obstacle the distance is infinite and all are.
        """
        distance, slopes = with_slopes(self.signed_distance, s)
        return distance, unit(slopes)

    def nearest_free(self, s: Array) -> Array:
        """Return the points `s` (*B, 3), those inside moved about to the nearest free place, (*B, 3), metres."""
        free = np.array(s, dtype=float).reshape(-1, 3)
        inside = np.flatnonzero(self.signed_distance(free) < 0)
        for row in inside:
            free[row] = self._way_out(free[row])
        return free.reshape(np.shape(s))

    def _way_out(self, s: Array) -> Array:
        """Find the free place for one point (3,) inside."""
        deepest = Union((min(self.parts, key=lambda part: float(part.signed_distance(s))),))
        free, rounding = s[None], 1e-9
        for _ in range(20):  # one step to exact surfaces, more to interpolated ones
            distance, normal = deepest.distance_and_normal(free)
            free = free - (distance - rounding)[:, None] * normal
        if self.signed_distance(free)[0] >= 0:  # no free place is nearer
            return free[0]
        directions = golden_spiral(500) * [1, -1, -1]
        length = escape_lengths(self, s, directions)
        return s + length.min() * directions[length.argmin()]

    def cover(self) -> tuple[Array, Array]:
        """Cover all parts by balls: centres (K, 3) and radii (K,), metres."""
        centres, radii = zip(*(part.cover() for part in self.parts), strict=True)
        return np.concatenate(centres), np.concatenate(radii)

    def field(self, generator: Generator, temperature: float) -> Sum:
        """Return the sum of the parts' generators (sec. 4.4)."""
        return Sum(tuple(part.field(generator, temperature) for part in self.parts))


def escape_lengths(obstacle: Obstacle | Union, points: Array, directions: Array, margin: float = 0.0) -> Array:
    """How far points (N, 3) have to go along unit vectors (N, 3), or one for all, to keep a margin: (N,) metres."""
    length = np.zeros(np.broadcast_shapes(points.shape, directions.shape)[:-1])
    for _ in range(MAX_STEPS):
        lacking = margin - obstacle.signed_distance(points + length[:, None] * directions)
        if lacking.max() <= 0:
            break
        length += np.where(lacking > 0, np.maximum(lacking, SHORTEST), 0)
    return length
