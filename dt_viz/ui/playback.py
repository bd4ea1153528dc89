"""The arm's motion in a loop, on a clock of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from dt_viz.engine import ArmMotion
from dt_viz.fields import Array

PICTURES_PER_SECOND = 25
REST = 0.8
"""Seconds at the goal before the motion begins again."""


def at_moment(motion: ArmMotion, moment: float) -> tuple[Array, Array]:
    """Joint angles (6,), rad, so many seconds after the start, with and without avoidance."""
    place = float(np.interp(moment, motion.times, np.arange(len(motion.times))))
    before = min(int(place), len(motion.times) - 2)
    weight = place - before
    q, without = ((1 - weight) * path[before] + weight * path[before + 1] for path in (motion.q, motion.without))
    return q, without


class Playback:
    """Poses the arms along the newest motion. A new motion takes over at the same moment of the loop."""

    def __init__(self, pose: Callable[[Array, Array], None]) -> None:
        self._pose = pose
        self._motion: ArmMotion | None = None
        self._playing = True
        self._speed = 1.0
        self._clock = 0.0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="playback", daemon=True)
        self._thread.start()

    def follow(self, motion: ArmMotion | None) -> None:
        """Go on along this motion; None keeps the arm where it is."""
        self._motion = motion

    def set_pace(self, playing: bool, speed: float) -> None:
        """Play or pause, and how many times faster than real time."""
        self._playing, self._speed = playing, speed

    def close(self) -> None:
        """Stop, and wait for the picture that is being sent."""
        self._closed.set()
        self._thread.join(timeout=1)

    def _loop(self) -> None:
        before, shown = time.monotonic(), None
        while not self._closed.wait(1 / PICTURES_PER_SECOND):
            now = time.monotonic()
            if self._playing:
                self._clock += self._speed * (now - before)
            before, motion = now, self._motion
            if motion is None or (shown is motion and not self._playing):
                continue
            moment = min(self._clock % (motion.times[-1] + REST), motion.times[-1])
            self._pose(*at_moment(motion, moment))
            shown = motion
