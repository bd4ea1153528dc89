"""The demo as a process of its own, as its user starts it."""

import os
import re
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import dt_viz

APP = Path(dt_viz.__file__).parent.parent / "app.py"
PATIENCE = 120.0
"""Seconds that anything may take: the machine may be busy."""


@contextmanager
def started(cache, *arguments):
    """The process."""
    process = subprocess.Popen(
        [sys.executable, str(APP), "--port", "0", *arguments],
        env=os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    guard = threading.Timer(PATIENCE, process.kill)
    guard.start()
    try:
        yield process
    finally:
        guard.cancel()
        process.kill()
        process.communicate()


def address(process):
    """Of its WebSocket, once it answers."""
    for line in process.stdout:
        if found := re.search(r"DT-Viz is at http://(\S+)", line):
            return f"ws://{found[1]}"
    raise AssertionError(process.stderr.read())
