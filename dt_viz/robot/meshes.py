"""Shapes of an arm's links: triangles that move with its joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dt_viz.flows.fields import Array, Indices

T = TypeVar("T", bound="LinkMesh")


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """Collision shape of a link; links that do not move, such as fingers, are those of the joint that carries them."""

    name: str
    """Name of the link in the URDF."""
    joint: int
    """Index of the joint that it moves with, −1 for the base."""
    vertices: Array
    """(V, 3) metres, in the frame of that joint; of the base in the base frame."""
    faces: NDArray[np.intp]
    """(F, 3) indices of vertices."""

    def turned(self: T, base: Array) -> T:
        """The same on a base that is turned by a rotation (3, 3): what is fixed to the base turns along."""
        return self if self.joint >= 0 else replace(self, vertices=constant(self.vertices @ base.T))


@dataclass(frozen=True, eq=False)
class VisualMesh(LinkMesh):
    """What is drawn of a link."""

    colour: tuple[int, int, int] | None = None
    """Red, green and blue up to 255; None is the page's colour of an arm."""


def cells(points: Array, size: float) -> Indices:
    """Number the cells of a grid (N,), in the order of their places, that points (N, 3) are in."""
    cell = np.floor(points / size).astype(np.intp)
    cell -= cell.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)))


def constant(values: ArrayLike, dtype: DTypeLike = float) -> NDArray[Any]:
    """Return a read-only copy."""
    array = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array
