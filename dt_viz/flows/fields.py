"""Point fields that generate flows, and the separable Gaussian basis they are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]
Indices = NDArray[np.integer[Any]]
Mask = NDArray[np.bool_]
Selection = slice | Indices

BLOCK = 4096
"""Number of points that a sum over a grid takes at once; with more of them the intermediate results leave the cache."""


class VectorField(Protocol):
    """A Lipschitz vector field V: R^d → R^d that knows its derivative."""

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        ...

    def __call__(self, s: Array, /) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        ...

    def with_jacobian(self, s: Array, /) -> tuple[Array, Array]:
        """V (N, d) and its derivative DV (N, d, d), DV[:, i, j] = ∂V_i/∂s_j, at the points `s` (N, d)."""
        ...


class CompiledField(ABC):
    """Mixin of a `VectorField` whose flow is a compiled loop over the points, without tangents."""

    @abstractmethod
    def rk4(self, s: Array, duration: float, steps: int) -> Array:
        """Carry the points `s` (N, d) along in equal steps of the classical Runge–Kutta method."""

    @abstractmethod
    def dormand_prince(self, s: Array, duration: float, tolerance: float, max_steps: int) -> Array:
        """Carry the points `s` (N, d) along as `integrate_adaptive` does. Raises ArithmeticError as it does."""


@dataclass(frozen=True)
class GaussianGrid:
    """Gaussian basis k(s, ŝ) = exp(−ℓ‖s − ŝ‖²) with inducing points ŝ on an equally spaced grid (sec. 5).

    A Gaussian is a product of 1-D Gaussians, so a weighted sum over all inducing points is a chain of small matrix
    products, one axis after the other; no (N, m) matrix of exponentials is formed.
    """

    axes: tuple[Array, ...]
    """Per axis the n_j increasing coordinates of the inducing points."""

    ell: float
    """Inverse squared width ℓ = 1/(2σ²), in 1/unit²."""

    @classmethod
    def covering(cls, points: ArrayLike, sigma: float, *, spacing: float = 1.0, pad: float = 1.0) -> GaussianGrid:
        """Grid of Gaussians of width `sigma` over the bounding box of `points`.

        Args:
            points: (N, d) points to cover.
            sigma: width σ of a Gaussian, in the unit of the points.
            spacing: largest distance between neighbouring inducing points, in σ.
            pad: margin around the points, in σ.
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

    @cached_property
    def _flat_axes(self) -> tuple[NDArray[np.intp], Array, tuple[slice, ...]]:
        """The axes one after the other: to which coordinate each entry belongs, the entries, and each axis' part."""
        ends = np.cumsum(self.shape)
        parts = tuple(slice(int(end) - n, int(end)) for n, end in zip(self.shape, ends, strict=True))
        return np.repeat(np.arange(self.dim), self.shape), np.concatenate(self.axes), parts

    def _gaussians(self, s: Array, max_order: int) -> Array:
        """1-D Gaussians of all axes and their derivatives, (K + 1, Σn_j, N): the batch last, for long inner loops."""
        coordinate, entries, _ = self._flat_axes
        offset = np.ascontiguousarray(s.T)[coordinate] - entries[:, None]
        values = np.empty((max_order + 1, *offset.shape))
        np.exp(-self.ell * (offset * offset), out=values[0])
        # Hermite recursion: g⁽ⁿ⁺¹⁾ = −2ℓ (offset · g⁽ⁿ⁾ + n · g⁽ⁿ⁻¹⁾)
        offset *= -2.0 * self.ell
        for n in range(max_order):
            np.multiply(offset, values[n], out=values[n + 1])
            if n:
                values[n + 1] -= 2.0 * self.ell * n * values[n - 1]
        return values

    def factors(self, s: Array, max_order: int = 0) -> list[Array]:
        """1-D Gaussians of each axis and their derivatives.

        Args:
            s: (N, d) points.
            max_order: K, the highest derivative.

        Returns:
            For each axis j an array (K + 1, N, n_j), the derivative's order first.
        """
        values = self._gaussians(s, max_order)
        return [np.ascontiguousarray(values[:, part].swapaxes(1, 2)) for part in self._flat_axes[2]]

    def contract(self, s: Array, weights: Array, orders: tuple[tuple[int, ...], ...]) -> Array:
        """Partial derivatives of Σ_i w_i k(s, ŝ_i).

        Args:
            s: (N, d) points.
            weights: (m, k) weights of k such sums.
            orders: multi-indices; (0, 1) asks for ∂/∂s_2 in the plane.

        Returns:
            (len(orders), N, k). Multi-indices with a common prefix share its computation.
        """
        num, k = len(s), weights.shape[1]
        if not num:  # an obstacle that covers the whole slice leaves no arrows to evaluate
            return np.empty((len(orders), 0, k))
        if num > BLOCK:
            blocks = [self.contract(s[i : i + BLOCK], weights, orders) for i in range(0, num, BLOCK)]
            return np.concatenate(blocks, axis=1)
        highest, levels, order = _plan(orders)
        values = self._gaussians(s, highest)
        first, *others = self._flat_axes[2]
        (pieces, _), *rest = levels
        weights = weights.reshape(self.shape[0], -1).T  # (n_2 ⋯ n_d k, n_1)
        partial = weights @ values[[derivative for derivative, *_ in pieces], first]
        for n, part, (pieces, size) in zip(self.shape[1:], others, rest, strict=True):
            longer = np.empty((size, partial.shape[1] // n, num))
            partial = partial.reshape(len(partial), n, -1, num)
            for derivative, source, target in pieces:
                np.einsum("parn,an->prn", partial[source], values[derivative, part], out=longer[target])
            partial = longer
        return partial[order].swapaxes(1, 2)

    def features(self, s: Array) -> Array:
        """The dense matrix k(s, ŝ), (N, m): for fitting, not for evaluating."""
        columns = np.ones((len(s), 1))
        for factor in self.factors(s):
            columns = (columns[:, :, None] * factor[0][:, None, :]).reshape(len(s), -1)
        return columns

    def gram(self) -> Array:
        """Kernel matrix K (m, m) of the inducing points, whose form WᵀKW is the RKHS norm of a field."""
        return self.features(self.inducing_points)


_Piece = tuple[int, Selection, slice]
"""A derivative along an axis, the prefixes of multi-indices that it extends, and the rows of the longer prefixes."""


class _Plan(NamedTuple):
    """Order in which a contraction computes partial derivatives, axis by axis."""

    highest: int
    """Highest derivative along any axis."""
    levels: tuple[tuple[tuple[_Piece, ...], int], ...]
    """For each axis its pieces, and the number of prefixes of multi-indices that end with it."""
    order: Selection
    """Rows of the requested multi-indices after the last axis."""


@lru_cache(maxsize=256)
def _plan(orders: tuple[tuple[int, ...], ...]) -> _Plan:
    """Group the multi-indices by their derivative along each axis; each group is one call."""
    levels: list[tuple[tuple[_Piece, ...], int]] = []
    before: list[tuple[int, ...]] = [()]
    for length in range(1, len(orders[0]) + 1):
        wanted, now, pieces = {order[:length] for order in orders}, [], []
        for derivative in sorted({beginning[-1] for beginning in wanted}):
            source = [i for i, beginning in enumerate(before) if (*beginning, derivative) in wanted]
            pieces.append((derivative, _selection(source), slice(len(now), len(now) + len(source))))
            now += [(*before[i], derivative) for i in source]
        levels.append((tuple(pieces), len(now)))
        before = now
    return _Plan(max(map(max, orders)), tuple(levels), _selection([before.index(order) for order in orders]))


def _selection(rows: list[int]) -> Selection:
    """Selection of rows of an array: a slice, which copies nothing, where they are consecutive."""
    consecutive = rows == list(range(rows[0], rows[-1] + 1))
    return slice(rows[0], rows[-1] + 1) if consecutive else np.array(rows)


@lru_cache
def unit_orders(dim: int) -> tuple[tuple[int, ...], ...]:
    """Multi-indices of the `dim` first derivatives."""
    return tuple(tuple(int(i == j) for i in range(dim)) for j in range(dim))


@lru_cache
def second_orders(dim: int) -> dict[tuple[int, int], tuple[int, ...]]:
    """Multi-index of each second derivative ∂²/∂s_i∂s_j, i ≤ j."""
    first = unit_orders(dim)
    return {
        (i, j): tuple(a + b for a, b in zip(first[i], first[j], strict=True)) for i in range(dim) for j in range(i, dim)
    }


@dataclass(frozen=True)
class GridRBF:
    """Point field V(s) = Wᵀ k(s, ŝ) on a Gaussian grid (sec. 4.3; the printed kernel with its norm squared)."""

    grid: GaussianGrid
    weights: Array
    """W, (m, d), one row for each inducing point."""

    def __post_init__(self) -> None:
        expected = (self.grid.num_points, self.grid.dim)
        if self.weights.shape != expected:
            raise ValueError(f"weights have shape {self.weights.shape}; the grid needs {expected}")

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.grid.dim

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        return self.grid.contract(s, self.weights, ((0,) * self.dim,))[0]

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and DV (N, d, d) at the points `s` (N, d)."""
        partials = self.grid.contract(s, self.weights, ((0,) * self.dim, *unit_orders(self.dim)))
        return partials[0], np.ascontiguousarray(partials[1:].transpose(1, 2, 0))


@dataclass(frozen=True)
class PlacedField:
    """A vector field moved, turned and scaled: V_world(s) = c·R·V(Rᵀ(s − o)/c).

    An obstacle that is only moved is not learned again: its field is evaluated in the obstacle's own frame.
    """

    inner: VectorField
    origin: Array
    """o, (d,), metres."""
    axes: Array
    """R, (d, d), orthonormal columns: the frame's axes in the world."""
    scale: float = 1.0
    """c, world metres for one unit of `inner`."""

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.inner.dim

    def to_frame(self, s: Array) -> Array:
        """Where the world points `s` (N, d) lie in the frame of `inner`, Rᵀ(s − o)/c, (N, d)."""
        return (s - self.origin) @ (self.axes / self.scale)

    def __call__(self, s: Array) -> Array:
        """V at the world points `s` (N, d), as (N, d)."""
        return self.inner(self.to_frame(s)) @ (self.scale * self.axes.T)

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and DV (N, d, d) at the world points `s` (N, d)."""
        v, DV = self.inner.with_jacobian(self.to_frame(s))
        return v @ (self.scale * self.axes.T), self.axes @ DV @ self.axes.T


@dataclass(frozen=True)
class InPlane:
    """A field of R³ of which only the part along a plane is left, so that its flow stays at every depth."""

    inner: VectorField
    axes: Array
    """(3, 2) orthonormal columns along the plane."""

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.inner.dim

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, 3), as (N, 3)."""
        return self.inner(s) @ self.axes @ self.axes.T

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, 3) and DV (N, 3, 3) at the points `s` (N, 3)."""
        V, DV = self.inner.with_jacobian(s)
        along = self.axes @ self.axes.T
        return V @ along, along @ DV


@dataclass(frozen=True)
class Sum:
    """Several fields of the same dimension, added up; at least one."""

    parts: tuple[VectorField, ...]

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.parts[0].dim

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        first, *others = self.parts
        V = first(s)
        for part in others:
            V = V + part(s)
        return V

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and DV (N, d, d) at the points `s` (N, d)."""
        first, *others = self.parts
        V, DV = first.with_jacobian(s)
        for part in others:
            v, Dv = part.with_jacobian(s)
            V, DV = V + v, DV + Dv
        return V, DV


@dataclass(frozen=True)
class Repeated:
    """The sum of one field at several places; at least one.

    The inner field is evaluated once, for the coordinates of all points in the frames of all places.
    """

    places: tuple[PlacedField, ...]
    """Places of one and the same inner field."""

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.places[0].dim

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        return self.places[0].inner(self._local(s)).reshape(len(s), len(self._to_world)) @ self._to_world

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and DV (N, d, d) at the points `s` (N, d)."""
        v, DV = self.places[0].inner.with_jacobian(self._local(s))
        V = v.reshape(len(s), len(self._to_world)) @ self._to_world
        DV = DV.reshape(len(s), len(self._derivatives_to_world)) @ self._derivatives_to_world
        return V, DV.reshape(len(s), self.dim, self.dim)

    def _local(self, s: Array) -> Array:
        """Coordinates (N·P, d) of the points in the frames of the P places, all of the first point first."""
        return (s @ self._to_local - self._origins).reshape(-1, self.dim)

    @cached_property
    def _to_local(self) -> Array:
        return np.concatenate([at.axes / at.scale for at in self.places], axis=1)

    @cached_property
    def _origins(self) -> Array:
        return np.concatenate([at.origin @ (at.axes / at.scale) for at in self.places])

    @cached_property
    def _to_world(self) -> Array:
        return np.concatenate([at.scale * at.axes.T for at in self.places])

    @cached_property
    def _derivatives_to_world(self) -> Array:
        # R·D·Rᵀ, row by row, is the row D times (R ⊗ R)ᵀ
        return np.concatenate([np.kron(at.axes, at.axes).T for at in self.places])
