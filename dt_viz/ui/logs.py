"""A log that nobody outside can fill, and that holds nothing of what visitors send."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable

MAX_RECORDS = 5
"""Records of one kind in a `PERIOD`."""
PERIOD = 60.0
"""Seconds after which records of a kind are let through again."""

_Kind = tuple[str, int, str | None]


class Terse(logging.Filter):
    """Lets a few records of each kind through, and of an exception its type and its places, not its text.

    A kind is a place in the program, so there are only so many. The first record after a `PERIOD` says how many were
    left out.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Count by this clock, seconds."""
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[_Kind, tuple[float, int]] = {}
        """When the period began, and how many records there were since."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write the record; what is not to be written of it is taken out."""
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
        """How many of its kind were left out in the period before; None if this one is to be left out, too."""
        now = self._clock()
        with self._lock:
            began, count = self._counts.get(kind, (now, 0))
            left_out = 0
            if now - began >= PERIOD:
                began, count, left_out = now, 0, max(0, count - MAX_RECORDS)
            self._counts[kind] = began, count + 1
        return left_out if count < MAX_RECORDS else None
