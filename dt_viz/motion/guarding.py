"""The last word on the joints' velocity: no part of the arm comes nearer to an obstacle than it can stop.

A control barrier (Ames et al., "Control Barrier Functions: Theory and Applications", 2019): the distance h of each body
point's sphere may fall no faster than at the rate ḣ = −γh, so it never falls below 0; where it is below, no further.
Of all velocities that obey, the nearest to the wanted one is taken. A motion that keeps its margin is not changed.
"""

from __future__ import annotations

import numpy as np

from dt_viz.arm.robot import KinematicChain, cross
from dt_viz.arm.whole_arm import OVERSHOOT, WholeArm
from dt_viz.flows.fields import Array, Indices
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.transforms.base import ArmAvoidance

KEPT = 5e-3
"""Distance of the arm from an obstacle that is kept, about, metres; half the margin if that is less."""
RATE = 6.0
"""γ, 1/s."""
WINDOW = 0.08
"""Distance from which on a sphere is looked at, metres."""
NUM_POINTS = 10
"""Number of body points, those nearest to an obstacle, that are looked at."""
NUM_ROUNDS = 8
"""Number of rounds in which the velocity is projected onto what each point allows."""
IMMOBILE = 1e-6
"""Squared slope of a distance, m²/rad², up to which no joint moves the point to speak of."""
DIFFERENCE = 1e-4
"""Distance between the places that a distance's slope is taken from, metres."""


def guarded(arm: WholeArm, q: Array, wanted: Array, avoidance: ArmAvoidance, velocities: Array) -> tuple[Array, float]:
    """The velocity nearest to the wanted one at which nothing is touched.

    Args:
        arm: whose body points are guarded.
        q: (6,) its posture, rad.
        wanted: (6,) rad/s.
        avoidance: where the obstacles are now, and the margin.
        velocities: (P, 3) of the obstacles, m/s.

    Returns:
        The velocity (6,), rad/s, and the distance of the arm from the nearest obstacle, about, metres.
    """
    chain = arm.robot.chain(q[:, None])
    points, kept = arm.links.of_chain(chain), _kept(avoidance)
    slopes, bounds, nearest = [], [], np.inf
    for part, velocity in zip(avoidance.obstacle.parts, velocities, strict=True):
        distance = part.signed_distance(points[:, :, 0]) - arm.links.radius + OVERSHOOT
        nearest = min(nearest, float(distance.min()))
        near = np.argsort(distance)[:NUM_POINTS]
        near = near[distance[near] - kept <= WINDOW]
        if len(near):
            found = _constraints(arm, chain, points, part, velocity, distance[near] - kept, near, np.zeros_like(near))
            slopes.append(found[0])
            bounds.append(found[1])
    if slopes:
        wanted = _projected(wanted, np.concatenate(slopes), np.concatenate(bounds))
    return wanted, nearest


def is_allowed(
    arm: WholeArm, q: Array, wanted: Array, avoidance: ArmAvoidance, velocities: Array
) -> tuple[bool, Array]:
    """Whether `guarded` leaves several velocities (N, 6) at postures (N, 6) as they are, all at once.

    Returns:
        Whether it does, for sure; and the distance (N,) of the arm from the nearest obstacle at each posture, metres.
    """
    chain = arm.robot.chain(q.T)
    points, kept, nearest = arm.links.of_chain(chain), _kept(avoidance), np.full(len(q), np.inf)
    for part, velocity in zip(avoidance.obstacle.parts, velocities, strict=True):
        distance = part.signed_distance(points.transpose(0, 2, 1)) - arm.links.radius[:, None] + OVERSHOOT
        nearest = np.minimum(nearest, distance.min(axis=0))
        near, posture = np.nonzero(distance - kept <= WINDOW)
        if len(near):
            h = distance[near, posture] - kept
            slopes, bounds = _constraints(arm, chain, points, part, velocity, h, near, posture)
            if ((slopes * wanted[posture]).sum(axis=1) < bounds).any():
                return False, nearest
    return True, nearest


def _kept(avoidance: ArmAvoidance) -> float:
    return min(KEPT, avoidance.margin / 2)


def _constraints(
    arm: WholeArm,
    chain: KinematicChain,
    points: Array,
    part: Obstacle,
    velocity: Array,
    h: Array,
    near: Indices,
    posture: Indices,
) -> tuple[Array, Array]:
    """Slopes s (K, 6) and bounds b (K,) of s·q̇ ≥ b for body points `near` (K,) at some of the chain's postures (K,).

    Those that no joint moves to speak of have slopes of 0 and bounds of −∞.
    """
    at = points[near, :, posture]
    normal = _outward(part, at)
    lever = cross(chain.axes[:, 2][..., posture], at.T - chain.origins[..., posture])  # (6, 3, K)
    slopes = (arm.links.is_beyond[:, near] * (lever * normal.T).sum(axis=1)).T
    mobile = (slopes * slopes).sum(axis=1) > IMMOBILE
    return slopes * mobile[:, None], np.where(mobile, normal @ velocity - RATE * np.maximum(h, 0.0), -np.inf)


def _projected(wanted: Array, slopes: Array, bounds: Array) -> Array:
    """The vector v (6,) with s·v ≥ b, for slopes s (K, 6) and bounds b (K,), that projections on them lead to."""
    for _ in range(NUM_ROUNDS):
        if (slopes @ wanted >= bounds).all():
            break
        for slope, bound in zip(slopes, bounds, strict=True):
            short = bound - slope @ wanted
            if short > 0:
                wanted = wanted + short / (slope @ slope) * slope
    return wanted


def _outward(part: Obstacle, points: Array) -> Array:
    """Unit vectors (K, 3) away from an obstacle at points (K, 3)."""
    steps = DIFFERENCE * np.concatenate([np.eye(3), -np.eye(3)])
    distance = part.signed_distance(points[:, None] + steps)
    slope = distance[:, :3] - distance[:, 3:]
    return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
