"""Which way an arm dodges obstacles that move: the velocities that lead furthest from where they are going to be."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.arm import Array, BodyPoints, Joints, chain, placed
from dt_viz.kernels.compiled import compiled, short_kernel
from dt_viz.kernels.distances import Shapes, Values, distance

AT_ONCE = 3
"""Number of joints whose velocities are chosen together: those that carry the hand, then those that turn it."""
ENOUGH = 1.0
"""Distance, in deviations of the obstacle from where it is expected, beyond which more is worth nothing."""


@compiled
def _room(
    joints: Joints,
    points: BodyPoints,
    shapes: Shapes,
    values: Values,
    motion: Array,
    q: Array,
    velocity: Array,
    wanted: Array,
    bounds: Array,
    acceleration: float,
    times: Array,
    least: float,
) -> float:
    """Find the smallest distance, in deviations and at most `ENOUGH`, of an arm that turns to velocities `wanted` (n,).

    Each joint changes its velocity as fast as it may and keeps it then. Ends early where it is below `least`. Other
    arguments as in `dodge`.
    """
    n, smallest = len(joints), ENOUGH
    axes, origins, p = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n)
    for t in times:
        for i in range(n):
            change = wanted[i] - velocity[i]
            ramp = min(abs(change) / acceleration, t)
            turned = velocity[i] * t + np.sign(change) * acceleration * ramp * (t - ramp / 2)
            p[i] = min(max(q[i] + turned, bounds[0, i]), bounds[1, i])
        chain(joints, p, axes, origins)
        for k in range(len(points)):
            offset, joint = points[k].offset, points[k].joint
            x, y = placed(offset, joint, axes, origins, 0), placed(offset, joint, axes, origins, 1)
            z = placed(offset, joint, axes, origins, 2)
            for o in range(len(shapes)):
                u, v, w = x - t * motion[o, 0], y - t * motion[o, 1], z - t * motion[o, 2]
                away = distance(shapes[o], values, u, v, w) - points[k].radius - motion[o, 3]
                smallest = min(smallest, away / (motion[o, 4] + t * motion[o, 5]))
        if smallest < least:
            break
    return smallest


@short_kernel
def dodge(
    joints: Joints,
    points: BodyPoints,
    shapes: Shapes,
    values: Values,
    motion: Array,
    q: Array,
    velocity: Array,
    wanted: Array,
    before: Array,
    bounds: Array,
    acceleration: float,
    times: Array,
    gain: float,
) -> tuple[bool, Array]:
    """Choose velocities (n,), rad/s, for an arm at q (n,) that has `velocity` (n,).

    Those that are wanted, if they lead past all obstacles. Else of the standstill and the largest velocities of both
    senses, for some joints after the others, those that leave most room; of several that leave enough, those nearest to
    what is wanted.

    Args:
        joints: of the arm.
        points: of its links.
        shapes: (P,) obstacles.
        values: of their grids.
        motion: (P, 6) velocity of each, m/s, distance that is kept, metres, its deviation from where it is expected,
            metres, and the growth of that, m/s.
        q: angles, rad.
        velocity: rad/s.
        wanted: (n,) rad/s.
        before: (n,) chosen just before, rad/s; kept where others do not leave `gain` more room.
        bounds: (3, n) smallest and largest angles, rad, and largest velocities, rad/s.
        acceleration: largest one, rad/s².
        times: (T,) at which distances are looked at, seconds.
        gain: in deviations.

    Returns:
        Whether what is wanted leads past them, and the velocities.
    """
    most = _room(joints, points, shapes, values, motion, q, velocity, wanted, bounds, acceleration, times, -np.inf)
    if most >= ENOUGH:
        return True, wanted
    chosen = wanted.copy()
    kept = _room(joints, points, shapes, values, motion, q, velocity, before, bounds, acceleration, times, most)
    if kept > most:
        most, chosen = min(kept + gain, ENOUGH), before.copy()
    tried = chosen.copy()
    for first in range(0, len(q), AT_ONCE):
        last, base = min(first + AT_ONCE, len(q)), chosen.copy()
        for number in range(3 ** (last - first)):
            tried[:] = base
            for i in range(first, last):
                tried[i] = (number // 3 ** (i - first) % 3 - 1) * bounds[2, i]
            left = _room(joints, points, shapes, values, motion, q, velocity, tried, bounds, acceleration, times, most)
            nearer = ((tried - wanted) ** 2).sum() < ((chosen - wanted) ** 2).sum()
            if left > most or (left == most and nearer):
                most = left
                chosen[:] = tried
    return False, chosen
