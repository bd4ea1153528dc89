"""Occupancy maps of shapes, learned from labelled samples of them (sec. 4.4), once for all their places and sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from dt_viz.flows.fields import Array, Mask
from dt_viz.obstacles.occupancy import OccupancyMap, fit_occupancy, sample_labels
from dt_viz.obstacles.solids import Solid


@dataclass(frozen=True)
class MapSettings:
    """How the map of a shape is learned; half sizes are relative to the largest."""

    num_samples: int = 4000
    """Number of labelled samples."""
    kernel_width: float = 0.9
    """Kernel width, in radii of the obstacle, or along each axis in half sizes."""
    regularisation: float = 10.0
    """Weight of ½‖w‖²."""
    solid_regularisation: float = 1.0
    """That for shapes that may be hollow, whose map must rise more steeply."""
    flattest: float = 0.3
    """Smallest half size that the kernel adapts to: a thinner field turns motions sharply."""
    thinnest: float = 0.3
    """Depth to which thinner shapes are thickened before they are learned."""
    turned: float = 0.8
    """Volume of the box along a shape's principal axes, relative to that along its frame's, below which the field
    follows the principal axes."""


SETTINGS = MapSettings()


@lru_cache(maxsize=32)
def unit_map(shape: Any) -> OccupancyMap:  # noqa: ANN401 - an `Obstacle`, whose module imports this one
    """Learn the occupancy of a shape about the origin whose largest half size is 1."""
    return learned(lambda s: shape.signed_distance(s) < 0)


def learned(inside: Callable[[Array], Mask], regularisation: float = SETTINGS.regularisation) -> OccupancyMap:
    """Learn the occupancy of a shape whose largest half sizes are 1 from labelled samples around it."""
    rng = np.random.default_rng(0)
    samples, labels = sample_labels(inside, -np.ones(3), np.ones(3), SETTINGS.num_samples, rng)
    return fit_occupancy(samples, labels, SETTINGS.kernel_width, regularisation=regularisation)


def unit_sizes(half: Array) -> tuple[float, float, float]:
    """Return half sizes after space is stretched to make them equal: 1, or less for a shape that is very flat."""
    x, y, z = (round(float(min(1.0, size / (SETTINGS.flattest * half.max()))), 3) for size in half)
    return x, y, z


@lru_cache(maxsize=16)
def solid_map(solid: Solid) -> tuple[OccupancyMap, Array, Array]:
    """Return the map of a solid, the stretched axes (3, 3) of its frame as columns, and its origin (3,), metres."""
    grid = solid.distances
    interior = grid.interior if len(grid.interior) else solid.vertices
    turn = np.eye(3)
    spread = np.linalg.eigh(np.cov(interior.T))[1]
    if np.prod(np.ptp(solid.vertices @ spread, axis=0)) < SETTINGS.turned * np.prod(np.ptp(solid.vertices, axis=0)):
        turn = spread  # it is askew in its own frame
    along = solid.vertices @ turn
    lower, upper = along.min(axis=0), along.max(axis=0)
    half = (upper - lower) / 2
    axes, centre = turn * (half / np.array(unit_sizes(half))), turn @ ((lower + upper) / 2)
    thicker = max(0.0, SETTINGS.thinnest * float(half.max()) - grid.depth)
    return learned(lambda u: grid(u @ axes.T + centre) < thicker, SETTINGS.solid_regularisation), axes, centre
