"""Distances of an arm's body points from obstacles, each other and the table, and how joints change them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.arm import Array, BodyPoints, Joints, chain, placed
from dt_viz.kernels.compiled import compiled, short_kernel
from dt_viz.kernels.distances import Shapes, Values, distance

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
    """Find what is near an obstacle at the posture q (n,): the pairs of a body point and an obstacle within `reach`.

    Returns:
        For M pairs the obstacle (M,), the distance of the body point's sphere from it (M,), metres, the slope of that
        distance by the joints (M, n), m/rad, and by the point's place (M, 3), which is the way away from the obstacle.
    """
    n, num = len(joints), len(shapes) * len(points)
    axes, origins = np.empty((n, 3, 3)), np.empty((n, 3))
    part, nearest, slopes, outward = np.empty(num, np.int64), np.empty(num), np.zeros((num, n)), np.empty((num, 3))
    chain(joints, q, axes, origins)
    found, step = 0, COMPLEX_STEP * 1j
    for p in range(len(points)):
        offset, joint = points[p].offset, points[p].joint
        x, y = placed(offset, joint, axes, origins, 0), placed(offset, joint, axes, origins, 1)
        z = placed(offset, joint, axes, origins, 2)
        for k in range(len(shapes)):
            away = distance(shapes[k], values, x, y, z) - points[p].radius
            if away >= reach:
                continue
            a = distance(shapes[k], values, x + step, y + 0j, z + 0j).imag / COMPLEX_STEP
            b = distance(shapes[k], values, x + 0j, y + step, z + 0j).imag / COMPLEX_STEP
            c = distance(shapes[k], values, x + 0j, y + 0j, z + step).imag / COMPLEX_STEP
            _slopes(axes, origins, 0, joint, (x, y, z), (a, b, c), slopes[found])
            part[found], nearest[found] = k, away
            outward[found, 0], outward[found, 1], outward[found, 2] = a, b, c
            found += 1
    return part[:found], nearest[:found], slopes[:found], outward[:found]


@short_kernel
def contacts(joints: Joints, points: BodyPoints, pairs: Indices, q: Array) -> tuple[Array, Array]:
    """Find the distances of pairs of body points, or of one and the table z = 0, at the posture q (n,).

    Args:
        joints: of the arm.
        points: those of joint −1 are fixed to the base.
        pairs: (M, 2) indices of points, that nearer to the base first; where that is −1 it is the table.
        q: angles, rad.

    Returns:
        The distances (M,) of their spheres, metres, and their slopes by the joints (M, n), m/rad.
    """
    n, num = len(joints), len(pairs)
    axes, origins, at = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(points), 3))
    apart, slopes = np.empty(num), np.zeros((num, n))
    _place(joints, points, q, axes, origins, at)
    for m in range(num):
        a, b = int(pairs[m, 0]), int(pairs[m, 1])
        apart[m], away = _apart(points, at, a, b)
        first = points[a].joint + 1 if a >= 0 else 0  # joints up to that of the first one move both
        _slopes(axes, origins, first, points[b].joint, (at[b, 0], at[b, 1], at[b, 2]), away, slopes[m])
    return apart, slopes


@short_kernel
def least_contacts(joints: Joints, points: BodyPoints, pairs: Indices, q: Array) -> Array:
    """Find the smallest distances (M,), metres, of the same pairs at postures q (N, n)."""
    n, least = len(joints), np.full(len(pairs), np.inf)
    axes, origins, at = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(points), 3))
    for row in range(len(q)):
        _place(joints, points, q[row], axes, origins, at)
        for m in range(len(pairs)):
            least[m] = min(least[m], _apart(points, at, int(pairs[m, 0]), int(pairs[m, 1]))[0])
    return least


@compiled
def _place(joints: Joints, points: BodyPoints, q: Array, axes: Array, origins: Array, at: Array) -> None:
    """Write the frames of the joints and the places of the points `at` (P, 3), metres."""
    chain(joints, q, axes, origins)
    for k in range(len(points)):
        offset, joint = points[k].offset, points[k].joint
        for c in range(3):
            at[k, c] = offset[c] if joint < 0 else placed(offset, joint, axes, origins, c)


@compiled
def _apart(points: BodyPoints, at: Array, a: int, b: int) -> tuple[float, Point]:
    """Find the distance of point b from a, or from the table where that is −1, and the direction away from there."""
    if a < 0:
        return at[b, 2] - points[b].radius, (0.0, 0.0, 1.0)
    u, v, w = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1], at[b, 2] - at[a, 2]
    length = np.sqrt(u * u + v * v + w * w)
    return length - points[a].radius - points[b].radius, (u / length, v / length, w / length)
