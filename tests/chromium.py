"""Chromium for tests."""

import os

import pytest

from dt_viz.evaluate.pictures import ARGUMENTS, CHROMIUM

__all__ = ["ARGUMENTS", "CHROMIUM", "needs_chromium"]

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None and "DT_VIZ_REQUIRE_BROWSER" not in os.environ,
    reason="no Chromium on this machine (Debian: apt-get install chromium)",
)
