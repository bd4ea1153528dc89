"""Work of one visitor beside the server's event loop, in lanes: one thing at a time in each."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

from dt_viz.accounts import Account, charged
from dt_viz.checkpoints import checked
from dt_viz.errors import UnwantedError, never

logger = logging.getLogger(__name__)

Work = Callable[[], None]


class Jobs:
    """Executor of one visitor. A lane has a thread while it has work, so lanes wait for nobody else.

    Running work is never cancelled from outside (that would show nothing until a drag ends); it may ask `superseded`
    between its parts and leave out the rest, or do what waits, too, and `drop` it. Else what was submitted last to a
    lane is always done.
    """

    def __init__(
        self,
        fail: Callable[[Exception], None],
        account: Account | None = None,
        wake: Callable[[int], None] = lambda _thread: None,
        give_way: Callable[[], object] = never,
    ) -> None:
        """Wait for work; `fail` is told of the exceptions that it raises, unless the visitor has left.

        Its processor time is charged to the visitor's `account`, if there is one; `wake` is told the number of a thread
        whose work is superseded; `give_way` is called at each checkpoint of work, and may pause.
        """
        self._fail, self._account, self._wake, self._give_way = fail, account, wake, give_way
        self._lock = threading.Lock()
        self._news: dict[str, threading.Condition] = {}
        """Notified of new work, for each lane that has rested: what is news for one lane wakes no other one."""
        self._idle, self._left = threading.Condition(self._lock), threading.Condition(self._lock)
        """Notified when a lane has nothing to do any more, and when the visitor leaves."""
        self._lanes: dict[str, deque[Work]] = {}
        """Work that waits, of each lane that has a thread."""
        self._threads: dict[str, int] = {}
        """Numbers of the lanes' threads."""
        self.closed = False
        """Whether the visitor has left."""

    def submit(self, lane: str, work: Work, *, latest: bool = False) -> int:
        """Do work on a lane, in turn or as its latest; nothing once the visitor has left. Never blocks for long.

        Returns:
            Number of the works that waited and were dropped for the latest one.
        """
        with self._lock:
            if self.closed:  # a control that still moves while its page goes away
                return 0
            dropped = self._drop(lane) if latest else 0
            if lane in self._lanes:
                self._lanes[lane].append(work)
                self._supersede(lane)
            else:
                # it waits until this lets go; a lane without a thread, where none can start, would be busy for ever
                threading.Thread(target=self._run, args=(lane,), name=lane, daemon=True).start()
                self._lanes[lane] = deque([work])
            return dropped

    def drop(self, lane: str) -> int:
        """Drop what waits on a lane; return how much that was."""
        with self._lock:
            return self._drop(lane)

    def busy(self, lane: str) -> bool:
        """Return whether a lane works."""
        return lane in self._lanes

    def superseded(self, lane: str) -> bool:
        """Return whether newer work waits on a lane, or the visitor has left."""
        return self.closed or bool(self._lanes.get(lane))

    def rest(self, lane: str, seconds: float) -> None:
        """Pause the work of a lane, which calls this, for so long or until it is superseded."""
        with self._lock:
            news = self._news.setdefault(lane, threading.Condition(self._lock))
            news.wait_for(lambda: self.superseded(lane), seconds)

    def pause(self, seconds: float) -> None:
        """Pause the work of a lane, which calls this, for so long, whatever waits, or until the visitor has left."""
        with self._left:
            self._left.wait_for(lambda: self.closed, seconds)

    def wait_idle(self, lane: str | None = None, timeout: float | None = None) -> bool:
        """Wait until a lane, or each, has nothing to do; False if that took longer than `timeout` seconds."""
        with self._idle:
            return self._idle.wait_for(lambda: not (self.busy(lane) if lane else self._lanes), timeout)

    def close(self) -> None:
        """Drop what waits: the visitor has left. What runs is not waited for."""
        with self._lock:
            self.closed = True
            for lane in self._lanes:
                self._drop(lane)
                self._supersede(lane)
            self._left.notify_all()

    def _supersede(self, lane: str) -> None:
        if lane in self._threads:
            self._wake(self._threads[lane])
        if lane in self._news:
            self._news[lane].notify_all()

    def _drop(self, lane: str) -> int:
        waiting = self._lanes.get(lane, deque())
        dropped = len(waiting)
        waiting.clear()
        return dropped

    def _run(self, lane: str) -> None:
        while True:
            with self._lock:
                self._threads[lane] = threading.get_ident()
                waiting = self._lanes[lane]
                if not waiting:
                    del self._lanes[lane], self._threads[lane]
                    self._idle.notify_all()
                    return
                work = waiting.popleft()
            try:
                with charged(self._account), checked(self._give_way):
                    work()
            except UnwantedError:
                pass
            except Exception as error:  # the one place where whatever work raises is caught: the page goes on
                if not self.closed:
                    logger.exception("%s failed", lane)
                    self._report(lane, error)

    def _report(self, lane: str, error: Exception) -> None:
        try:
            self._fail(error)
        except Exception:  # the page that is to show it may be what broke
            logger.exception("an error of %s could not be shown", lane)
