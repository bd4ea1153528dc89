"""A worker thread with one slot: the newest job waits, older waiting ones are dropped, the running one goes on."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

logger = logging.getLogger(__name__)

Job = TypeVar("Job")


class LatestWorker(Generic[Job]):
    """Runs jobs one at a time, always the newest next.

    A running job is never cancelled from outside (that would show nothing until a drag ends); it may ask `superseded`
    between its stages and leave out the rest. The last job submitted is always run.
    """

    def __init__(
        self,
        run: Callable[[Job, Callable[[], bool]], None],
        on_error: Callable[[Exception], None],
        name: str = "worker",
    ) -> None:
        """Start the thread.

        Args:
            run: does one job; its second argument tells whether a newer one is waiting.
            on_error: told of an exception that a job raised; the worker goes on.
            name: of the thread.
        """
        self._run = run
        self._on_error = on_error
        self._wake = threading.Condition()
        self._waiting: Job | None = None
        self._closed = False
        self._busy = False
        self.num_skipped = 0
        """Jobs that were dropped because a newer one came before they began."""
        self._thread = threading.Thread(target=self._loop, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Do this job next, instead of any that is still waiting. Never blocks for long."""
        with self._wake:
            if self._closed:  # a control that still moves while its page goes away
                return
            self.num_skipped += self._waiting is not None
            self._waiting = job
            self._wake.notify_all()

    def superseded(self) -> bool:
        """Whether a newer job than the running one is waiting, or the worker is closing."""
        return self._waiting is not None or self._closed

    def rest(self, seconds: float) -> None:
        """Called by a running job: pause it for so long, or until it is superseded."""
        with self._wake:
            self._wake.wait_for(self.superseded, seconds)

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait until nothing runs or waits; False if that took longer than `timeout` seconds."""
        with self._wake:
            return self._wake.wait_for(lambda: not self._busy and self._waiting is None, timeout)

    def close(self) -> None:
        """Let the running job end and stop. Does not wait for it."""
        with self._wake:
            self._closed = True
            self._waiting = None
            self._wake.notify_all()

    def _loop(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                self._wake.wait_for(lambda: self._closed or self._waiting is not None)
                if self._closed:
                    return
                job, self._waiting, self._busy = self._waiting, None, True
            assert job is not None
            try:
                self._run(job, self.superseded)
            except Exception as error:  # the one place where whatever a job raises is caught: the session goes on
                logger.exception("a job of %s failed", self._thread.name)
                self._report(error)

    def _report(self, error: Exception) -> None:
        try:
            self._on_error(error)
        except Exception:  # the page that is to show it may be what broke
            logger.exception("an error of %s could not be shown", self._thread.name)
