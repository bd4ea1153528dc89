"""Who computes when: what follows a hand comes before what refines, and that before who has overdrawn his account."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum, auto
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


class Rank(IntEnum):
    """Ranks of what is computed, the first one first."""

    HAND = auto()
    """What follows a hand."""
    REFINEMENT = auto()
    OVERDRAWN = auto()
    """Both, of a thread whose account is overdrawn."""


class _Place(NamedTuple):
    """A place in the queue; those of the smallest rank, debt and number come first."""

    rank: Rank
    debt: float
    """Debt of the account on arrival, seconds."""
    number: int
    """A number that grows with each arrival."""
    thread: int


class Cores:
    """A bounded semaphore with ranks; see `Rank`.

    Among equals who has waited longest gets a slot first, but of those who have overdrawn, who owes least. One slot is
    for hands only, unless there is only one slot: a hand waits for other hands alone. Nobody waits for a slot within a
    slot, nor within a `functools.cached_property`: Python 3.10 and 3.11 lock it for all instances.
    """

    def __init__(self, num: int = os.cpu_count() or 1, settings: CoresSettings = CoresSettings()) -> None:
        """Allow `num` computations at once."""
        self._changed, self._settings = threading.Condition(), settings
        self._free, self._free_for = num, {True: settings.num_hands, False: max(1, num - 1)}
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
        rank = Rank.OVERDRAWN if debt else Rank.HAND if cancelled is None else Rank.REFINEMENT
        with self._changed:
            place = _Place(rank, debt, next(self._numbers), threading.get_ident())
            self.queue.append(place)
            try:
                while not self._changed.wait_for(
                    lambda: self._is_next(place), self._settings.look if cancelled else None
                ):
                    end_if(cancelled or never)
                self._take(rank, 1)
                self._held.append(place)
            finally:
                self.queue.remove(place)
                self._changed.notify_all()  # another one may be next now
        try:
            yield
        finally:
            settle()
            with self._changed:
                self._take(rank, -1)
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
                return all(place[:2] >= (Rank.OVERDRAWN, debt) for place in others)

            self._changed.wait_for(is_last, self._settings.longest)

    def giving_way(self, cancelled: Cancelled) -> Cancelled:
        """Return the same question, which gives way whenever it is asked: between parts of what takes long."""

        def asked() -> bool:
            self.give_way()
            return cancelled()

        return asked

    def _take(self, rank: Rank, num: int) -> None:
        self._free -= num
        self._free_for[rank is Rank.HAND] -= num

    def _is_next(self, place: _Place) -> bool:
        return place == min(self.queue) and self._free > 0 and self._free_for[place.rank is Rank.HAND] > 0
