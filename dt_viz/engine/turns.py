"""A queue with two priorities for threads that share a processor: one computes at a time."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from dt_viz.interruption import Checkpoint

SLICE = 0.1
"""Time slice in seconds; afterwards the holder yields to waiters of equal priority."""
LOOK = 0.02
"""Time in seconds between two calls of the checkpoint of a thread that waits."""

_Place = tuple[bool, int]
"""Place in the queue: whether its priority is low, and a number that grows with each arrival; the smallest is next."""


class Turns:
    """A lock whose holder can let others go first.

    Threads of high priority get it before those of low priority; among equals, the one that has waited longest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: list[_Place] = []
        self._numbers = itertools.count()
        self._holder: int | None = None
        """Identifier of the thread that has the turn."""
        self._patient = False
        """Whether the current holder has low priority."""
        self._ends = 0.0
        """End of the holder's time slice, seconds."""

    @contextmanager
    def taken(self, *, patient: bool = False, checkpoint: Checkpoint = lambda: None) -> Iterator[None]:
        """Wait for the turn, and have it within this block. It is not reentrant.

        Args:
            patient: whether this thread has low priority.
            checkpoint: called every `LOOK` seconds of waiting; what it raises ends the waiting.
        """
        self._take(checkpoint, patient=patient)
        try:
            yield
        finally:
            self._end()

    def give_way(self, checkpoint: Checkpoint = lambda: None) -> None:
        """Called by the holder: join the end of the queue, and go on from there when the turn comes again.

        Nothing is done unless a thread of higher priority waits, or one of equal priority after a `SLICE`.

        Args:
            checkpoint: as in `taken`. If it raises, this thread has lost its turn for good.
        """
        if self._is_due():
            patient = self._patient
            self._end()
            self._take(checkpoint, patient=patient)

    def let_pass(self, longest: float) -> None:
        """Wait while a thread of high priority has or wants the turn; for work that needs no turn but slows others.

        Args:
            longest: seconds to wait at most.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_hurried(), longest)

    def _is_hurried(self) -> bool:
        return (self._holder is not None and not self._patient) or any(not patient for patient, _ in self._queue)

    def _is_due(self) -> bool:
        with self._changed:
            if not self._queue:
                return False
            patient, _ = min(self._queue)
            return patient < self._patient or (patient == self._patient and time.monotonic() > self._ends)

    def _take(self, checkpoint: Checkpoint, *, patient: bool) -> None:
        with self._changed:
            place = patient, next(self._numbers)
            self._queue.append(place)
        try:
            while not self._has_come(place):
                checkpoint()
        except BaseException:
            with self._changed:
                self._queue.remove(place)
                self._changed.notify_all()  # another place may be the first now
            raise

    def _has_come(self, place: _Place) -> bool:
        """Wait for the turn, at most `LOOK` seconds; True if this thread has it now."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._holder is None and min(self._queue) == place, LOOK):
                return False
            self._queue.remove(place)
            self._holder, self._patient, self._ends = threading.get_ident(), place[0], time.monotonic() + SLICE
            return True

    def _end(self) -> None:
        """Let others have the turn, if this thread has it."""
        with self._changed:
            if self._holder == threading.get_ident():
                self._holder = None
                self._changed.notify_all()
