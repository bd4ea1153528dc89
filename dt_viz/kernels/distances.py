"""Signed distance of a point from obstacles.

All functions are analytic: points may be a tiny complex step away from real ones, and the imaginary part of the result
is then the derivative in that direction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.compiled import compiled, kernel

KINDS = SPHERE, BOX, CYLINDER, CAPSULE = 0, 1, 2, 3  # of shapes that `from_surface` knows
GRID = 4

SHAPE = np.dtype(
    [
        ("kind", np.int64),
        ("position", np.float64, 3),  # origin of its own frame, metres
        ("axes", np.float64, (3, 3)),  # axes of that frame as columns
        ("half", np.float64, 3),  # half sizes along them, metres
        ("scale", np.float64),  # of a grid: metres for one unit of its frame, which the rest is in
        ("first", np.float64, 3),  # its first node
        ("cell", np.float64),  # distance between neighbouring nodes
        ("counts", np.int64, 3),  # number of nodes along each axis
        ("begin", np.int64),  # index of its first value
        ("margin", np.float64),  # smallest distance of what it encloses from its border
        ("centre", np.float64, 3),  # centre of the ball that holds that
        ("radius", np.float64),  # and the ball's radius
    ]
)
"""An obstacle; what a kind does not have is zero."""

Number = Any  # a float, or a complex number for derivatives
Record = Any  # an element of an array of records, whose fields are attributes in compiled code
Shapes = NDArray[Any]  # (K,) obstacles of dtype `SHAPE`
Values = NDArray[np.float32]  # (V,) signed distances of the nodes of all grids, last axis fastest


@kernel
def distances(shapes: Shapes, values: Values, points: NDArray[Any]) -> NDArray[Any]:
    """Distances (N,) of points (N, 3) from the nearest surface, metres, negative inside; infinite without obstacles."""
    found = np.empty(len(points), points.dtype)
    found[:] = np.inf
    for i in range(len(points)):
        for k in range(len(shapes)):
            away = distance(shapes[k], values, points[i, 0], points[i, 1], points[i, 2])
            if away.real < found[i].real:
                found[i] = away
    return found


def batch(s: NDArray[Any]) -> NDArray[Any]:
    """Return points (*B, 3) as an array (N, 3) for which `distances` is compiled."""
    return np.ascontiguousarray(s.reshape(-1, 3), complex if np.iscomplexobj(s) else float)


@compiled
def distance(shape: Record, values: Values, x: Number, y: Number, z: Number) -> Number:
    """Distance of a point from the surface of an obstacle, metres, negative inside."""
    x, y, z = x - shape.position[0], y - shape.position[1], z - shape.position[2]
    axes = shape.axes
    u = axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z
    v = axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z
    w = axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z
    if shape.kind == GRID:
        return shape.scale * _on_grid(shape, values, u / shape.scale, v / shape.scale, w / shape.scale)
    return from_surface(shape.kind, shape.half[0], shape.half[1], shape.half[2], u, v, w)


@compiled
def from_surface(kind: int, a: float, b: float, c: float, u: Number, v: Number, w: Number) -> Number:
    """Distance of a point (u, v, w) from the surface of a shape of half sizes (a, b, c) about 0, negative inside."""
    if kind == SPHERE:
        return np.sqrt(u * u + v * v + w * w) - a
    u, v, w = _magnitude(u), _magnitude(v), _magnitude(w)
    if kind == BOX:
        return _beyond_faces(u - a, v - b, w - c)
    if kind == CYLINDER:
        return _beyond_edge(np.sqrt(u * u + v * v) - a, w - c)
    if kind == CAPSULE:
        along = _positive(w - (c - a))
        return np.sqrt(u * u + v * v + along * along) - a
    return np.nan * u


@compiled
def _beyond_faces(x: Number, y: Number, z: Number) -> Number:
    """Distance from a box by the excess of each coordinate over its half size."""
    deepest = _larger(_larger(x, y), z)
    if deepest.real <= 0:
        return deepest
    x, y, z = _positive(x), _positive(y), _positive(z)
    return np.sqrt(x * x + y * y + z * z)


@compiled
def _beyond_edge(across: Number, along: Number) -> Number:
    """Distance from a cylinder by the excess across and along its axis."""
    deepest = _larger(across, along)
    if deepest.real <= 0:
        return deepest
    across, along = _positive(across), _positive(along)
    return np.sqrt(across * across + along * along)


@compiled
def _on_grid(shape: Record, values: Values, u: Number, v: Number, w: Number) -> Number:
    """Interpolate a distance grid by quadratic splines; see `dt_viz.obstacles.solids.DistanceGrid`."""
    first, counts, cell = shape.first, shape.counts, shape.cell
    a, i, beyond_x = _within((u - first[0]) / cell, counts[0])
    b, j, beyond_y = _within((v - first[1]) / cell, counts[1])
    c, n, beyond_z = _within((w - first[2]) / cell, counts[2])
    stride = counts[2]
    node = shape.begin + ((i - 1) * counts[1] + (j - 1)) * stride + n - 1
    value = 0 * u
    for p in range(3):
        for q in range(3):
            at = node + (p * counts[1] + q) * stride
            row = weight(c, 0) * values[at] + weight(c, 1) * values[at + 1]
            value += weight(a, p) * weight(b, q) * (row + weight(c, 2) * values[at + 2])
    if beyond_x != 0 or beyond_y != 0 or beyond_z != 0:
        x, y, z, margin = cell * beyond_x, cell * beyond_y, cell * beyond_z, shape.margin
        value = _larger(value, margin + 0 * value)
        sides = _magnitude(x) + _magnitude(y) + _magnitude(z)
        value = np.sqrt(value * value + x * x + y * y + z * z + 2 * margin * sides)
    x, y, z = u - shape.centre[0], v - shape.centre[1], w - shape.centre[2]
    return _larger(value, np.sqrt(x * x + y * y + z * z) - shape.radius)


@compiled
def _within(t: Number, count: int) -> tuple[Number, int, Number]:
    """Offset of a coordinate, in cells, from its nearest inner node, that node, and how far it is beyond the grid."""
    clipped = t
    if t.real < 0.5:
        clipped = 0 * t + 0.5
    elif t.real > count - 1.5:
        clipped = 0 * t + count - 1.5
    node = min(int(clipped.real + 0.5), count - 2)
    return clipped - node, node, t - clipped


@compiled
def weight(f: Number, k: int) -> Number:
    """Weight of the k-th of three nodes at an offset from the middle one, of the quadratic B-spline."""
    if k == 0:
        return 0.5 * (0.5 - f) ** 2
    return 0.75 - f * f if k == 1 else 0.5 * (0.5 + f) ** 2


@compiled
def _magnitude(x: Number) -> Number:
    return -x if x.real < 0 else x


@compiled
def _positive(x: Number) -> Number:
    return x if x.real > 0 else 0 * x


@compiled
def _larger(x: Number, y: Number) -> Number:
    return y if y.real > x.real else x
