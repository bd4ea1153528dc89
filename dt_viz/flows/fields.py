"""Point fields that generate flows, and the separable Gaussian basis they are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.kernels.fields import GRID, LANES, TERM, Terms
from dt_viz.kernels.flows import carry
from dt_viz.kernels.runge_kutta import DORMAND_PRINCE, RATE
from dt_viz.memo import cached_property
from dt_viz.numerics import Array, Indices, Mask  # noqa: F401 - other packages import them with the fields
from dt_viz.scheduler import checkpoint

MOST_AT_ONCE = 2 * 10**8
"""Largest product of points, equal steps and values of a field between two checkpoints: about a second."""


class VectorField(Protocol):
    """A Lipschitz vector field V: R^d → R^d."""

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        ...

    def __call__(self, s: Array, /) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        ...


class CompiledField(ABC):
    """Mixin of a `VectorField` whose flow is a compiled loop over the points, without tangents."""

    @abstractmethod
    def carried(self, s: Array, method: int, duration: float = 0.0, steps: int = 1, tolerance: float = 0.0) -> Array:
        """Carry points `s` (N, d) along by an explicit method; see `dt_viz.flows.integrators.carried`."""


class PointField(ABC):
    """A vector field of the plane or of space that compiled loops know; everything follows from its `terms`."""

    @property
    def dim(self) -> int:
        """Dimension d of the space, 3 if nothing else is said."""
        return 3

    @abstractmethod
    def _terms(self) -> Terms:
        """The field as compiled loops take it."""

    @cached_property
    def terms(self) -> Terms:
        """The field as compiled loops take it."""
        return self._terms()

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        return self.carried(s, None, RATE)[0]

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and its derivative DV (N, d, d), DV[:, i, j] = ∂V_i/∂s_j, at the points `s` (N, d)."""
        V, DV = self.carried(s, np.broadcast_to(np.eye(self.dim), (len(s), self.dim, self.dim)), RATE)
        assert DV is not None
        return V, DV

    def carried(
        self, s: Array, U: Array | None, method: int, duration: float = 0.0, steps: int = 1, tolerance: float = 0.0
    ) -> tuple[Array, Array | None]:
        """Carry `s` (N, d) and `U` (N, d, k) along the flow; see `dt_viz.flows.integrators.carried`."""
        num, d = s.shape
        states = np.empty((num, d if U is None else d * (1 + U.shape[2])))
        states[:, :d] = s
        if U is not None:
            states[:, d:] = U.reshape(num, states.shape[1] - d)
        num_failed, equal_steps = 0, 1 if method == DORMAND_PRINCE else steps
        rows = LANES * max(1, MOST_AT_ONCE // (LANES * equal_steps * max(1, self.terms.values.size)))
        for begin in range(0, num, rows):
            if num > rows:
                checkpoint()
            block = states[begin : begin + rows]
            num_failed += carry(self.terms, block, d, method, float(duration), int(steps), float(tolerance))
        if num_failed:
            text = f"{num_failed} points need more than {steps} steps: the field is too steep for them"
            raise ArithmeticError(text)
        return (states, None) if U is None else (states[:, :d], states[:, d:].reshape(U.shape))


@dataclass(frozen=True)
class GaussianGrid:
    """Gaussian basis k(s, ŝ) = exp(−ℓ‖s − ŝ‖²) with inducing points ŝ on an equally spaced grid (sec. 5).

    A Gaussian is a product of 1-D Gaussians, so a weighted sum over all inducing points is contracted one axis after
    the other (`dt_viz.kernels.fields`); no (N, m) matrix of exponentials is formed.
    """

    axes: tuple[Array, ...]  # per axis the n_j increasing coordinates of the inducing points

    ell: float  # inverse squared width ℓ = 1/(2σ²), in 1/unit²

    @classmethod
    def covering(cls, points: ArrayLike, sigma: float, *, spacing: float = 1.0, pad: float = 1.0) -> GaussianGrid:
        """Grid of Gaussians of width `sigma`, in the unit of the points (N, d), over the box of these.

        The largest distance between neighbouring inducing points, `spacing`, and the margin around the points, `pad`,
        are in σ.
        """
        points = np.asarray(points, dtype=float)
        lower, upper = points.min(axis=0) - pad * sigma, points.max(axis=0) + pad * sigma
        counts = np.ceil((upper - lower) / (spacing * sigma) - 1e-9).astype(int) + 1
        axes = tuple(np.linspace(a, b, max(2, n)) for a, b, n in zip(lower, upper, counts, strict=True))
        return cls(axes, 0.5 / sigma**2)

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return len(self.axes)

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Inducing points per axis."""
        return tuple(len(axis) for axis in self.axes)

    @property
    def num_points(self) -> int:
        """Number m of inducing points."""
        return int(np.prod(self.shape))

    @property
    def inducing_points(self) -> Array:
        """All inducing points, (m, d), last axis fastest."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(-1, self.dim)

    def factors(self, s: Array, max_order: int = 0) -> list[Array]:
        """1-D Gaussians of points `s` (N, d) and their derivatives up to the order K: for each axis (K + 1, N, n_j)."""
        factors = []
        for coordinate, nodes in zip(s.T, self.axes, strict=True):
            offset = coordinate[:, None] - nodes
            values = np.empty((max_order + 1, *offset.shape))
            np.exp(-self.ell * (offset * offset), out=values[0])
            # Hermite recursion: g⁽ⁿ⁺¹⁾ = −2ℓ (offset · g⁽ⁿ⁾ + n · g⁽ⁿ⁻¹⁾)
            offset *= -2.0 * self.ell
            for n in range(max_order):
                np.multiply(offset, values[n], out=values[n + 1])
                if n:
                    values[n + 1] -= 2.0 * self.ell * n * values[n - 1]
            factors.append(values)
        return factors

    def terms(self, weights: Array, kind: int = GRID) -> Terms:
        """Sums Wᵀk(s, ŝ) with weights (m, k), k ≤ 3, as a term of compiled fields."""
        d, term = self.dim, np.zeros(1, TERM)
        term["kind"], term["ell"], term["num"], term["size"] = kind, self.ell, weights.shape[1], weights.size
        term["inward"][0, 3 - d :, :d] = term["outward"][0, :d, :d] = np.eye(d)
        term["first"][0, 3 - d :] = [nodes[0] for nodes in self.axes]
        term["counts"][0, 3 - d :] = self.shape
        term["spacing"][0, 3 - d :] = [np.ptp(nodes) / max(1, len(nodes) - 1) for nodes in self.axes]
        return Terms(term, np.array(weights, dtype=float).reshape(-1))

    def features(self, s: Array) -> Array:
        """The dense matrix k(s, ŝ), (N, m): for fitting, not for evaluating."""
        columns = np.ones((len(s), 1))
        for factor in self.factors(s):
            columns = (columns[:, :, None] * factor[0][:, None, :]).reshape(len(s), -1)
        return columns


@dataclass(frozen=True)
class GridRBF(PointField):
    """Point field V(s) = Wᵀ k(s, ŝ) on a Gaussian grid (sec. 4.3; the printed kernel with its norm squared)."""

    grid: GaussianGrid
    weights: Array  # W, (m, d), one row for each inducing point

    def __post_init__(self) -> None:
        expected = (self.grid.num_points, self.grid.dim)
        if self.weights.shape != expected:
            raise ValueError(f"weights have shape {self.weights.shape}; the grid needs {expected}")

    @property
    def dim(self) -> int:
        return self.grid.dim

    def _terms(self) -> Terms:
        return self.grid.terms(self.weights)


@dataclass(frozen=True)
class PlacedField(PointField):
    """A field under an affine map of space: V_world(s) = M·V(M⁻¹(s − o)).

    Its flow is o + M·γ(t, M⁻¹(s − o)), which leaves the moved, turned and stretched shape in the time in which γ leaves
    the original one. So an obstacle that is only moved is not learned again, and a flat or long shape gets a field that
    is as smooth, relative to each of its sizes, as that of a ball.
    """

    inner: PointField
    origin: Array  # o, (d,), metres
    axes: Array
    """M, (d, d), invertible; its columns are the axes of the frame of `inner`, one unit long, metres."""

    @property
    def dim(self) -> int:
        return self.inner.dim

    @cached_property
    def _inverse(self) -> Array:
        return np.linalg.inv(self.axes)

    def to_frame(self, s: Array) -> Array:
        """Where the world points `s` (N, d) lie in the frame of `inner`, M⁻¹(s − o), (N, d)."""
        return (s - self.origin) @ self._inverse.T

    def _terms(self) -> Terms:
        terms, d = self.inner.terms.terms.copy(), self.dim
        terms["origin"][:, :d] = self.origin + terms["origin"][:, :d] @ self.axes.T
        terms["inward"][:, :, :d] = terms["inward"][:, :, :d] @ self._inverse
        terms["outward"][:, :d] = self.axes @ terms["outward"][:, :d]
        return Terms(terms, self.inner.terms.values)


@dataclass(frozen=True)
class Projected(PointField):
    """The part M·V of a field that a matrix leaves, such as that along a plane: its flow then stays at every depth."""

    inner: PointField
    matrix: Array  # M, (d, d)

    @property
    def dim(self) -> int:
        return self.inner.dim

    def _terms(self) -> Terms:
        terms = self.inner.terms.terms.copy()
        terms["outward"] = self.matrix @ terms["outward"]
        return Terms(terms, self.inner.terms.values)


@dataclass(frozen=True)
class Sum(PointField):
    """Several fields of the same dimension, added up; at least one."""

    parts: tuple[PointField, ...]

    @property
    def dim(self) -> int:
        return self.parts[0].dim

    def _terms(self) -> Terms:
        all_terms = [part.terms for part in self.parts]
        terms = np.concatenate([part.terms for part in all_terms])
        begins = np.cumsum([0, *(len(part.values) for part in all_terms[:-1])])
        terms["begin"] += np.repeat(begins, [len(part.terms) for part in all_terms])
        return Terms(terms, np.concatenate([part.values for part in all_terms]))
