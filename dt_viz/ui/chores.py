"""Work of buttons that takes longer than the server's event loop may wait."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

Later = Callable[[Callable[[], None]], None]
"""Function that queues work to be done later, in order."""


class Chores:
    """Does the queued work of one visitor in order, on a thread of its own."""

    def __init__(self, fail: Callable[[Exception], None]) -> None:
        """Wait for work; `fail` is called with the exceptions that it raises."""
        self._fail = fail
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="chores")

    def later(self, work: Callable[[], None]) -> None:
        """Queue work; nothing is done once the visitor has left."""
        with suppress(RuntimeError):  # of an executor that is closed
            self._executor.submit(self._do, work)

    def close(self) -> None:
        """Drop the work that has not begun."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _do(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            self._fail(error)
