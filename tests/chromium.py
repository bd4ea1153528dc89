"""Chromium for tests, headless and drawing by software."""

import os
import shutil

import pytest

CHROMIUM = os.environ.get("DT_VIZ_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None and "DT_VIZ_REQUIRE_BROWSER" not in os.environ,
    reason="no Chromium on this machine (Debian: apt-get install chromium)",
)
