"""Visitors' files, read by a process of their own with limits of memory, time and files.

Each request has a process: a fork of multiprocessing's forkserver, which has imported the readers, or a new process
where the system has no forkserver. The values come back in the file `answer` of a temporary folder: a line of JSON,
`{"value": …, "arrays": [names]}` as `dt_viz.files.values.packed` makes it, or `{"refused": [field, found, accepted]}`,
then the arrays as `numpy.save` writes them. Nothing that the process sends is unpickled, as an executor would do.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dt_viz.errors import Cancelled, FormatError, end_if, never
from dt_viz.files.confinement import confine
from dt_viz.files.npz import Archive, read_archive
from dt_viz.files.processes import stand_back
from dt_viz.files.recordings import Recordings, read_recordings
from dt_viz.files.shapes import Points, Triangles, read_points, read_triangles
from dt_viz.files.triangles import Distances, read_distances
from dt_viz.files.values import packed, unpacked
from dt_viz.folders import TemporaryFolder

T = TypeVar("T")
START = 60.0
"""Longest time until a process is ready for a file, seconds; a busy machine takes ten to import the readers."""
PATIENCE = 20.0  # longest time for a file from then on, seconds
MEMORY = 2**30  # largest address space of the process, bytes
MAX_ANSWER = 10**8  # largest size of an answer, bytes
LIMITS = {"AS": MEMORY, "CPU": 15, "FSIZE": MAX_ANSWER, "NOFILE": 32, "CORE": 0}
"""Limits of the process, named as in the module resource; of processor time in seconds."""
READERS: Mapping[str, Callable[..., Any]] = {
    Triangles.__name__: read_triangles,
    Points.__name__: read_points,
    Recordings.__name__: read_recordings,
    Archive.__name__: read_archive,
    Distances.__name__: read_distances,
}
"""Readers of names and contents, by the class of the value."""
CONTEXT: Any = multiprocessing.get_context("forkserver" if hasattr(os, "fork") else "spawn")
if hasattr(os, "fork"):
    CONTEXT.set_forkserver_preload([__name__])


def read_upload(
    kind: type[T],
    files: Sequence[tuple[str, bytes]],
    cancelled: Cancelled = never,
    **options: Any,  # noqa: ANN401 - what JSON can hold
) -> T:
    """Read files, each a name and its content, in another process, by the reader of that class in `READERS`.

    The value is of that class and its types; its arrays are finite, and of any shape.

    Raises:
        FormatError: the files cannot be read, or not within the limits of memory and time.
        UnwantedError: the request is cancelled.
        Exception: of almost any kind, if the process gave another answer.
    """
    temporary = TemporaryFolder()  # with files that a killed reader leaves
    receiver, sender = CONTEXT.Pipe(duplex=False)
    request = kind.__name__, files, options
    process = CONTEXT.Process(target=_run, args=(temporary.name, sender, _respond, request), daemon=True)
    found = f"none that is ready within {START:.0f} s"
    unready = FormatError("reader", found, "another try, when the server is less busy")
    late = FormatError("file", f"data that take more than {PATIENCE:.0f} s to read", "a simpler file")
    # in a thread: the first start waits until the forkserver has imported the readers
    starting = threading.Thread(target=_start, args=(process, sender), daemon=True)
    starting.start()
    try:
        _wait(lambda: not starting.is_alive() and receiver.poll(), START, cancelled, unready)
        with suppress(EOFError):  # it has ended
            receiver.recv_bytes(1)
        _wait(lambda: process.exitcode is not None, PATIENCE, cancelled, late)
        if process.exitcode:
            raise FormatError("file", f"something that ended its reader ({process.exitcode})", "a whole file")
        with Path(temporary.name, "answer").open("rb") as file:
            first = json.loads(file.readline(MAX_ANSWER))
            if "refused" in first:
                field, found, accepted = map(str, first["refused"])
                raise FormatError(field, found, accepted)
            arrays = {str(name): np.load(file, allow_pickle=False) for name in first["arrays"]}
        return unpacked(first["value"], kind, "file", arrays)
    finally:
        threading.Thread(target=_end, args=(starting, process, temporary)).start()


def _wait(condition: Callable[[], bool], patience: float, cancelled: Cancelled, late: FormatError) -> None:
    """Wait until a condition holds; raise `late` after so many seconds, UnwantedError if the request is cancelled."""
    deadline = time.monotonic() + patience
    while not condition():
        end_if(cancelled)
        if time.monotonic() > deadline:
            raise late
        time.sleep(0.005)


def _start(process: BaseProcess, sender: Connection) -> None:
    """Start a process, and a forkserver if there is none, which Ctrl-C at the terminal does not reach."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    process.start()
    sender.close()


def _end(starting: threading.Thread, process: BaseProcess, temporary: TemporaryFolder) -> None:
    """Kill a process, whatever it does, once it has started, and remove its folder."""
    starting.join()
    process.kill()
    process.join()
    process.close()
    temporary.cleanup()


def _run(folder: str, ready: Connection, respond: Callable[..., None], request: tuple[Any, ...]) -> None:
    _limit(folder)
    ready.send_bytes(b".")
    respond(*request)


def _respond(kind: str, files: Sequence[tuple[str, bytes]], options: dict[str, Any]) -> None:
    with np.errstate(all="ignore"):
        first, arrays = answer(kind, files, **options)
    with Path(tempfile.gettempdir(), "answer").open("wb") as file:
        file.write(json.dumps(first).encode() + b"\n")
        for array in arrays:
            np.save(file, array, allow_pickle=False)


def _limit(folder: str) -> None:
    """Limit this process to a temporary folder, as far as the platform can, and end it with the server."""
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # readers print nothing in the server's terminal
        os.dup2(null, stream)
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    stand_back()
    threading.Thread(target=_end_with_server, daemon=True).start()
    with suppress(ImportError):  # not on Windows
        import resource  # noqa: PLC0415

        for name, most in LIMITS.items():
            with suppress(AttributeError, ValueError, OSError):  # unknown there, or above what is allowed anyway
                resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (most, most))
    confine(Path(folder))


def _end_with_server() -> None:
    if (server := multiprocessing.parent_process()) is not None:
        server.join()
        os._exit(1)


def answer(kind: str, files: Sequence[tuple[str, bytes]], **options: Any) -> tuple[dict[str, Any], list[np.ndarray]]:  # noqa: ANN401
    """Read files, each a name and its content; return the first line of the answer and the arrays."""
    arrays: dict[str, np.ndarray] = {}
    try:
        value = packed(READERS[kind](files, **options), "file", arrays)
    except FormatError as error:
        return {"refused": [error.field, error.found, error.accepted]}, []
    except MemoryError:
        return {"refused": ["file", f"data that need more than {MEMORY / 1e9:.0f} GB to read", "a smaller file"]}, []
    except Exception as error:  # no reader lists what corrupt bytes make it raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        accepted = f"a {Path(files[0][0]).suffix or 'whole'} file"
        return {"refused": ["file", f"something that cannot be read ({reason})", accepted]}, []
    return {"value": value, "arrays": [*arrays]}, [*arrays.values()]
