"""Distances of an arm's body points from obstacles, each other and the table, and how joints change them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.arm import Array, BodyPoints, Joints, chain, holds_others, placed
from dt_viz.kernels.compiled import compiled, kernel, short_kernel
from dt_viz.kernels.distances import Record, Shapes, Values, distance

COMPLEX_STEP = 1e-30
Indices = NDArray[Any]
Point = tuple[float, float, float]


@compiled
def _slopes(axes: Array, origins: Array, first: int, last: int, place: Point, away: Point, slopes: Array) -> None:
    """Write how joints `first` to `last` move what is at a place (3,) along `away` (3,), to `slopes` (n,), m/rad."""
    x, y, z = place
    for i in range(first, last + 1):  # what joint i turns moves along its axis times the lever
        u, v, w = x - origins[i, 0], y - origins[i, 1], z - origins[i, 2]
        along_x = axes[i, 2, 1] * w - axes[i, 2, 2] * v
        along_y = axes[i, 2, 2] * u - axes[i, 2, 0] * w
        along_z = axes[i, 2, 0] * v - axes[i, 2, 1] * u
        slopes[i] = away[0] * along_x + away[1] * along_y + away[2] * along_z


@short_kernel
def proximity(
    joints: Joints, points: BodyPoints, shapes: Shapes, values: Values, q: Array, reach: float
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Find the pairs of a part of the arm and an obstacle that are within `reach` at the posture q (n,).

    A part is what an outermost sphere of the tree holds; its place is that of its sphere that is nearest.

    Returns:
        For M pairs the obstacle (M,), the distance of the part from it (M,), metres, the slope of that distance by the
        joints (M, n), m/rad, and by the part's place (M, 3), which is the way away from the obstacle.
    """
    n, num = len(joints), len(shapes) * len(points)
    axes, origins = np.empty((n, 3, 3)), np.empty((n, 3))
    part, nearest, slopes, outward = np.empty(num, np.int64), np.empty(num), np.zeros((num, n)), np.empty((num, 3))
    chain(joints, q, axes, origins)
    found, outer, step = 0, 0, COMPLEX_STEP * 1j
    while outer < len(points):
        joint, end = points[outer].joint, points[outer].end
        for k in range(len(shapes)):
            nearest[found], p, place = reach, outer, (0.0, 0.0, 0.0)
            while p < end:
                at = _place(points[p], axes, origins)
                away = distance(shapes[k], values, at[0], at[1], at[2]) - points[p].radius
                if away < nearest[found] and not holds_others(points, p):
                    nearest[found], place = away, at
                p = p + 1 if away < nearest[found] else points[p].end
            if nearest[found] >= reach:
                continue
            x, y, z = place
            a = distance(shapes[k], values, x + step, y + 0j, z + 0j).imag / COMPLEX_STEP
            b = distance(shapes[k], values, x + 0j, y + step, z + 0j).imag / COMPLEX_STEP
            c = distance(shapes[k], values, x + 0j, y + 0j, z + step).imag / COMPLEX_STEP
            _slopes(axes, origins, 0, joint, place, (a, b, c), slopes[found])
            part[found] = k
            outward[found, 0], outward[found, 1], outward[found, 2] = a, b, c
            found += 1
        outer = end
    return part[:found], nearest[:found], slopes[:found], outward[:found]


@short_kernel
def contacts(
    joints: Joints, points: BodyPoints, pairs: Indices, q: Array, reach: float
) -> tuple[NDArray[np.int64], Array, Array]:
    """Find which parts of the arm are within `reach` of each other, or of the table z = 0, at the posture q (n,).

    Args:
        joints: of the arm.
        points: those of joint −1 are fixed to the base.
        pairs: (M, 2) indices of outermost spheres, that nearer to the base first; where that is −1 it is the table.
        q: angles, rad.
        reach: metres.

    Returns:
        For L pairs their index (L,), their distance (L,), metres, and its slope by the joints (L, n), m/rad.
    """
    n, num, found = len(joints), len(pairs), 0
    axes, origins, at = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(points), 3))
    which, apart, slopes = np.empty(num, np.int64), np.empty(num), np.zeros((num, n))
    _pose(joints, points, q, axes, origins, at)
    for m in range(num):
        a, b = int(pairs[m, 0]), int(pairs[m, 1])
        if _bound(points, at, a, b) >= reach:
            continue
        nearest, place, away = _apart(points, a, b, axes, origins, reach)
        if nearest >= reach:
            continue
        first = points[a].joint + 1 if a >= 0 else 0  # joints up to that of the first one move both
        _slopes(axes, origins, first, points[b].joint, place, away, slopes[found])
        which[found], apart[found] = m, nearest
        found += 1
    return which[:found], apart[:found], slopes[:found]


@short_kernel
def least_contacts(joints: Joints, points: BodyPoints, pairs: Indices, q: Array, enough: float) -> Array:
    """Find the smallest distances (M,), metres, of the same pairs at postures q (N, n), up to what is enough."""
    n, least = len(joints), np.full(len(pairs), enough)
    axes, origins, at = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(points), 3))
    for row in range(len(q)):
        _pose(joints, points, q[row], axes, origins, at)
        for m in range(len(pairs)):
            a, b = int(pairs[m, 0]), int(pairs[m, 1])
            if _bound(points, at, a, b) < least[m]:
                least[m] = _apart(points, a, b, axes, origins, least[m])[0]
    return least


@compiled
def _pose(joints: Joints, points: BodyPoints, q: Array, axes: Array, origins: Array, at: Array) -> None:
    """Write the frames of the joints and the places of the outermost spheres, `at` (P, 3), metres."""
    chain(joints, q, axes, origins)
    p = 0
    while p < len(points):
        at[p, 0], at[p, 1], at[p, 2] = _place(points[p], axes, origins)
        p = points[p].end


@compiled
def _bound(points: BodyPoints, at: Array, a: int, b: int) -> float:
    """Find the distance of sphere b from sphere a, or from the table where that is −1."""
    if a < 0:
        return at[b, 2] - points[b].radius
    u, v, w = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1], at[b, 2] - at[a, 2]
    return np.sqrt(u * u + v * v + w * w) - points[a].radius - points[b].radius


@compiled
def _place(point: Record, axes: Array, origins: Array) -> Point:
    """Find the place (3,), metres, of a body point."""
    offset, joint = point.offset, point.joint
    if joint < 0:
        return offset[0], offset[1], offset[2]
    return (
        placed(offset, joint, axes, origins, 0),
        placed(offset, joint, axes, origins, 1),
        placed(offset, joint, axes, origins, 2),
    )


@compiled
def _apart(
    points: BodyPoints, a: int, b: int, axes: Array, origins: Array, enough: float
) -> tuple[float, Point, Point]:
    """Find the distance of what sphere b holds from what a holds, or from the table where that is −1, up to `enough`.

    Returns:
        The distance, and of the nearest sphere in b the place and the direction away from a.
    """
    nearest, place, away, i = enough, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), b
    while i < points[b].end:
        at, radius = _place(points[i], axes, origins), points[i].radius
        if a < 0:
            gap, found = at[2] - radius, away
        else:
            length, found = _from_sphere(points, a, at, axes, origins, nearest + radius)
            gap = length - radius if length < nearest + radius else nearest
        if gap < nearest and not holds_others(points, i):
            nearest, place, away = gap, at, found
        i = i + 1 if gap < nearest else points[i].end
    return nearest, place, away


@compiled
def _from_sphere(
    points: BodyPoints, a: int, place: Point, axes: Array, origins: Array, enough: float
) -> tuple[float, Point]:
    """Find the distance of a place from what sphere a holds, up to `enough`, and the direction away from there."""
    nearest, away, i = enough, (0.0, 0.0, 1.0), a
    while i < points[a].end:
        at = _place(points[i], axes, origins)
        u, v, w = place[0] - at[0], place[1] - at[1], place[2] - at[2]
        length = np.sqrt(u * u + v * v + w * w)
        gap = length - points[i].radius
        if gap < nearest and not holds_others(points, i):
            nearest, away = gap, (u / length, v / length, w / length)
        i = i + 1 if gap < nearest else points[i].end
    return nearest, away


@kernel
def step_to_the_farthest(centre: Array, spheres: Array, num: int) -> None:
    """Move a centre (3,) `num` times towards the farthest of the spheres (N, 4), by ever smaller parts of the way."""
    for step in range(2, num + 2):
        farthest, longest, length = 0, -1.0, 0.0
        for k in range(len(spheres)):
            x, y, z = spheres[k, 0] - centre[0], spheres[k, 1] - centre[1], spheres[k, 2] - centre[2]
            apart = math.sqrt(x * x + y * y + z * z)
            if apart + spheres[k, 3] > longest:
                farthest, longest, length = k, apart + spheres[k, 3], apart
        if length:
            part = 1 + spheres[farthest, 3] / length
            for axis in range(3):
                centre[axis] += (spheres[farthest, axis] - centre[axis]) * part / step
