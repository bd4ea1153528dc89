"""The flow around obstacles while a robot moves: made anew where they have moved, its duration changed gradually."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.arm_field import WholeArmField
from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE, MAX_DURATION, SLOPE
from dt_viz.avoidance.arm_solver import clearing as clearing_time
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.detour import escape_directions, turned
from dt_viz.control.courses import Course, Progress
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.diffeomorphisms import Conjugated, Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array
from dt_viz.kernels.blocks import room_asked
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle, as_point
from dt_viz.robot.robot import sized

NUM_COMPARED = 16
"""Number of colliding postures that escape directions are compared by, about; half of it where an obstacle moves, for
each is then compared with several places of the obstacle."""
NUM_TRIED = 8
"""Largest number of escape directions that are tried from obstacles at rest where the best one leads into them."""
STEP = 0.05  # flow time between two looks at the clearance
COARSE_STEP = 0.2  # length of a Runge–Kutta step, in flow time


@dataclass(frozen=True, eq=False)
class Clearing:
    """The way around obstacles for a motion ahead."""

    field: WholeArmField | None = None  # generator of ψ_q; None where nothing is in the way
    directions: tuple[Array | None, ...] = ()
    """Escape direction (3,) from each obstacle; None for those that are not in the way."""
    duration: float = 0.0  # shortest flow time after which the motion is clear

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


@dataclass(frozen=True, eq=False)
class ObstacleMotion:
    """The measured motion of an obstacle: a velocity v that swings about its mean m.

    Its deviation d = v − m returns as a critically damped one does, d̈ + 2λḋ + λ²d = 0: what is moved by hand bends its
    way and goes on where it was going. That is also the mean of a process of Matérn's kind with ν = 3/2.
    """

    velocity: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m/s
    acceleration: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m/s²
    mean: Array = field(default_factory=lambda: np.zeros(3))  # (3,) mean velocity, m/s
    age: float = 0.0  # time for which it is known, seconds

    def then(self, moved: Array, passed: float, averaging: float) -> ObstacleMotion:
        """Take note of a displacement (3,), metres, in a time, seconds; the mean is over `averaging` seconds."""
        velocity, age = moved / passed, self.age + passed
        if not self.age:
            return ObstacleMotion(velocity, np.zeros(3), velocity, age)
        surprise = velocity - self.velocity - passed / 2 * self.acceleration  # in the mean velocity of that time
        acceleration = self.acceleration + surprise / passed
        mean = self.mean + passed / min(age, averaging) * (velocity - self.mean)
        return ObstacleMotion(velocity + passed / 2 * acceleration, acceleration, mean, age)

    def ahead(self, times: Array, rate: float) -> Array:
        """Displacements (T, 3), metres, after times (T,), seconds, with λ the rate, 1/s, at which it returns."""
        t = times[:, None]
        deviation, left = self.velocity - self.mean, np.exp(-rate * t)
        turn = self.acceleration + rate * deviation
        swing = deviation * (1 - left) / rate + turn * (1 - left * (1 + rate * t)) / rate**2
        return t * self.mean + swing


@dataclass(frozen=True, eq=False)
class Sighting:
    """Obstacles at a time."""

    time: float  # time of the sighting, seconds
    avoidance: ArmAvoidance | None  # what is avoided, and how
    motions: tuple[ObstacleMotion, ...]  # of its P parts

    @cached_property
    def velocities(self) -> Array:
        """(P, 3) m/s."""
        return np.array([motion.velocity for motion in self.motions]).reshape(-1, 3)

    @cached_property
    def speed(self) -> float:
        """That of the fastest, m/s."""
        return float(np.linalg.norm(self.velocities, axis=1).max(initial=0.0))

    def expected(self, seconds: float, room: float, rate: float) -> ArmAvoidance | None:
        """The obstacles some seconds later, and a margin that grows by `room` seconds of their speed.

        `rate` is that of `Motion.ahead`.
        """
        if self.avoidance is None or not self.speed:
            return self.avoidance
        moved = tuple(
            part.moved(as_point(np.asarray(part.position) + motion.ahead(np.array([seconds]), rate)[0]), part.wxyz)
            for part, motion in zip(self.avoidance.avoided.parts, self.motions, strict=True)
        )
        return replace(self.avoidance, obstacles=moved, margin=self.avoidance.margin + room * self.speed)

    def then(self, avoidance: ArmAvoidance | None, time: float, settings: ControllerSettings) -> Sighting:
        """What is seen at a later time: each obstacle goes on with the motion of the nearest one of its kind."""
        parts = avoidance.avoided.parts if avoidance is not None else ()
        passed, motions = time - self.time, []
        known = [] if self.avoidance is None else list(zip(self.avoidance.avoided.parts, self.motions, strict=True))
        for part in parts:
            alike = [(_between(old, part), k) for k, (old, _) in enumerate(known) if _alike(part, old)]
            motion = ObstacleMotion()
            if alike and passed < settings.stale:
                moved, k = min(alike, key=lambda found: float(np.linalg.norm(found[0])))
                if passed == 0:
                    motion = known.pop(k)[1]
                elif np.linalg.norm(moved) < settings.fastest * passed:
                    motion = known.pop(k)[1].then(moved, passed, settings.averaging)
            motions.append(motion)
        return Sighting(time, avoidance, tuple(motions))


NOTHING_SEEN = Sighting(-np.inf, None, ())


def _alike(part: Obstacle, other: Obstacle) -> bool:
    return type(part) is type(other) and part.radius == other.radius


def _between(part: Obstacle, other: Obstacle) -> Array:
    return np.asarray(other.position) - np.asarray(part.position)


class ObstacleFlow:
    """ψ_q of this moment, and the obstacles that it is made for."""

    def __init__(self, arm: WholeArm, avoidance: ArmAvoidance | None, settings: ControllerSettings) -> None:
        """Take an arm and what it is to avoid."""
        self._arm, self._settings = arm, settings
        self.time = 0.0  # seconds
        self.seen = NOTHING_SEEN.then(avoidance, self.time, settings)
        """The obstacles, when they were seen last."""
        self.changed = True  # whether something has changed since the flow was made
        self._clearing, self._duration, self._made = Clearing(), 0.0, -np.inf
        self._image: tuple[tuple[Course, Clearing, float, float], Array] | None = None
        """Course, flow, its duration, and time of the course, and the robot's posture (n,) for these, rad."""

    def see(self, avoidance: ArmAvoidance | None) -> None:
        """Take note of where the obstacles are now."""
        self.seen, self.changed = self.seen.then(avoidance, self.time, self._settings), True

    @property
    def late(self) -> float:
        """Time since the obstacles were seen, seconds."""
        return self.time - self.seen.time

    @property
    def cleared(self) -> bool:
        """Whether there is a way around the obstacles."""
        return self._clearing.cleared

    @property
    def is_settled(self) -> bool:
        """Whether the flow is the one that the obstacles ask for, not on its way there."""
        return self._duration == self._clearing.duration

    @property
    def is_calm(self) -> bool:
        """Whether obstacles rest, and the flow is settled and stays as it is."""
        return self.is_settled and self.seen.speed == 0 and not self.changed

    @property
    def transform(self) -> Diffeomorphism:
        """ψ_q, from the postures where the robot moves to those of its undisturbed motion."""
        return self._clearing.transform(self._arm, self._duration)

    def settle(self, progress: Progress) -> None:
        """Make the flow for what has changed, at once."""
        if self.changed:
            self.make(progress)
            self._duration = self._clearing.duration

    def advance(self, progress: Progress, dt: float, *, looks: bool) -> None:
        """Make the flow anew where that is due: every few ticks where obstacles move, else after a change."""
        settings = self._settings
        if self.seen.speed > 0 and self.time > self.seen.time + settings.stale:
            self.see(self.seen.avoidance)
        due = looks and self.time >= self._made + settings.look_period
        if due and (self.seen.speed > 0 or self.changed):
            self.make(progress)
        rise = self._clearing.duration - self._duration
        self._duration += min(max(rise, -settings.easing * dt), 2 * settings.easing * dt)

    def image(self, progress: Progress) -> Array:
        """Find the posture (n,), rad, where the robot is to be."""
        key = progress.course, self._clearing, self._duration, progress.clock
        if self._image is None or self._image[0] != key:
            q = progress.q
            at = self.transform.inverse(self._arm.limits.inside(q)[None])[0] if self._duration > 0 else q
            self._image = key, at
        return self._image[1]

    def make(self, progress: Progress) -> None:
        """Find the way around obstacles for the motion that is ahead."""
        seen, settings, course, clock = self.seen, self._settings, progress.course, progress.clock
        turn = settings.turning * min(self.time - self._made, 1.0)
        if seen.speed > 0:
            avoidance = seen.expected(settings.lead + self.late, settings.room, settings.returning)
            times = np.linspace(clock, min(clock + settings.window, course.end), settings.num_clear_moving)
            ahead, end = np.stack([course.at(time) for time in np.unique(times)]), None
        else:
            avoidance, ahead = seen.avoidance, progress.ahead
            ahead, end = ahead[:: max(1, len(ahead) // settings.num_clear)], self._arm.limits.inside(ahead[-1])
        found = clearing(self._arm, ahead, avoidance, seen.velocities, self._clearing, turn, end)
        if end is not None and avoidance is not None:
            near, q = min(settings.clearance, avoidance.margin / 2), course.between(clock, settings.num_between)
            found = checked(self._arm, found, q, avoidance, self._clearing, end, near)
        self._clearing = found
        self._made, self.changed = self.time, False
