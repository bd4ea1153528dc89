"""Chains of stationary flows with their sensitivities: the model that is fitted to demonstrations.

ψ⁻¹ is a composition of L layers (sec. 4.1), each the flow of one Gaussian field in a few explicit Euler steps
s ← s + h·F(s). While fitting, a field is written F(s) = Φ(s)·θ in whitened features Φ = k(s, ŝ)·C⁻ᵀ, K = C·Cᵀ the
kernel matrix of the inducing points in use, so that its squared RKHS norm is plainly ‖θ‖².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial import KDTree

from dt_viz.flows.diffeomorphisms import Chain, Flow
from dt_viz.flows.fields import Array, GaussianGrid, GridRBF
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER


@dataclass(frozen=True)
class FlowLayer:
    """Features of one stationary field: the Gaussians of a grid that are near the data."""

    grid: GaussianGrid
    active: NDArray[np.integer[Any]]  # (m,) indices into the grid's inducing points
    whitening: Array  # C⁻ᵀ, (m, m)

    @classmethod
    def near(cls, points: Array, sigma: float, *, spacing: float, reach: float) -> FlowLayer:
        """Make a layer of Gaussians of width `sigma` around points (N, d) at which the field must be able to act.

        The distance between neighbouring inducing points, `spacing`, and that from the points beyond which they are
        left out, `reach`, are in σ.
        """
        grid = GaussianGrid.covering(points, sigma, spacing=spacing, pad=reach)
        distance, _ = KDTree(points).query(grid.inducing_points)
        # points on the edge of the reach, as in even data, count as near
        farthest = max(reach, 0.5 * spacing * np.sqrt(grid.dim)) * sigma * (1 + 1e-9)
        return cls.of(grid, np.flatnonzero(distance <= farthest))

    @classmethod
    def of(cls, grid: GaussianGrid, active: NDArray[np.integer[Any]] | None = None) -> FlowLayer:
        """Make a layer of the Gaussians of a grid with indices `active`; None takes all."""
        if active is None:
            active = np.arange(grid.num_points)
        centres = grid.inducing_points[active]
        gram = np.exp(-grid.ell * ((centres[:, None] - centres) ** 2).sum(axis=-1))
        lower = cholesky(gram + 1e-4 * np.eye(len(active)), lower=True)  # overlapping Gaussians are nearly dependent
        return cls(grid, active, solve_triangular(lower, np.eye(len(active)), lower=True).T)

    @property
    def num_features(self) -> int:
        """Number m of inducing points in use."""
        return len(self.active)

    def features(self, s: Array) -> Array:
        """Compute Φ (N, m) at the points `s` (N, d)."""
        return self.gaussians(s) @ self.whitening

    def gaussians(self, s: Array) -> Array:
        """Compute the raw Gaussians k(s, ŝ) (N, m) at the points `s` (N, d)."""
        return self._products([factor[0] for factor in self.grid.factors(s)])

    def gaussians_with_derivatives(self, s: Array) -> tuple[Array, list[Array]]:
        """Compute the raw Gaussians (N, m) at the points `s` (N, d), and their d partial derivatives."""
        factors = self.grid.factors(s, 1)
        value = self._products([f[0] for f in factors])
        d = self.grid.dim
        return value, [self._products([factors[i][int(i == j)] for i in range(d)]) for j in range(d)]

    def field(self, theta: Array) -> GridRBF:
        """Return the field with coefficients `theta` (m, d), on the whole grid."""
        weights = np.zeros((self.grid.num_points, self.grid.dim))
        weights[self.active] = self.whitening @ theta
        return GridRBF(self.grid, weights)

    def _products(self, factors: Sequence[Array]) -> Array:
        """Multiply 1-D Gaussians (N, n_j) over the axes, for the inducing points in use, (N, m)."""
        columns = np.unravel_index(self.active, self.grid.shape)
        value = factors[0][:, columns[0]]
        for factor, column in zip(factors[1:], columns[1:], strict=True):
            value *= factor[:, column]
        return value


@dataclass(frozen=True)
class FlowChain:
    """ψ⁻¹ as a chain of layers; layer 0 acts first. Coefficients are lists of L arrays (m_l, d)."""

    layers: tuple[FlowLayer, ...]
    steps: int  # number of Euler steps of each layer

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.layers[0].grid.dim

    @property
    def sizes(self) -> list[int]:
        """Numbers of unknowns of the layers, m_l·d."""
        return [layer.num_features * self.dim for layer in self.layers]

    def split(self, vector: Array) -> list[Array]:
        """Split a vector of unknowns, a component's m_l numbers contiguous, into the layers' coefficients."""
        ends = np.cumsum(self.sizes)
        return [part.reshape(self.dim, -1).T for part in np.split(vector[: ends[-1]], ends[:-1])]

    def join(self, thetas: Sequence[Array]) -> Array:
        """Join the coefficients of all layers: the inverse of `split`."""
        return np.concatenate([theta.T.reshape(-1) for theta in thetas])

    def images(self, z: Array, thetas: Sequence[Array]) -> Array:
        """Compute the images (N, d) of points `z` (N, d)."""
        h = 1.0 / self.steps
        for layer, theta in zip(self.layers, thetas, strict=True):
            raw = layer.whitening @ theta
            for _ in range(self.steps):
                z = z + h * (layer.gaussians(z) @ raw)
        return z

    def images_with_sensitivity(self, z: Array, thetas: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Compute images (N, d) of points `z` (N, d), their derivative by z (N, d, d), and by P unknowns (N, d, P).

        That, ordered as in `join`, is the sum over steps of (product of the later steps' Jacobians)·h·Φ(s).
        """
        h, d = 1.0 / self.steps, self.dim
        path: list[tuple[Array, Array]] = []  # step by step: raw Gaussians, Jacobian of the step
        for layer, theta in zip(self.layers, thetas, strict=True):
            raw = layer.whitening @ theta
            for _ in range(self.steps):
                value, partials = layer.gaussians_with_derivatives(z)
                z = z + h * (value @ raw)
                path.append((value, np.eye(d) + h * np.stack([p @ raw for p in partials], axis=-1)))
        sensitivity = np.empty((d, len(z), sum(self.sizes)))
        later = np.broadcast_to(np.eye(d), (len(z), d, d))
        end = sensitivity.shape[-1]
        for index in reversed(range(len(self.layers))):
            layer = self.layers[index]
            total = np.zeros((d, d, len(z), layer.num_features))
            for value, jacobian in reversed(path[index * self.steps : (index + 1) * self.steps]):
                for a in range(d):
                    for b in range(d):
                        total[a, b] += (h * later[:, a, b])[:, None] * value
                later = later @ jacobian
            for b in reversed(range(d)):
                start = end - layer.num_features
                sensitivity[:, :, start:end] = total[:, b] @ layer.whitening
                end = start
        return z, later, sensitivity.transpose(1, 0, 2)

    def min_step_determinant(self, thetas: Sequence[Array]) -> float:
        """Return the smallest determinant of an Euler step's derivative, over all layers and all of space."""
        pairs = zip(self.layers, thetas, strict=True)
        return min(min_step_determinant(layer.field(theta), 1.0 / self.steps) for layer, theta in pairs)

    def transform(self, thetas: Sequence[Array], centre: Array, scale: float) -> Chain:
        """Return ψ in the user's coordinates y = centre + scale·s, this chain being ψ⁻¹, exact to rounding.

        ψ⁻¹ is the cheap direction, explicit Euler: rollouts are images under ψ⁻¹, and ψ is needed only at their starts.
        """
        flows = []
        for layer, theta in zip(self.layers, thetas, strict=True):
            field = layer.field(theta)
            reversed_field = GridRBF(field.grid, -field.weights)
            flows.append(Flow(scaled_field(reversed_field, centre, scale), 1.0, self.steps, IMPLICIT_EULER, EULER))
        return Chain(flows)


def min_step_determinant(field: GridRBF, h: float) -> float:
    """Return the smallest determinant of the derivative of the Euler step s + h·V(s), over all of space.

    With a bounded V the step is proper, so by Hadamard's theorem it is a diffeomorphism of R^d if this determinant is
    positive everywhere. Away from the grid the field vanishes and it is 1; on the grid it is computed every quarter of
    a Gaussian's width in the plane and every half in space.
    """
    sigma = np.sqrt(0.5 / field.grid.ell)
    spacing = (0.25 if field.dim == 2 else 0.5) * sigma
    axes = [np.arange(axis[0] - 2 * sigma, axis[-1] + 2 * sigma, spacing) for axis in field.grid.axes]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, field.dim)
    return float(np.linalg.det(np.eye(field.dim) + h * field.with_jacobian(points)[1]).min())


def scaled_field(field: GridRBF, centre: Array, scale: float) -> GridRBF:
    """Return the field in coordinates y = centre + scale·s."""
    axes = tuple(c + scale * axis for c, axis in zip(centre, field.grid.axes, strict=True))
    return GridRBF(GaussianGrid(axes, field.grid.ell / scale**2), scale * field.weights)


def equally_spaced_grid(points: Array, num: int, ell: float) -> GaussianGrid:
    """Place `num` Gaussians over the box of `points` (N, d) and a width more, as evenly as factors of `num` allow."""
    sigma = np.sqrt(0.5 / ell)
    lower, upper = points.min(axis=0) - sigma, points.max(axis=0) + sigma

    def unevenness(counts: tuple[int, ...]) -> float:
        return float(np.ptp(np.log((upper - lower) / (np.array(counts) - 1))))

    counts = min(_factorings(num, len(lower)), key=unevenness)
    return GaussianGrid(tuple(np.linspace(a, b, n) for a, b, n in zip(lower, upper, counts, strict=True)), ell)


def _factorings(num: int, parts: int) -> list[tuple[int, ...]]:
    """List all ways to write `num` as a product of `parts` factors of at least 2."""
    if parts == 1:
        return [(num,)] if num > 1 else []
    return [(n, *rest) for n in range(2, num) if num % n == 0 for rest in _factorings(num // n, parts - 1)]
