"""One at a time: threads that share a processor take turns, and who is in a hurry goes first."""

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
"""In the queue: whether it is patient, and a number that grows with each who comes."""


class Turns:
    """A lock whose holder can let others go first.

    It is given to those in a hurry before those who are patient, and among them to who has waited longest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: list[_Place] = []
        self._numbers = itertools.count()
        self._holder: int | None = None
        """Identifier of the thread that has the turn."""
        self._patient = False
        """Whether the holder is patient."""
        self._ends = 0.0
        """End of the holder's time slice, seconds."""

    @contextmanager
    def taken(self, *, patient: bool = False, checkpoint: Checkpoint = lambda: None) -> Iterator[None]:
        """Wait for the turn, and have it within this block. It is not reentrant.

        Args:
            patient: whether those in a hurry go first.
            checkpoint: called every `LOOK` seconds of waiting; what it raises ends the waiting.
        """
        self._take(checkpoint, patient=patient)
        try:
            yield
        finally:
            self._end()

    def give_way(self, checkpoint: Checkpoint = lambda: None) -> None:
        """Called by the holder: join the end of the queue, and go on from there when the turn comes again.

        That is done only if somebody waits who is in more of a hurry, or after a `SLICE` in as much.

        Args:
            checkpoint: as of `taken`. The turn is lost for good if it raises.
        """
        if self._is_due():
            patient = self._patient
            self._end()
            self._take(checkpoint, patient=patient)

    def let_pass(self, longest: float) -> None:
        """Called by who needs no turn, but takes the processor as well: wait while somebody in a hurry has or wants it.

        Args:
            longest: seconds after which not to wait any more.
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
        """Whether this thread has the turn now; waits for it `LOOK` seconds at most."""
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
