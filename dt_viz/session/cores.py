"""Who computes when: what follows a hand comes before what refines, and in both who owes least comes first."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

from dt_viz.accounts import settle
from dt_viz.errors import Cancelled, end_if, never


@dataclass(frozen=True)
class CoresSettings:
    """How slots are shared; times in seconds."""

    num_hands: int = 1
    """Number of hands that are followed at once."""
    look: float = 0.02
    """Interval at which what waits and may be cancelled asks whether it is still wanted."""
    longest: float = 0.25
    """Longest time for which who has overdrawn gives way at once: he goes on, if slowly."""


class _Place(NamedTuple):
    """A place in the queue; the smallest comes first."""

    refines: bool
    """Whether it refines, and so follows no hand."""
    debt: float
    """Debt of the account on arrival, seconds; 0 if it is not overdrawn."""
    number: int
    """A number that grows with each arrival."""
    thread: int


class Cores:
    """A bounded semaphore with priorities.

    Those who follow a hand get a slot before those who refine; among equals who owes least, and of these who has waited
    longest. One slot is never a refinement's, unless there is only one: a hand waits for other hands alone. Nobody
    waits for a slot within a slot, nor within a `functools.cached_property`: Python 3.10 and 3.11 lock it for all
    instances.
    """

    def __init__(self, num: int = os.cpu_count() or 1, settings: CoresSettings = CoresSettings()) -> None:
        """Allow `num` computations at once."""
        self._changed, self._settings = threading.Condition(), settings
        self._free, self._free_for = num, {False: settings.num_hands, True: max(1, num - 1)}
        self._numbers = itertools.count()
        self.queue: list[_Place] = []
        """Those who wait; the smallest is next."""
        self._held: list[_Place] = []
        """Those who have a slot."""

    @contextmanager
    def slot(self, cancelled: Cancelled | None = None) -> Iterator[None]:
        """Wait for a slot, and have it within this block.

        Args:
            cancelled: of a refinement, asked before it begins and while it waits; None for what follows a hand.

        Raises:
            UnwantedError: it is cancelled.
        """
        end_if(cancelled or never)
        debt = settle()
        with self._changed:
            place = _Place(cancelled is not None, debt, next(self._numbers), threading.get_ident())
            self.queue.append(place)
            try:
                look = self._settings.look if place.refines else None
                while not self._changed.wait_for(lambda: self._is_next(place), look):
                    end_if(cancelled or never)
                self._take(place, 1)
                self._held.append(place)
            finally:
                self.queue.remove(place)
                self._changed.notify_all()  # another one may be next now
        try:
            yield
        finally:
            settle()
            with self._changed:
                self._take(place, -1)
                self._held.remove(place)
                self._changed.notify_all()

    def give_way(self) -> None:
        """Pause for a while if this thread's account is overdrawn and others compute, or wait, who owe less.

        Within a slot or not: what holds none, such as learning, gives way all the same.
        """
        debt, own = settle(), threading.get_ident()
        if not debt:
            return
        with self._changed:

            def is_last() -> bool:
                others = [place for place in (*self._held, *self.queue) if place.thread != own]
                return all(place.debt >= debt for place in others)

            self._changed.wait_for(is_last, self._settings.longest)

    def giving_way(self, cancelled: Cancelled) -> Cancelled:
        """Return the same question, which gives way whenever it is asked: between parts of what takes long."""

        def asked() -> bool:
            self.give_way()
            return cancelled()

        return asked

    def _take(self, place: _Place, num: int) -> None:
        self._free -= num
        self._free_for[place.refines] -= num

    def _is_next(self, place: _Place) -> bool:
        return place == min(self.queue) and self._free > 0 and self._free_for[place.refines] > 0
