"""Triangles in space: nearest points, samples on them, and the nodes of a grid that they enclose."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from dt_viz.errors import FormatError
from dt_viz.numerics import Array, Indices, Mask, divisor

MAX_DISPUTED = 0.02
"""Largest number of nodes off the surface on which the directions may disagree, relative to that inside. Meshes that
lack 5 % of their triangles have mostly up to 0.01, a ball with a round hole of a third of its diameter 0.03."""
REMEDY = (
    "close it in a mesh editor, or give its walls a thickness; if its hollows do not matter, load its convex hull "
    "(Blender, MeshLab and trimesh make one)"
)
MAX_CROSSINGS = 3_000_000
"""Largest number of pairs of a triangle and a line near it; 500,000 even triangles have some 10,000."""


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
