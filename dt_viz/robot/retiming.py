"""Joint velocity limits: a sampled motion is delayed where it is too fast, and slows down gradually before that.

A positive rescaling of time changes no orbit: the arm passes through the same configurations, only later, so its path
stays free of obstacles and within the joint limits, and still ends at the goal.
"""

import numpy as np

from dt_viz.flows.fields import Array

RAMP = 0.3
"""Shortest time in which a motion slows down from its own pace to a standstill, or back, seconds."""
NEGLIGIBLE = 1e-6
"""Delay of a segment, seconds, up to which the motion around it does not slow down."""


def within_velocity_limits(times: Array, q: Array, limits: Array) -> Array:
    """Delay a motion so that it respects the joint velocity limits.

    The progress of the motion is the rate g = dt/ds of its own time t in the new time s: at most 1, and at most what
    each segment allows. It changes at most at the rate 1/`RAMP`, and since dg/ds = ½ d(g²)/dt, its square is the
    largest function below the squares of what the segments allow whose slope in t nowhere exceeds 2/`RAMP`:

        g²(t) = minₖ (gₖ² + 2 |t − segment k| / RAMP),     s = ∫ dt/g.

    Between two samples g² rises, stays at what the segment allows, and falls, so that its integral is exact. Where a
    motion jumps (g = 0), it comes to rest, crosses the gap at the limit, and goes on.

    Args:
        times: (T,) seconds, not decreasing.
        q: (T, n) joint angles, rad; those of continuous joints unwrapped.
        limits: (n,) rad/s, greater than 0.

    Returns:
        (T,) seconds, from the same start: no interval is shorter than before, and in none is a joint's mean speed above
        its limit (up to rounding). A motion that respects the limits keeps its times, bit for bit.
    """
    intervals, least = np.diff(times), (np.abs(np.diff(q, axis=0)) / limits).max(axis=1)  # at a joint's limit
    if (least <= intervals).all():
        return times
    slows = least > intervals + NEGLIGIBLE
    allowed = np.ones_like(intervals)  # g² of each segment
    np.divide(intervals, least, out=allowed, where=slows)
    np.square(allowed, out=allowed)
    slope = 2 / RAMP
    sources = np.where(slows, allowed, np.inf)
    behind = np.minimum.accumulate(sources - slope * times[1:]) + slope * times[1:]
    ahead = np.minimum.accumulate((sources + slope * times[:-1])[::-1])[::-1] - slope * times[:-1]
    nodes = np.ones_like(times)  # g² at the samples; the minima with `sources` undo rounding
    nodes[1:] = np.minimum(np.minimum(behind, sources), nodes[1:])
    nodes[:-1] = np.minimum(np.minimum(ahead, sources), nodes[:-1])
    nodes = np.maximum(nodes, 0.0)

    highest = np.minimum(allowed, (nodes[:-1] + nodes[1:] + slope * intervals) / 2)
    ramps = 2 * highest - nodes[:-1] - nodes[1:]  # how much g² rises and falls within a segment
    at_nodes, at_highest = np.sqrt(nodes), np.sqrt(highest)
    level = np.maximum(intervals - ramps / slope, 0.0)  # of the segment, in its own time
    np.divide(level, at_highest, out=level, where=at_highest > 0)
    new = level + 2 / slope * (2 * at_highest - at_nodes[:-1] - at_nodes[1:])
    delays = np.maximum(np.maximum(new, least) - intervals, 0.0)
    return times + np.concatenate([[0.0], np.cumsum(delays)])
