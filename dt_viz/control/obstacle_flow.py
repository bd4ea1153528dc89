"""The flow around obstacles while a robot moves: made anew where they have moved, its duration changed gradually."""

from __future__ import annotations

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.clearing import Clearing, checked, clearing
from dt_viz.control.courses import Course, Progress
from dt_viz.control.obstacle_motion import NOTHING_SEEN
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array


class ObstacleFlow:
    """ψ_q of this moment, and the obstacles that it is made for."""

    def __init__(self, arm: WholeArm, avoidance: ArmAvoidance | None, settings: ControllerSettings) -> None:
        """Take an arm and what it is to avoid."""
        self._arm, self._settings = arm, settings
        self.time = 0.0
        """Seconds."""
        self.seen = NOTHING_SEEN.then(avoidance, self.time, settings)
        """The obstacles, when they were seen last."""
        self.changed = True
        """Whether something has changed since the flow was made."""
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
