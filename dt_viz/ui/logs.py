"""A log that visitors cannot flood, and that contains nothing they send."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable

MAX_RECORDS = 5
"""Largest number of records of one kind in a `PERIOD`."""
PERIOD = 60.0
"""Time after which records of a kind are logged again, seconds."""

_Kind = tuple[str, int, str | None]


class Terse(logging.Filter):
    """Filter that passes a few records of each kind, with the type and traceback of exceptions but not their text.

    A kind is a place in the program, so their number is limited. The first record after a `PERIOD` says how many were
    left out.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Count by a clock, seconds."""
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[_Kind, tuple[float, int]] = {}
        """Start of the current period, and number of records since, by kind."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write the record, after removing its confidential parts."""
        place = None
        if record.exc_info and record.exc_info[0] is not None:
            kind, _, trace = record.exc_info
            frames = traceback.extract_tb(trace)
            place = f"{kind.__name__}" + (f" {frames[-1].filename}:{frames[-1].lineno}" if frames else "")
            record.exc_text = "".join(traceback.format_list(frames)) + kind.__name__
            record.exc_info = None
        left_out = self._num_left_out((record.pathname, record.lineno, place))
        if left_out is None:
            return False
        if left_out:
            record.msg, record.args = f"{record.getMessage()} (and {left_out} more like this)", ()
        return True

    def _num_left_out(self, kind: _Kind) -> int | None:
        """Return how many of its kind were left out in the last period; None if this one is left out, too."""
        now = self._clock()
        with self._lock:
            began, count = self._counts.get(kind, (now, 0))
            left_out = 0
            if now - began >= PERIOD:
                began, count, left_out = now, 0, max(0, count - MAX_RECORDS)
            self._counts[kind] = began, count + 1
        return left_out if count < MAX_RECORDS else None
