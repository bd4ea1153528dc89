"""Diffeomorphisms whose inverse is read from a table: where few points at a time are asked for, very often."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.diffeomorphisms import Diffeomorphism, Placed
from dt_viz.flows.fields import Array
from dt_viz.interruption import checkpoint

NUM_NODES = 40_000
"""Number of nodes of a table, about."""
BLOCK = 2000
"""Number of nodes that are computed between two checkpoints."""
CUBIC = np.array([[0, -2, 3, -1], [6, -3, -6, 3], [0, 6, 3, -3], [0, -1, 0, 1]]) / 6
"""Coefficients of 1, t, t², t³ in the weights of the nodes −1, 0, 1, 2 (Lagrange)."""


@dataclass(frozen=True, eq=False)
class Tabulated(Diffeomorphism):
    """ψ with ψ⁻¹ and its Jacobian interpolated by cubic polynomials between the nodes of a lattice.

    ψ itself is exact, as is ψ⁻¹ without tangents, and all where a point lies beyond the lattice.
    """

    exact: Diffeomorphism
    """ψ."""
    lowest: Array
    """(d,) first node."""
    spacing: float
    shape: tuple[int, ...]
    """Number of nodes along each axis."""
    values: Array
    """(nodes, d + d²), last axis fastest: ψ⁻¹ and the rows of its Jacobian."""

    @classmethod
    def around(cls, exact: Diffeomorphism, points: Array, margin: float) -> Tabulated:
        """Tabulate ψ⁻¹ in the box of images `points` (N, d), and by a `margin` beyond it."""
        lowest, highest = points.min(axis=0) - margin, points.max(axis=0) + margin
        spacing = float((np.prod(highest - lowest) / NUM_NODES) ** (1 / exact.dim))
        axes = [
            np.arange(low - spacing, high + 2 * spacing, spacing) for low, high in zip(lowest, highest, strict=True)
        ]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, exact.dim)
        blocks = []
        for k in range(0, len(nodes), BLOCK):
            checkpoint()
            y, J = exact.inverse_jacobian(nodes[k : k + BLOCK])
            blocks.append(np.concatenate([y, J.reshape(len(y), -1)], axis=1))
        return cls(exact, lowest - spacing, spacing, tuple(map(len, axes)), np.concatenate(blocks))

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.exact.dim

    def scaled(self, fraction: float) -> Diffeomorphism:
        """See `Diffeomorphism`; without a table."""
        return self.exact.scaled(fraction)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        place = (s - self.lowest) / self.spacing
        cell = np.floor(place).astype(int)
        if U is None or not inverse or not len(s) or (cell < 1).any() or (cell > np.subtract(self.shape, 3)).any():
            return self.exact._map(s, U, inverse=inverse)
        along = (place - cell)[:, :, None, None] ** np.arange(4) @ CUBIC.T  # (N, d, 1, 4)
        weights, index = np.ones((len(s), 1)), np.zeros((len(s), 1), dtype=int)
        for axis, num in enumerate(self.shape):
            weights = (weights[:, :, None] * along[:, axis]).reshape(len(s), -1)
            nodes = cell[:, axis, None] + np.arange(-1, 3)
            index = (num * index[:, :, None] + nodes[:, None]).reshape(len(s), -1)
        found = (weights[:, None] @ self.values[index])[:, 0]
        return found[:, : self.dim], found[:, self.dim :].reshape(-1, self.dim, self.dim) @ U


def tabulated(transform: Diffeomorphism, points: Array, margin: float) -> Diffeomorphism:
    """The transform with its inverse tabulated around the images `points` (N, d), by a `margin` beyond them.

    What is placed in a larger space is tabulated in its own.
    """
    if isinstance(transform, Placed):
        own = transform.to_frame(points)[:, : transform.inner.dim]
        return replace(transform, inner=Tabulated.around(transform.inner, own, margin / transform.scale))
    return Tabulated.around(transform, points, margin)
