"""Poses the arm: the one in the loop, or, in replay, along its newest motion again and again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.metrics import interpolate
from dt_viz.session.engine import ArmMotion
from dt_viz.session.jobs import Jobs
from dt_viz.session.robot_loop import LiveArm, RoundSettings

logger = logging.getLogger(__name__)

LANE = "arm"
"""Lane of the jobs on which the arm moves."""


@dataclass(frozen=True)
class PlaybackSettings:
    """How often arms are drawn; times in seconds."""

    shortest: float = 1 / 20
    """Shortest time from one picture of an arm to the next."""
    longest: float = 1 / 6
    """Longest time from one picture to the next: at twice that an obstacle of 0.5 m/s reaches the arm unseen."""
    asleep: float = 0.5
    """Time from one look at whether the page is touched to the next, while the arm waits for that."""
    part: float = 1 / 12
    """Part of its time that moving and drawing an arm takes: the more visitors there are, the fewer pictures."""


class Replay:
    """A motion that is shown in a loop, like the arm in the loop; a new one takes over at the same moment of it."""

    def __init__(self) -> None:
        self.motion: ArmMotion | None = None
        """The motion; None before there is one."""
        self._clock = 0.0

    def advance(self, seconds: float, *, moves: bool = True) -> None:
        """Let some time pass."""
        self._clock += seconds if moves else 0.0

    def restart(self) -> None:
        """Begin the loop anew."""
        self._clock = 0.0

    @property
    def arrived(self) -> float:
        """Time since the goal was reached, seconds; 0 before."""
        return 0.0 if self.motion is None else max(0.0, self._moment(self.motion) - self.motion.times[-1])

    @property
    def q(self) -> Array | None:
        """Joint angles (n,) now, rad; None before there is a motion."""
        motion = self.motion
        return None if motion is None else self._now(motion, motion.q)

    @property
    def undisturbed(self) -> Array | None:
        """The same of the motion without avoidance."""
        motion = self.motion
        return None if motion is None else self._now(motion, motion.without)

    def _now(self, motion: ArmMotion, path: Array) -> Array:
        return interpolate(np.array([self._moment(motion)]), motion.times, path)[0]

    def _moment(self, motion: ArmMotion) -> float:
        """Time in the loop, seconds."""
        return self._clock % (motion.times[-1] + RoundSettings().rest)


class Playback:
    """Moves the arm, beside the server's event loop, and has it drawn where it is another one than before."""

    def __init__(
        self, live: LiveArm, draw: Callable[[], None], settings: PlaybackSettings = PlaybackSettings()
    ) -> None:
        """Take the arm in the loop, and what draws it; it moves from `begin` on."""
        self.live, self.replay = live, Replay()
        self.arm: LiveArm | Replay = live
        """What moves now, with its joint angles `q` and `undisturbed`, (n,), rad, and the time since it `arrived`."""
        self.neglected = False
        """Whether nobody has touched the page for a while, and others need the processor: the goal is not left then."""
        self._draw, self._settings = draw, settings
        self._playing, self._speed = True, 1.0

    @property
    def note(self) -> str:
        """What is unusual about where the arm is, in words; empty if nothing is."""
        return "rests until you touch the page" if self._waits else self.live.note

    @property
    def _waits(self) -> bool:
        return self.neglected and 0 < self.arm.arrived < RoundSettings().rest

    def begin(self, jobs: Jobs, fail: Callable[[Exception], None]) -> None:
        """Move the arm until the jobs are closed; `fail` is told what stops it until its next motion."""
        jobs.submit(LANE, partial(self._loop, jobs, fail))

    def play(self, playing: bool, speed: float, *, replays: bool) -> None:
        """Choose whether and how fast the arm moves, and whether it repeats its motion; later it goes on from there."""
        left = self.arm.q
        if self.arm is self.replay and not replays and left is not None:
            self.live.put(left)
        self._playing, self._speed, self.arm = playing, speed, self.replay if replays else self.live

    def advance(self, seconds: float) -> None:
        """Let some real time pass, in seconds, and have the arm drawn; called by one thread only."""
        self.arm.advance(self._speed * seconds, moves=self._playing)
        self._draw()

    def _loop(self, jobs: Jobs, fail: Callable[[Exception], None]) -> None:
        period = self._settings.shortest
        before = time.monotonic()
        while True:
            jobs.rest(LANE, max(0.0, before + period - time.monotonic()))
            if jobs.superseded(LANE):
                return
            now, waits = time.monotonic(), self._waits
            try:
                self.advance(0.0 if waits else now - before)
            except Exception as error:
                logger.exception("the arm stopped")
                self.live.stop()
                fail(error)
            before, period = now, self._settings.asleep if waits else self._period(time.monotonic() - now)

    def _period(self, taken: float) -> float:
        """Time from one picture to the next where moving and drawing takes so long, seconds."""
        settings = self._settings
        return min(max(settings.shortest, taken / settings.part), settings.longest)
