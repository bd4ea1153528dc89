"""Which way an arm dodges obstacles that move: the velocities that lead furthest from where they are going to be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dt_viz.kernels.arm import Array, BodyPoints, Joints, chain, holds_others, placed
from dt_viz.kernels.compiled import compiled, short_kernel
from dt_viz.kernels.distances import Shapes, Values, distance

AT_ONCE = 3
"""Number of joints whose velocities are chosen together: those that carry the hand, then those that turn it."""
ENOUGH = 1.0
"""Distance, in deviations of the obstacle from where it is expected, beyond which more is worth nothing."""


class LimitedArm(NamedTuple):
    """An arm and its limits."""

    joints: Joints
    points: BodyPoints  # of its links
    lower: Array  # (n,) smallest angles, rad
    upper: Array  # (n,) largest angles, rad
    fastest: Array  # (n,) largest velocities, rad/s
    acceleration: float  # largest one, rad/s²


class Forecast(NamedTuple):
    """Where obstacles are going to be."""

    shapes: Shapes  # (P,) obstacles
    values: Values  # of their grids
    times: Array  # (T,) at which distances are looked at, seconds from now
    moved: Array  # (T, P, 3) displacement until then, metres
    deviation: Array  # (T, P) deviation from there, metres
    kept: float  # distance that is kept, metres
    floor: float  # height that is kept, metres
    depth: float  # depth below it that counts as much as one deviation, metres


@compiled
def _room(arm: LimitedArm, forecast: Forecast, q: Array, velocity: Array, wanted: Array, least: float) -> float:
    """Find the smallest distance, in deviations and at most `ENOUGH`, of an arm that turns to velocities `wanted` (n,).

    Each joint changes its velocity as fast as it may and keeps it then. Ends early where it is below `least`.
    """
    n, smallest, points, moved = len(arm.joints), ENOUGH, arm.points, forecast.moved
    axes, origins, p = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n)
    for m in range(len(forecast.times)):
        t = forecast.times[m]
        for i in range(n):
            change = wanted[i] - velocity[i]
            ramp = min(abs(change) / arm.acceleration, t)
            turned = velocity[i] * t + np.sign(change) * arm.acceleration * ramp * (t - ramp / 2)
            p[i] = min(max(q[i] + turned, arm.lower[i]), arm.upper[i])
        chain(arm.joints, p, axes, origins)
        k = 0
        while k < len(points):
            offset, joint, radius = points[k].offset, points[k].joint, points[k].radius
            x, y = placed(offset, joint, axes, origins, 0), placed(offset, joint, axes, origins, 1)
            z = placed(offset, joint, axes, origins, 2)
            room = (z - radius - forecast.floor) / forecast.depth
            for o in range(len(forecast.shapes)):
                u, v, w = x - moved[m, o, 0], y - moved[m, o, 1], z - moved[m, o, 2]
                away = distance(forecast.shapes[o], forecast.values, u, v, w) - radius - forecast.kept
                room = min(room, away / forecast.deviation[m, o])
            if holds_others(points, k):
                k = k + 1 if room < smallest else points[k].end
                continue
            smallest = min(smallest, room)
            k += 1
        if smallest < least:
            break
    return smallest


@short_kernel
def dodge(
    arm: LimitedArm, forecast: Forecast, q: Array, velocity: Array, wanted: Array, before: Array, gain: float
) -> tuple[bool, Array]:
    """Choose velocities (n,), rad/s, for an arm at q (n,) that has `velocity` (n,).

    Those that are wanted, if they lead past all obstacles. Else of the standstill and the largest velocities of both
    senses, for some joints after the others, those that leave most room; of several that leave enough, those nearest to
    what is wanted.

    Args:
        arm: the arm.
        forecast: of the obstacles.
        q: angles, rad.
        velocity: rad/s.
        wanted: (n,) rad/s.
        before: (n,) chosen just before, rad/s; kept where others do not leave `gain` more room.
        gain: in deviations.

    Returns:
        Whether what is wanted leads past them, and the velocities.
    """
    most = _room(arm, forecast, q, velocity, wanted, -np.inf)
    if most >= ENOUGH:
        return True, wanted
    chosen = wanted.copy()
    kept = _room(arm, forecast, q, velocity, before, most)
    if kept > most:
        most, chosen = min(kept + gain, ENOUGH), before.copy()
    tried = chosen.copy()
    for first in range(0, len(q), AT_ONCE):
        last, base = min(first + AT_ONCE, len(q)), chosen.copy()
        for number in range(3 ** (last - first)):
            for i in range(len(q)):
                tried[i] = base[i]
            for i in range(first, last):
                tried[i] = (number // 3 ** (i - first) % 3 - 1) * arm.fastest[i]
            left = _room(arm, forecast, q, velocity, tried, most)
            nearer = ((tried - wanted) ** 2).sum() < ((chosen - wanted) ** 2).sum()
            if left > most or (left == most and nearer):
                most = left
                for i in range(len(q)):
                    chosen[i] = tried[i]
    return False, chosen
