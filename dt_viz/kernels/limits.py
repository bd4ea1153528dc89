"""Limits of the joints' velocities in a tick of a controller."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.arm import Array
from dt_viz.kernels.compiled import compiled, short_kernel
from dt_viz.kernels.dodging import LimitedArm
from dt_viz.kernels.proximity import Indices

NUM_ROWS = 8  # number of distances, the smallest ones, that have a barrier
BRAKING_SHARE = 0.8
"""Part of the acceleration limit that braking before a joint limit counts on: ticks are not infinitely short."""
IMMOBILE = 1e-4  # squared slope of a distance, m²/rad², up to which no joint changes it to speak of
STEADIEST = 0.5  # part of a distance that goes in one tick at most, however long it is


@compiled
def fastest(room: float, braking: float, dt: float) -> float:
    """Velocity v towards a limit `room` away after which `braking` b suffices: room − v·dt = v²/2b."""
    return braking * (np.sqrt(dt * dt + 2 * room / braking) - dt) if room > 0 else room / dt


@compiled
def within(value: float, lower: float, upper: float) -> float:
    """Return the number between two others that is nearest to a value; the upper one if there is none between."""
    return min(max(value, lower), upper)


@short_kernel
def velocity_bounds(arm: LimitedArm, q: Array, velocity: Array, dt: float) -> tuple[Array, Array]:
    """Lowest and highest velocities (n,), rad/s, in a tick of `dt` seconds after `velocity` (n,) at q (n,), rad.

    Joints are never faster than they can brake before the end of their range, nor than their velocity limit, unless
    their acceleration limit, which comes first, leaves no other way.
    """
    lower, upper = np.empty(len(q)), np.empty(len(q))
    for i in range(len(q)):
        braking, change, most = BRAKING_SHARE * arm.acceleration, arm.acceleration * dt, arm.fastest[i]
        lowest, highest = velocity[i] - change, velocity[i] + change
        down, up = -fastest(q[i] - arm.lower[i], braking, dt), fastest(arm.upper[i] - q[i], braking, dt)
        lower[i] = within(within(down, -most, most), lowest, highest)
        upper[i] = within(within(up, -most, most), lowest, highest)
    return lower, upper


@short_kernel
def barrier(h: Array, slopes: Array, gain: float, dt: float) -> tuple[Indices, Array]:
    """Choose the smallest of some distances, of those that joints change, and the least rates of these, ḣ ≥ −γh.

    Args:
        h: (L,) distances beyond what is kept, metres.
        slopes: (L, n) of them by the joints, m/rad.
        gain: γ, 1/s.
        dt: duration of the tick, seconds.

    Returns:
        Their places (K,), the smallest first, and rates (K,), m/s.
    """
    near, num = np.empty(NUM_ROWS, np.int64), 0
    for place in range(len(h)):
        if (slopes[place] ** 2).sum() <= IMMOBILE or (num == NUM_ROWS and h[place] >= h[near[-1]]):
            continue
        k = min(num, NUM_ROWS - 1)
        while k > 0 and h[near[k - 1]] > h[place]:
            near[k] = near[k - 1]
            k -= 1
        near[k], num = place, min(num + 1, NUM_ROWS)
    near = near[:num]
    rate = min(gain, STEADIEST / dt)
    # what is too near parts faster than what is apart may approach
    return near, np.array([-rate * (h[k] if h[k] > 0 else 2 * h[k]) for k in near])
