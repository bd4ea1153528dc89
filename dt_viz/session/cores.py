"""Who computes when: what follows a hand comes before what refines, and no more at once than there are cores."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dt_viz.errors import Cancelled, end_if, never

NUM_HANDS = 1
"""Number of hands that are followed at once."""
LOOK = 0.02
"""Interval at which a refinement that waits asks whether it is still wanted, seconds."""


class Cores:
    """A bounded semaphore with two priorities.

    Those who follow a hand get a slot before those who refine; among equals, the one that has waited longest. One slot
    is never a refinement's, unless there is only one: a hand waits for other hands alone. Nobody waits for a slot
    within a slot, nor within a `functools.cached_property`: Python 3.10 and 3.11 lock it for all instances.
    """

    def __init__(self, num: int = os.cpu_count() or 1, num_hands: int = NUM_HANDS) -> None:
        """Allow `num` computations at once, `num_hands` of which follow a hand."""
        self._changed = threading.Condition()
        self._free, self._free_for = num, {False: num_hands, True: max(1, num - 1)}
        self._numbers = itertools.count()
        self.queue: list[tuple[bool, int]] = []
        """Those who wait: whether each refines, and a number that grows with each arrival; the smallest is next."""

    @contextmanager
    def slot(self, cancelled: Cancelled | None = None) -> Iterator[None]:
        """Wait for a slot, and have it within this block.

        Args:
            cancelled: of a refinement, asked before it begins and while it waits; None for what follows a hand.

        Raises:
            UnwantedError: it is cancelled.
        """
        refines = cancelled is not None
        end_if(cancelled or never)
        with self._changed:
            place = refines, next(self._numbers)
            self.queue.append(place)
            try:
                while not self._changed.wait_for(lambda: self._is_next(place), LOOK if refines else None):
                    end_if(cancelled or never)
                self._take(refines, 1)
            finally:
                self.queue.remove(place)
                self._changed.notify_all()  # another one may be next now
        try:
            yield
        finally:
            with self._changed:
                self._take(refines, -1)
                self._changed.notify_all()

    def _take(self, refines: bool, num: int) -> None:
        self._free, self._free_for[refines] = self._free - num, self._free_for[refines] - num

    def _is_next(self, place: tuple[bool, int]) -> bool:
        refines, _ = place
        return place == min(self.queue) and self._free > 0 and self._free_for[refines] > 0
