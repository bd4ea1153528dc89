"""How the robot dodges: a diffeomorphism of configuration space made for its own motion, from where it is on.

It is the flow of `dt_viz.arm.cspace.WholeArmField` as in `dt_viz.arm.whole_arm`, which makes it for all rollouts of a
task at once. Here it is made anew dozens of times a second while obstacles move, so that the way out is remembered and
turns gradually: the image of a posture then moves as gradually as the obstacles. No posture is pinned: a robot at
rest gives way, too, and where nothing comes too near, the flow is the identity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dt_viz.arm.cspace import REACH_PER_TEMPERATURE, WholeArmField, squared_lengths
from dt_viz.arm.escape import escape_directions
from dt_viz.arm.robot import NUM_JOINTS
from dt_viz.arm.whole_arm import BESIDE, COARSE_STEP, MAX_DURATION, OVERSHOOT, ROUNDING, SLOPE, WholeArm
from dt_viz.flows.diffeomorphisms import Conjugated, Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array, Mask, Sum, VectorField
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.ways import OPPOSITE, turned
from dt_viz.transforms.base import ArmAvoidance

COMPARED = 16
"""Number of colliding postures that ways out are compared by, about; half of it where an obstacle moves, for each is
then compared with several places of the obstacle."""
NO_PINS = np.empty((0, NUM_JOINTS))
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Dodge:
    """ψ_q of the robot's own motion."""

    transform: Diffeomorphism
    """From the postures where the robot moves to those of the undisturbed motion."""
    directions: tuple[Array | None, ...] = ()
    """For each obstacle the way out of it, a unit vector (3,); None where it is not in the way."""
    cleared: bool = True
    """Whether all postures that it was made for keep the clearance that is asked for."""


NO_DODGE = Dodge(Identity(NUM_JOINTS))


def dodge(
    arm: WholeArm,
    q: Array,
    hosts: Mask,
    avoidance: ArmAvoidance | None,
    velocities: Array,
    before: Dodge,
    turn: float,
) -> tuple[Dodge, Array]:
    """Make the flow that clears the motion ahead.

    Args:
        arm: whose body points are to be clear.
        q: (N, 6) postures of the undisturbed motion ahead, in their order, rad.
        hosts: (N,) bool: those that are to be clear.
        avoidance: what is to be avoided, and by how much.
        velocities: (P, 3) of the obstacles, m/s.
        before: whose ways out are gone on with.
        turn: largest angle by which a way out turns away from that before, rad.

    Returns:
        The dodge, and the images (N, 6) of the postures, rad.
    """
    q = arm.limits.inside(q)
    if avoidance is None:
        return NO_DODGE, q
    parts = avoidance.obstacle.parts
    known = before.directions if len(before.directions) == len(parts) else (None,) * len(parts)
    points = arm.body.of_chain(arm.robot.chain(q[hosts].T))
    hand = arm.robot.end_effector(q[hosts])
    tangents = np.gradient(hand, axis=0) if len(hand) > 1 else np.zeros_like(hand)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    directions = tuple(
        _direction(arm, points, tangents, part, velocity, avoidance.margin, way, turn)
        for part, velocity, way in zip(parts, velocities, known, strict=True)
    )
    reach = REACH_PER_TEMPERATURE * avoidance.temperature
    fields = tuple(
        WholeArmField(arm.robot, arm.body, part, way, NO_PINS, reach)
        for part, way in zip(parts, directions, strict=True)
        if way is not None
    )
    if not fields:
        return NO_DODGE, q
    end = None if velocities.any() else q[-1]  # who is after the robot is not to be met with less room
    duration, p = _cleared(arm, Sum(fields), q, hosts, avoidance, end)
    flow = Flow(Sum(fields), duration, math.ceil(duration / COARSE_STEP) or 1, sparse=True)
    return Dodge(Conjugated(flow, arm.limits), directions, duration < MAX_DURATION), p


def _direction(
    arm: WholeArm,
    points: Array,
    tangents: Array,
    part: Obstacle,
    velocity: Array,
    margin: float,
    before: Array | None,
    turn: float,
) -> Array | None:
    """The way out of one obstacle (3,); None where no body point (P, 3, N) comes too near it."""
    distance = part.signed_distance(points.transpose(0, 2, 1)) - arm.body.radius[:, None]
    clearance = distance.min(axis=0)
    near = np.flatnonzero(clearance < margin)
    if not len(near):
        return None
    bent = np.flatnonzero(clearance < BESIDE)
    num = COMPARED // 2 if velocity.any() else COMPARED
    compared = points[:, :, near[:: max(1, len(near) // num)]]
    best, *_ = escape_directions(compared, arm.body.radius, tangents[bent], part, margin, num=1, velocity=velocity)
    return best if before is None else _turned(before, best, turn)


def _turned(before: Array, towards: Array, most: float) -> Array:
    """The unit vector `before` (3,), turned towards another by an angle of at most `most`, rad."""
    if before @ towards < OPPOSITE:
        towards = towards + UP + 1e-3 * np.roll(before, 1)
        towards = towards / np.linalg.norm(towards)
    return turned(before, towards, most)


def _cleared(
    arm: WholeArm, field: VectorField, q: Array, hosts: Mask, avoidance: ArmAvoidance, end: Array | None
) -> tuple[float, Array]:
    """The shortest duration after which the flow has carried the hosts clear, or `MAX_DURATION`, and all images."""
    duration, state, p = 0.0, arm.limits.forward(q), q.copy()
    slope = field(state)
    moving: Mask = np.any(slope, axis=1)  # where the field vanishes its flow rests
    lacking, carries = lack(arm, q[hosts], avoidance, end), moving[hosts]
    at_rest, lacking = lacking[~carries].max(initial=-np.inf), lacking[carries]
    state, slope, hosts = state[moving], slope[moving], hosts[moving]
    while duration < MAX_DURATION and lacking.max(initial=at_rest) > 0:
        carried, there = _stepped(field, state, slope, -COARSE_STEP)
        before, lacking = lacking, lack(arm, arm.limits.inverse(carried[hosts]), avoidance, end)
        part = 1.0
        if lacking.max(initial=at_rest) <= 0:
            part = float((before / np.maximum(before - lacking, 1e-12)).clip(0, 1).max())
            carried = _between(state, slope, carried, there, -COARSE_STEP, part)
        state, slope, duration = carried, there, duration + part * COARSE_STEP
    p[moving] = arm.limits.inverse(state)
    return duration, p


def _stepped(field: VectorField, s: Array, slope: Array, h: float) -> tuple[Array, Array]:
    """The points (N, d) after an RK4 step of length h, and the field there, from the field at `s` (N, d)."""
    second = field(s + h / 2 * slope)
    third = field(s + h / 2 * second)
    fourth = field(s + h * third)
    after = s + h / 6 * (slope + 2 * second + 2 * third + fourth)
    return after, field(after)


def _between(s: Array, slope: Array, after: Array, there: Array, h: float, part: float) -> Array:
    """The points (N, d) within that step, at a part of it, by the cubic with these ends and slopes."""
    bend = (1 - 2 * part) * (after - s) + h * ((part - 1) * slope + part * there)
    return (1 - part) * s + part * after + part * (part - 1) * bend


def lack(arm: WholeArm, p: Array, avoidance: ArmAvoidance, end: Array | None) -> Array:
    """Distances (N,), metres, by which postures p (N, 6) miss the clearance that is asked for.

    That is the margin, or beside a free posture `end` (6,) that has less itself, what it has.
    """
    asked: Array | float = avoidance.margin - OVERSHOOT
    if end is not None and (room := float(arm.clearance(end[None], avoidance.obstacle)[0]) - ROUNDING) > 0:
        asked = np.minimum(asked, room + SLOPE * np.sqrt(squared_lengths(p, end[None])[:, 0]))
    return asked - arm.clearance(p, avoidance.obstacle)
