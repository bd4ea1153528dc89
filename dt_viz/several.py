"""Several obstacles as one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.fields import Array, Repeated, Sum, VectorField
from dt_viz.obstacles import Obstacle, Sphere
from dt_viz.occupancy import Generator

ROUNDS = 3
"""Of moving points out of one obstacle after the other: leaving one may lead into the next."""


@dataclass(frozen=True)
class Several:
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
        """The points `s` (*B, 3), those inside moved to a place outside, (*B, 3), metres."""
        for _ in range(ROUNDS):
            for part in self.parts:
                s = part.nearest_free(s)
        return s

    def field(self, generator: Generator, temperature: float) -> VectorField:
        """The generators of the parts, added up (sec. 4.4)."""
        spheres = tuple(part.field(generator, temperature) for part in self.parts if isinstance(part, Sphere))
        others = tuple(part.field(generator, temperature) for part in self.parts if not isinstance(part, Sphere))
        return Sum((*((Repeated(spheres),) if spheres else ()), *others))
