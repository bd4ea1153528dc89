"""Visitors' files, read by a process of their own: what they make a reader do does not harm the server."""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dt_viz.accounts import settle
from dt_viz.errors import Cancelled, FormatError, end_if, never
from dt_viz.files import worker
from dt_viz.files.processes import end_session, start_module
from dt_viz.files.values import unpacked

T = TypeVar("T")
START = 60.0
"""Longest time until a process is ready for a file, seconds; a busy machine takes ten to import what it needs."""
PATIENCE = 20.0
"""Longest time for a file from then on, seconds; see `dt_viz.files.worker.limit` for its processor time."""


def _ended(code: object) -> FormatError:
    return FormatError("file", f"something that ended its reader ({code})", "a whole file")


class _Process:
    """A process of `dt_viz.files.worker`, which reads the files of one request at a time."""

    def __init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="dt-viz-")  # what is left by what is ended goes with it
        self._folder = Path(self._temporary.name)
        self._said = self._folder / "said"
        with self._said.open("wb") as said:  # a pipe could be filled without end
            self._process = start_module(
                worker.__name__, output=said, given=subprocess.PIPE, temporary=self._temporary.name
            )
        self._num_lines, self._used = 1, 0.0
        self.is_idle = True
        """Whether it has read everything it was given."""

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._process.poll() is not None

    def read(self, kind: type[T], request: Sequence[bytes], cancelled: Cancelled) -> T:
        """Have files read. Raises as `read_upload`."""
        self.is_idle = False
        paths = [self._folder / name for name in (worker.REQUEST, worker.ANSWER)]
        with paths[0].open("wb") as file:
            file.writelines(request)
        found = f"none that is ready within {START:.0f} s"
        self._line(START, cancelled, FormatError("reader", found, "another try, when the server is less busy"))
        assert self._process.stdin is not None
        with suppress(OSError):  # it may have ended
            self._process.stdin.write(b"\n")
            self._process.stdin.flush()
        self._num_lines += 1
        found = f"data that take more than {PATIENCE:.0f} s to read"
        code, used = self._line(PATIENCE, cancelled, FormatError("file", found, "a simpler file")).split()
        settle(float(used) - self._used)
        self._used = float(used)
        if code != "0":
            raise _ended(code)
        self.is_idle = True
        try:
            with paths[1].open("rb") as file:
                first = json.loads(file.readline(worker.MAX_ANSWER))
                if "refused" in first:
                    field, found, accepted = map(str, first["refused"])
                    raise FormatError(field, found, accepted)
                arrays = {str(name): np.load(file, allow_pickle=False) for name in first["arrays"]}
        finally:
            for path in paths:
                path.unlink()
        return unpacked(first["value"], kind, "file", arrays)

    def _line(self, patience: float, cancelled: Cancelled, late: FormatError) -> str:
        """Wait for the newest line that it has to say: one when it is ready, then one for each request.

        Raises:
            FormatError: it has ended, or, which `late` says, not said anything for so long.
            UnwantedError: nobody wants it any more.
        """
        deadline = time.monotonic() + patience
        while len(lines := self._said.read_text().split("\n")[:-1]) < self._num_lines:  # those that have ended
            if self.has_ended:
                raise _ended(self._process.returncode)
            end_if(cancelled)
            if time.monotonic() > deadline:
                raise late
            time.sleep(0.02)  # until it may be unwanted
        return lines[-1]

    def end(self) -> None:
        """End the process, and the one that reads for it, whatever they do."""
        end_session(self._process)
        self._temporary.cleanup()


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

    def renew(self, process: _Process) -> None:
        """Have a process wait for the next file: this one if it can, or a new one."""
        with self._lock:
            if self._users and self._process is None:
                self._process = process if process.is_idle else _Process()
            if self._process is not process:
                process.end()

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
    """Read files, each a name and its content, in another process, as one of `dt_viz.files.worker.READERS`.

    The value is of that class and its types; its arrays are finite, and of any shape.

    Raises:
        FormatError: the files cannot be read, or not within the limits of memory and time.
        UnwantedError: nobody wants it any more.
        Exception: of almost any kind, if the process gave another answer.
    """
    first = json.dumps([kind.__name__, [[name, len(content)] for name, content in files], options]).encode()
    process = _ready.take()
    try:
        return process.read(kind, [first, b"\n", *(content for _, content in files)], cancelled)
    finally:
        _ready.renew(process)


def keep_ready(user: object) -> None:
    """Keep a process ready, from the first file on, since this user may send more."""
    _ready.set_user(user, present=True)


def let_go(user: object) -> None:
    """Keep no process ready for this user any more."""
    _ready.set_user(user, present=False)
