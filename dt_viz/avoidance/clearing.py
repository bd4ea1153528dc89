"""Until clear: how long a flow takes to carry points out of something."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.flows.fields import Array, VectorField

Lack = Callable[[Array, float], Array]
"""What points (N, d) lack to be clear, (N,), at most 0 where they are; beyond the given lack, only that."""


def clearing_duration(field: VectorField, points: Array, lack: Lack, step: float, longest: float) -> float | None:
    """Find the shortest duration after which the reverse flow of a field has carried all points (N, d) clear.

    γ is a one-parameter group, so one integration with snapshots, at each `step` of RK4, passes every duration on its
    way; points that are clear stay clear and are dropped. Between the last two snapshots the duration is interpolated.

    Returns None where some point is not clear after the longest one.
    """
    duration, before = 0.0, points
    while (lacking := lack(points, 1e-4) > 0).any():  # whether, not how much
        if duration >= longest:
            return None
        before = points[lacking]
        points = Flow(field, step, 1).inverse(before)
        duration += step
    if not duration:
        return 0.0
    lacked, left = lack(before, np.inf), lack(points, np.inf)
    return duration - step + step * float((lacked / np.maximum(lacked - left, 1e-12)).clip(0, 1).max())
