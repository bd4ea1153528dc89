"""Files of visitors, read one at a time over all visitors, each for as long as its visitor stays."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dt_viz.engine.engine import let_drags_pass
from dt_viz.interruption import UnwantedError, interruptible

logger = logging.getLogger(__name__)

LOOK = 0.1
"""Time between two looks whether a visitor who waits is still there, seconds."""
LONGEST_PAUSE = 0.1
"""Longest pause of reading at a checkpoint, for others who drag, seconds."""

_one_file = threading.Lock()
"""Held by who reads: a file takes up to some hundred megabytes on its way to an obstacle."""


class Reader:
    """Reads the files of one visitor, on a thread of its own."""

    def __init__(self, waits: Callable[[], None]) -> None:
        """Read nothing yet.

        Args:
            waits: called when another visitor's file is being read, so that this visitor's has to wait.
        """
        self._waits = waits
        self._left = threading.Event()
        self._busy = threading.Lock()

    def begin(self, read: Callable[[], None]) -> bool:
        """Have a file read soon, and shown; False if another one of this visitor is under way.

        What `read` raises is logged: it is expected to say itself what is wrong with the file.
        """
        if not self._busy.acquire(blocking=False):
            return False
        threading.Thread(target=self._run, args=(read,), name="file", daemon=True).start()
        return True

    def close(self) -> None:
        """The visitor has left: stop reading at the next checkpoint, and waiting."""
        self._left.set()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait until no other file is read, then read within this block; others who drag go first at checkpoints.

        Raises:
            UnwantedError: the visitor has left.
        """
        if not _one_file.acquire(blocking=False):
            self._waits()
            while not _one_file.acquire(timeout=LOOK):
                self._check()
        try:
            with interruptible(self._pause):
                yield
        finally:
            _one_file.release()

    def _run(self, read: Callable[[], None]) -> None:
        try:
            read()
        except UnwantedError:
            pass
        except Exception:  # of a thread nobody else would hear of it
            logger.exception("a file could not be read")
        finally:
            self._busy.release()

    def _pause(self) -> None:
        self._check()
        let_drags_pass(LONGEST_PAUSE)

    def _check(self) -> None:
        if self._left.is_set():
            raise UnwantedError
