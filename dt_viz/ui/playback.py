"""The arm's motion in a loop, on a clock of its own."""

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
"""Seconds at the goal before the motion begins again."""
CATCH_UP = 0.3
"""Seconds in which the arm gets onto a detour: it has moved on while the detour was computed."""


def at_moment(motion: ArmMotion, moment: float) -> tuple[Array, Array]:
    """Joint angles (6,), rad, so many seconds after the start, with and without avoidance."""
    place = float(np.interp(moment, motion.times, np.arange(len(motion.times))))
    before = min(int(place), len(motion.times) - 2)
    weight = place - before
    q, without = ((1 - weight) * path[before] + weight * path[before + 1] for path in (motion.q, motion.without))
    return q, without


@dataclass(eq=False)
class _Detour:
    """A motion that is followed once, beginning from where the arm is."""

    motion: ArmMotion
    ended: Callable[[], None]
    offsets: tuple[Array, Array] | None
    """(6,) each: from the motion's first postures to those of the arms when it began, rad."""
    held: bool = False
    """Whether the arm stays at its beginning."""
    clock: float = 0.0

    @property
    def over(self) -> bool:
        """Whether the goal is reached."""
        return self.clock > self.motion.times[-1] + REST

    def postures(self) -> tuple[Array, Array]:
        """As `at_moment`, now."""
        q, without = at_moment(self.motion, min(self.clock, self.motion.times[-1]))
        left = max(0.0, 1 - self.clock / CATCH_UP)
        if self.offsets is not None and left > 0:
            q, without = q + left * self.offsets[0], without + left * self.offsets[1]
        return q, without


class Playback:
    """Poses the arms along the newest motion. A new motion takes over at the same moment of the loop."""

    def __init__(self, pose: Callable[[Array, Array], None]) -> None:
        self._pose = pose
        self._motion: ArmMotion | None = None
        self._detour: _Detour | None = None
        self._changing = threading.Lock()
        self._posed: tuple[Array, Array] | None = None
        self._shown: ArmMotion | _Detour | None = None
        """What the arms were posed along last."""
        self._playing = True
        self._speed = 1.0
        self._clock = 0.0
        self._resting = 0.0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="playback", daemon=True)
        self._thread.start()

    @property
    def q(self) -> Array | None:
        """Joint angles (6,) of the arm now, rad; None before there is a motion."""
        return None if self._posed is None else self._posed[0]

    @property
    def resting(self) -> float:
        """Seconds for which the arm has been at the goal; 0 on its way."""
        return self._resting

    def follow(self, motion: ArmMotion | None) -> None:
        """Go on along this motion; None keeps the arm where it is."""
        self._motion = motion

    def take_detour(self, motion: ArmMotion, ended: Callable[[], None]) -> None:
        """Leave the loop for this motion, once, to its end; then call `ended` and begin the loop again.

        A detour that is under way is left for it, and its `ended` is not called.
        """
        posed = self._posed
        offsets = None if posed is None else (posed[0] - motion.q[0], posed[1] - motion.without[0])
        with self._changing:
            self._detour = _Detour(motion, ended, offsets)

    def hold(self, motion: ArmMotion | None, ended: Callable[[], None]) -> None:
        """Keep the arm at the beginning of a motion, or where it is if that is None, until a detour begins or ends.

        `ended` is called when it ends, not when another detour begins.
        """
        if motion is None:
            if self._posed is None:
                return
            q, without = (np.stack([posed, posed]) for posed in self._posed)
            motion = ArmMotion(np.array([0.0, 1.0]), q, without)
        with self._changing:
            self._detour = _Detour(motion, ended, None, held=True)

    def end_detour(self) -> None:
        """Go on with the loop now."""
        detour = self._detour
        if detour is not None:
            self._leave(detour)

    def let_go(self) -> None:
        """Go on with the loop if the arm is held; a detour that is under way goes on."""
        detour = self._detour
        if detour is not None and detour.held:
            self._leave(detour)

    def set_pace(self, playing: bool, speed: float) -> None:
        """Play or pause, and how many times faster than real time."""
        self._playing, self._speed = playing, speed

    def close(self) -> None:
        """Stop, and wait for the picture that is being sent."""
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
        """Move the clock on by so much real time and pose the arms; called by the thread of the playback only."""
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
