"""Learned imitations, kept in memory and in the user's cache folder by the content they were learned from."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np

from dt_viz.demos import Demonstration
from dt_viz.imitation import Imitation, ImitationSettings, Progress, fit

logger = logging.getLogger(__name__)

FORMAT = 1
"""Raised whenever the fit or its file changes, so that older files are not taken for newer ones."""


def default_cache_folder() -> Path:
    """`$XDG_CACHE_HOME/dt-viz`, or `~/.cache/dt-viz`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dt-viz"


class FitStore:
    """Fits on demand, once for all visitors; a damaged file is fitted anew, never trusted."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._memory: dict[str, Imitation] = {}
        self._lock = threading.Lock()

    def get(
        self,
        demonstrations: tuple[Demonstration, ...],
        settings: ImitationSettings | None = None,
        progress: Progress | None = None,
    ) -> Imitation:
        """The imitation of these demonstrations, fitted if it is new.

        Args:
            demonstrations: what to imitate.
            settings: of the fit; None takes the defaults.
            progress: see `dt_viz.imitation.fit`; not called for a fit that is known.

        Raises:
            ImitationError: as `dt_viz.imitation.fit`.
        """
        settings = settings or ImitationSettings()
        key = _content_key(demonstrations, settings)
        with self._lock:  # two visitors who open the same task fit it once
            if key not in self._memory:
                self._memory[key] = self._read(key) or self._fit(key, demonstrations, settings, progress)
            return self._memory[key]

    def _fit(
        self,
        key: str,
        demonstrations: tuple[Demonstration, ...],
        settings: ImitationSettings,
        progress: Progress | None,
    ) -> Imitation:
        imitation = fit(demonstrations, settings, progress)
        if self._folder is not None:
            path = self._folder / f"{key}.npz"
            partial = path.with_suffix(f".{os.getpid()}.partial")
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                with partial.open("wb") as file:
                    np.savez_compressed(file, allow_pickle=False, **imitation.to_arrays())
                partial.replace(path)
            except OSError as error:
                logger.warning("the fit was not cached: %s", error)
                with suppress(OSError):
                    partial.unlink()
        return imitation

    def _read(self, key: str) -> Imitation | None:
        path = self._folder / f"{key}.npz" if self._folder is not None else None
        if path is None or not path.exists():
            return None
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                if damaged := arrays.zip.testzip():  # numpy stops reading before a member's checksum is looked at
                    raise ValueError(f"{damaged} does not match its checksum")
                return Imitation.from_arrays(arrays)
        except Exception as error:  # damaged bytes make zipfile, zlib and numpy raise almost anything
            logger.warning("%s is damaged and will be fitted anew: %s", path, error)
            return None


def _content_key(demonstrations: tuple[Demonstration, ...], settings: ImitationSettings) -> str:
    digest = hashlib.sha256(f"{FORMAT} {settings!r}".encode())
    for demonstration in demonstrations:
        digest.update(repr(demonstration.positions.shape).encode())
        digest.update(np.ascontiguousarray(demonstration.times, dtype=float).tobytes())
        digest.update(np.ascontiguousarray(demonstration.positions, dtype=float).tobytes())
    return digest.hexdigest()
