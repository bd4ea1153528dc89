"""Process that reads a visitor's files within limits of memory, time and files, and ends.

It imports what it needs, gives an empty line, and waits for files, or ends without them when its standard input is
closed. It takes a line of JSON, what they are, the name and size of each, and options, and then the files. It gives a
line of JSON, `{"value": …, "arrays": [names]}` as `dt_viz.files.values.packed` makes it, or `{"refused": [field, found,
accepted]}`, and then the arrays as `numpy.save` writes them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.recordings import Recordings, read_recordings
from dt_viz.files.shapes import Points, Triangles, read_points, read_triangles
from dt_viz.files.values import packed

MEMORY = 2**30
"""Largest address space of the process, bytes."""
READERS: Mapping[str, Callable[..., Any]] = {
    Triangles.__name__: read_triangles,
    Points.__name__: read_points,
    Recordings.__name__: read_recordings,
}
"""Readers of names and contents, by the class of what they give."""


def limit() -> None:
    """Limit this process, as far as the platform can."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    limits = {
        "RLIMIT_AS": MEMORY,
        "RLIMIT_CPU": 15 + int(used.ru_utime + used.ru_stime) + 1,  # seconds for the file
        "RLIMIT_FSIZE": 10**8,  # bytes of an answer
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
        return {"refused": ["file", f"something that cannot be read ({reason})", "a whole file of its kind"]}, []
    return {"value": value, "arrays": [*arrays]}, [*arrays.values()]


def main() -> None:
    """Read one request from the standard input."""
    print(flush=True)
    line = sys.stdin.buffer.readline()
    if not line:
        return
    limit()
    kind, sizes, options = json.loads(line)
    files = [(name, sys.stdin.buffer.read(size)) for name, size in sizes]
    with np.errstate(all="ignore"):
        first, arrays = answer(kind, files, **options)
    sys.stdout.buffer.write(json.dumps(first).encode() + b"\n")
    for array in arrays:
        np.save(sys.stdout.buffer, array, allow_pickle=False)


if __name__ == "__main__":
    main()
