"""What the robot has just done: the last minute of its loop, in arrays that are written over again and again."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.motion.following import ArmMotion

SPAN = 60.0
"""Time that is remembered, seconds."""
LEAST = 0.045
"""Shortest time from one sample to the next, seconds: less than from one picture to the next."""
NUM_SAMPLES = math.ceil(SPAN / LEAST) + 1
"""Number of samples that are remembered."""


@dataclass(frozen=True, kw_only=True)
class Past(ArmMotion):
    """What the robot did; its times begin at 0."""

    arrived: Array
    """(T,) time since the robot came to the goal, seconds; 0 from when it sets out from a start until then."""
    seeks: Array
    """(T,) 1 where the robot is on its way to the goal, 0 elsewhere."""


class Recording:
    """The last `SPAN` seconds of a robot; one thread adds to it, any thread reads it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._times = np.empty(NUM_SAMPLES)
        self._rows: Array | None = None
        """(NUM_SAMPLES, 2 n + 2) joint angles, those without avoidance, time since the arrival, and `Past.seeks`."""
        self._num, self._now = 0, 0.0
        """Number of samples ever added, and time now, seconds."""

    def add(self, seconds: float, q: Array, without: Array, arrived: float, *, seeks: bool) -> None:
        """Add where the robot is, some seconds after what was added before, unless that is less than `LEAST`.

        Args:
            seconds: time since `add` was called before.
            q: (n,) joint angles, rad.
            without: (n,) the same without avoidance.
            arrived: see `Past`.
            seeks: likewise.
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
