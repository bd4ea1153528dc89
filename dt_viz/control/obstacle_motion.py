"""Where moving obstacles are going to be, by where they were seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Obstacle, as_point
from dt_viz.obstacles.union import Union
from dt_viz.transforms.base import ArmAvoidance

SMOOTHING = 0.02
"""Time constant of the measured velocity, seconds."""
FASTEST = 1.5
"""Speed, m/s, from which on an obstacle counts as put elsewhere, not as moving."""
STALE = 0.25
"""Time without news, seconds, after which an obstacle counts as at rest."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Obstacles at a time."""

    time: float
    """Time of the sighting, seconds."""
    avoidance: ArmAvoidance | None
    """What is avoided, and how."""
    velocities: Array
    """(P, 3) measured, m/s."""

    @cached_property
    def speed(self) -> float:
        """That of the fastest, m/s."""
        return float(np.linalg.norm(self.velocities, axis=1).max(initial=0.0))

    def expected(self, seconds: float, room: float) -> ArmAvoidance | None:
        """The obstacles some seconds later, and a margin that grows by `room` seconds of their speed."""
        if self.avoidance is None or not self.speed:
            return self.avoidance
        parts = self.avoidance.obstacle.parts
        moved = tuple(
            part.moved(as_point(np.asarray(part.position) + seconds * velocity), part.wxyz)
            for part, velocity in zip(parts, self.velocities, strict=True)
        )
        return replace(self.avoidance, obstacle=Union(moved), margin=self.avoidance.margin + room * self.speed)

    def where(self, avoidance: ArmAvoidance | None) -> Sighting:
        """What is seen, with the obstacles where they are expected."""
        return replace(self, avoidance=avoidance)

    def then(self, avoidance: ArmAvoidance | None, time: float) -> Sighting:
        """What is seen at a later time."""
        parts = avoidance.obstacle.parts if avoidance is not None else ()
        velocities, passed = np.zeros((len(parts), 3)), time - self.time
        before = self.avoidance.obstacle.parts if self.avoidance is not None else ()
        if passed < STALE and len(before) == len(parts):
            weight = -np.expm1(-passed / SMOOTHING)
            for part, known, velocity, old in zip(parts, before, velocities, self.velocities, strict=True):
                if passed == 0:
                    velocity[:] = old
                elif _alike(part, known):
                    new = (np.asarray(part.position) - np.asarray(known.position)) / passed
                    if np.linalg.norm(new) < FASTEST:
                        velocity[:] = old + weight * (new - old) if old.any() else new
        return Sighting(time, avoidance, velocities)


NOTHING_SEEN = Sighting(-np.inf, None, np.empty((0, 3)))


def _alike(part: Obstacle, other: Obstacle) -> bool:
    return type(part) is type(other) and part.radius == other.radius
