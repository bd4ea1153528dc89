"""Occupancy maps learned from labelled samples, and vector fields that lead out of the occupied region (sec. 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit

from dt_viz.flows.fields import Array, GaussianGrid, Mask, VectorField, second_orders, unit_orders

Generator = Literal["free-space", "probability"]
GENERATORS: tuple[Generator, ...] = ("free-space", "probability")
PAD = 0.5
"""Margin of the inducing points around the occupied samples, in kernel widths. A larger one lets the map vary far from
the obstacle, where no field is wanted."""


@dataclass(frozen=True)
class OccupancyMap:
    """f_map(s) = p(o = 1 | s) = σ(wᵀ k(s, ŝ) + b): logistic regression on a grid of Gaussians."""

    grid: GaussianGrid
    weights: Array
    """w, (m,)."""
    bias: float
    """b, the logit far away from every inducing point."""

    def logit(self, s: Array) -> Array:
        """Compute the log-odds log p/(1 − p) at the points `s` (N, d), as (N,)."""
        return self.grid.contract(s, self.weights[:, None], ((0,) * self.grid.dim,))[0][:, 0] + self.bias

    def probability(self, s: Array) -> Array:
        """Compute p(o = 1 | s) at the points `s` (N, d), as (N,)."""
        return expit(self.logit(s))

    def logit_gradient(self, s: Array) -> tuple[Array, Array]:
        """The logit (N,) and its gradient (N, d) at the points `s` (N, d)."""
        d = self.grid.dim
        partials = self.grid.contract(s, self.weights[:, None], ((0,) * d, *unit_orders(d)))[..., 0]
        return partials[0] + self.bias, partials[1:].T

    def logit_hessian(self, s: Array) -> tuple[Array, Array, Array]:
        """The logit (N,), its gradient (N, d) and its second derivatives (N, d, d) at the points `s` (N, d)."""
        d = self.grid.dim
        second = second_orders(d)
        orders = ((0,) * d, *unit_orders(d), *second.values())
        partials = self.grid.contract(s, self.weights[:, None], orders)[..., 0]
        hessian = np.empty((len(s), d, d))
        for (i, j), column in zip(second, partials[1 + d :], strict=True):
            hessian[:, i, j] = hessian[:, j, i] = column
        return partials[0] + self.bias, partials[1 : 1 + d].T, hessian


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
    grid = GaussianGrid.covering(samples[occupied], kernel_width, pad=PAD)
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
    """Draw labelled samples {(s_k, o_k)} of a shape, uniform in its grown bounding box, half of them close to it.

    Args:
        inside: tells for points (N, d) whether they are occupied, (N,) bool.
        lower: (d,) lower corner of the shape's bounding box.
        upper: (d,) upper corner.
        num_samples: K.
        rng: source of randomness.

    Returns:
        Samples (K, d) and labels (K,), 1 occupied and 0 free.
    """
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    growth = np.where(np.arange(num_samples) % 2 == 0, 1.25, 3.0)
    samples = centre + growth[:, None] * half * rng.uniform(-1, 1, (num_samples, len(centre)))
    return samples, inside(samples).astype(float)


@dataclass(frozen=True)
class AvoidanceField:
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

    @cached_property
    def _gain(self) -> float:
        return 0.5 / self.occupancy.grid.ell  # the squared kernel width

    @cached_property
    def _far(self) -> float:
        return float(expit(self.occupancy.bias / self.temperature))

    def __call__(self, s: Array) -> Array:
        """Compute V at the points `s` (N, d), as (N, d)."""
        logit, gradient = self.occupancy.logit_gradient(s)
        return (self._gain * self._weight(logit)[0])[:, None] * gradient

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """Compute V (N, d) and DV (N, d, d) at the points `s` (N, d). DV is symmetric: V is a gradient."""
        logit, gradient, hessian = self.occupancy.logit_hessian(s)
        weight, slope = self._weight(logit)
        outer = gradient[:, :, None] * gradient[:, None, :]
        return (self._gain * weight)[:, None] * gradient, self._gain * (
            weight[:, None, None] * hessian + slope[:, None, None] * outer
        )

    def _weight(self, logit: Array) -> tuple[Array, Array]:
        """dU/dlogit and its derivative."""
        if self.generator == "probability":
            p = expit(logit)
            weight = p * (1 - p)
            return weight, weight * (1 - 2 * p)
        p = expit(logit / self.temperature)
        weight = np.maximum(p - self._far, 0)
        return weight, (weight > 0) * p * (1 - p) / self.temperature


@dataclass(frozen=True)
class StretchedField:
    """A vector field under a linear map of space: V_out(s) = M·V(M⁻¹s).

    Its flow is M γ(t, M⁻¹s), which leaves the stretched shape in the time in which γ leaves the original one. A flat or
    long shape thus gets a field that is as smooth, relative to each of its sizes, as that of a ball.
    """

    inner: VectorField
    axes: Array
    """M, (d, d), invertible."""

    @cached_property
    def _inverse(self) -> Array:
        return np.linalg.inv(self.axes)

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.inner.dim

    def to_frame(self, s: Array) -> Array:
        """Transform the points `s` (N, d) to the frame of `inner`: M⁻¹s, (N, d)."""
        return s @ self._inverse.T

    def __call__(self, s: Array) -> Array:
        """Compute V_out at the points `s` (N, d), as (N, d)."""
        return self.inner(self.to_frame(s)) @ self.axes.T

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """Compute V_out (N, d) and its derivative (N, d, d) at the points `s` (N, d)."""
        v, DV = self.inner.with_jacobian(self.to_frame(s))
        return v @ self.axes.T, self.axes @ DV @ self._inverse
