"""Makes what `dt-viz picture` asks for: a picture, a video or a page of a scene, a task or a saved scenario."""

from __future__ import annotations

import argparse
import logging
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

from dt_viz.errors import DataError, FormatError
from dt_viz.files.npz import write_whole
from dt_viz.folders import TemporaryFolder, default_cache_folder
from dt_viz.learning.imitation import ImitationError
from dt_viz.learning.store import FitStore
from dt_viz.pictures import figures, video
from dt_viz.robot.models import load_jaco
from dt_viz.robot.robot import Robot
from dt_viz.saving import read_scenario
from dt_viz.scenario.paper_scenes import found, offered
from dt_viz.scenario.saved import Saved
from dt_viz.scenario.tasks import TASKS, TaskEntry
from dt_viz.scenario.tour import STEPS, TASK
from dt_viz.session.arms import ArmStore
from dt_viz.session.frame import Stage
from dt_viz.session.session import CHOICES
from dt_viz.ui.page import initial, known_names, pose_of
from dt_viz.ui.scene.export import FORMATS, SETTINGS, Order
from dt_viz.ui.scene.figure import SUFFIXES
from dt_viz.ui.scene.recording import drawn
from dt_viz.ui.server import Server

BAD_INPUT = 2  # exit status for what the user can put right; argparse uses the same
BROWSERS = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
"""Commands that are looked for; the first that there is is taken."""
BY_SOFTWARE = "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--mute-audio"
"""Arguments with which a browser draws without a screen."""
VARIABLE = "DT_VIZ_CHROMIUM"  # name of the environment variable that names another browser
SMALLEST, LARGEST, LARGEST_VIDEO = 64, 7680, 1920  # width and height of a picture, and of a video, pixels
WINDOW = 1920  # largest width and height of the browser's window, pixels: the picture may be larger
PATIENCE = 300.0  # longest time to wait for the page, and for its motion, seconds
DRAWING = 4.0  # time that a browser takes for letters and surfaces once it has all that is drawn, seconds


def make(options: argparse.Namespace, prog: str) -> int:
    """Write the file of the command's options; returns the process' exit status."""
    logging.basicConfig(level=logging.CRITICAL)  # what a browser that is closed leaves unsaid is no matter
    try:
        made = _maker(options.out, options.size, options.of)
        write_whole(options.out, made(_chosen(options.scene)))
    except (DataError, FormatError, ImitationError, OSError, TimeoutError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return BAD_INPUT
    print(options.out)
    return 0


def _maker(out: Path, size: str | None, of: str) -> Callable[[Saved], bytes]:
    """Return what makes a file of this kind; raises FormatError before anything is computed where nothing can."""
    if out.suffix not in FORMATS:
        raise FormatError("--out", repr(str(out)), f"a file that ends in {', '.join(FORMATS)}")
    if not out.absolute().parent.is_dir() or out.is_dir():
        raise FormatError("--out", repr(str(out)), "a file in a folder that exists")
    if out.suffix in SUFFIXES:
        figures.check_installed()
    if out.suffix in (*SUFFIXES, ".html"):
        return partial(_drawn, suffix=out.suffix)
    is_video = out.suffix in video.VIDEO_SUFFIXES
    size = size or ("1280x720" if is_video else "1920x1080")
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", size)
    width, height = (int(number) for number in found.groups()) if found else (0, 0)
    largest, even = (LARGEST_VIDEO, "even, ") if is_video else (LARGEST, "")
    odd = is_video and (width % 2 or height % 2)
    if odd or not SMALLEST <= min(width, height) <= max(width, height) <= largest:
        raise FormatError("--size", repr(size), f"WIDTHxHEIGHT, each {even}{SMALLEST} to {largest}")
    if is_video:
        video.ffmpeg()
    given = os.environ.get(VARIABLE)
    browser = next(filter(None, map(shutil.which, (given,) if given else BROWSERS)), None)
    if browser is None:
        accepted = f"one of {', '.join(BROWSERS)}, or its path in {VARIABLE} (or --out with .svg)"
        raise FormatError("Chromium", repr(given) if given else "none installed", accepted)
    order = Order(out.suffix, (width, height), what=of.title(), alone=True)
    return partial(_rendered, order=order, browser=browser)


def _chosen(name: str) -> Saved:
    """Return a scene, a task or a step of the tour as a scenario, or the one that a file holds.

    Raises:
        DataError: the file cannot be used.
        FormatError: there is none of that name.
    """
    if Path(name).suffix.lower() == ".json":
        return read_scenario(Path(name), known_names(TASKS, ArmStore(*_given()).titles))
    scenes = offered(TASKS)
    scene = found(name, scenes) if name else None
    if scene is not None:
        return Saved(scene.scenario(TASKS[scene.task]()))
    steps = {f"tour-{number}": step.ended for number, step in enumerate(STEPS, start=1)}
    if name in steps:
        return Saved(steps[name](TASKS[TASK]()))
    if name not in TASKS:
        known = *(each.name for each in scenes), *TASKS, *steps
        accepted = f"{', '.join(known)}, a figure such as fig-4, or the .json of a saved scenario"
        raise FormatError("SCENE", repr(name), accepted)
    return Saved(initial(TASKS[name]()))


def _given() -> tuple[Mapping[str, TaskEntry], FitStore, Robot]:
    """Return the tasks of a page, what was learned before, and the arm that it begins with."""
    return TASKS, FitStore(default_cache_folder()), load_jaco()


def _drawn(saved: Saved, suffix: str) -> bytes:
    """Compute a scenario, and draw it without a browser."""
    scenario, engine = saved.scenario, ArmStore(*_given()).engine(saved.scenario.arm)
    if saved.own is not None:
        own, _gone = engine.bring(saved.own.task, scenario.arm)
        scenario = replace(scenario, task=own.name)
    stage = Stage.FINE if suffix in SUFFIXES else Stage.CERTIFIED
    frame = next(frame for frame in engine.frames(scenario) if frame.stage is stage)
    return drawn(frame, suffix, engine.follower, pose_of(saved.camera))


def _rendered(saved: Saved, order: Order, browser: str) -> bytes:
    """Have a browser render a scenario as the page saves it, its arm in the middle of its motion, or a video of it.

    Raises:
        FormatError: it is no browser, and ends.
        TimeoutError: it does not answer.
    """
    scenario = saved.scenario
    at_rest = replace(saved, scenario=replace(scenario, view=replace(scenario.view, playing=False)))
    first = scenario.task if scenario.task in TASKS else next(iter(TASKS))
    server = Server(*_given(), task=first, port=0, begins=at_rest)
    shrunk = min(1.0, WINDOW / max(order.size))
    try:
        window = tuple(round(shrunk * side) for side in order.size)
        with _opened(browser, f"http://{server.host}:{server.port}", window) as process:
            _until(lambda: bool(server.visitors) or process.poll() is not None, f"{browser} to open the page")
            if not server.visitors:
                raise FormatError("Chromium", f"{browser!r}, which ended", "a browser that opens a page")
            visitor = server.visitors[0]
            session = visitor.session
            _until(lambda: session.jobs.wait_idle(CHOICES, 0.1) and session.wait_idle(0.1), "the motion")
            frame, wanted = visitor.shown, replace(scenario.choices, task="")
            choices = None if frame is None else replace(frame.scenario.choices, task="", passing=None)
            if frame is None or frame.stage is not Stage.CERTIFIED or choices != wanted:
                raise TimeoutError(f"the page shows no motion of {scenario.task}")
            if frame.arm is not None:
                visitor.robot.playback.live.put(frame.arm.q[round(SETTINGS.along * (len(frame.arm.q) - 1))])
            visitor.robot.playback.advance(0.0)
            visitor.client.flush()
            picture = visitor.studio.picture
            picture(Order(".png", (SMALLEST, SMALLEST), alone=True))  # the browser then has all that was sent
            time.sleep(DRAWING)
            return picture(order._replace(pose=pose_of(saved.camera)) if order.suffix == ".png" else order)
    finally:
        server.close()


@contextmanager
def _opened(browser: str, address: str, window: tuple[int, ...]) -> Iterator[subprocess.Popen[bytes]]:
    """Open a page in a browser of its own, without a screen, and close it in the end."""
    sandbox = ("--no-sandbox",) if hasattr(os, "geteuid") and os.geteuid() == 0 else ()
    with TemporaryFolder() as profile:
        own = (f"--user-data-dir={profile}", "--remote-debugging-port=0", f"--window-size={window[0]},{window[1]}")
        command = (browser, "--headless", *BY_SOFTWARE, *sandbox, *own, address)
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                yield process
            finally:
                process.terminate()


def _until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited for {PATIENCE:g} s in vain for {what}")
        time.sleep(0.05)
