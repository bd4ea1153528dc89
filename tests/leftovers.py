"""What a test may leave behind: threads, processes, listening ports, and files where it has no business."""

import os
import re
import tempfile
import threading
import time
from pathlib import Path

PATIENCE = 20.0
"""Seconds in which what was told to end may end; reached only by what would never end."""
OF_POOLS = re.compile(
    r"ThreadPoolExecutor|asyncio_\d|Dask-Offload|Thread-\d+ \(_do_work\)|pytest|execnet|hypothesis|playwright"
)
"""Names of threads that a pool starts when it first needs one; a pool ends with the server that owns it."""
PROC = Path("/proc")
WATCHED = (Path.cwd(), Path.cwd() / "assets", Path.cwd() / "dt_viz")
"""Folders in which no test may make a file."""
HARMLESS = {
    "dask-scratch-space",
    ".hypothesis",
    ".pytest_cache",
    ".ruff_cache",
    "__pycache__",
    "dconf",
    "matplotlib",
    "fontconfig",
}
OF_PYTEST = "pytest-of-"
"""Beginning of the name of the folder in which pytest makes `tmp_path`."""


def now() -> float:
    """Seconds since the machine was started, by which the kernel dates processes."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def found(since: float = 0.0) -> set[str]:
    """Everything that would stay if the test ended now, described in words; of processes those begun `since` then."""
    return _threads() | _processes(since) | _ports() | _files()


def left_behind(before: set[str], since: float) -> set[str]:
    """What was not there before and does not go by itself.

    The kernel may leave a process out of a list of children that is read while another one ends: it counts only if it
    was begun `since` the test was.
    """
    deadline = time.monotonic() + PATIENCE
    while (left := found(since) - before) and time.monotonic() < deadline:
        time.sleep(0.02)
    return left


def _threads() -> set[str]:
    return {
        f"thread {thread.name} ({thread.ident})"
        for thread in threading.enumerate()
        if thread is not threading.main_thread() and not OF_POOLS.search(thread.name)
    }


def _processes(since: float) -> set[str]:
    """Child processes; only on Linux."""
    children = set()
    for file in PROC.glob("self/task/*/children"):
        for pid in _read(file).split():
            command = _read(PROC / pid / "cmdline").replace("\0", " ")
            if "resource_tracker" not in command and _begun(pid) >= since:
                children.add(f"process {pid}: {command[:100]}")
    return children


def _begun(pid: str) -> float:
    """When a process was begun, as `now` counts."""
    fields = _read(PROC / pid / "stat").rpartition(")")[2].split()
    return int(fields[19]) / os.sysconf("SC_CLK_TCK") if len(fields) > 19 else 0.0


def _ports() -> set[str]:
    """Ports on which this process listens; only on Linux."""
    own = set()
    for file in PROC.glob("self/fd/*"):
        try:
            own.update(re.findall(r"socket:\[(\d+)\]", str(file.readlink())))
        except OSError:
            continue  # closed meanwhile
    if not own:
        return set()  # the tables of all ports take long to read
    rows = [line.split() for name in ("tcp", "tcp6") for line in _read(PROC / "net" / name).splitlines()[1:]]
    return {f"port {int(row[1].rsplit(':', 1)[1], 16)}" for row in rows if row[3] == "0A" and row[9] in own}


def _files() -> set[str]:
    folders = (*WATCHED, Path(tempfile.gettempdir()), Path(os.environ["XDG_CACHE_HOME"]))
    names = [(folder, name) for folder in folders if folder.is_dir() for name in os.listdir(folder)]  # noqa: PTH208 - Path's own takes ten times as long
    return {
        f"file {folder}/{name}" for folder, name in names if name not in HARMLESS and not name.startswith(OF_PYTEST)
    }


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
