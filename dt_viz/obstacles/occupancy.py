"""Occupancy maps learned from labelled samples, and vector fields that lead out of the occupied region (sec. 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit

from dt_viz.flows.fields import Array, GaussianGrid, Mask, PointField
from dt_viz.kernels.fields import OCCUPANCY, Terms
from dt_viz.kernels.flows import carry
from dt_viz.kernels.runge_kutta import RATE
from dt_viz.memo import cached_property
from dt_viz.obstacles.solids import Solid

Generator = Literal["free-space", "probability"]
GENERATORS: tuple[Generator, ...] = ("free-space", "probability")


@dataclass(frozen=True)
class OccupancyMap:
    """f_map(s) = p(o = 1 | s) = σ(wᵀ k(s, ŝ) + b): logistic regression on a grid of Gaussians."""

    grid: GaussianGrid
    weights: Array  # w, (m,)
    bias: float  # b, the logit far away from every inducing point

    @cached_property
    def sums(self) -> Terms:
        """The logit without its bias, and its gradient, as a term of compiled fields."""
        return self.grid.terms(self.weights[:, None])

    def logit(self, s: Array) -> Array:
        """Compute the log-odds log p/(1 − p) at the points `s` (N, d), as (N,)."""
        states = np.array(s, dtype=float, order="C")
        carry(self.sums, states, self.grid.dim, RATE, 0.0, 1, 0.0)
        return states[:, 0] + self.bias

    def probability(self, s: Array) -> Array:
        """Compute p(o = 1 | s) at the points `s` (N, d), as (N,)."""
        return expit(self.logit(s))


def fit_occupancy(
    samples: Array, labels: Array, kernel_width: float, *, regularisation: float = 0.1, max_iterations: int = 50
) -> OccupancyMap:
    """Learn an occupancy map by penalised maximum likelihood (Newton's method on a convex objective).

    Args:
        samples: (K, d) points s_k.
        labels: (K,) o_k, 1 occupied and 0 free.
        kernel_width: σ of a Gaussian, about half the size of the obstacle. A narrow kernel leaves local minima inside
            the obstacle, where points get stuck.
        regularisation: weight of ½‖w‖².
        max_iterations: largest number of Newton steps.

    Raises:
        ValueError: the labels are all of one kind, so that there is no boundary to learn.
    """
    occupied = labels > 0.5
    if occupied.all() or not occupied.any():
        found = "occupied" if occupied.any() else "free"
        raise ValueError(f"all {len(labels)} samples are {found}; an occupancy map needs both occupied and free ones")
    # a larger margin, in kernel widths, lets the map vary far from the obstacle, where no field is wanted
    grid = GaussianGrid.covering(samples[occupied], kernel_width, pad=0.5)
    features = np.concatenate([grid.features(samples), np.ones((len(samples), 1))], axis=1)
    penalty = np.full(features.shape[1], regularisation)
    penalty[-1] = 1e-3  # the bias follows from the data: the share of free space
    w = np.zeros(features.shape[1])
    for _ in range(max_iterations):
        p = expit(features @ w)
        gradient = features.T @ (labels - p) - penalty * w
        hessian = (features * (p * (1 - p))[:, None]).T @ features
        hessian[np.diag_indices_from(hessian)] += penalty
        update = cho_solve(cho_factor(hessian), gradient)
        # a long first step overshoots the flat tails of the logistic function
        w = w + update * min(1.0, 10.0 / np.abs(features @ update).max())
        if np.abs(update).max() < 1e-8 * (1 + np.abs(w).max()):
            break
    return OccupancyMap(grid, w[:-1], float(w[-1]))


def sample_labels(
    inside: Callable[[Array], Mask], lower: Array, upper: Array, num_samples: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw labelled samples (K, d), (K,) of a shape, uniform in its grown bounding box, half of them close to it.

    Labels are 1 where `inside` tells that points (N, d) are occupied, else 0; the box is from `lower` (d,) to `upper`
    (d,).
    """
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    growth = np.where(np.arange(num_samples) % 2 == 0, 1.25, 3.0)
    samples = centre + growth[:, None] * half * rng.uniform(-1, 1, (num_samples, len(centre)))
    return samples, inside(samples).astype(float)


@dataclass(frozen=True)
class AvoidanceField(PointField):
    """Generator V whose reverse flow leaves the occupied region.

    - "free-space" (default): V = ∇U with U'(logit) = max(σ(logit/T) − σ(b/T), 0), b the logit far away. Without the
      second term and with T = 1 this is −∇log(1 − p). The temperature T widens the field, which makes the warp
      smoother; the second term ends it away from the obstacle, so that far points do not move.
    - "probability": V = ∇p, the paper's. It vanishes where p saturates, so points deep inside never leave.

    V is scaled by the squared kernel width, which makes the duration dimensionless and about 1.
    """

    occupancy: OccupancyMap
    generator: Generator = "free-space"
    temperature: float = 3.0

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.occupancy.grid.dim

    def _terms(self) -> Terms:
        terms, values = self.occupancy.grid.terms(self.occupancy.weights[:, None], OCCUPANCY)
        terms["bias"] = self.occupancy.bias
        terms["temperature"] = 0.0 if self.generator == "probability" else self.temperature
        terms["outward"] = terms["inward"].transpose(0, 2, 1) * 0.5 / self.occupancy.grid.ell
        return Terms(terms, values)


@dataclass(frozen=True)
class MapSettings:
    """How the map of a shape is learned; half sizes are relative to the largest."""

    num_samples: int = 4000  # number of labelled samples
    kernel_width: float = 0.9
    """Kernel width, in radii of the obstacle, or along each axis in half sizes."""
    regularisation: float = 10.0  # weight of ½‖w‖²
    solid_regularisation: float = 1.0
    """That for shapes that may be hollow, whose map must rise more steeply."""
    flattest: float = 0.3
    """Smallest half size that the kernel adapts to: a thinner field turns motions sharply."""
    thinnest: float = 0.3  # depth to which thinner shapes are thickened before they are learned
    turned: float = 0.8
    """Volume of the box along a shape's principal axes, relative to that along its frame's, below which the field
    follows the principal axes."""


SETTINGS = MapSettings()


@lru_cache(maxsize=32)
def unit_map(shape: Any, *stretch: float) -> OccupancyMap:  # noqa: ANN401 - an `Obstacle`, whose module imports this one
    """Learn the occupancy of a shape about the origin whose largest half size is 1, once its axes are shrunk thus."""
    return learned(lambda s: shape.signed_distance(s * np.array(stretch or 1.0)) < 0)


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
