"""Take a test picture of the first page and of each scene of the paper, in headless Chromium.

    python -m tests.benchmarks pictures --out DIR

Needs Chromium (Debian: apt-get install chromium) and the test extra. Each picture is the page as a visitor sees it,
once every check is done and the arm stopped in the middle of its motion: to be looked at by a person.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image

from dt_viz.control.controller import Phase
from dt_viz.errors import FormatError
from dt_viz.evaluate.options import output
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.paper_scenes import SCENES, offered
from dt_viz.scenario.tasks import known_tasks
from dt_viz.session.frame import Stage
from dt_viz.ui.page import Page
from dt_viz.ui.server import Server
from tests.chromium import ARGUMENTS, CHROMIUM

FIRST = "first"  # name of the picture of the first page
DRAWING = 8.0  # time that software takes to draw the page, seconds
PATIENCE = 180.0  # longest time to wait for the page, seconds
HIDE_NOTICES = "() => document.querySelectorAll('button.mantine-Notification-closeButton').forEach(b => b.click())"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    names = (FIRST, *SCENES)
    parser.add_argument("--only", choices=names, nargs="+", metavar="NAME", help=", ".join(names))
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")
    parser.add_argument("--out", type=output(), required=True, metavar="DIR", help="folder of what is written")
    parser.add_argument("--size", type=_size, default=(1920, 1080), metavar="W,H", help="pixels (default: 1920,1080)")


def run(options: argparse.Namespace) -> int:
    """Run the command: ends with status 1 where the page complains."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise FormatError("playwright", "not installed", "pip install 'dt-viz[test]'") from None
    if CHROMIUM is None:
        raise FormatError("Chromium", "not installed", "apt-get install chromium")
    tasks = known_tasks(options.lasa)
    scenes = (FIRST, *(scene.name for scene in offered(tasks)))
    lacking = [name for name in options.only or () if name not in scenes]
    if lacking:
        raise FormatError("--only", ", ".join(lacking), "scenes whose tasks there are; --lasa DIR adds more")
    width, height = options.size
    options.out.mkdir(parents=True, exist_ok=True)
    complaints: list[str] = []
    with sync_playwright() as playwright:
        server = Server(tasks, FitStore(default_cache_folder()), load_jaco(), task="draw_s", port=0)
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        try:
            for name in options.only or scenes:
                page = browser.new_page(viewport={"width": width, "height": height})
                page.on("console", lambda message: _complain(message, complaints))
                opened = time.monotonic()
                page.goto(f"http://{server.host}:{server.port}")
                _until(lambda: any(visitor.shown is not None for visitor in server.visitors))
                waited = time.monotonic() - opened
                _until(lambda: _is_certified(server.visitors[0]))
                (visitor,) = server.visitors
                _begin(visitor, name)
                _stop_in_the_middle(visitor)
                page.evaluate(HIDE_NOTICES)
                time.sleep(DRAWING)
                file = options.out / f"{name}.png"
                page.screenshot(path=file, timeout=1000 * PATIENCE)
                Image.open(file).convert("RGB").quantize(256).save(file, optimize=True)
                page.close()
                _until(lambda: not server.visitors)
                title = SCENES[name].title if name in SCENES else "the first page"
                print(f"{file}: {title}; the first motion was sent {waited:.1f} s after the page was opened")
        finally:
            browser.close()
            server.close()
    for complaint in complaints:
        print(f"the page says: {complaint}", file=sys.stderr)
    return 1 if complaints else 0


def _begin(visitor: Page, name: str) -> None:
    """Load a scene, and wait until it is certified."""
    if name in SCENES:
        visitor.session.load(SCENES[name].task, SCENES[name].scenario)
    _until(lambda: visitor.session.wait_idle(0.1) and _is_certified(visitor))


def _is_certified(visitor: Page) -> bool:
    frame = visitor.shown
    return (
        frame is not None
        and frame.stage is Stage.CERTIFIED
        and frame.scenario.choices == visitor.session.scenario.choices
    )


def _stop_in_the_middle(visitor: Page) -> None:
    """Let the arm set out from a start, and stop it later."""
    live, frame = visitor.robot.playback.live, visitor.shown
    if frame is None or frame.arm is None or not frame.scenario.view.arm:
        return
    _until(lambda: live.phase is not Phase.MOVING)
    _until(lambda: live.phase is Phase.MOVING)
    time.sleep(0.45 * float(frame.arm.times[-1]))
    visitor.session.edit("play", view=replace(visitor.session.scenario.view, playing=False))


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"the page was not ready after {PATIENCE:g} s")
        time.sleep(0.05)


def _complain(message: Any, complaints: list[str]) -> None:
    """Note what a page says; not that it draws by software, nor what the library of its 3-D view will replace."""
    expected = ("software", "WebGL", "GPU", "THREE.Clock")
    if message.type in ("error", "warning") and not any(word in message.text for word in expected):
        complaints.append(message.text)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition(",")
    return int(width), int(height)
