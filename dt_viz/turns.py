"""One at a time: threads that share a processor take turns, and who is in a hurry goes first."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

SLICE = 0.1
"""Seconds after which who has the turn lets others go on that are in as much of a hurry."""

_Place = tuple[bool, int]
"""In the queue: whether it is patient, and a number that grows with each who comes."""


class Turns:
    """A lock whose holder can let others go first.

    It is given to those in a hurry before those who are patient, and among them to who has waited longest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: list[_Place] = []
        self._numbers = itertools.count()
        self._taken = False
        self._patient = False
        """Whether who has the turn is."""
        self._ends = 0.0
        """When the slice of who has the turn is over, seconds."""

    @contextmanager
    def taken(self, *, patient: bool = False) -> Iterator[None]:
        """Wait for the turn, and have it within this block. It is not reentrant."""
        self._take(patient=patient)
        try:
            yield
        finally:
            self._end()

    def give_way(self) -> None:
        """Called by who has the turn: join the end of the queue, and go on from there when the turn comes again.

        That is done only if somebody waits who is in more of a hurry, or after a `SLICE` in as much.
        """
        if self._is_due():
            patient = self._patient
            self._end()
            self._take(patient=patient)

    def let_pass(self, longest: float) -> None:
        """Called by who needs no turn, but takes the processor as well: wait while somebody in a hurry has or wants it.

        Args:
            longest: seconds after which not to wait any more.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_hurried(), longest)

    def _is_hurried(self) -> bool:
        return (self._taken and not self._patient) or any(not patient for patient, _ in self._queue)

    def _is_due(self) -> bool:
        with self._changed:
            if not self._queue:
                return False
            patient, _ = min(self._queue)
            return patient < self._patient or (patient == self._patient and time.monotonic() > self._ends)

    def _take(self, *, patient: bool) -> None:
        with self._changed:
            place = patient, next(self._numbers)
            self._queue.append(place)
            self._changed.wait_for(lambda: not self._taken and min(self._queue) == place)
            self._queue.remove(place)
            self._taken, self._patient, self._ends = True, patient, time.monotonic() + SLICE

    def _end(self) -> None:
        with self._changed:
            self._taken = False
            self._changed.notify_all()
