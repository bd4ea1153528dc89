"""Python processes of our own, beside the server."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def start_module(name: str, *arguments: str, output: int, given: int = subprocess.DEVNULL) -> subprocess.Popen:
    """Start a module of this package, by its full name, as a process, with one thread for linear algebra."""
    root = Path(__file__).parents[2]  # holds this package
    path = os.pathsep.join([str(root), *filter(None, sys.path)])
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, "-m", name, *arguments],
        cwd=root,  # where -m looks first
        env=os.environ | threads | {"PYTHONPATH": path},
        stdin=given,
        stdout=output,
        stderr=subprocess.DEVNULL,
    )


def stand_back() -> None:
    """Let the server, and so its visitors, go before this process where processors are busy."""
    with suppress(AttributeError, OSError):  # not on Windows
        os.nice(5)
