"""Who computes when: what follows a hand comes before what refines, and there are no more at once than cores."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dt_viz.errors import Cancelled, end_if, never

LOOK = 0.02
"""Interval, seconds, at which a refinement that waits asks whether it is still wanted."""


class Cores:
    """A bounded semaphore with two priorities. It is not reentrant: a holder must not wait for another slot.

    Those who follow a hand get a slot before those who refine; among equals, the one that has waited longest. One slot
    is never a refinement's, unless there is only one.
    """

    def __init__(self, num: int = os.cpu_count() or 1) -> None:
        """Allow `num` computations at once."""
        self._changed = threading.Condition()
        self._free, self._free_to_refine = num, max(1, num - 1)
        self._numbers = itertools.count()
        self.queue: list[tuple[bool, int]] = []
        """Those who wait: whether each refines, and a number that grows with each arrival; the smallest is next."""

    @contextmanager
    def slot(self, cancelled: Cancelled | None = None) -> Iterator[None]:
        """Wait for a slot, and have it within this block.

        Args:
            cancelled: of a refinement: whether nobody wants it any more; None for what follows a hand.

        Raises:
            UnwantedError: the refinement is cancelled while it waits.
        """
        refines = cancelled is not None
        with self._changed:
            place = refines, next(self._numbers)
            self.queue.append(place)
            try:
                while not self._changed.wait_for(lambda: self._is_next(place), LOOK if refines else None):
                    end_if(cancelled or never)
                self._free, self._free_to_refine = self._free - 1, self._free_to_refine - refines
            finally:
                self.queue.remove(place)
                self._changed.notify_all()  # another one may be next now
        try:
            yield
        finally:
            with self._changed:
                self._free, self._free_to_refine = self._free + 1, self._free_to_refine + refines
                self._changed.notify_all()

    def _is_next(self, place: tuple[bool, int]) -> bool:
        return min(self.queue) == place and self._free > 0 and (self._free_to_refine > 0 or not place[0])
