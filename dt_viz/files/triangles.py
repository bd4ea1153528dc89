"""Triangles in space: samples on them, the nodes of a grid that they enclose, and their distances from these."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from dt_viz.errors import FormatError
from dt_viz.numerics import Array, Indices, Mask, divisor, unit

MAX_DISPUTED = 0.02
"""Largest number of nodes off the surface on which the directions may disagree, relative to that inside. Meshes that
lack 5 % of their triangles have mostly up to 0.01, a ball with a round hole of a third of its diameter 0.03."""
REMEDY = (
    "close it in a mesh editor, or give its walls a thickness; if its hollows do not matter, load its convex hull "
    "(Blender, MeshLab and trimesh make one)"
)
MAX_CROSSINGS = 3_000_000
"""Largest number of pairs of a triangle and a line near it; 500,000 even triangles have some 10,000."""


@dataclass(frozen=True)
class GridSettings:
    """How a solid's signed distance is computed."""

    num_nodes: int = 64**3  # approximate number of nodes of the grid
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


def surface_samples(triangles: Array, spacing: float) -> tuple[Array, Indices]:
    """Spread points over triangles (F, 3, 3), about `spacing` apart, at least one on each; also return their owners."""
    longest = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2).argmax(axis=1)
    turned = (longest[:, None] + np.arange(3)) % 3  # its longest side first
    a, b, c = np.take_along_axis(triangles, turned[..., None], axis=1).swapaxes(0, 1)
    base = np.linalg.norm(b - a, axis=1)
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / divisor(base)
    along, across = (np.maximum(1, np.ceil(size / spacing)).astype(np.intp) for size in (base, height))
    count = along * across
    owner = np.repeat(np.arange(len(triangles)), count)
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    u = ((rank % along[owner] + 0.5) / along[owner])[:, None]
    v = ((rank // along[owner] + 0.5) / across[owner])[:, None]
    return (1 - v) * ((1 - u) * a[owner] + u * b[owner]) + v * c[owner], owner


def grid_nodes(origin: Array, cell: float, shape: tuple[int, ...]) -> Array:
    """Return the nodes (N, 3) of a grid, the last axis fastest."""
    return origin + cell * np.indices(shape).reshape(3, -1).T


def inside_of_grid(
    triangles: Array, origin: Array, cell: float, shape: tuple[int, ...], *, closed: bool = False
) -> Mask:
    """Find the nodes of a grid that triangles (F, 3, 3) enclose, by winding numbers along lines; a few may be missing.

    The lines of two of the three directions must agree, since a line through a small hole counts wrongly. The grid has
    its first node at `origin` (3,) and others every `cell`, metres.

    Raises:
        FormatError: very many triangles are long or overlap; or they have large holes, where they are to be `closed`.
    """
    votes = np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        winding = _winding(triangles[..., order], origin[order], cell, tuple(shape[k] for k in order))
        votes += np.moveaxis(winding != 0, [0, 1, 2], order)
    inside = votes >= 2
    if not closed:
        return inside
    grown, shrunk = (np.asarray(f(inside), bool) for f in (ndimage.binary_dilation, ndimage.binary_erosion))
    beside = grown & ~shrunk  # lines may meet these nodes either way
    disputed = np.count_nonzero(((votes == 1) | (votes == 2)) & ~beside) / max(1, np.count_nonzero(inside))
    if disputed > MAX_DISPUTED:
        found = f"large holes: what is inside differs with the direction, in {min(disputed, 1):.0%} of it"
        raise FormatError("mesh", found, f"a closed (watertight) mesh: {REMEDY}")
    return inside


def _winding(triangles: Array, origin: Array, cell: float, shape: tuple[int, ...]) -> Array:
    """Count the winding numbers of the nodes along the last axis."""
    nx, ny, nz = shape
    # the lines pass a little beside the nodes, so as not to hit the edges of shapes with round coordinates
    shift = cell * np.array([0.00137, 0.00219])
    t = (triangles - origin) / cell
    flat = t[..., :2] - shift / cell
    lower = np.maximum(np.ceil(flat.min(axis=1)), 0).astype(np.intp)
    upper = np.minimum(np.floor(flat.max(axis=1)), [nx - 1, ny - 1]).astype(np.intp)
    size = np.maximum(upper - lower + 1, 0)
    count = size[:, 0] * size[:, 1]
    crossings = np.zeros((nx, ny, nz + 1), dtype=np.int32)
    hit = np.flatnonzero(count)
    ends = np.cumsum(count[hit])
    if len(hit) and ends[-1] > MAX_CROSSINGS:
        found = f"{len(hit)} triangles, most of them long or one over the other"
        raise FormatError("faces", found, "a mesh of even triangles; remesh it more coarsely or more evenly")
    start = 0
    while start < len(hit):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + 100_000, side="right")))
        some = hit[start:stop]
        owner = np.repeat(some, count[some])
        rank = np.arange(len(owner)) - np.repeat(np.cumsum(count[some]) - count[some], count[some])
        i = lower[owner, 0] + rank // size[owner, 1]
        j = lower[owner, 1] + rank % size[owner, 1]
        a, b, c = (flat[owner, k] - np.stack([i, j], axis=1) for k in range(3))
        wa, wb, wc = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] for u, v in ((b, c), (c, a), (a, b)))
        through = ((wa > 0) & (wb > 0) & (wc > 0)) | ((wa < 0) & (wb < 0) & (wc < 0))
        owner, i, j = owner[through], i[through], j[through]
        wa, wb, wc = wa[through], wb[through], wc[through]
        z = (wa * t[owner, 0, 2] + wb * t[owner, 1, 2] + wc * t[owner, 2, 2]) / (wa + wb + wc)
        k = np.clip(np.ceil(z), 0, nz).astype(np.intp)  # the first node above
        np.add.at(crossings, (i, j, k), np.where(wa > 0, 1, -1))
        start = stop
    return crossings.cumsum(axis=2)[..., :nz]


@dataclass(frozen=True)
class Distances:
    """What a process computes of a mesh."""

    values: Array  # (n_x, n_y, n_z) signed distances of the nodes of a grid, in the mesh's unit


def read_distances(
    files: Sequence[tuple[str, bytes]], origin: list[float], cell: float, shape: list[int], settings: dict[str, Any]
) -> Distances:
    """Compute distances from the bytes of a mesh's vertices and faces with `GridSettings`; takes some 200 MB meanwhile.

    Raises:
        FormatError: as `inside_of_grid`.
    """
    (_, vertices), (_, faces) = files
    triangles = np.frombuffer(vertices).reshape(-1, 3)[np.frombuffer(faces, np.intp).reshape(-1, 3)]
    first, counts = np.array(origin), tuple(shape)
    # first, since it refuses meshes that take too long, or that are not closed
    inside = inside_of_grid(triangles, first, cell, counts, closed=True)
    distance = _Surface(triangles, GridSettings(**settings)).distances(first, cell, counts)
    signed = np.where(inside, -distance, distance)
    _flatten(signed, cell)
    return Distances(signed)


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

    def distances(self, origin: Array, cell: float, shape: tuple[int, ...]) -> Array:
        """Compute the distances (n_x, n_y, n_z) of a grid's nodes from the surface.

        Nodes beside the surface search the tree, and hand on what they find from node to node: far away from the
        surface so many samples are about equally near that a tree is slow.
        """
        nodes, beside = grid_nodes(origin, cell, shape), np.zeros(shape, dtype=bool)
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
