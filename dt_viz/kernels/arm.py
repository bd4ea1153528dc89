"""Kinematics of an arm, posture by posture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.compiled import compiled, short_kernel
from dt_viz.kernels.distances import Number

JOINT = np.dtype(
    [
        ("rotation", np.float64, (3, 3)),  # orientation in the joint before, at angle zero
        ("translation", np.float64, 3),  # position there, metres
    ]
)
"""A joint, which turns about its own z axis."""
BODY_POINT = np.dtype(
    [
        ("joint", np.int64),  # that it moves with
        ("offset", np.float64, 3),  # position in that joint's frame, metres
        ("radius", np.float64),  # of its sphere, metres
        ("end", np.int64),  # index of the next one that it does not hold
    ]
)
"""A point of a link with its sphere. A list of them is a tree, depth first: each holds those up to its `end`.

The spheres that hold no others cover the links. They are inside all that hold them, which bound their distances.
"""

Array = NDArray[Any]  # of floats, or of complex numbers for derivatives
Joints = NDArray[Any]  # (n,) joints of dtype `JOINT`, from the base to the hand
BodyPoints = NDArray[Any]  # (P,) body points of dtype `BODY_POINT`, not decreasing by joint


@compiled
def chain(joints: Joints, q: Array, axes: Array, origins: Array) -> None:
    """Write the frames of the joints at angles q (n,): `axes` (n, 3, 3) [joint, column, component], `origins` (n, 3).

    Frame i is frame i − 1 times the joint's fixed rotation R_i, then a turn by q_i about its z axis.
    """
    for i in range(len(joints)):
        cos, sin = np.cos(q[i]), np.sin(q[i])
        R, shift = joints[i].rotation, joints[i].translation
        for k in range(3):
            if i == 0:
                x, y, z = R[k, 0] + 0 * cos, R[k, 1] + 0 * cos, R[k, 2] + 0 * cos
                origins[0, k] = shift[k]
            else:
                a, b, c = axes[i - 1, 0, k], axes[i - 1, 1, k], axes[i - 1, 2, k]
                x = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
                y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
                z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
                origins[i, k] = origins[i - 1, k] + shift[0] * a + shift[1] * b + shift[2] * c
            axes[i, 0, k] = x * cos + y * sin
            axes[i, 1, k] = y * cos - x * sin
            axes[i, 2, k] = z


@compiled
def holds_others(points: BodyPoints, p: int) -> bool:
    """Return whether the sphere of body point p holds others."""
    return points[p].end > p + 1


@compiled
def placed(offset: Array, joint: int, axes: Array, origins: Array, k: int) -> Number:
    """Coordinate k, metres, of what is fixed to a joint at an offset (3,)."""
    turned = offset[0] * axes[joint, 0, k] + offset[1] * axes[joint, 1, k] + offset[2] * axes[joint, 2, k]
    return origins[joint, k] + turned


@short_kernel
def chains(joints: Joints, q: Array) -> tuple[Array, Array]:
    """Frames at angles q (N, n), batch last: axes (n, 3, 3, N) [joint, column, component] and origins (n, 3, N)."""
    num, n = q.shape
    axes, origins = np.empty((n, 3, 3, num), q.dtype), np.empty((n, 3, num), q.dtype)
    for row in range(num):
        chain(joints, q[row], axes[..., row], origins[..., row])
    return axes, origins


@short_kernel
def places(joints: Joints, offset: Array, q: Array) -> Array:
    """Places (N, 3), metres, at angles q (N, n) of what is fixed to the last joint at an offset (3,)."""
    n, result = len(joints), np.empty((len(q), 3), q.dtype)
    axes, origins = np.empty((n, 3, 3), q.dtype), np.empty((n, 3), q.dtype)
    for row in range(len(q)):
        chain(joints, q[row], axes, origins)
        for k in range(3):
            result[row, k] = placed(offset, n - 1, axes, origins, k)
    return result
