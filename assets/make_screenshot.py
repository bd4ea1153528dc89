"""Make the README's picture: the page in headless Chromium, the sphere dragged by its handle.

    python -m assets.make_screenshot

Needs Chromium (Debian: apt-get install chromium) and the test extra.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from dt_viz.learning.store import FitStore
from dt_viz.scenario.scenario import View
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

PICTURE = Path(__file__).parent / "screenshot.png"
SIZE = {"width": 1280, "height": 760}
MOMENT = 0.55
"""Of the motion, at which the arm is shown."""


def main() -> None:
    """Write `assets/screenshot.png`."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        server = Server(TASKS, FitStore(Path(folder)), task="draw_s", port=0)
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"),
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        page = browser.new_page(viewport=SIZE)  # pyright: ignore[reportArgumentType]
        page.goto(f"http://127.0.0.1:{server.port}")
        page.get_by_text("falls").wait_for(timeout=120_000)
        (visitor,) = server.visitors
        page.locator("button.mantine-Notification-closeButton").first.click()
        session = visitor.session
        session.edit("screenshot", space="cspace", view=View(playing=False, ghost_arm=True))
        session.wait_idle(60)
        assert visitor.shown is not None and visitor.shown.arm is not None
        arm = visitor.shown.arm
        moment = round(MOMENT * (len(arm.q) - 1))
        visitor.arms.pose(arm.q[moment], arm.without[moment])
        time.sleep(10)  # software rendering is slow
        page.screenshot(path=PICTURE)
        browser.close()
        server.close()
    Image.open(PICTURE).convert("RGB").quantize(256).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
