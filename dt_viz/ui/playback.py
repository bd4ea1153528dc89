"""Poses the arm: the one in the loop, or, in its place, its finished motion, or what it did before."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dt_viz.errors import UnwantedError
from dt_viz.flows.fields import Array
from dt_viz.metrics import interpolate
from dt_viz.motion.following import ArmMotion
from dt_viz.scheduler import SCHEDULER, Jobs
from dt_viz.session.robot_loop import LiveArm, RoundSettings

logger = logging.getLogger(__name__)


LANE = "arm"  # lane of the jobs on which the arm moves
ALIKE = 1e-6  # distance of two moments that are one, seconds


@dataclass(frozen=True)
class PlaybackSettings:
    """How often arms are drawn; times in seconds."""

    shortest: float = 1 / 20  # shortest time from one picture of an arm to the next
    longest: float = 1 / 6
    """Longest time from one picture to the next: at twice that an obstacle of 0.5 m/s reaches the arm unseen."""
    asleep: float = 0.5
    """Time from one look at whether the page is touched to the next, while the arm waits for that."""
    part: float = 1 / 12
    """Part of its time that moving and drawing an arm takes: the more visitors there are, the fewer pictures."""


SPAN = 60.0  # time that is remembered, seconds
LEAST = 0.045
"""Shortest time from one sample to the next, seconds: less than from one picture to the next."""
NUM_SAMPLES = math.ceil(SPAN / LEAST) + 1  # number of samples that are remembered


@dataclass(frozen=True, kw_only=True)
class Past(ArmMotion):
    """What the robot did; its times begin at 0."""

    arrived: Array
    """(T,) time since the robot came to the goal, seconds; 0 from when it sets out from a start until then."""
    seeks: Array  # (T,) 1 where the robot is on its way to the goal, 0 elsewhere


class Recording:
    """The last `SPAN` seconds of a robot; one thread adds to it, any thread reads it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._times = np.empty(NUM_SAMPLES)
        self._rows: Array | None = None
        """(NUM_SAMPLES, 2 n + 2) joint angles, those without avoidance, time since the arrival, and `Past.seeks`."""
        self._num, self._now = 0, 0.0  # number of samples ever added, and time now, seconds

    def add(self, seconds: float, q: Array, without: Array, arrived: float, *, seeks: bool) -> None:
        """Add joint angles (n,), rad, and those without avoidance, unless the sample before is less than `LEAST` old.

        `seconds` have passed since `add` was called before; see `Past` for the rest.
        """
        with self._lock:
            self._now += seconds
            if self._num and self._now - self._times[(self._num - 1) % NUM_SAMPLES] < LEAST:
                return
            if self._rows is None:
                self._rows = np.empty((NUM_SAMPLES, 2 * len(q) + 2))
            place = self._num % NUM_SAMPLES
            self._times[place] = self._now
            self._rows[place] = *q, *without, arrived, seeks
            self._num += 1

    @property
    def past(self) -> Past | None:
        """The last `SPAN` seconds; None before there are two samples."""
        with self._lock:
            if self._rows is None or self._num < 2:
                return None
            order = np.arange(max(0, self._num - NUM_SAMPLES), self._num) % NUM_SAMPLES
            times, rows = self._times[order], self._rows[order]
        kept = times >= times[-1] - SPAN
        times, rows = times[kept], rows[kept]
        n = rows.shape[1] // 2 - 1
        q, without, arrived, seeks = np.split(rows, [n, 2 * n, 2 * n + 1], axis=1)
        return Past(times - times[0], q, without, arrived=arrived[:, 0], seeks=seeks[:, 0])


class Replay:
    """A motion that is played, like the arm in the loop; a new one takes over at the same moment of it."""

    def __init__(self) -> None:
        self.motion: ArmMotion | None = None  # the motion; None before there is one
        self.playing, self.loops, self.speed = True, True, 1.0
        """Whether its time passes, whether it begins anew after its end, and its speed relative to real time."""
        self.jumps = 0  # number of times that it was taken to another moment
        self._clock = 0.0
        self._changing = threading.Lock()  # the page takes it to a moment while its time passes

    def advance(self, seconds: float) -> None:
        """Let some real time pass."""
        with self._changing:
            if not self.playing:
                return
            before = self.clock
            self._clock += self.speed * seconds
            if not self.loops and self.motion is not None and before + self.speed * seconds >= self.duration:
                self._clock, self.playing = self.duration, False

    def restart(self) -> None:
        """Begin the loop anew."""
        with self._changing:
            self._clock = 0.0

    def play(self) -> None:
        """Play it from where it is, or, where that is its end, from its beginning."""
        with self._changing:
            if self.clock >= self.duration:
                self._clock = 0.0
                self.jumps += 1
            self.playing = True

    def seek(self, moment: float) -> None:
        """Hold it at a moment of it, seconds."""
        with self._changing:
            self._clock, self.playing = min(max(moment, 0.0), self.duration), False
            self.jumps += 1

    def step(self, num: int) -> None:
        """Hold it so many samples of it later, or earlier if negative."""
        motion, moment = self.motion, self.moment
        if motion is not None:
            earlier, later = np.searchsorted(motion.times, (moment - ALIKE, moment + ALIKE))
            place = int(later + num - 1 if num > 0 else earlier + num)
            self.seek(float(motion.times[min(max(place, 0), len(motion.times) - 1)]))

    @property
    def duration(self) -> float:
        """Time from its beginning to its end, seconds; 0 before there is a motion."""
        return 0.0 if self.motion is None else float(self.motion.times[-1])

    @property
    def clock(self) -> float:
        """Time in the loop, seconds: that in the motion, and then that of a rest at its end."""
        return self._clock % (self.duration + RoundSettings().rest)

    @property
    def moment(self) -> float:
        """Time in the motion, seconds."""
        return min(self.clock, self.duration)

    @property
    def arrived(self) -> float:
        """Time since the goal was reached, seconds; 0 before."""
        motion = self.motion
        if isinstance(motion, Past):
            return float(motion.arrived[_newest(motion.times, self.moment)])
        return 0.0 if motion is None else max(0.0, self.clock - self.duration)

    @property
    def seeks(self) -> bool:
        """Whether the arm is on its way to the goal."""
        motion = self.motion
        return not isinstance(motion, Past) or bool(motion.seeks[_newest(motion.times, self.moment)])

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

    @property
    def trace(self) -> tuple[Array, Array]:
        """Joint angles (K, n), rad, since the arm set out from a start last, and the times since it arrived (K,)."""
        motion = self.motion
        return (np.empty((0, 0)), np.empty(0)) if motion is None else trace(motion, self.moment)

    def _now(self, motion: ArmMotion, path: Array) -> Array:
        return interpolate(np.array([self.moment]), motion.times, path)[0]


def trace(motion: ArmMotion, moment: float) -> tuple[Array, Array]:
    """Return what a motion does until a moment, seconds, since it set out from a start last; see `Replay.trace`."""
    end = _newest(motion.times, moment) + 1
    arrived = motion.arrived[:end] if isinstance(motion, Past) else np.zeros(end)
    sets_out = np.flatnonzero((arrived[1:] == 0) & (arrived[:-1] > 0)) + 1
    begin = sets_out[-1] if len(sets_out) else 0
    return motion.q[begin:end], arrived[begin:]


def _newest(times: Array, moment: float) -> int:
    """Place of the last of the times (T,) that is no later than a moment; of the first if none is."""
    return max(0, int(np.searchsorted(times, moment, side="right")) - 1)


class Playback:
    """Moves the arm, beside the server's event loop, and has it drawn where it is another one than before."""

    def __init__(
        self, live: LiveArm, draw: Callable[[], None], settings: PlaybackSettings = PlaybackSettings()
    ) -> None:
        """Take the arm in the loop, and what draws it; it moves from `begin` on."""
        self.live, self.replay, self.past = live, Replay(), Replay()
        """The arm in the loop, its finished motion, and what it did before `rewind`."""
        self.film: LiveArm | Replay | None = None
        """What a video shows in place of all else, which waits until there is none any more."""
        self._arm: LiveArm | Replay = live
        self.recording = Recording()
        self.neglected = False
        """Whether nobody has touched the page for a while, and others need the processor: the goal is not left then."""
        self._draw, self._settings = draw, settings
        self._playing, self._speed = True, 1.0
        self._returns = 0  # number of times that the robot was shown again after its past

    @property
    def arm(self) -> LiveArm | Replay:
        """What is drawn, with its joint angles `q` and `undisturbed`, (n,), rad, and the time since it `arrived`."""
        return self.film or self._arm

    @property
    def note(self) -> str:
        """What is unusual about where the arm is, in words; empty if nothing is."""
        return "rests until you touch the page" if self._waits else self.live.note

    @property
    def _waits(self) -> bool:
        return self.neglected and 0 < self.arm.arrived < RoundSettings().rest

    @property
    def player(self) -> Replay | None:
        """What is played in place of the arm in the loop; None while that is shown."""
        return None if self._arm is self.live else self.past if self._arm is self.past else self.replay

    @property
    def jumps(self) -> int:
        """Number of times that what is shown has not gone on from where it was."""
        players = {player for player in (self.replay, self.past, self.film) if isinstance(player, Replay)}
        return sum(player.jumps for player in players) + self._returns

    @property
    def trace(self) -> tuple[Array, Array]:
        """What is drawn since it set out from a start; see `Replay.trace`."""
        if isinstance(arm := self.arm, Replay):
            return arm.trace
        past = self.recording.past
        return (np.empty((0, 0)), np.empty(0)) if past is None else trace(past, past.times[-1])

    @property
    def pace(self) -> float:
        """Speed at which the time of what is shown passes, relative to real time."""
        player = self.player
        playing, speed = (self._playing, self._speed) if player is None else (player.playing, player.speed)
        return speed if playing else 0.0

    def begin(self, jobs: Jobs, fail: Callable[[Exception], None]) -> None:
        """Move the arm until the jobs are closed; `fail` is called with what stops it until its next motion."""
        jobs.submit(LANE, partial(self._loop, jobs, fail))

    def play(self, playing: bool, speed: float, *, replays: bool) -> None:
        """Choose whether and how fast the robot moves, and whether its motion is shown in its place.

        Later the robot goes on from where the motion was; what it did before stays shown unless the motion is.
        """
        left = self._arm.q
        self._playing, self._speed = playing, speed
        if replays:
            self._arm = self.replay
        elif self._arm is self.replay:
            if left is not None:
                self.live.put(left)
            self._arm = self.live

    def rewind(self) -> bool:
        """Show what the robot has done until now, held at its end; return whether there is something.

        The robot goes on meanwhile, until `resume`.
        """
        past = self.recording.past
        if past is None:
            return False
        self.live.release()  # a drag of the ball, which is hidden, ends without an event
        self.past.motion = past
        self.past.seek(self.past.duration)
        self._arm = self.past
        return True

    def resume(self) -> None:
        """Show the robot again in place of what it did."""
        if self._arm is self.past:
            self._arm = self.live
            self._returns += 1

    def advance(self, seconds: float) -> None:
        """Let some real time pass, in seconds, and have the arm drawn; called by one thread only."""
        if self.film is not None:
            return
        player = self.player
        if player is not self.replay:
            self._go_on(seconds)
        if player is not None:
            player.advance(seconds)
        self._draw()

    def _go_on(self, seconds: float) -> None:
        """Move the robot, and remember where it is; a pause, unless the hand is held in it, is not remembered."""
        live = self.live
        before = live.q
        live.advance(self._speed * seconds, moves=self._playing)
        q, without = live.q, live.undisturbed
        if q is not None and (self._playing or q is not before):
            self.recording.add(seconds, q, q if without is None else without, live.arrived, seeks=live.left < 1)

    def _loop(self, jobs: Jobs, fail: Callable[[Exception], None]) -> None:
        period = self._settings.shortest
        before = time.monotonic()
        while True:
            jobs.rest(max(0.0, before + period - time.monotonic()), LANE)
            if jobs.superseded(LANE):
                return
            with SCHEDULER.between_drags():
                now, waits = time.monotonic(), self._waits
                try:
                    self.advance(0.0 if waits else now - before)
                except UnwantedError:  # the visitor has left
                    return
                except Exception as error:
                    logger.exception("the arm stopped")
                    self.live.stop()
                    fail(error)
                before, period = now, self._settings.asleep if waits else self._period(time.monotonic() - now)

    def _period(self, taken: float) -> float:
        """Time from one picture to the next where moving and drawing takes so long, seconds."""
        settings = self._settings
        return min(max(settings.shortest, taken / settings.part), settings.longest)
