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
    look: float = 0.25
    """Interval at which what waits and may be cancelled asks whether it is still wanted, unless it is woken before."""
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
    woken: threading.Event


class Cores:
    """A bounded semaphore with priorities.

    Those who follow a hand get a slot before those who refine; among equals who owes least, and of these who has waited
    longest. One slot is never a refinement's, unless there is only one: a hand waits for other hands alone. Nobody
    waits for a slot within a slot, nor within a `functools.cached_property`: Python 3.10 and 3.11 lock it for all
    instances.
    """

    def __init__(self, num: int = os.cpu_count() or 1, settings: CoresSettings = CoresSettings()) -> None:
        """Allow `num` computations at once."""
        self._lock, self._settings = threading.Lock(), settings
        self._left = threading.Condition(self._lock)
        """Notified when somebody gives a slot back."""
        self._num, self._most = num, {False: settings.num_hands, True: max(1, num - 1)}
        """Number of slots, and of those of hands and of refinements."""
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
        place = _Place(cancelled is not None, settle(), next(self._numbers), threading.get_ident(), threading.Event())
        with self._lock:
            self.queue.append(place)
            self._admit()
        try:
            while place not in self._held:
                place.woken.wait(self._settings.look if place.refines else None)
                place.woken.clear()
                end_if(cancelled or never)
            yield
        finally:
            settle()
            with self._lock:
                (self._held if place in self._held else self.queue).remove(place)
                self._admit()
                self._left.notify_all()

    def wake(self, thread: int) -> None:
        """Have a thread that waits for a slot, to refine, ask at once whether that is still wanted."""
        with self._lock:
            for place in self.queue:
                if place.thread == thread and place.refines:
                    place.woken.set()

    def give_way(self) -> None:
        """Pause for a while if this thread's account is overdrawn and others compute, or wait, who owe less.

        Within a slot or not: what holds none, such as learning, gives way all the same.
        """
        debt, own = settle(), threading.get_ident()
        if not debt:
            return
        with self._left:

            def is_last() -> bool:
                others = [place for place in (*self._held, *self.queue) if place.thread != own]
                return all(place.debt >= debt for place in others)

            self._left.wait_for(is_last, self._settings.longest)

    def giving_way(self, cancelled: Cancelled) -> Cancelled:
        """Return the same question, which gives way whenever it is asked: between parts of what takes long."""

        def asked() -> bool:
            self.give_way()
            return cancelled()

        return asked

    def _admit(self) -> None:
        """Give slots to those who are next, as far as there are any."""
        while self.queue:
            place = min(self.queue)
            if len(self._held) == self._num or self._num_held(refines=place.refines) == self._most[place.refines]:
                return
            self.queue.remove(place)
            self._held.append(place)
            place.woken.set()

    def _num_held(self, *, refines: bool) -> int:
        return sum(place.refines == refines for place in self._held)
