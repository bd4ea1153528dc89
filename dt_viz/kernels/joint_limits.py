"""The map that keeps joints inside their limits: the formulas of `avoidance.arm_field.JointLimits`, joint by joint."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.arm import Array
from dt_viz.kernels.compiled import short_kernel


@short_kernel
def stretched(q: Array, lower: Array, upper: Array, zone: float, part: float) -> tuple[Array, Array]:
    """Map angles q (N, n), rad, which may be a tiny complex step away from real ones.

    Args:
        q: (N, n) rad.
        lower: (n,) limits, rad, −inf for continuous joints.
        upper: (n,) the same, +inf for continuous joints.
        zone: width m of the zones before the limits, rad.
        part: p; a joint at the depth e in its zone goes to the depth f·e, f = 1/√(1 + p(e/m)²).

    Returns:
        The image (N, n), and the factors f (N, n).
    """
    mapped, factor = q.copy(), np.ones_like(q)
    for row in range(len(q)):
        for i in range(q.shape[1]):
            angle = q[row, i]
            border = min(max(angle.real, lower[i] + zone), upper[i] - zone)
            if border != angle.real:
                depth = angle - border
                factor[row, i] = 1 / np.sqrt(1 + part * (depth / zone) ** 2)
                mapped[row, i] = border + factor[row, i] * depth
    return mapped, factor
