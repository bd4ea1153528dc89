"""Union obstacles as one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dt_viz.flows.fields import Array, Repeated, Sum, VectorField
from dt_viz.obstacles.occupancy import Generator
from dt_viz.obstacles.shapes import Obstacle, Sphere

NUM_DIRECTIONS, NUM_STEPS = 500, 200
"""In which a way out of overlapping obstacles is looked for, and largest number of steps on it."""
SHORTEST = 1e-4
"""Metres of such a step: by so much a way may lead farther than to the surface."""
ROUNDING = 1e-6
"""Metres inside that do not count on a surface."""


@dataclass(frozen=True)
class Union:
    """The union of any number of obstacles, also none: what is inside one of them is inside."""

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
        """The points `s` (*B, 3), those inside moved to the nearest place outside, or nearly so, (*B, 3), metres."""
        free = np.array(s, dtype=float).reshape(-1, 3)
        for row in np.flatnonzero(self.signed_distance(free) < 0):
            free[row] = self._way_out(free[row])
        return free.reshape(s.shape)

    def _way_out(self, s: Array) -> Array:
        """The same for one point (3,) that is inside."""
        deepest = min(self.parts, key=lambda part: float(part.signed_distance(s)))
        free = deepest.nearest_free(s)
        if self.signed_distance(free) >= -ROUNDING:  # nothing outside is nearer
            return free
        directions, length = _directions(), np.zeros(NUM_DIRECTIONS)
        for _ in range(NUM_STEPS):
            depth = -self.signed_distance(s + length[:, None] * directions)
            if depth[length.argmin()] <= 0:
                break
            length += np.where(depth > 0, np.maximum(depth, SHORTEST), 0)
        nearest = length.argmin()
        return s + length[nearest] * directions[nearest]

    def field(self, generator: Generator, temperature: float) -> VectorField:
        """The generators of the parts, added up (sec. 4.4)."""
        spheres = tuple(part.field(generator, temperature) for part in self.parts if isinstance(part, Sphere))
        others = tuple(part.field(generator, temperature) for part in self.parts if not isinstance(part, Sphere))
        return Sum((*((Repeated(spheres),) if spheres else ()), *others))


@lru_cache(maxsize=1)
def _directions() -> Array:
    """Unit vectors (NUM_DIRECTIONS, 3), evenly spread: a spiral from pole to pole in golden angles."""
    k = np.arange(NUM_DIRECTIONS)
    z, turn = (2 * k + 1) / NUM_DIRECTIONS - 1, k * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
