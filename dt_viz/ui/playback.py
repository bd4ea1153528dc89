"""Poses the arm: the one in the loop, or, in replay, along its newest motion again and again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.session.engine import ArmMotion
from dt_viz.session.jobs import Jobs
from dt_viz.session.robot_loop import LiveArm, RoundSettings

logger = logging.getLogger(__name__)

LANE = "arm"
"""Lane of the jobs on which the arm moves."""
SHORTEST, LONGEST = 1 / 20, 1 / 6
"""Bounds of the time from one picture of the arm to the next, seconds."""
PART = 1 / 12
"""Part of that time that moving and drawing the arm takes, at most: the more visitors there are, the fewer pictures."""


def at_moment(motion: ArmMotion, moment: float) -> tuple[Array, Array]:
    """Return the joint angles (6,), rad, with and without avoidance at a moment, seconds after the start."""
    place = float(np.interp(moment, motion.times, np.arange(len(motion.times))))
    before = min(int(place), len(motion.times) - 2)
    weight = place - before
    q, without = ((1 - weight) * path[before] + weight * path[before + 1] for path in (motion.q, motion.without))
    return q, without


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
    def posture(self) -> tuple[Array, Array] | None:
        """The joint angles (6,) now, rad, with and without avoidance; None before there is a motion."""
        return None if self.motion is None else at_moment(self.motion, self._moment(self.motion))

    @property
    def q(self) -> Array | None:
        """The former."""
        return self.posture and self.posture[0]

    @property
    def undisturbed(self) -> Array | None:
        """The latter."""
        return self.posture and self.posture[1]

    def _moment(self, motion: ArmMotion) -> float:
        """Time in the loop, seconds."""
        return self._clock % (motion.times[-1] + RoundSettings().rest)


class Playback:
    """Moves the arm, beside the server's event loop, and has it drawn where it is another one than before."""

    def __init__(self, live: LiveArm, draw: Callable[[], None]) -> None:
        """Take an arm; it moves from `begin` on.

        Args:
            live: the arm in the loop.
            draw: draws the arm in its posture.
        """
        self.live, self.replay = live, Replay()
        self._arm: LiveArm | Replay = live
        """The one of them that is shown."""
        self._draw = draw
        self._playing, self._speed = True, 1.0

    def begin(self, jobs: Jobs, fail: Callable[[Exception], None]) -> None:
        """Move the arm from now on, until the jobs are closed.

        Args:
            jobs: jobs of the visitor.
            fail: called with what keeps the arm in the loop from moving; it waits for its next motion then.
        """
        jobs.submit(LANE, partial(self._loop, jobs, fail))

    @property
    def q(self) -> Array | None:
        """Joint angles (6,) of the arm now, rad; None before there is a motion."""
        return self._arm.q

    @property
    def without(self) -> Array | None:
        """The same at this moment of the motion without avoidance."""
        return self._arm.undisturbed

    @property
    def arrived(self) -> float:
        """Time since the arm came to the goal, seconds; 0 before."""
        return self._arm.arrived

    def play(self, playing: bool, speed: float, *, replays: bool) -> None:
        """Choose how the arm moves.

        Args:
            playing: whether it does so by itself.
            speed: its time, relative to real time.
            replays: whether it repeats its motion; when it does so no more, it goes on from where it is.
        """
        left = self._arm.q
        if self._arm is self.replay and not replays and left is not None:
            self.live.put(left)
        self._playing, self._speed, self._arm = playing, speed, self.replay if replays else self.live

    def advance(self, seconds: float) -> None:
        """Let some real time pass, in seconds, and have the arm drawn; called by one thread only."""
        self._arm.advance(self._speed * seconds, moves=self._playing)
        self._draw()

    def _loop(self, jobs: Jobs, fail: Callable[[Exception], None]) -> None:
        period = SHORTEST
        before = time.monotonic()
        while True:
            jobs.rest(LANE, max(0.0, before + period - time.monotonic()))
            if jobs.superseded(LANE):
                return
            now = time.monotonic()
            try:
                self.advance(now - before)
            except Exception as error:
                logger.exception("the arm stopped")
                self.live.stop()
                fail(error)
            before, period = now, min(max(SHORTEST, (time.monotonic() - now) / PART), LONGEST)
