"""The flow around obstacles of a robot in the loop: a diffeomorphism of configuration space made for its own motion.

It is the flow of `avoidance.arm_field.WholeArmField`, as `dt_viz.avoidance.arm` makes it for all rollouts of a task at
once. No posture is pinned: a robot at rest gives way, too, and where nothing comes too near, the flow is the identity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.arm_field import WholeArmField
from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE, MAX_DURATION, SLOPE
from dt_viz.avoidance.arm_solver import clearing as clearing_time
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.detour import escape_directions, turned
from dt_viz.flows.diffeomorphisms import Conjugated, Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array
from dt_viz.kernels.blocks import room_asked
from dt_viz.robot.sizing import sized

NUM_COMPARED = 16
"""Number of colliding postures that escape directions are compared by, about; half of it where an obstacle moves, for
each is then compared with several places of the obstacle."""
NUM_TRIED = 8
"""Largest number of escape directions that are tried from obstacles at rest where the best one leads into them."""
STEP = 0.05
"""Flow time between two looks at the clearance."""
COARSE_STEP = 0.2
"""Length of a Runge–Kutta step, in flow time."""


@dataclass(frozen=True, eq=False)
class Clearing:
    """The way around obstacles for a motion ahead."""

    field: WholeArmField | None = None
    """Generator of ψ_q; None where nothing is in the way."""
    directions: tuple[Array | None, ...] = ()
    """Escape direction (3,) from each obstacle; None for those that are not in the way."""
    duration: float = 0.0
    """Shortest flow time after which the motion is clear."""

    @property
    def cleared(self) -> bool:
        """Whether there is such a time."""
        return self.duration < MAX_DURATION

    def transform(self, arm: WholeArm, duration: float) -> Diffeomorphism:
        """ψ_q for a flow time, from the postures where the robot moves to those of its undisturbed motion."""
        if self.field is None or duration <= 0:
            return Identity(arm.robot.num_joints)
        return Conjugated(Flow(self.field, duration, max(2, math.ceil(duration / COARSE_STEP))), arm.limits)


def clearing(
    arm: WholeArm,
    q: Array,
    avoidance: ArmAvoidance | None,
    velocities: Array,
    before: Clearing,
    turn: float,
    end: Array | None,
) -> Clearing:
    """Find the way around obstacles with velocities (P, 3), m/s, for postures q (N, n) of an undisturbed motion.

    Escape directions of `before` are gone on with, and turn by an angle `turn`, rad, at most; those of obstacles that
    are not in the way any more are kept. Beside a free posture `end` (n,) the clearance may be what it has itself.
    """
    if avoidance is None or not avoidance.avoided.parts:
        return Clearing()
    q, parts = arm.limits.inside(q), avoidance.avoided.parts
    known = before.directions if len(before.directions) == len(parts) else (None,) * len(parts)
    chosen = [
        None if escapes is None else escapes[0] if way is None else turned(way, escapes[0], turn, escapes)
        for escapes, way in zip(_escapes(arm, q, avoidance, velocities, known, 1), known, strict=True)
    ]
    return _by(arm, q, avoidance, end, [way if one is None else one for one, way in zip(chosen, known, strict=True)])


def checked(
    arm: WholeArm, found: Clearing, q: Array, avoidance: ArmAvoidance | None, before: Clearing, end: Array, near: float
) -> Clearing:
    """The same way around obstacles at rest, or another one where it leads into an obstacle; see `clearing`.

    A posture that is clear by itself may be carried into an obstacle, on whose other side it is: then other escape
    directions are tried, that before first. Where none leads around, what was found is left as it is. Postures must
    have the clearance `near`, metres, or beside `end` what that lacks of the margin more.
    """
    if avoidance is None or found.field is None:
        return found
    q = arm.limits.inside(q)

    def leads_around(way: Clearing) -> bool:
        p = way.transform(arm, way.duration).inverse(q)
        return bool((lack(arm, p, avoidance, end, avoidance.margin) <= avoidance.margin - near).all())

    if leads_around(found):
        return found
    known = before.directions if len(before.directions) == len(found.directions) else (None,) * len(found.directions)
    escapes = _escapes(arm, q, avoidance, np.zeros((len(known), 3)), (None,) * len(known), NUM_TRIED)
    tried = [
        [way] * NUM_TRIED if others is None else [*([] if old is None else [old]), *others, *[others[-1]] * NUM_TRIED]
        for way, old, others in zip(found.directions, known, escapes, strict=True)
    ]
    for ways in list(zip(*tried, strict=False))[:NUM_TRIED]:
        other = _by(arm, q, avoidance, end, ways)
        if other.cleared and leads_around(other):
            return other
    return found


def _by(
    arm: WholeArm, q: Array, avoidance: ArmAvoidance, end: Array | None, directions: Sequence[Array | None]
) -> Clearing:
    """The way around obstacles in given directions; see `clearing`."""
    met = [(part, way) for part, way in zip(avoidance.avoided.parts, directions, strict=True) if way is not None]
    if not met:
        return Clearing()
    obstacles, ways = zip(*met, strict=True)
    settings = arm.settings
    reach = max(settings.reach_per_temperature * avoidance.temperature, avoidance.margin + settings.beyond)
    field = WholeArmField(arm.robot, arm.body, obstacles, np.stack(ways), q[:0], reach)

    def lacking(p: Array, most: float) -> Array:
        return lack(arm, p, avoidance, end, most)

    return Clearing(field, tuple(directions), clearing_time(field, arm.limits, q, lacking, STEP, MAX_DURATION))


def _escapes(
    arm: WholeArm, q: Array, avoidance: ArmAvoidance, velocities: Array, before: Sequence[Array | None], num: int
) -> list[list[Array] | None]:
    """At most `num` escape directions (3,) from each obstacle, the best first; None where no posture is too near it."""
    chain = arm.robot.chain(q.T)
    points, tangents = arm.body.of_chain(chain), np.gradient(chain.position.T, axis=0) if len(q) > 1 else 0 * q[:, :3]
    tangents = tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    beside = max(arm.settings.beside, avoidance.margin)  # that of what is fast may be wider
    found: list[list[Array] | None] = []
    for part, velocity, way in zip(avoidance.avoided.parts, velocities, before, strict=True):
        clearance = arm.clearance(q, part, beside)
        near, bent = np.flatnonzero(clearance < avoidance.margin), np.flatnonzero(clearance < beside)
        if not len(near):
            found.append(None)
            continue
        compared = NUM_COMPARED // 2 if velocity.any() else NUM_COMPARED
        found.append(
            escape_directions(
                points[:, :, near[:: max(1, len(near) // compared)]],
                arm.body.radius,
                tangents[bent],
                part,
                avoidance.margin,
                num=num,
                velocity=velocity,
                previous=way,
                settings=sized(avoidance.detour, arm.robot.size),
            )
        )
    return found


def lack(arm: WholeArm, p: Array, avoidance: ArmAvoidance, end: Array | None, most: float) -> Array:
    """Distances (N,), metres, by which postures p (N, n) miss the clearance that is asked for, up to `most`.

    That is the margin, or beside a free posture `end` (n,) that has less itself, what it has.
    """
    pins = p[:0] if end is None else end[None]
    room = arm.clearance(pins, avoidance.avoided) - MARGIN_TOLERANCE
    pins, room = pins[room > 0], room[room > 0]
    asked = room_asked(np.array(p, order="C"), pins, room, np.array(arm.robot.levers), SLOPE, float(avoidance.margin))
    return asked - arm.clearance(p, avoidance.avoided, asked + arm.settings.speed * STEP, asked - most)
