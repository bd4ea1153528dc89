"""Playback of the arm's motion in a loop, on a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dt_viz.engine.engine import ArmMotion
from dt_viz.flows.fields import Array

PICTURES_PER_SECOND = 25
REST = 0.8
"""Time at the goal before the motion begins again, seconds."""
CATCH_UP = 0.3
"""Time in which the arm joins a detour, seconds, since it has moved on while the detour was computed."""


def at_moment(motion: ArmMotion, moment: float) -> tuple[Array, Array]:
    """Return the joint angles (6,), rad, with and without avoidance at a moment, seconds after the start."""
    place = float(np.interp(moment, motion.times, np.arange(len(motion.times))))
    before = min(int(place), len(motion.times) - 2)
    weight = place - before
    q, without = ((1 - weight) * path[before] + weight * path[before + 1] for path in (motion.q, motion.without))
    return q, without


@dataclass(eq=False)
class _Detour:
    """A motion that is followed once, from the current posture of the arm."""

    motion: ArmMotion
    ended: Callable[[], None]
    offsets: tuple[Array, Array] | None
    """Offsets (6,) of the arms' postures from the first ones of the motion when it began, rad."""
    held: bool = False
    """Whether the arm stays at the beginning of the motion."""
    clock: float = 0.0

    @property
    def over(self) -> bool:
        """Whether the goal is reached."""
        return self.clock > self.motion.times[-1] + REST

    def postures(self) -> tuple[Array, Array]:
        """Return the current joint angles, as `at_moment`."""
        q, without = at_moment(self.motion, min(self.clock, self.motion.times[-1]))
        left = max(0.0, 1 - self.clock / CATCH_UP)
        if self.offsets is not None and left > 0:
            q, without = q + left * self.offsets[0], without + left * self.offsets[1]
        return q, without


class Playback:
    """Poses the arms along the newest motion; a new motion takes over at the same moment of the loop."""

    def __init__(self, pose: Callable[[Array, Array], None]) -> None:
        self._pose = pose
        self._motion: ArmMotion | None = None
        self._detour: _Detour | None = None
        self._changing = threading.Lock()
        self._posed: tuple[Array, Array] | None = None
        self._shown: ArmMotion | _Detour | None = None
        """Motion or detour of the last pose."""
        self._playing = True
        self._speed = 1.0
        self._clock = 0.0
        self._resting = 0.0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="playback", daemon=True)
        self._thread.start()

    @property
    def q(self) -> Array | None:
        """Current joint angles (6,) of the arm, rad; None before there is a motion."""
        return None if self._posed is None else self._posed[0]

    @property
    def resting(self) -> float:
        """Time that the arm has been at the goal, seconds; 0 before."""
        return self._resting

    def follow(self, motion: ArmMotion | None) -> None:
        """Continue along this motion; None stops the arm."""
        self._motion = motion

    def take_detour(self, motion: ArmMotion, ended: Callable[[], None]) -> None:
        """Follow this motion once to its end; then call `ended` and begin the loop again.

        It replaces a current detour, whose `ended` is not called.
        """
        posed = self._posed
        offsets = None if posed is None else (posed[0] - motion.q[0], posed[1] - motion.without[0])
        with self._changing:
            self._detour = _Detour(motion, ended, offsets)

    def hold(self, motion: ArmMotion | None, ended: Callable[[], None]) -> None:
        """Hold the arm at the beginning of a motion, or in its posture if that is None, until a detour begins or ends.

        `ended` is called when the hold ends, not when another detour begins.
        """
        if motion is None:
            if self._posed is None:
                return
            q, without = (np.stack([posed, posed]) for posed in self._posed)
            motion = ArmMotion(np.array([0.0, 1.0]), q, without)
        with self._changing:
            self._detour = _Detour(motion, ended, None, held=True)

    def end_detour(self) -> None:
        """End the detour and continue the loop."""
        detour = self._detour
        if detour is not None:
            self._leave(detour)

    def let_go(self) -> None:
        """Continue the loop if the arm is held; a moving detour continues."""
        detour = self._detour
        if detour is not None and detour.held:
            self._leave(detour)

    def set_pace(self, playing: bool, speed: float) -> None:
        """Play or pause, at a multiple of real time."""
        self._playing, self._speed = playing, speed

    def close(self) -> None:
        """Stop the thread, and wait for the current picture."""
        self._closed.set()
        self._thread.join(timeout=1)

    def _leave(self, detour: _Detour) -> None:
        with self._changing:
            if self._detour is not detour:  # another one has begun
                return
            self._detour = None
        detour.ended()

    def _loop(self) -> None:
        before = time.monotonic()
        while not self._closed.wait(1 / PICTURES_PER_SECOND):
            now = time.monotonic()
            self.advance(now - before)
            before = now

    def advance(self, seconds: float) -> None:
        """Advance the clock by real time, in seconds, and pose the arms; called by the playback's thread only."""
        step = self._speed * seconds if self._playing else 0.0
        motion, detour = self._motion, self._detour
        if detour is not None:
            detour.clock += 0.0 if detour.held else step
            if detour.over:
                self._clock = 0.0
                self._leave(detour)
                return
        else:
            self._clock += step
        follows = motion if detour is None else detour
        if motion is None or follows is None or (self._shown is follows and not self._playing):
            return
        if detour is not None:
            posed = detour.postures()
            self._resting = max(0.0, detour.clock - detour.motion.times[-1])
        else:
            moment, end = self._clock % (motion.times[-1] + REST), motion.times[-1]
            posed = at_moment(motion, min(moment, end))
            self._resting = max(0.0, moment - end)
        self._posed = posed
        self._pose(*posed)
        self._shown = follows
