"""Store of learned imitations, in memory and in the user's cache folder, keyed by what they were learned from."""

from __future__ import annotations

import hashlib
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from dt_viz.files.npz import read_cached, write_cached
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, Progress, fit
from dt_viz.learning.interface import AnyImitation, State
from dt_viz.learning.state import learn

FORMAT = 5
"""Version of the fit and its file; raised with every change, so that older files are not used."""

MAX_BYTES = 40 * 10**6  # largest number of bytes that a file unpacks to

LONGEST_WRITE = 3600.0
"""Age after which an incomplete file counts as left behind by a server that has ended, seconds."""

LONGEST_WITHOUT_REPORT = 0.2
"""Longest time between two progress reports to those who wait for a fit, seconds."""


class FitStore:
    """Fits on demand, once for all visitors; a damaged file is fitted anew, never trusted.

    Who asks first for a fit makes it, others wait for that one only; where the first gives up, the next begins anew.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._memory: dict[str, Imitation] = {}
        self._making: dict[str, threading.Lock] = {}
        self._reports: dict[str, tuple[float, str]] = {}  # how far fits are that are being made
        if folder is not None:
            _remove_leftovers(folder)

    def learned(
        self,
        demonstrations: tuple[Demonstration, ...],
        settings: ImitationSettings | None = None,
        state: State = "auto",
        progress: Progress | None = None,
    ) -> AnyImitation:
        """Return what is learned from these demonstrations in a state; see `dt_viz.learning.state.learn` and `get`.

        What is learned in the augmented state is not stored: it takes milliseconds.
        """
        plain = lambda settings, progress: self.get(demonstrations, settings, progress)  # noqa: E731
        return learn(demonstrations, settings, state, progress=progress, plain=plain)

    def get(
        self,
        demonstrations: tuple[Demonstration, ...],
        settings: ImitationSettings | None = None,
        progress: Progress | None = None,
    ) -> Imitation:
        """Return the plain imitation of these demonstrations, fitted if it is new; None takes default settings.

        Progress, see `dt_viz.learning.imitation.fit`, is not called for a known fit. It may raise an exception to
        cancel, which is let through; to those who wait for another's fit it is called repeatedly, also without news.

        Raises:
            ImitationError: as `dt_viz.learning.imitation.fit`.
        """
        settings = settings or ImitationSettings()
        key = fingerprint(demonstrations, f"{FORMAT} {settings!r}")
        progress = progress or (lambda _fraction, _message: None)
        if key in self._memory:
            return self._memory[key]

        def tell(fraction: float, message: str) -> None:
            self._reports[key] = fraction, message
            progress(fraction, message)

        lock = self._making.setdefault(key, threading.Lock())
        while not lock.acquire(timeout=LONGEST_WITHOUT_REPORT):
            progress(*self._reports.get(key, (0.0, "looking for a stored fit")))
        try:
            if key not in self._memory:
                path = None if self._folder is None else self._folder / f"{key}.npz"
                imitation = None if path is None else read_cached(path, Imitation.from_arrays, MAX_BYTES)
                if imitation is None:
                    imitation = fit(demonstrations, settings, tell)
                    if path is not None:
                        write_cached(path, imitation.to_arrays())
                self._memory[key] = imitation
            return self._memory[key]
        finally:
            self._reports.pop(key, None)
            lock.release()


def _remove_leftovers(folder: Path) -> None:
    """Remove incomplete files of servers that have ended; those of running servers are younger."""
    for path in folder.glob("*.partial"):
        with suppress(OSError):  # another server may be faster
            if time.time() - path.stat().st_mtime > LONGEST_WRITE:
                path.unlink()


def fingerprint(demonstrations: tuple[Demonstration, ...], purpose: str) -> str:
    """Digest of what is made from demonstrations for a purpose; their names play no part."""
    digest = hashlib.sha256(purpose.encode())
    for demonstration in demonstrations:
        digest.update(repr(demonstration.positions.shape).encode())
        digest.update(np.ascontiguousarray(demonstration.times, dtype=float).tobytes())
        digest.update(np.ascontiguousarray(demonstration.positions, dtype=float).tobytes())
    return digest.hexdigest()
