"""Files that ship with DT-Viz: demonstrations and the arm's body points."""

from __future__ import annotations

from pathlib import Path

_INSTALLED = Path(__file__).resolve().parent / "assets"

ASSETS = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[1] / "assets"
"""Folder of these files: in the package where a wheel was installed; beside it in a checkout, also with `pip -e`."""
