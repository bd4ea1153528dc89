"""Distances of an arm's body points from obstacles, and how joints change them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.arm import Array, BodyPoints, Joints, chain, placed
from dt_viz.kernels.compiled import short_kernel
from dt_viz.kernels.distances import Shapes, Values, distance

COMPLEX_STEP = 1e-30


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
            for i in range(joint + 1):  # what joint i turns moves along its axis times the lever
                u, v, w = x - origins[i, 0], y - origins[i, 1], z - origins[i, 2]
                along_x = axes[i, 2, 1] * w - axes[i, 2, 2] * v
                along_y = axes[i, 2, 2] * u - axes[i, 2, 0] * w
                along_z = axes[i, 2, 0] * v - axes[i, 2, 1] * u
                slopes[found, i] = a * along_x + b * along_y + c * along_z
            part[found], nearest[found] = k, away
            outward[found, 0], outward[found, 1], outward[found, 2] = a, b, c
            found += 1
    return part[:found], nearest[:found], slopes[:found], outward[:found]
