"""The demo as a process of its own, as its user starts it."""

import asyncio
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import dt_viz
from dt_viz.serving.supervisor import listen

APP = Path(dt_viz.__file__).parent.parent / "app.py"
PATIENCE = 120.0  # seconds that anything may take: the machine may be busy


@contextmanager
def started(cache, *arguments, program=(str(APP),), patience=PATIENCE):
    """The process, which is killed after so many seconds."""
    process = subprocess.Popen(
        [sys.executable, *program, "--port", "0", *arguments],
        cwd=APP.parent,
        env=os.environ | {"XDG_CACHE_HOME": str(cache), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    guard = threading.Timer(patience, process.kill)
    guard.start()
    try:
        yield process
    finally:
        guard.cancel()
        process.kill()
        process.communicate()


def address(process, printed=r"DT-Viz is at http://(\S+)"):
    """Of its WebSocket, once it answers; or of another line that it prints."""
    for line in process.stdout:
        if found := re.search(printed, line):
            return f"ws://{found[1]}"
    raise AssertionError(process.stderr.read())


async def until(condition):
    """Wait until something holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        await asyncio.sleep(0.1)


def free_port():
    """A port on which nothing listens."""
    with listen("127.0.0.1", 0) as unused:
        return unused.getsockname()[1]
