"""Folders of the user's machine."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

PREFIX = "dt-viz-temporary-"  # beginning of the names of temporary folders


def default_cache_folder() -> Path:
    """Return `$XDG_CACHE_HOME/dt-viz`, or `~/.cache/dt-viz`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dt-viz"


class TemporaryFolder(tempfile.TemporaryDirectory):
    """A temporary folder, locked as long as this process lives: `remove_abandoned` removes what a killed one leaves."""

    def __init__(self) -> None:
        while True:
            super().__init__(prefix=PREFIX, ignore_cleanup_errors=True)
            self._lock = _locked(self.name, waits=True)
            if Path(self.name).exists():  # else another process has removed it before it was locked
                return
            self.cleanup()

    def cleanup(self) -> None:
        """Remove the folder and all that is in it."""
        super().cleanup()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def remove_abandoned() -> None:
    """Remove the temporary folders of processes that were killed, where the system has locks."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        if (lock := _locked(folder, waits=False)) is not None:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)


def _locked(folder: str | Path, *, waits: bool) -> int | None:
    """Return the descriptor of a folder that is now locked; None where another process has it locked, or none can."""
    try:
        import fcntl  # noqa: PLC0415 - not on Windows

        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except (ImportError, OSError):
        return None
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
    except OSError:
        os.close(opened)
        return None
    return opened
