"""Poses the arm: the one in the loop, or, in replay, along its newest motion again and again."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.metrics import interpolate
from dt_viz.session.engine import ArmMotion
from dt_viz.session.robot_loop import REST, LiveArm

logger = logging.getLogger(__name__)

SHORTEST, LONGEST = 1 / 20, 1 / 6
"""Bounds of the time from one picture of the arm to the next, seconds."""
PART = 1 / 12
"""Part of that time that moving and drawing the arm takes, at most: the more visitors there are, the fewer pictures."""


class Replay:
    """A motion that is shown in a loop; a new one takes over at the same moment of the loop."""

    def __init__(self) -> None:
        self.motion: ArmMotion | None = None
        """The motion; None before there is one."""
        self._clock = 0.0

    def advance(self, seconds: float) -> None:
        """Let some time pass."""
        self._clock += seconds

    def restart(self) -> None:
        """Begin the loop anew."""
        self._clock = 0.0

    @property
    def arrived(self) -> float:
        """Time since the goal was reached, seconds; 0 before."""
        return 0.0 if self.motion is None else max(0.0, self._moment - self.motion.times[-1])

    @property
    def q(self) -> Array | None:
        """Joint angles (6,) now, rad; None before there is a motion."""
        motion = self.motion
        return None if motion is None else interpolate(np.array([self._moment]), motion.times, motion.q)[0]

    @property
    def undisturbed(self) -> Array | None:
        """The same of the motion without avoidance."""
        motion = self.motion
        return None if motion is None else interpolate(np.array([self._moment]), motion.times, motion.without)[0]

    @property
    def _moment(self) -> float:
        """Time in the loop, seconds."""
        return 0.0 if self.motion is None else self._clock % (self.motion.times[-1] + REST)


class Playback:
    """Moves the arm, on a thread of its own, and has it drawn where it is another one than before."""

    def __init__(self, live: LiveArm, draw: Callable[[], None], fail: Callable[[Exception], None]) -> None:
        """Take an arm; it moves from `begin` on.

        Args:
            live: the arm in the loop.
            draw: draws the arm in its posture; called by the playback's thread.
            fail: called with what keeps the arm in the loop from moving; it waits for its next motion then.
        """
        self.live, self.replay = live, Replay()
        self._draw, self._fail = draw, fail
        self._replays = False
        self._playing, self._speed = True, 1.0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="playback", daemon=True)

    def begin(self) -> None:
        """Move the arm from now on."""
        self._thread.start()

    @property
    def arm(self) -> LiveArm | Replay:
        """What moves now, with its joint angles `q` and `undisturbed`, (6,), rad, and the time since it `arrived`."""
        return self.replay if self._replays else self.live

    def play(self, playing: bool, speed: float, *, replays: bool) -> None:
        """Choose how the arm moves.

        Args:
            playing: whether it does so by itself.
            speed: its time, relative to real time.
            replays: whether it repeats its motion; when it does so no more, it goes on from where it is.
        """
        if self._replays and not replays and self.replay.q is not None:
            self.live.put(self.replay.q)
        self._playing, self._speed, self._replays = playing, speed, replays

    def close(self) -> None:
        """Stop the thread, and wait for the current picture."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=1)

    def _loop(self) -> None:
        period = SHORTEST
        before = time.monotonic()
        while not self._closed.wait(max(0.0, before + period - time.monotonic())):
            now = time.monotonic()
            try:
                self.advance(now - before)
            except Exception as error:
                logger.exception("the arm stopped")
                self.live.stop()
                self._fail(error)
            before, period = now, min(max(SHORTEST, (time.monotonic() - now) / PART), LONGEST)

    def advance(self, seconds: float) -> None:
        """Let some real time pass, in seconds, and have the arm drawn; called by the playback's thread only."""
        step = self._speed * seconds
        if not self._replays:
            self.live.advance(step, moves=self._playing)
        elif self._playing:
            self.replay.advance(step)
        self._draw()
