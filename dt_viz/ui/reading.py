"""Reading of uploaded files, one at a time over all visitors."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dt_viz.errors import UnwantedError, end_if
from dt_viz.files.uploads import keep_ready, let_go

logger = logging.getLogger(__name__)

LOOK = 0.1
"""Interval of the checks whether a waiting visitor is still there, seconds."""

_one_file = threading.Lock()
"""Lock of the reader: a file takes up to a gigabyte, in another process, on its way to an obstacle."""


class Reader:
    """Reads the files of one visitor, on a thread of its own."""

    def __init__(self, waits: Callable[[], None]) -> None:
        """Prepare for the files of a visitor.

        Args:
            waits: called when a file has to wait for another visitor's.
        """
        self._waits = waits
        self._left = threading.Event()
        self._busy = threading.Lock()
        keep_ready(self)

    def begin(self, read: Callable[[], None]) -> bool:
        """Start to read a file; return False if another one of this visitor is being read.

        What `read` raises is logged; it should report bad files itself.
        """
        if not self._busy.acquire(blocking=False):
            return False
        threading.Thread(target=self._run, args=(read,), name="file", daemon=True).start()
        return True

    def left(self) -> bool:
        """Return whether the visitor has left: what is being read is not wanted any more."""
        return self._left.is_set()

    def close(self) -> None:
        """Stop waiting, and drop what is being read: the visitor has left."""
        self._left.set()
        let_go(self)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait until no other file is being read, and read within the block.

        Raises:
            UnwantedError: the visitor has left, before the block or within it.
        """
        if not _one_file.acquire(blocking=False):
            self._waits()
            while not _one_file.acquire(timeout=LOOK):
                end_if(self.left)
        try:
            yield
        finally:
            _one_file.release()
        end_if(self.left)

    def _run(self, read: Callable[[], None]) -> None:
        try:
            read()
        except UnwantedError:
            pass
        except Exception:  # nobody else handles a thread's errors
            logger.exception("a file could not be read")
        finally:
            self._busy.release()
