"""Store of learned imitations, in memory and in the user's cache folder, keyed by what they were learned from."""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from dt_viz.files.npz import arrays_of, npz_bytes, write_whole
from dt_viz.learning.choice import AnyImitation, State, learn
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, Progress, fit

logger = logging.getLogger(__name__)

FORMAT = 4
"""Version of the fit and its file; raised with every change, so that older files are not used."""

MAX_BYTES = 40 * 10**6
"""Largest number of bytes that a file unpacks to."""

LONGEST_WRITE = 3600.0
"""Age after which an incomplete file counts as left behind by a server that has ended, seconds."""

LONGEST_WITHOUT_REPORT = 0.2
"""Longest time between two progress reports to those who wait for a fit, seconds."""


class _AbandonedError(Exception):
    """A fit that nobody waits for any more."""


class _RunningFit:
    """A fit on a thread of its own that runs as long as somebody waits for it."""

    def __init__(self, work: Callable[[Progress], Imitation]) -> None:
        """Start the thread; the caller counts as waiting."""
        self._work = work
        self._changed = threading.Condition()
        self._num_waiting = 1
        self._num_reports, self._report = 0, (0.0, "looking for a stored fit")
        self._result: Imitation | None = None
        self._error: Exception | None = None
        threading.Thread(target=self._run, name="fit", daemon=True).start()

    def join(self) -> bool:
        """Join those who wait; return False if the fit has been abandoned."""
        with self._changed:
            self._num_waiting += self._num_waiting > 0
            return self._num_waiting > 0

    def wait(self, progress: Progress) -> Imitation:
        """Return the result. What `progress` raises is let through, and ends the fit if nobody else waits for it."""
        seen = 0
        try:
            while True:
                with self._changed:
                    if not self._ended and self._num_reports == seen:
                        self._changed.wait(LONGEST_WITHOUT_REPORT)
                    ended, fresh = self._ended, self._num_reports > seen
                    seen, report = self._num_reports, self._report
                if fresh or not ended:
                    progress(*report)
                if self._error is not None:
                    raise self._error
                if self._result is not None:
                    return self._result
        finally:
            with self._changed:
                self._num_waiting -= 1

    @property
    def _ended(self) -> bool:
        return self._result is not None or self._error is not None

    def _run(self) -> None:
        result, failed = None, None
        try:
            result = self._work(self._tell)
        except Exception as error:  # any error is for those who wait
            failed = error
        with self._changed:
            self._result, self._error = result, failed
            self._changed.notify_all()

    def _tell(self, fraction: float, message: str) -> None:
        with self._changed:
            if not self._num_waiting:
                raise _AbandonedError
            self._num_reports += 1
            self._report = (fraction, message)
            self._changed.notify_all()


class FitStore:
    """Fits on demand, once for all visitors; a damaged file is fitted anew, never trusted.

    Each fit has a thread of its own, so that nobody waits for the fit of another motion, and one visitor can stop
    waiting while others go on.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._memory: dict[str, Imitation] = {}
        self._running: dict[str, _RunningFit] = {}
        self._lock = threading.Lock()
        if folder is not None:
            _remove_leftovers(folder)

    def learned(
        self,
        demonstrations: tuple[Demonstration, ...],
        settings: ImitationSettings | None = None,
        state: State = "auto",
        progress: Progress | None = None,
    ) -> AnyImitation:
        """Return what is learned from these demonstrations in a state; see `dt_viz.learning.choice.learn` and `get`.

        What is learned in the augmented state is not stored: it takes milliseconds.
        """
        plain = lambda settings: self.get(demonstrations, settings, progress)  # noqa: E731
        return learn(demonstrations, settings, state, plain=plain)

    def get(
        self,
        demonstrations: tuple[Demonstration, ...],
        settings: ImitationSettings | None = None,
        progress: Progress | None = None,
    ) -> Imitation:
        """Return the plain imitation of these demonstrations, fitted if it is new.

        Args:
            demonstrations: motions to imitate.
            settings: settings of the fit; None takes the defaults.
            progress: see `dt_viz.learning.imitation.fit`; not called for a known fit. It is also called repeatedly
                without news, so that it can raise an exception to cancel: that is let through, and the fit goes on
                only if somebody else waits for it.

        Raises:
            ImitationError: as `dt_viz.learning.imitation.fit`.
        """
        settings = settings or ImitationSettings()
        key = _content_key(demonstrations, settings)
        with self._lock:
            if key in self._memory:
                return self._memory[key]
            running = self._running.get(key)
            if running is None or not running.join():
                running = self._running[key] = self._begin(key, demonstrations, settings)
        return running.wait(progress or (lambda _fraction, _message: None))

    def _begin(self, key: str, demonstrations: tuple[Demonstration, ...], settings: ImitationSettings) -> _RunningFit:
        """Start to read or fit on another thread; the lock must be held."""

        def work(progress: Progress) -> Imitation:
            try:
                imitation = self._read(key) or self._fit(key, demonstrations, settings, progress)
                with self._lock:
                    return self._memory.setdefault(key, imitation)
            finally:
                with self._lock:
                    if self._running.get(key) is running:
                        del self._running[key]

        running = _RunningFit(work)
        return running

    def _fit(
        self, key: str, demonstrations: tuple[Demonstration, ...], settings: ImitationSettings, progress: Progress
    ) -> Imitation:
        imitation = fit(demonstrations, settings, progress)
        if self._folder is not None:
            path = self._folder / f"{key}.npz"
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                write_whole(path, npz_bytes(imitation.to_arrays()))
            except OSError as error:
                logger.warning("the fit was not cached: %s", error)
        return imitation

    def _read(self, key: str) -> Imitation | None:
        path = self._folder / f"{key}.npz" if self._folder is not None else None
        if path is None or not path.exists():
            return None
        try:
            return Imitation.from_arrays(arrays_of(path.read_bytes(), max_bytes=MAX_BYTES))
        except Exception as error:  # damaged bytes make zipfile and zlib raise almost anything
            logger.warning("%s is damaged and will be fitted anew: %s", path, error)
            return None


def _remove_leftovers(folder: Path) -> None:
    """Remove incomplete files of servers that have ended; those of running servers are younger."""
    for path in folder.glob("*.partial"):
        with suppress(OSError):  # another server may be faster
            if time.time() - path.stat().st_mtime > LONGEST_WRITE:
                path.unlink()


def _content_key(demonstrations: tuple[Demonstration, ...], settings: ImitationSettings) -> str:
    return fingerprint(demonstrations, f"{FORMAT} {settings!r}")


def fingerprint(demonstrations: tuple[Demonstration, ...], purpose: str) -> str:
    """Digest of what is made from demonstrations for a purpose; their names play no part."""
    digest = hashlib.sha256(purpose.encode())
    for demonstration in demonstrations:
        digest.update(repr(demonstration.positions.shape).encode())
        digest.update(np.ascontiguousarray(demonstration.times, dtype=float).tobytes())
        digest.update(np.ascontiguousarray(demonstration.positions, dtype=float).tobytes())
    return digest.hexdigest()
