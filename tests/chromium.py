"""Chromium for tests."""

import os
import shutil

import pytest

CHROMIUM = os.environ.get("DT_VIZ_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
"""Chromium's command; None where it is not installed."""
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""Arguments with which it draws by software, without a screen."""

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None,
    reason="no Chromium on this machine (Debian: apt-get install chromium)",
)
