"""The right of a process to open files, given up by Landlock, where it runs on Linux 5.13 or later."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

CREATE_RULESET, ADD_RULE, RESTRICT_SELF, NO_NEW_PRIVILEGES = 444, 445, 446, 38
"""Numbers of system calls, the same on all processors, and of the option of `prctl` that the last one needs."""
READ_FILE, READ_FOLDER = 1 << 2, 1 << 3
SHARED = ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/nix/store", "/gnu/store")
"""Folders of the system's shared libraries."""


def confine(folder: Path) -> bool:
    """Forbid this thread, and what it starts later, to read or change files outside a folder; it cannot be undone.

    Code can still be read, since modules are imported when they are first needed. Files that are open stay open.

    Args:
        folder: in which everything stays allowed.

    Returns:
        Whether the system can do that; without Landlock nothing is forbidden.
    """
    if sys.platform != "linux":
        return False
    libc = ctypes.CDLL(None)
    version = libc.syscall(CREATE_RULESET, None, ctypes.c_size_t(0), 1)  # -1 without Landlock
    rights = (1 << 12 + min(max(version, 0), 3)) - 1  # versions 2 and 3 of it added one right each
    rules = libc.syscall(CREATE_RULESET, struct.pack("=Q", rights), ctypes.c_size_t(8), 0)
    if rules < 0:
        return False
    for path, allowed in ((folder, rights), *((path, READ_FILE | READ_FOLDER) for path in _code())):
        with suppress(OSError):  # there is no such folder
            opened = os.open(path, os.O_PATH | os.O_DIRECTORY)
            libc.syscall(ADD_RULE, rules, 1, struct.pack("=Qi", allowed, opened), 0)
            os.close(opened)
    libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    is_confined = libc.syscall(RESTRICT_SELF, rules, 0) == 0
    os.close(rules)
    return is_confined


def _code() -> Iterator[str | Path]:
    """Folders of Python, of installed packages, of this one, and of shared libraries."""
    yield from (Path(os.__file__).parents[1], Path(__file__).parents[1], *SHARED)
    yield from (path for path in sys.path if Path(path).name in ("site-packages", "dist-packages"))
