"""Fields of a bias: unit vectors away from the centre of a region (sec. 4.6), and a shift in one direction."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dt_viz.flows.fields import Array, GaussianGrid, GridRBF, PointField
from dt_viz.kernels.fields import REGION, SHIFT, TERM, Terms

NUM_SAMPLES = 400
"""Number of unit vectors sampled in one octant of the region, or quadrant of the disc; the others mirror them."""
KERNEL_WIDTH = 0.4
"""Kernel width of the regression, in radii; about the size of the core in which it smooths the unit vectors, which are
singular at the target."""


@dataclass(frozen=True)
class RegionField(PointField):
    """A field on the unit ball (or on the cylinder over the unit disc) that fades out smoothly towards its border.

    V(s) = (1 − ‖u‖²)³·V_fit(u), u the first k coordinates of s; the others are not moved.
    """

    directions: GridRBF
    """V_fit, in R^k."""

    def _terms(self) -> Terms:
        return self.directions.grid.terms(self.directions.weights, REGION)


@dataclass(frozen=True, eq=False)
class Shift(PointField):
    """A field of one direction on the unit ball (or on the cylinder over the unit disc): V(s) = (1 − ‖u‖²)³·n."""

    direction: Array
    """n, (3,), a unit vector."""
    dim_of_region: int
    """3 for the ball, 2 for the cylinder."""

    def _terms(self) -> Terms:
        term = np.zeros(1, TERM)
        term["kind"], term["inward"] = SHIFT, np.diag([1.0, 1.0, self.dim_of_region - 2.0])
        term["outward"][0, :, 0] = self.direction
        return Terms(term, np.empty(0))


def shifting_time(u: float) -> float:
    """Time in which a shift carries a place from the distance u, in radii, to the target: ∫ du / (1 − u²)³."""
    room = 1 - u * u
    return u / (4 * room * room) + 3 * u / (8 * room) + 3 / 8 * math.atanh(u)


@lru_cache(maxsize=2)
def unit_field(dim: int) -> RegionField:
    """The field for the unit region, ridge regression of unit vectors away from the centre of the ball of `dim`.

    With every sample come its mirror images, so the centre is at rest and no sampling noise turns the field.
    """
    rng = np.random.default_rng(0)
    octant = np.abs(rng.normal(size=(NUM_SAMPLES, dim)))
    octant *= rng.uniform(size=(NUM_SAMPLES, 1)) ** (1 / dim) / np.linalg.norm(octant, axis=1, keepdims=True)
    samples = np.concatenate([octant * signs for signs in itertools.product((-1, 1), repeat=dim)])
    away = samples / np.linalg.norm(samples, axis=1, keepdims=True)
    grid = GaussianGrid.covering(np.stack([-np.ones(dim), np.ones(dim)]), KERNEL_WIDTH, pad=0)
    features = grid.features(samples)
    gram = features.T @ features / len(samples)
    gram[np.diag_indices_from(gram)] += 1e-3  # the ridge
    return RegionField(GridRBF(grid, cho_solve(cho_factor(gram), features.T @ away / len(samples))))
