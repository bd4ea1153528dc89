"""Unions of obstacles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array, Sum
from dt_viz.obstacles.occupancy import Generator
from dt_viz.obstacles.shapes import Obstacle, golden_spiral

NUM_DIRECTIONS, NUM_STEPS = 500, 200
"""Number of rays along which a way out of overlapping obstacles is searched, and largest number of steps on a ray."""
SHORTEST = 1e-4
"""Smallest ray-marching step, metres; bounds the overshoot."""
ROUNDING = 1e-6
"""Largest depth, metres, that counts as lying on a surface."""


@dataclass(frozen=True)
class Union:
    """The union of any number of obstacles, possibly none."""

    parts: tuple[Obstacle, ...] = ()

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the nearest surface, (*B,), metres, negative inside; analytic in `s`.

        Inside more than one it may be smaller than the depth of the union. Infinite where there is no obstacle.
        """
        nearest: Array = np.full(s.shape[:-1], np.inf, dtype=s.dtype)
        for part in self.parts:
            distance = part.signed_distance(s)
            nearest = np.where(distance.real < nearest.real, distance, nearest)
        return nearest

    def nearest_free(self, s: Array) -> Array:
        """Return the points `s` (*B, 3), those inside moved about to the nearest free place, (*B, 3), metres."""
        free = np.array(s, dtype=float).reshape(-1, 3)
        for row in np.flatnonzero(self.signed_distance(free) < 0):
            free[row] = self._way_out(free[row])
        return free.reshape(s.shape)

    def _way_out(self, s: Array) -> Array:
        """Find the free place for one point (3,) inside."""
        deepest = min(self.parts, key=lambda part: float(part.signed_distance(s)))
        free = deepest.nearest_free(s)
        if self.signed_distance(free) >= -ROUNDING:  # no free place is nearer
            return free
        directions, length = golden_spiral(NUM_DIRECTIONS) * [1, -1, -1], np.zeros(NUM_DIRECTIONS)
        for _ in range(NUM_STEPS):
            depth = -self.signed_distance(s + length[:, None] * directions)
            if depth[length.argmin()] <= 0:
                break
            length += np.where(depth > 0, np.maximum(depth, SHORTEST), 0)
        nearest = length.argmin()
        return s + length[nearest] * directions[nearest]

    def cover(self) -> tuple[Array, Array]:
        """Cover all parts by balls: centres (K, 3) and radii (K,), metres."""
        centres, radii = zip(*(part.cover() for part in self.parts), strict=True)
        return np.concatenate(centres), np.concatenate(radii)

    def field(self, generator: Generator, temperature: float) -> Sum:
        """Return the sum of the parts' generators (sec. 4.4)."""
        return Sum(tuple(part.field(generator, temperature) for part in self.parts))
