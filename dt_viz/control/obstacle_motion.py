"""Where moving obstacles are going to be, by where they were seen."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Obstacle, as_point


@dataclass(frozen=True, eq=False)
class ObstacleMotion:
    """The measured motion of an obstacle: a velocity v that swings about its mean m.

    Its deviation d = v − m returns as a critically damped one does, d̈ + 2λḋ + λ²d = 0: what is moved by hand bends its
    way and goes on where it was going. That is also the mean of a process of Matérn's kind with ν = 3/2.
    """

    velocity: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) m/s."""
    acceleration: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) m/s²."""
    mean: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) mean velocity, m/s."""
    age: float = 0.0
    """Time for which it is known, seconds."""

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

    time: float
    """Time of the sighting, seconds."""
    avoidance: ArmAvoidance | None
    """What is avoided, and how."""
    motions: tuple[ObstacleMotion, ...]
    """Of its P parts."""

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
