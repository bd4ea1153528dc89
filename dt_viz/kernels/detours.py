"""How far the arm would have to be shifted in each direction to leave an obstacle."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.arm import Array
from dt_viz.kernels.compiled import kernel, short_kernel


@kernel
def detours(
    directions: Array, points: Array, radius: Array, centres: Array, radii: Array, margin: float, length: float
) -> tuple[Array, Array]:
    """Find how far the arm has to be shifted until none of its spheres is nearer than a margin to a ball.

    A ball that a sphere would meet only after more than `length` metres of the shift is not in the way.

    Args:
        directions: (D, 3) unit vectors.
        points: (P, 3, M) centres of the arm's spheres at M samples, metres.
        radius: (P,) their radii, metres.
        centres: (B, 3) centres of the balls that cover the obstacle, metres.
        radii: (B,) their radii, metres.
        margin: required distance, metres.
        length: see above.

    Returns:
        For each direction the shift (D,), and the greatest depth (D,) below the plane z = 0 of the spheres that are
        near a ball, each shifted as far as it needs itself, metres.
    """
    shifts, depths = np.zeros(len(directions)), np.zeros(len(directions))
    u, v, w = directions[:, 0].copy(), directions[:, 1].copy(), directions[:, 2].copy()
    for b in range(len(centres)):
        for p in range(len(points)):
            apart = radii[b] + margin + radius[p]
            for m in range(points.shape[2]):
                x, y = points[p, 0, m] - centres[b, 0], points[p, 1, m] - centres[b, 1]
                z = points[p, 2, m] - centres[b, 2]
                room = x * x + y * y + z * z - apart * apart
                if room >= 4 * length * (apart + length):
                    continue
                lowest = points[p, 2, m] - radius[p]
                for d in range(len(u)):
                    # along the direction it meets the ball, grown by `apart`, at −along ± root
                    along = u[d] * x + v[d] * y + w[d] * z
                    root = np.sqrt(max(along * along - room, 0.0))
                    in_the_way = (root > along) & (along + root > -length) & (along * along > room)
                    shift = root - along if in_the_way else 0.0
                    shifts[d] = max(shifts[d], shift)
                    depths[d] = max(depths[d], -lowest - shift * w[d])
    return shifts, depths


@short_kernel
def distinct(directions: Array, cost: Array, alike: float, selectivity: float, num: int) -> tuple[Array, Array]:
    """Gather directions that are alike, those about the cheapest first.

    Args:
        directions: (D, 3) unit vectors.
        cost: (D,) their costs; infinite where they are out of the question.
        alike: cosine of the largest angle from the cheapest direction of a group.
        selectivity: relative difference in cost over which a direction's share in its group's mean falls by e.
        num: largest number of groups.

    Returns:
        For F groups the means (F, 3), unit vectors, and the least costs (F,).
    """
    num = min(num, len(cost))
    left, means, costs, found = cost.copy(), np.zeros((num, 3)), np.empty(num), 0
    while found < num and left.min() < np.inf:
        best, mean = left.argmin(), means[found]
        costs[found] = least = left[best]
        for d in range(len(directions)):
            if directions[d] @ directions[best] > alike and left[d] < np.inf:
                mean += (
                    np.exp((least - left[d]) / (selectivity * least)) * directions[d] if least > 0 else directions[d]
                )
                left[d] = np.inf
        mean /= np.sqrt(mean @ mean)
        found += 1
    return means[:found], costs[:found]
