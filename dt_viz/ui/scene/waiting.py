"""Waiting for a browser, or another program, for only as long as the result is wanted."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from time import monotonic, thread_time
from typing import TypeVar

from dt_viz.accounts import settle
from dt_viz.errors import Cancelled, end_if

LOOK = 0.1
"""Interval at which whoever waits asks whether the result is still wanted, seconds."""
BROWSER = "the browser, its page out of sight perhaps, drew nothing"
"""What is said of a browser that is not waited for any longer."""

_Result = TypeVar("_Result")


class Worker:
    """A thread, until the end of a `with` block, whose results are waited for only while they are wanted."""

    def __init__(self, cancelled: Cancelled, patience: float) -> None:
        """Start it; `cancelled` may raise, too, and `patience` is the longest time to wait for a result, seconds."""
        self._pool, self._cancelled, self._patience = ThreadPoolExecutor(1, "worker"), cancelled, patience

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_error: object) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)

    def done(self, work: Callable[[], _Result], failed: str) -> _Result:
        """Return the result of work, whose processor time is charged to the visitor.

        Raises:
            TimeoutError: it takes too long; the text begins with what `failed`.
            UnwantedError: it is cancelled.
        """

        def timed() -> tuple[_Result, float]:
            began = thread_time()
            return work(), thread_time() - began

        future, deadline = self._pool.submit(timed), monotonic() + self._patience
        while not wait([future], LOOK).done:
            end_if(self._cancelled)
            if monotonic() > deadline:
                raise TimeoutError(f"{failed} within {self._patience:g} s")
        result, seconds = future.result()
        settle(seconds)
        return result
