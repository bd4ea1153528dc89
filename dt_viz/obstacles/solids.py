"""Solids bounded by triangles, with a signed distance that is smooth and quick to evaluate anywhere.

The distance is computed once on a grid: of each node from the nearest triangle, with the sign of the winding number.
Between the nodes it is a quadratic B-spline with the nodes' values as coefficients, that is, a weighted mean of
distances: its slope is continuous and, up to the discretisation, at most 1.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from dt_viz.errors import check_between
from dt_viz.files.checks import check_triangles
from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.distances import GRID, SHAPE, Values, batch, distances
from dt_viz.numerics import divisor, unit
from dt_viz.obstacles.covers import cells_cover
from dt_viz.obstacles.triangles import grid_nodes, inside_of_grid, surface_samples


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


SETTINGS = GridSettings()
SMALLEST = 1e-9
"""Smallest size of a solid, and inverse of the largest, in its own unit."""


class ByContent:
    """Base of dataclasses of arrays, which are copied and kept read-only; they are compared and hashed by content."""

    def _keep(self, **kinds: type) -> None:
        """Replace arrays by read-only copies of these types."""
        for name, kind in kinds.items():
            if (values := getattr(self, name)) is not None:
                array = np.array(values, dtype=kind)
                array.flags.writeable = False
                object.__setattr__(self, name, array)

    @cached_property
    def digest(self) -> bytes:
        """Hash of all arrays."""
        arrays = [getattr(self, field.name) for field in fields(self)]  # pyright: ignore[reportArgumentType]
        content = b"".join(array.tobytes() for array in arrays if array is not None)
        return hashlib.blake2b(content, digest_size=16).digest()

    def __eq__(self, other: object) -> bool:
        return self is other or (type(other) is type(self) and self.digest == getattr(other, "digest", b""))

    def __hash__(self) -> int:
        return hash(self.digest)


@dataclass(frozen=True, eq=False)
class Solid(ByContent):
    """The solid enclosed by triangles; compared and hashed by its vertices and faces.

    Raises:
        FormatError: as :func:`check_triangles`, or it is a point.
    """

    vertices: Array
    """(V, 3) metres, in the solid's own frame."""
    faces: Indices
    """(F, 3) indices of vertices."""

    def __post_init__(self) -> None:
        self._keep(vertices=float, faces=np.intp)
        check_triangles(self.vertices, self.faces)
        check_between("size", float(np.ptp(self.bounds, axis=0).max()), SMALLEST, 1 / SMALLEST)

    @property
    def distances(self) -> DistanceGrid:
        """Signed distance; computed once for all equal solids."""
        return _distances(self)

    @cached_property
    def radius(self) -> float:
        """Radius of the ball around the origin that holds it, metres."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @cached_property
    def bounds(self) -> Array:
        """(2, 3) lower and upper corner of its bounding box, metres."""
        return np.stack([self.used.min(axis=0), self.used.max(axis=0)])

    @property
    def used(self) -> Array:
        """Vertices of its faces, metres."""
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        return self.vertices[used]

    @property
    def balls(self) -> tuple[Array, Array]:
        """A cover of it: centres (K, 3) and radii (K,), metres."""
        return _balls(self)


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """A signed distance sampled on a grid; analytic between and beyond its nodes.

    For an object of 15 cm its error is up to 2 mm beside edges, 0.3 mm elsewhere near the surface, and 2 % far from it.
    """

    origin: Array
    """(3,) first node, metres."""
    cell: float
    """Distance between neighbouring nodes, metres."""
    values: Array
    """(n_x, n_y, n_z) signed distances of the nodes, metres."""
    margin: float
    """Smallest distance of the shape from the border of the grid, metres."""
    centre: Array
    """(3,) centre of the bounding box, metres."""
    radius: float
    """Radius of the ball around that centre that holds the shape, metres."""

    @cached_property
    def nodes(self) -> Array:
        """Nodes (n_x·n_y·n_z, 3), metres, last axis fastest."""
        return grid_nodes(self.origin, self.cell, self.values.shape)

    @cached_property
    def depth(self) -> float:
        """Distance of the deepest point from the surface, metres."""
        return max(0.0, -float(self.values.min()))

    @cached_property
    def interior(self) -> Array:
        """Nodes (N, 3) inside, metres."""
        return self.nodes[self.values.ravel() < 0]

    def __call__(self, s: Array) -> Array:
        """Signed distance (*B,) of the points `s` (*B, 3), which may be a tiny complex step away from real ones.

        Beyond the grid it is a lower bound of the distance, continuous and of a slope of at most 1: with c the nearest
        point of the border, o = s − c and m the margin, d² = d(c)² + |o|² + 2m·Σ|o_i|; or the distance from the ball
        that holds the shape, whatever is larger.
        """
        shape = np.zeros(1, SHAPE)
        shape["axes"], shape["scale"] = np.eye(3), 1.0
        for name, value in self.record.items():
            shape[name] = value
        return distances(shape, self.coefficients, batch(s)).reshape(s.shape[:-1])

    @property
    def record(self) -> dict[str, Any]:
        """Fields of its `dt_viz.kernels.distances.SHAPE`."""
        grid = {"first": self.origin, "cell": self.cell, "counts": self.values.shape, "margin": self.margin}
        return {"kind": GRID, **grid, "centre": self.centre, "radius": self.radius}

    @cached_property
    def coefficients(self) -> Values:
        """Values, flat and in single precision, which fits the processor's cache."""
        return self.values.astype(np.float32).ravel()


def with_slopes(distance: Callable[[Array], Array], s: Array) -> tuple[Array, Array]:
    """Compute an analytic function (N,) of points `s` (N, 3) and its gradients (N, 3), by complex steps."""
    step = 1e-20
    beside: Array = s + 1j * step * np.eye(3)[:, None]  # pyright: ignore[reportAssignmentType]
    ahead = distance(beside)  # (3, N)
    return ahead[0].real, ahead.imag.T / step


class _Surface:
    """Triangles with samples on them, by which near ones are found."""

    def __init__(self, triangles: Array) -> None:
        self._triangles = triangles
        a, b, c = triangles.swapaxes(0, 1)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        # long and thin triangles would otherwise have rows of very many samples
        length = sum(float(np.linalg.norm(side, axis=1).sum()) for side in (b - a, c - b, a - c)) / 2
        spacing = max(np.sqrt(area / SETTINGS.num_samples), length / (SETTINGS.longest_rows * SETTINGS.num_samples))
        self.samples, self._owner = surface_samples(triangles, spacing)
        self._tree = KDTree(self.samples)

    def _nearest(self, s: Array) -> tuple[Indices, Array]:
        """Find the triangles (N,) nearest to points `s` (N, 3), and the points (N, 3) on them."""
        _, found = self._tree.query(s, k=min(SETTINGS.num_nearest, self._tree.n))
        owners = self._owner[np.reshape(found, (len(s), -1))]  # (N, K)
        points = np.stack([closest_point(self._triangles[owner], s) for owner in owners.T], axis=1)
        best = np.arange(len(s)), ((points - s[:, None]) ** 2).sum(axis=2).argmin(axis=1)
        return owners[best], points[best]

    def distances(self, nodes: Array, origin: Array, cell: float, shape: tuple[int, int, int]) -> Array:
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
        for _ in range(SETTINGS.num_rounds):
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
        squared, step = np.einsum("ni,ni->n", offset, offset), SETTINGS.walk * np.linalg.norm(aside, axis=1)
        far = np.flatnonzero(step**2 > 1e-4 * squared)
        aside *= (SETTINGS.walk * np.minimum(1, longest / divisor(step)))[:, None]
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


@lru_cache(maxsize=16)
def _distances(solid: Solid) -> DistanceGrid:
    lower, upper = solid.bounds
    margin = SETTINGS.margin * float((upper - lower).max())
    size = upper - lower + 2 * margin
    cell = float(np.cbrt(size.prod() / SETTINGS.num_nodes))
    counts = np.ceil(size / cell).astype(int) + 2  # the outermost nodes are for the spline only
    centre = (lower + upper) / 2
    origin = centre - cell * (counts - 1) / 2
    shape = (int(counts[0]), int(counts[1]), int(counts[2]))
    nodes = grid_nodes(origin, cell, shape)
    # first, since it refuses meshes that take too long, or that are not closed
    inside = inside_of_grid(solid.vertices[solid.faces], origin, cell, shape, closed=True)
    distance = _Surface(solid.vertices[solid.faces]).distances(nodes, origin, cell, shape)
    radius = float(np.linalg.norm(solid.used - centre, axis=1).max())
    signed = np.where(inside, -distance, distance)
    _flatten(signed, cell)
    grid = DistanceGrid(origin, cell, signed, margin, centre, radius)
    # steeper than 1 by a percent or two beside edges
    s = origin + cell * np.random.default_rng(0).uniform(0.5, counts - 1.5, (100_000, 3))
    slope = np.linalg.norm(with_slopes(grid, s)[1], axis=1).max()
    return replace(grid, values=grid.values / slope, margin=margin / slope) if slope > 1 else grid


@lru_cache(maxsize=64)
def _balls(solid: Solid) -> tuple[Array, Array]:
    grid = solid.distances  # cells into which the solid reaches
    return cells_cover(grid.nodes[grid.values.ravel() < grid.cell * np.sqrt(3) / 2], grid.cell)
