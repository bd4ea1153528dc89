"""A log that visitors cannot flood, and that contains nothing they send."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable


class RateLimitFilter(logging.Filter):
    """Filter that passes a few records of each kind, with the type and traceback of exceptions but not their text.

    A kind is a place in the program, so their number is limited. The first record after a period says how many were
    left out.
    """

    def __init__(self, max_records: int = 5, period: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        """Pass at most `max_records` of a kind in a `period`, seconds, of a clock."""
        super().__init__()
        self._max_records, self._period, self._clock = max_records, period, clock
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, int, str], tuple[float, int]] = {}
        """Start of the current period, and number of records since, by kind."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write the record, after removing its confidential parts."""
        place, left_out = "", 0
        if record.exc_info and record.exc_info[0] is not None:
            error, _, trace = record.exc_info
            frames = traceback.extract_tb(trace)
            place = error.__name__ + (f" {frames[-1].filename}:{frames[-1].lineno}" if frames else "")
            record.exc_text = "".join(traceback.format_list(frames)) + error.__name__
            record.exc_info = None
        kind, now = (record.pathname, record.lineno, place), self._clock()
        with self._lock:
            began, count = self._counts.get(kind, (now, 0))
            if now - began >= self._period:
                began, count, left_out = now, 0, max(0, count - self._max_records)
            self._counts[kind] = began, count + 1
        if left_out:
            record.msg, record.args = f"{record.getMessage()} (and {left_out} more like this)", ()
        return count < self._max_records
