"""Obstacles: their true shape, and the field learned from samples of it that motions are led around with (sec. 4.4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dt_viz.fields import Array, PlacedField
from dt_viz.occupancy import AvoidanceField, Generator, OccupancyMap, fit_occupancy, sample_labels

NUM_SAMPLES = 4000
KERNEL_WIDTH = 0.9
"""Of the occupancy map, in radii of the obstacle."""
REGULARISATION = 10.0


@dataclass(frozen=True)
class Sphere:
    """A ball in the world, with the true shape that clearances are measured against."""

    position: tuple[float, float, float]
    """Centre, metres."""
    diameter: float = 0.15
    """Metres."""

    @property
    def radius(self) -> float:
        """Metres."""
        return self.diameter / 2

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the surface, (*B,), metres, negative inside; analytic in `s`."""
        offset = s - np.asarray(self.position)
        return np.sqrt((offset * offset).sum(axis=-1)) - self.radius

    def nearest_free(self, s: Array) -> Array:
        """The points `s` (*B, 3), those inside moved to the nearest point of the surface, (*B, 3), metres."""
        offset = s - np.asarray(self.position)
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        outward = np.where(distance > 0, offset / np.maximum(distance, 1e-300), np.array([0.0, 0.0, 1.0]))
        return np.where(distance < self.radius, np.asarray(self.position) + self.radius * outward, s)

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """The generator whose reverse flow leaves the sphere, from an occupancy map learned once for all spheres."""
        local = AvoidanceField(unit_sphere_map(), generator, temperature)
        return PlacedField(local, np.asarray(self.position), np.eye(3), self.radius)


@lru_cache(maxsize=1)
def unit_sphere_map() -> OccupancyMap:
    """Occupancy of the unit ball, learned from labelled samples."""
    samples, labels = sample_labels(
        lambda s: np.linalg.norm(s, axis=1) < 1, -np.ones(3), np.ones(3), NUM_SAMPLES, np.random.default_rng(0)
    )
    return fit_occupancy(samples, labels, KERNEL_WIDTH, regularisation=REGULARISATION)
