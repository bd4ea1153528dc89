"""Visitors' files, read by a process of their own: what they make a reader do does not harm the server."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np

from dt_viz.errors import Cancelled, FormatError, end_if, never
from dt_viz.files import worker
from dt_viz.files.processes import start_module
from dt_viz.files.values import unpacked

T = TypeVar("T")
START = 60.0
"""Longest time until a process is ready for a file, seconds; a busy machine takes ten to import what it needs."""
PATIENCE = 20.0
"""Longest time for a file from then on, seconds."""


class _Process:
    """A process of `dt_viz.files.worker`, which may read the files of one request."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="dt-viz-")  # what a process leaves that is ended goes with it
        self._answer = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `end`; a pipe could be filled without end
        self._process = start_module(
            worker.__name__, output=self._answer, given=subprocess.PIPE, temporary=self._folder.name
        )

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._process.poll() is not None

    def read(self, kind: type[T], request: bytes, cancelled: Cancelled) -> T:
        """Have files read, and end. Raises as `read_upload`."""
        try:
            self._give(request, cancelled)
            self._answer.seek(1)  # behind the line that says that it is ready
            line = self._answer.readline(2**22)
            if self._process.returncode or not line:
                found = f"something that ended its reader ({self._process.returncode})"
                raise FormatError("file", found, "a whole file")
            first = json.loads(line)
            if "refused" in first:
                field, found, accepted = map(str, first["refused"])
                raise FormatError(field, found, accepted)
            arrays = {str(name): np.load(self._answer, allow_pickle=False) for name in first["arrays"]}
            return unpacked(first["value"], kind, "file", arrays)
        finally:
            self.end()

    def _give(self, request: bytes, cancelled: Cancelled) -> None:
        """Give it a request, and wait until it has ended."""
        deadline, ready = time.monotonic() + START, False
        given: bytes | None = request
        while True:
            if not ready and os.fstat(self._answer.fileno()).st_size:
                deadline, ready = time.monotonic() + PATIENCE, True
            with suppress(subprocess.TimeoutExpired):
                self._process.communicate(given, timeout=0.1)  # seconds until it may be unwanted
                return
            given = None  # the rest of it
            end_if(cancelled)
            if time.monotonic() > deadline:
                found = f"data that take more than {PATIENCE:.0f} s to read"
                raise FormatError("file", found, "a simpler file")

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with suppress(OSError):  # what it has not taken
            self._process.stdin.close()
        self._answer.close()
        self._folder.cleanup()


class _Ready:
    """The process that waits for the next file, as long as somebody may send one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users: set[object] = set()
        self._process: _Process | None = None

    def take(self) -> _Process:
        """Return a process, the one that waits unless it has died meanwhile."""
        with self._lock:
            process, self._process = self._process, None
        if process is not None and process.has_ended:
            process.end()
            process = None
        return process or _Process()

    def renew(self) -> None:
        """Start the next process."""
        with self._lock:
            if self._users and self._process is None:
                self._process = _Process()

    def set_user(self, user: object, *, present: bool) -> None:
        """Add or remove somebody who may send files; end the process with the last one."""
        with self._lock:
            self._users = self._users | {user} if present else self._users - {user}
            if not self._users and self._process is not None:
                self._process.end()
                self._process = None


_ready = _Ready()


def read_upload(
    kind: type[T],
    files: Sequence[tuple[str, bytes]],
    cancelled: Cancelled = never,
    **options: Any,  # noqa: ANN401 - what JSON can hold
) -> T:
    """Read files in another process.

    Args:
        kind: class of what is read, one of `dt_viz.files.worker.READERS`.
        files: name and content of each.
        cancelled: whether nobody wants it any more.
        options: further arguments of the reader.

    Returns:
        A value of that class, of its types; its arrays are finite, and of any shape.

    Raises:
        FormatError: the files cannot be read, or not within the limits of memory and time.
        UnwantedError: nobody wants it any more.
        Exception: of almost any kind, if the process gave another answer.
    """
    first = json.dumps([kind.__name__, [[name, len(content)] for name, content in files], options]).encode()
    request = b"".join([first, b"\n", *(content for _, content in files)])
    try:
        return _ready.take().read(kind, request, cancelled)
    finally:
        _ready.renew()


def make_ready() -> None:
    """Start the process for a file that is about to come."""
    _ready.renew()


def keep_ready(user: object) -> None:
    """Keep a process ready, from the first file on, since this user may send more."""
    _ready.set_user(user, present=True)


def let_go(user: object) -> None:
    """Keep no process ready for this user any more."""
    _ready.set_user(user, present=False)
