"""The smallest sphere around spheres."""

from __future__ import annotations

import math

from dt_viz.kernels.arm import Array
from dt_viz.kernels.compiled import kernel


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
