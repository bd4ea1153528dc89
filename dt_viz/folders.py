"""Folders of the user's machine."""

from __future__ import annotations

import os
from pathlib import Path


def default_cache_folder() -> Path:
    """Return `$XDG_CACHE_HOME/dt-viz`, or `~/.cache/dt-viz`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dt-viz"
