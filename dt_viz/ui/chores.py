"""Work that a press of a button asks for and that takes longer than the server's event loop may wait."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

Later = Callable[[Callable[[], None]], None]
"""Takes work that is done later, in the order in which it was asked for."""


class Chores:
    """Does the work of one visitor on a thread of its own, one piece after the other."""

    def __init__(self, fail: Callable[[Exception], None]) -> None:
        """Wait for work; `fail` is told of what it raises."""
        self._fail = fail
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="chores")

    def later(self, work: Callable[[], None]) -> None:
        """Do this after what was asked for before; nothing is done once the visitor has left."""
        with suppress(RuntimeError):  # of an executor that is closed
            self._executor.submit(self._do, work)

    def close(self) -> None:
        """Forget what has not begun."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _do(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            self._fail(error)
