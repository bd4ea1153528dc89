"""Who computes when: what follows a hand comes before all else, and among equals who owes least comes first."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial

from dt_viz.accounts import settle
from dt_viz.checkpoints import checked
from dt_viz.errors import Cancelled, end_if, never


@dataclass(frozen=True)
class CoresSettings:
    """How slots are shared; times in seconds."""

    num_hands: int = 1
    """Number of hands that are followed at once."""
    look: float = 0.25
    """Interval at which what waits and may be cancelled asks whether it is still wanted, unless it is woken before."""
    longest: float = 0.25
    """Longest single pause of what gives way: then it computes until its next checkpoint."""
    gap: float = 0.15
    """Time after a frame of a drag for which overdrawn accounts still give way: the next frame is about to begin."""
    least: float = 0.05
    """Time that an overdrawn account computes, at least, from one pause to the next."""
    pause: float = 0.05
    """Longest time for which an arm whose turn it is to be moved waits while a hand is followed."""
    patience: float = 1.0
    """Interval at which whoever has waited longest, if for as long, comes first, whatever his rank and debt."""
    turn: float = 0.0005
    """Time for which a thread keeps the interpreter while another one waits for it, beside `Cores.short_turns`."""


class Rank(IntEnum):
    """What a computation is for; the smallest comes first."""

    HAND = 0
    """It follows a hand: takes a fraction of the time from one picture to the next."""
    BEGINNING = 1
    """The first picture of a page, a task or a scene: takes ten times as long."""
    PAGE = 2
    """The building of a page, which has no picture yet."""
    REFINEMENT = 3


class _Thread(threading.local):
    went_on: float = -math.inf
    """When it last went on after it had given way, of `time.monotonic`."""


_thread = _Thread()


@dataclass(order=True)
class _Place:
    """A thread that waits for a slot or has one; of those who wait, the smallest comes first."""

    rank: Rank
    debt: float
    """Debt of the account on arrival, seconds; 0 if it is not overdrawn."""
    came: float
    """Time of arrival, of `time.monotonic`."""
    thread: int = field(default_factory=threading.get_ident)
    woken: threading.Event = field(default_factory=threading.Event, compare=False)
    has_slot: bool = field(default=False, compare=False)
    pauses: bool = field(default=False, compare=False)
    """Whether it pauses at a checkpoint now, so that its slot is lent to smaller ranks."""


class Cores:
    """A bounded semaphore with priorities.

    Slots are given by rank; among equals who owes least comes first, and of these who has waited longest. Nobody is
    left out: once in a while whoever has waited longest of all comes first. One slot is for hands only, unless there is
    only one: a hand waits for other hands alone. At checkpoints what follows no hand gives way, and lends its slot
    meanwhile, see `give_way`; a refinement ends there if it is cancelled. Nobody waits for a slot within a slot, nor
    within a `functools.cached_property`: Python 3.10 and 3.11 lock it for all instances.
    """

    def __init__(self, num: int = os.cpu_count() or 1, settings: CoresSettings = CoresSettings()) -> None:
        """Allow `num` computations at once."""
        self._lock, self._settings = threading.Lock(), settings
        self._left = threading.Condition(self._lock)
        """Notified when somebody gives a slot back, or is to ask at once whether his work is still wanted."""
        self._num, self._most = num, {True: settings.num_hands, False: max(1, num - 1)}
        """Number of slots, and of those of hands and of all else."""
        self.queue: list[_Place] = []
        """Those who wait; the smallest is next."""
        self._held: list[_Place] = []
        """Those who have a slot."""
        self._followed = -math.inf
        """When a slot that followed a hand was last given back, of `time.monotonic`."""
        self._last_due = -math.inf
        """When somebody last got a slot because he had waited longest, of `time.monotonic`."""
        self._between = threading.Lock()
        """Held by one of those within `between_hands`."""
        self._num_long, self._usual_turn = 0, sys.getswitchinterval()
        """Number of blocks of `short_turns`, and a thread's turn while there are none, seconds."""

    @contextmanager
    def slot(self, rank: Rank = Rank.HAND, cancelled: Cancelled = never) -> Iterator[None]:
        """Wait for a slot, and have it within this block.

        Args:
            rank: what it is for.
            cancelled: asked before it begins and, unless it is for a hand, while it waits and at each `checkpoint`
                within the block.

        Raises:
            UnwantedError: it is cancelled; a checkpoint raises it, too.
        """
        end_if(cancelled)
        place = _Place(rank, settle(), time.monotonic())
        with self._lock:
            self.queue.append(place)
            self._admit()
        try:
            while not place.has_slot:
                place.woken.wait(None if rank is Rank.HAND else self._settings.look)
                place.woken.clear()
                end_if(cancelled)
            with checked(never if rank is Rank.HAND else partial(self.give_way, cancelled, place)):
                yield
        finally:
            settle()
            with self._lock:
                (self._held if place.has_slot else self.queue).remove(place)
                if rank is Rank.HAND:
                    self._followed = time.monotonic()
                self._admit()
                self._left.notify_all()

    def wake(self, thread: int) -> None:
        """Have a thread that pauses, or waits for a slot but a hand's, ask at once whether that is still wanted."""
        with self._left:
            self._left.notify_all()
            for place in self.queue:
                if place.thread == thread and place.rank is not Rank.HAND:
                    place.woken.set()

    def give_way(self, cancelled: Cancelled = never, place: _Place | None = None) -> None:
        """Pause where others come first, for `longest` at most; called at checkpoints, within a slot or not.

        A refinement pauses while something else than a refinement has a slot, or waits for one: threads of one
        interpreter slow each other. A thread whose account is overdrawn also pauses between the frames of a drag, and
        while an account that owes less has a slot. While a place pauses, its slot is lent to smaller ranks; who
        borrows it keeps it, also where the pause ends first.

        Raises:
            UnwantedError: it is cancelled.
        """
        debt, own, now = settle(), threading.get_ident(), time.monotonic()
        refines = place is not None and place.rank is Rank.REFINEMENT
        pauses = refines or (debt and now - _thread.went_on > self._settings.least)
        longest = now + self._settings.longest if pauses else now
        with self._left:
            while now < longest and not cancelled():
                others = [other for other in self._held if other.thread != own]
                borrow = place is not None and any(other.rank < place.rank for other in self.queue)
                come_first = borrow or any(
                    other.rank is Rank.HAND or other.debt < debt or (refines and other.rank < Rank.REFINEMENT)
                    for other in others
                )
                until = longest if come_first else min(longest, self._followed + self._settings.gap if debt else now)
                if until <= now:
                    break
                if place is not None and not place.pauses:
                    place.pauses = True
                    self._admit()
                self._left.wait(until - now)
                now = _thread.went_on = time.monotonic()
            if place is not None:
                place.pauses = False
        end_if(cancelled)

    @contextmanager
    def between_hands(self) -> Iterator[None]:
        """Wait for a moment in which no slot follows a hand and nobody else is within this block; for a while at most.

        For what takes a few milliseconds and comes again and again, as each picture of each arm. Threads that compute
        at once share one interpreter: all of them, and the frames of a drag with them, take several times as long.
        """
        alone = self._between.acquire(timeout=self._settings.longest)
        try:
            with self._left:
                no_hand = lambda: all(place.rank is not Rank.HAND for place in self._held)  # noqa: E731
                self._left.wait_for(no_hand, self._settings.pause)
            with checked(never):
                yield
        finally:
            if alone:
                self._between.release()

    @contextmanager
    def short_turns(self) -> Iterator[None]:
        """Have threads switch ten times as often within this block, whose computation holds the interpreter for long.

        A frame of a drag asks for the interpreter dozens of times, and each time waits until the thread that has it has
        had its turn. Where only frames are computed, short turns make all of them slower.
        """
        with self._lock:
            self._num_long += 1
            if self._num_long == 1:
                self._usual_turn = sys.getswitchinterval()
                sys.setswitchinterval(min(self._usual_turn, self._settings.turn))
        try:
            yield
        finally:
            with self._lock:
                self._num_long -= 1
                if not self._num_long:
                    sys.setswitchinterval(self._usual_turn)

    def _admit(self) -> None:
        """Give slots to those who are next, as far as there are any; nothing refines while a hand waits."""
        now = time.monotonic()
        due = min(self.queue, key=lambda place: place.came, default=None)
        if due is not None and now - max(due.came, self._last_due) < self._settings.patience:
            due = None
        for place in sorted(self.queue, key=lambda place: (place is not due, place)):
            hands_wait = any(other.rank is Rank.HAND for other in self.queue)
            if place.rank is Rank.REFINEMENT and hands_wait and place is not due:
                return
            follows = place.rank is Rank.HAND
            taken = [held for held in self._held if not held.pauses or held.rank <= place.rank]
            same = sum((held.rank is Rank.HAND) == follows for held in taken)
            rest = min(len(taken) - same, self._most[not follows])  # who has lent his slot may have gone on beside it
            if same < self._most[follows] and same + rest < self._num:
                self.queue.remove(place)
                self._held.append(place)
                place.has_slot = True
                place.woken.set()
                if place is due:
                    self._last_due = now


CORES = Cores()
"""Slots of all that this process computes."""
