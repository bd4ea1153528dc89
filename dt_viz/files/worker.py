"""Process that reads one visitor's file within limits of memory, time and files, and ends.

It imports what it needs, gives an empty line, and waits for a file, or ends without one when its standard input is
closed. It takes a line of JSON, the kind, the suffix and options, and then the file. It gives a line of JSON,
`{"notes": …}` or `{"refused": [field, found, accepted]}`, and then arrays as `numpy.save` writes them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.recordings import answer_recordings
from dt_viz.files.shapes import read_mesh, read_points

MEMORY = 2**30
"""Largest address space of the process, bytes."""
KINDS: Mapping[str, Callable[..., tuple[tuple[np.ndarray, ...], tuple[str, ...]]]] = {
    "mesh": read_mesh,
    "points": read_points,
    "takes": answer_recordings,
}
"""Readers by what is asked for: they give arrays, and notes about them for the page."""


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


def answer(kind: str, suffix: str, content: bytes, **options: Any) -> tuple[dict[str, object], tuple[np.ndarray, ...]]:  # noqa: ANN401
    """Read a file; return the first line of the answer and the arrays."""
    try:
        arrays, notes = KINDS[kind](content, suffix, **options)
    except FormatError as error:
        return {"refused": [error.field, error.found, error.accepted]}, ()
    except MemoryError:
        return {"refused": ["file", f"data that need more than {MEMORY / 1e9:.0f} GB to read", "a smaller file"]}, ()
    except Exception as error:  # no reader lists what corrupt bytes make it raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        return {"refused": ["file", f"something that cannot be read ({reason})", f"a {suffix} file"]}, ()
    return {"notes": notes}, arrays


def main() -> None:
    """Read one file from the standard input."""
    print(flush=True)
    line = sys.stdin.buffer.readline()
    if not line:
        return
    limit()
    kind, suffix, options = json.loads(line)
    with np.errstate(all="ignore"):
        first, arrays = answer(kind, suffix, sys.stdin.buffer.read(), **options)
    sys.stdout.buffer.write(json.dumps(first).encode() + b"\n")
    for array in arrays:
        np.save(sys.stdout.buffer, array, allow_pickle=False)


if __name__ == "__main__":
    main()
