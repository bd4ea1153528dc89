"""Python processes of our own, beside the server."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO, Any


def start_module(
    name: str, *arguments: str, output: int | IO[Any], given: int = subprocess.DEVNULL, temporary: str | None = None
) -> subprocess.Popen:
    """Start a module of this package, by its full name, as a process, with one thread for linear algebra.

    With a folder of temporary files it has a session of its own, which `end_session` ends with all its processes.
    """
    root = Path(__file__).parents[2]  # holds this package
    path = os.pathsep.join([str(root), *filter(None, sys.path)])
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, "-m", name, *arguments],
        cwd=root,  # where -m looks first
        env=os.environ | threads | {"PYTHONPATH": path} | ({"TMPDIR": temporary} if temporary else {}),
        stdin=given,
        stdout=output,
        stderr=subprocess.DEVNULL,
        start_new_session=temporary is not None,
    )


def stand_back() -> None:
    """Let the server, and so its visitors, go before this process where processors are busy."""
    with suppress(AttributeError, OSError):  # not on Windows
        os.nice(5)


def end_session(process: subprocess.Popen) -> None:
    """End a process with a session of its own, and what it has started, also if it has ended itself before."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):  # none is left, or, on macOS, none but dead ones
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()
    if process.stdin is not None:
        with suppress(OSError):  # what it has not taken
            process.stdin.close()
