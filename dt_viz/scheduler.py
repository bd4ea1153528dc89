"""Which thread computes when: a drag before a first picture before a refinement, and among equals visitors in turn.

Threads of one interpreter slow each other. So no more of them compute at once than there are cores, one slot is for
drags alone, and a long computation pauses at its checkpoints while a frame of a drag is computed.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from itertools import count
from time import monotonic

from dt_viz.errors import Cancelled, UnwantedError, end_if, never

logger = logging.getLogger(__name__)

LONGEST = 0.25  # longest pause at a checkpoint, seconds
LEAST = 0.05  # shortest time that a thread computes from one pause to the next, seconds
MOMENT = 0.05  # longest time that a picture of a moving arm waits for a frame of a drag, seconds
PATIENCE = 1.0  # time after which a waiting computation comes first, whatever its rank, seconds


class Rank(IntEnum):
    """What a computation is for; the smallest comes first."""

    DRAG = 0  # a frame that follows a hand, within a fraction of the time to the next one
    FIRST_PICTURE = 1  # of a page, a task or a scene, ten times as long
    REFINEMENT = 2


@dataclass(eq=False)
class _Place:
    """A computation that waits for a slot or has one."""

    rank: Rank
    cancelled: Cancelled
    jobs: Jobs | None  # of its visitor
    came: float = 0.0  # time of arrival, of `monotonic`

    @property
    def order(self) -> tuple[int, int, float]:  # the smallest is next
        rank = Rank.DRAG if monotonic() - self.came > PATIENCE else self.rank
        return rank, 0 if self.jobs is None else self.jobs.turn, self.came


class _Thread(threading.local):
    jobs: Jobs | None = None  # whose work the thread does
    place: _Place | None = None  # its slot
    pauses = False  # whether it pauses at checkpoints
    paused = 0.0  # when it last did, of `monotonic`


_thread = _Thread()


class Scheduler:
    """A bounded semaphore with priorities."""

    def __init__(self, num: int = os.cpu_count() or 1) -> None:
        """Allow `num` computations at once, at least two: one drag, and others beside it."""
        self._most, self._turns = {True: 1, False: max(1, num - 1)}, count(1)
        self._changed = threading.Condition()  # notified when a computation comes, begins or ends
        self._waiting: list[_Place] = []
        self._running: list[_Place] = []

    @contextmanager
    def slot(self, rank: Rank = Rank.DRAG, cancelled: Cancelled = never) -> Iterator[None]:
        """Wait for a slot, and have it within this block, where no thread waits for a second one.

        `cancelled` is asked while it waits, and at each checkpoint of a refinement. Raises UnwantedError if it is so.
        """
        place, before = _Place(rank, cancelled, _thread.jobs), (_thread.place, _thread.pauses)
        self._take(place)
        _thread.place, _thread.pauses = place, rank is Rank.REFINEMENT
        try:
            yield
        finally:
            _thread.place, _thread.pauses = before
            self._give_back(place)

    @contextmanager
    def between_drags(self) -> Iterator[None]:
        """Wait until no frame of a drag is computed, for a `MOMENT` at most; nothing pauses within this block."""
        before, _thread.pauses = _thread.pauses, False
        with self._changed:
            self._changed.wait_for(lambda: not self._drags, MOMENT)
        try:
            yield
        finally:
            _thread.pauses = before

    def pause(self) -> None:
        """Let frames of drags be computed, and what comes first have this thread's slot; see `checkpoint`."""
        place = _thread.place
        cancelled = never if place is None else place.cancelled
        if monotonic() - _thread.paused > LEAST:
            with self._changed:
                self._changed.wait_for(lambda: not self._drags or cancelled(), LONGEST)
                if place is not None and any(Rank.DRAG < other.rank < place.rank for other in self._waiting):
                    self._give_back(place)
                    self._take(place)
            _thread.paused = monotonic()
        end_if(cancelled)

    def wake(self) -> None:
        """Have each computation that waits or pauses ask at once whether it is cancelled."""
        with self._changed:
            self._changed.notify_all()

    @property
    def _drags(self) -> bool:
        return any(place.rank is Rank.DRAG for place in self._running)

    def _take(self, place: _Place) -> None:
        place.came = monotonic()
        with self._changed:
            self._waiting.append(place)
            try:
                end_if(place.cancelled)
                while not self._is_next(place):
                    self._changed.wait(LONGEST)
                    end_if(place.cancelled)
                self._running.append(place)
                if place.jobs is not None:
                    place.jobs.turn = next(self._turns)
            finally:
                self._waiting.remove(place)
                self._changed.notify_all()

    def _give_back(self, place: _Place) -> None:
        with self._changed:
            self._running = [other for other in self._running if other is not place]  # a pause may have ended without
            self._changed.notify_all()

    def _is_next(self, place: _Place) -> bool:
        drags = place.rank is Rank.DRAG
        num = sum((other.rank is Rank.DRAG) == drags for other in self._running)
        rivals = [other for other in self._waiting if (other.rank is Rank.DRAG) == drags]
        return num < self._most[drags] and place is min(rivals, key=lambda other: other.order)


SCHEDULER = Scheduler()  # of all that this process computes


def checkpoint() -> None:
    """Pause between parts of a long computation; raise UnwantedError if its result is not wanted any more."""
    end_if(lambda: _thread.jobs is not None and _thread.jobs.closed)
    if _thread.pauses:
        SCHEDULER.pause()


class Jobs:
    """Work of one visitor beside the server's event loop, in lanes: a thread each, one piece of work at a time."""

    def __init__(self, fail: Callable[[Exception], None]) -> None:
        """Wait for work; `fail` is called with exceptions that it raises until the visitor has left."""
        self._fail = fail
        self._changed = threading.Condition()  # notified when work comes or ends, and when the visitor leaves
        self._lanes: dict[str, deque[Callable[[], None]]] = {}  # work that waits, of each lane that has a thread
        self.turn = 0  # number of the visitor's last slot, of all
        self.closed = False  # whether the visitor has left

    def submit(self, lane: str, work: Callable[[], None], *, latest: bool = False) -> int:
        """Do work on a lane, in turn or in place of what waits there; return the number of works dropped for it.

        Running work may ask `superseded` between its parts. Nothing is done once the visitor has left.
        """
        with self._changed:
            if self.closed:
                return 0
            num_dropped = self.drop(lane) if latest else 0
            if lane not in self._lanes:  # where no thread can start, the lane must not seem to have one
                threading.Thread(target=self._run, args=(lane,), name=lane, daemon=True).start()
            self._lanes.setdefault(lane, deque()).append(work)
            self._changed.notify_all()
        SCHEDULER.wake()
        return num_dropped

    def drop(self, lane: str) -> int:
        """Drop what waits on a lane; return how much that was."""
        with self._changed:
            num = len(waiting := self._lanes.get(lane, deque()))
            waiting.clear()
            return num

    def busy(self, lane: str) -> bool:
        """Return whether a lane works."""
        return lane in self._lanes

    def superseded(self, lane: str) -> bool:
        """Return whether newer work waits on a lane, or the visitor has left."""
        return self.closed or bool(self._lanes.get(lane))

    def rest(self, seconds: float, lane: str = "") -> None:
        """Pause work for so long, or until its lane, if it is named, has newer work, or the visitor has left."""
        with self._changed:
            self._changed.wait_for(lambda: self.superseded(lane), seconds)

    def wait_idle(self, lane: str = "", timeout: float | None = None) -> bool:
        """Wait until a lane, or each, has nothing to do; False if that took longer than `timeout` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self.busy(lane) if lane else self._lanes), timeout)

    def close(self) -> None:
        """Drop what waits: the visitor has left. What runs ends at its next checkpoint, and is not waited for."""
        with self._changed:
            self.closed = True
            for lane in self._lanes:
                self.drop(lane)
            self._changed.notify_all()
        SCHEDULER.wake()

    def _run(self, lane: str) -> None:
        _thread.jobs, _thread.pauses = self, True
        while True:
            with self._changed:
                if not self._lanes[lane]:
                    del self._lanes[lane]
                    self._changed.notify_all()
                    return
                work = self._lanes[lane].popleft()
            try:
                work()
            except UnwantedError:
                pass
            except Exception as error:  # whatever work raises, the page goes on
                if not self.closed:
                    logger.exception("%s failed", lane)
                    try:
                        self._fail(error)
                    except Exception:  # the page that is to show it may be what broke
                        logger.exception("an error of %s could not be shown", lane)
