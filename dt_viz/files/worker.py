"""Process that reads visitors' files, each request in a process of its own with limits of memory, time and files.

It imports what it needs, gives an empty line, and waits for lines, until its standard input is closed. For each it has
the file `request` of its temporary folder read: a line of JSON, what the files are, the name and size of each, and
options, and then the files. The file `answer` is a line of JSON, `{"value": …, "arrays": [names]}` as
`dt_viz.files.values.packed` makes it, or `{"refused": [field, found, accepted]}`, and then the arrays as `numpy.save`
writes them. Then it gives a line: 0 or the code with which the reader has ended, and the seconds of
processor time of all readers so far. Where processes cannot be forked, it reads itself.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.npz import Archive, read_archive
from dt_viz.files.processes import stand_back
from dt_viz.files.recordings import Recordings, read_recordings
from dt_viz.files.shapes import Points, Triangles, read_points, read_triangles
from dt_viz.files.triangles import Distances, read_distances
from dt_viz.files.values import packed

REQUEST, ANSWER = "request", "answer"
"""Names of files in the temporary folder."""
MEMORY = 2**30
"""Largest address space of the process, bytes."""
MAX_ANSWER = 10**8
"""Largest size of an answer, bytes."""
READERS: Mapping[str, Callable[..., Any]] = {
    Triangles.__name__: read_triangles,
    Points.__name__: read_points,
    Recordings.__name__: read_recordings,
    Archive.__name__: read_archive,
    Distances.__name__: read_distances,
}
"""Readers of names and contents, by the class of what they give."""


def limit() -> None:
    """Limit this process, as far as the platform can."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    limits = {
        "RLIMIT_AS": MEMORY,
        "RLIMIT_CPU": 15,  # seconds
        "RLIMIT_FSIZE": MAX_ANSWER,
        "RLIMIT_NOFILE": 32,  # open files
        "RLIMIT_CORE": 0,
    }
    for name, most in limits.items():
        with suppress(AttributeError, ValueError, OSError):  # unknown there, or above what is allowed anyway
            resource.setrlimit(getattr(resource, name), (most, most))


def answer(kind: str, files: list[tuple[str, bytes]], **options: Any) -> tuple[dict[str, Any], list[np.ndarray]]:  # noqa: ANN401
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


def respond() -> None:
    """Read the request, and write the answer."""
    limit()
    folder = Path(tempfile.gettempdir())
    with (folder / REQUEST).open("rb") as file:
        kind, sizes, options = json.loads(file.readline())
        files = [(name, file.read(size)) for name, size in sizes]
    with np.errstate(all="ignore"):
        first, arrays = answer(kind, files, **options)
    with (folder / ANSWER).open("wb") as file:
        file.write(json.dumps(first).encode() + b"\n")
        for array in arrays:
            np.save(file, array, allow_pickle=False)


def forked(work: Callable[[], None]) -> int:
    """Do something in a process of its own, which ends with it; return its exit code."""
    if not hasattr(os, "fork"):
        work()
        return 0
    if process := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    code = 1
    try:
        os.dup2(2, 1)  # what readers print is no code
        work()
        code = 0
    finally:
        os._exit(code)


def main() -> None:
    """Read requests until there are no more."""
    stand_back()
    print(flush=True)
    while sys.stdin.readline():
        code, used = forked(respond), os.times()
        print(code, used.children_user + used.children_system, flush=True)


if __name__ == "__main__":
    main()
