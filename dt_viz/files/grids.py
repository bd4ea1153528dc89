"""Signed distances of the nodes of a grid from a closed mesh, which need some 200 MB while they are computed."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from dt_viz.files.triangles import grid_nodes, inside_of_grid, surface_samples
from dt_viz.numerics import Array, Indices, divisor, unit

Shape = tuple[int, int, int]
"""Number of nodes along each axis."""


@dataclass(frozen=True)
class GridSettings:
    """How a solid's signed distance is computed."""

    num_nodes: int = 64**3
    """Approximate number of nodes of the grid."""
    margin: float = 0.2
    """Margin of the grid around the shape, relative to the largest side of its bounding box."""
    num_samples: int = 60_000
    """Approximate number of samples on a surface, by which nearest triangles are found; each has at least one."""
    longest_rows: int = 8
    """Largest number of samples in rows along the sides of all triangles, in units of `num_samples`."""
    num_nearest: int = 6
    """Number of nearest samples of a point whose triangles are measured exactly."""
    num_rounds: int = 2
    """Number of rounds of sweeps in which nodes of a grid hand on near points of the surface."""
    walk: float = 0.6
    """Part of the way along a surface to the place that would be nearest if it were flat, at most a cell at a time."""


@dataclass(frozen=True)
class Distances:
    """What was computed for a mesh."""

    values: Array
    """(n_x, n_y, n_z) signed distances of the nodes, in the mesh's unit."""


def signed_distances(
    vertices: Array, faces: Indices, origin: Array, cell: float, shape: Shape, settings: GridSettings
) -> Array:
    """Compute the signed distances of a grid's nodes from a mesh of vertices (V, 3) and faces (F, 3).

    The grid has its first node at `origin` (3,), others every `cell`, and as many as `shape` says.

    Raises:
        FormatError: the mesh is not closed, or would take too long.
    """
    triangles = vertices[faces]
    # first, since it refuses meshes that take too long, or that are not closed
    inside = inside_of_grid(triangles, origin, cell, shape, closed=True)
    distance = _Surface(triangles, settings).distances(grid_nodes(origin, cell, shape), origin, cell, shape)
    signed = np.where(inside, -distance, distance)
    _flatten(signed, cell)
    return signed


def read_distances(
    files: Sequence[tuple[str, bytes]], origin: Array, cell: float, shape: Shape, settings: Mapping[str, Any]
) -> Distances:
    """Compute the same for the bytes of vertices and faces, in the process of `dt_viz.files.worker`."""
    vertices, faces = (np.frombuffer(content, kind) for (_, content), kind in zip(files, (float, np.intp), strict=True))
    mesh, (x, y, z) = (vertices.reshape(-1, 3), faces.reshape(-1, 3)), shape
    return Distances(signed_distances(*mesh, np.array(origin), cell, (x, y, z), GridSettings(**settings)))


class _Surface:
    """Triangles with samples on them, by which near ones are found."""

    def __init__(self, triangles: Array, settings: GridSettings) -> None:
        self._triangles, self._settings = triangles, settings
        a, b, c = triangles.swapaxes(0, 1)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        # long and thin triangles would otherwise have rows of very many samples
        length = sum(float(np.linalg.norm(side, axis=1).sum()) for side in (b - a, c - b, a - c)) / 2
        spacing = max(np.sqrt(area / settings.num_samples), length / (settings.longest_rows * settings.num_samples))
        self.samples, self._owner = surface_samples(triangles, spacing)
        self._tree = KDTree(self.samples)

    def _nearest(self, s: Array) -> tuple[Indices, Array]:
        """Find the triangles (N,) nearest to points `s` (N, 3), and the points (N, 3) on them."""
        _, found = self._tree.query(s, k=min(self._settings.num_nearest, self._tree.n))
        owners = self._owner[np.reshape(found, (len(s), -1))]  # (N, K)
        points = np.stack([closest_point(self._triangles[owner], s) for owner in owners.T], axis=1)
        best = np.arange(len(s)), ((points - s[:, None]) ** 2).sum(axis=2).argmin(axis=1)
        return owners[best], points[best]

    def distances(self, nodes: Array, origin: Array, cell: float, shape: Shape) -> Array:
        """Compute the distances (n_x, n_y, n_z) of a grid's nodes (N, 3) from the surface.

        Nodes beside the surface search the tree, and hand on what they find from node to node: far away from the
        surface so many samples are about equally near that a tree is slow.
        """
        beside = np.zeros(shape, dtype=bool)
        corner = ((self.samples - origin) / cell).astype(np.intp)
        for step in np.ndindex(2, 2, 2):
            beside[tuple((corner + step).T)] = True
        to = ndimage.distance_transform_edt(~beside, return_distances=False, return_indices=True)
        assert isinstance(to, np.ndarray)
        owner, points = np.zeros(shape, dtype=np.intp), np.empty((*shape, 3))
        owner[beside], points[beside] = self._nearest(nodes[beside.ravel()])
        owner, points = owner[tuple(to)], points[tuple(to)]
        for _ in range(self._settings.num_rounds):
            _hand_on(owner, points, nodes.reshape(*shape, 3))
            points = closest_point(self._triangles[owner.ravel()], nodes).reshape(*shape, 3)
            self._walk(owner.reshape(-1), points.reshape(-1, 3), nodes, cell)
        return np.linalg.norm(points - nodes.reshape(*shape, 3), axis=-1)

    def _walk(self, owner: Indices, points: Array, nodes: Array, longest: float) -> None:
        """Move points of the surface, in place, along it to where they are nearer to the nodes.

        Where the surface has radius of curvature R and the node is at distance d, the step covers the part
        w·(1 + d/R) of the way.
        """
        offset = nodes - points
        a, b, c = self._triangles[owner].swapaxes(0, 1)
        normal = unit(np.cross(b - a, c - a))
        aside = offset - np.einsum("ni,ni->n", offset, normal)[:, None] * normal
        squared, step = np.einsum("ni,ni->n", offset, offset), self._settings.walk * np.linalg.norm(aside, axis=1)
        far = np.flatnonzero(step**2 > 1e-4 * squared)
        aside *= (self._settings.walk * np.minimum(1, longest / divisor(step)))[:, None]
        new = self._owner[self._tree.query(points[far] + aside[far])[1]]
        reached = closest_point(self._triangles[new], nodes[far])
        nearer = ((reached - nodes[far]) ** 2).sum(axis=1) < squared[far]
        owner[far[nearer]], points[far[nearer]] = new[nearer], reached[nearer]


def _flatten(signed: Array, cell: float) -> None:
    """Limit, in place, the slopes between neighbouring distances on a grid to 1."""
    outside = signed > 0
    for step in itertools.product(range(-2, 3), repeat=3):
        if any(step):
            here, there = (tuple(slice(max(sign * k, 0), min(sign * k, 0) or None) for k in step) for sign in (1, -1))
            far, value, other = cell * float(np.linalg.norm(step)), signed[here], signed[there]
            lowered = np.maximum(np.minimum(value, other + far), 0)
            raised = np.minimum(np.maximum(value, other - far), 0)
            signed[here] = np.where(outside[here], lowered, raised)


def _hand_on(owner: Indices, points: Array, nodes: Array) -> None:
    """Replace, in place, each node's point of the surface by its neighbour's where that is nearer."""
    squared = ((points - nodes) ** 2).sum(axis=-1)
    for _, axis, back in itertools.product(range(3), range(3), (False, True)):
        ends = slice(1, None), slice(None, -1)
        here, there = ((*axis * (slice(None),), end) for end in (ends[::-1] if back else ends))
        apart = ((points[there] - nodes[here]) ** 2).sum(axis=-1)
        nearer = apart < squared[here]
        squared[here][nearer] = apart[nearer]
        owner[here][nearer] = owner[there][nearer]
        points[here][nearer] = points[there][nearer]
