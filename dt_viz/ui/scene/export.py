"""Files of what a page shows: the way from its frame to a PNG, a video, a figure for a paper, or a page that plays."""

from __future__ import annotations

import io
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, repeat
from time import monotonic
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image

from dt_viz.errors import Cancelled, FormatError, end_if, never
from dt_viz.pictures.video import VIDEO_SUFFIXES, Encoder
from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui import patches
from dt_viz.ui.playback import Replay
from dt_viz.ui.scene.camera import CameraController, Framing, Pose, Shot, shot_beside, shot_of, turned_shot, view_of
from dt_viz.ui.scene.figure import SUFFIXES, Step, ignored
from dt_viz.ui.scene.legend import explained
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.recording import drawn
from dt_viz.ui.scene.robot_scene import RobotScene
from dt_viz.ui.scene.scene import ScenePictures

FORMATS = ".png", *SUFFIXES, ".html", *VIDEO_SUFFIXES  # suffixes of all files
RESOLUTIONS = {f"{w} × {h}": (w, h) for w, h in ((1280, 720), (1920, 1080), (2560, 1440), (3840, 2160))}
"""Width and height in pixels, by name."""
MOTION, TURNTABLE, WARP = "Motion", "Turntable", "Warp"
"""What videos show: the finished motion, the scene from all around, and the warp of the stack."""
SIGNATURE = b"\x89PNG\r\n\x1a\n"  # first bytes of a PNG
MAX_CHUNKS = 10_000
"""Largest number of chunks of a PNG that are read; browsers write 8 KB or more into each."""
TIMEOUT, TIMEOUT_ALONE = 60.0, 300.0
"""Longest time to wait for the browser with a PNG, and with one that stands alone, seconds."""
LOOK = 0.1  # interval at which the wait for a result checks whether it is still wanted, seconds
BROWSER = "the browser, its page out of sight perhaps, drew nothing"
"""Message where the browser has taken too long."""

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class FilmSettings:
    """Settings of videos; durations in seconds."""

    rate: int = 25  # frames a second; the delays of a GIF are hundredths of a second
    motion: float = 10.0  # longest duration of a motion: a longer one is played faster
    turn: float = 6.0  # duration of a turn
    warp: float = 4.0  # duration of the warp from 0 to 1
    rest: float = 1.0  # duration for which the end of a motion, or of the warp, stays
    along: float = 0.45  # part of its motion at which the arm is shown in a picture alone, and while the warp runs
    patience: float = 20.0  # longest time to wait for the browser, or for ffmpeg, with each frame


SETTINGS = FilmSettings()


class Order(NamedTuple):
    """A file of what is shown."""

    suffix: str  # one of `FORMATS`
    size: tuple[int, int] = (1280, 720)  # width and height of a PNG or a video, pixels
    transparent: bool = False  # whether a PNG has no background; else it is white
    what: str = MOTION  # what a video shows: `MOTION`, `TURNTABLE` or `WARP`
    alone: bool = False  # whether all of it is framed in a PNG or a video; else as seen beside the panel
    pose: Pose | None = None
    """Camera whose view beside the panel, in a window of the usual size, is shown `alone` in place of all of it."""


def awaited(work: Callable[[], _Result], failed: str, cancelled: Cancelled, patience: float) -> _Result:
    """Return the result of work on a thread of its own, which is waited for only while it is wanted.

    Raises:
        TimeoutError: it takes longer than `patience`, seconds; the text begins with what `failed`.
        UnwantedError: it is cancelled; `cancelled` may raise, too.
    """
    pool, deadline = ThreadPoolExecutor(1, "worker"), monotonic() + patience
    future = pool.submit(work)
    pool.shutdown(wait=False)
    while not wait([future], LOOK).done:
        end_if(cancelled)
        if monotonic() > deadline:
            raise TimeoutError(f"{failed} within {patience:g} s")
    return future.result()


def decoded(content: bytes, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Decode a PNG as browsers make it of a scene, in memory that its size bounds, whatever the bytes.

    Its header is checked first. Of its chunks only those of the pixels are decoded: others may unpack to any size.

    Args:
        content: bytes from a browser.
        size: width and height that were asked for, pixels.

    Returns:
        Pixels (height, width, 4), RGBA.

    Raises:
        FormatError: it is no PNG of this size with 8 bits for each of RGBA.
    """
    width, height = size
    header = SIGNATURE + struct.pack(">I4sIIBB", 13, b"IHDR", width, height, 8, 6)
    accepted = f"an RGBA PNG of {width}x{height} pixels"
    if not content.startswith(header):
        is_png = content.startswith(SIGNATURE) and len(content) >= 24
        found = "a PNG of {}x{} pixels".format(*struct.unpack_from(">II", content, 16)) if is_png else "no PNG"
        raise FormatError("the browser", found, accepted)
    ends = [len(header) + 7]  # of the chunk that holds the header
    while ends[-1] < len(content) and len(ends) < MAX_CHUNKS:
        ends.append(ends[-1] + 12 + int.from_bytes(content[ends[-1] : ends[-1] + 4], "big"))
    kept = [content[a:b] for a, b in pairwise([0, *ends]) if not a or content[a + 4 : a + 8] in (b"IDAT", b"IEND")]
    try:
        with Image.open(io.BytesIO(b"".join(kept)), formats=["PNG"]) as image:
            return np.array(image)
    except Exception as error:  # damaged bytes make Pillow raise almost anything
        raise FormatError("the browser", "a damaged PNG", accepted) from error


class StudioPage(Protocol):
    """What a studio uses of a visitor's page."""

    client: viser.ClientHandle
    pictures: ScenePictures
    robot: RobotScene
    camera: CameraController
    session: Session
    shown: Frame | None

    @property
    def previews(self) -> bool:
        """Whether takes are shown in place of the frame."""
        ...

    def changing(self) -> AbstractContextManager[object]:
        """Return a block within which no other thread changes the arm."""
        ...


class Studio:
    """Makes files of what a page shows; what its browser renders is in light colours, without handles."""

    def __init__(self, page: StudioPage) -> None:
        self.theme = LIGHT  # theme of the page
        self.drawing = threading.Lock()  # held while a frame is drawn, or a video is made
        self._page, self._renders = page, False

    def paint(self) -> None:
        """Paint all in the colours of the page, or of what is rendered now."""
        theme = LIGHT if self._renders else self.theme
        with self._page.changing():
            self._page.pictures.paint(theme)
            self._page.robot.paint(theme)

    def picture(self, order: Order, step: Step = ignored, cancelled: Cancelled = never) -> bytes:
        """Return what is shown as the content of a file; while a video is made the robot waits, and an edit ends it.

        Raises:
            FormatError: nothing is shown yet, there is no motion to film, it is edited meanwhile, or what draws or
                encodes it is missing or fails.
            TimeoutError: the browser does not answer.
            UnwantedError: it is cancelled; the browser is not waited for.
        """
        page = self._page
        if order.suffix in VIDEO_SUFFIXES:
            return self._film(order, step, cancelled)
        if order.suffix == ".png":
            file, timeout = io.BytesIO(), TIMEOUT_ALONE if order.alone else TIMEOUT
            with self._rendering():
                self._rendered(order, self._shot(order)[0], cancelled, timeout).save(file, "PNG")
            return file.getvalue()
        frame = self._frame
        follower = page.session.engines(frame.scenario.arm).follower
        with page.session.engine.refining(cancelled):
            return drawn(frame, order.suffix, follower, page.camera.chosen, step)

    @property
    def _frame(self) -> Frame:
        """The frame that is shown; raises FormatError where there is none yet."""
        if self._page.shown is None:
            raise FormatError("the scene", "nothing yet", "a scene that is shown")
        return self._page.shown

    def _shot(self, order: Order) -> tuple[Shot, float]:
        """Return the camera of a picture, and the distance of what it looks at, metres."""
        camera, pose = self._page.camera, order.pose
        if not order.alone:
            return camera.shot(order.size), camera.depth
        if pose is not None:
            shot = shot_beside(pose, shot_of(pose).wxyz, Framing(), order.size)
        else:
            panels = [panel.shown for panel in self._frame.pictures.panels]
            pose = view_of(self._frame.task, Framing(order.size, panel=0.0, narrow=0), panels=panels)
            shot = shot_of(pose)
        return shot, float(np.linalg.norm(pose[1] - pose[0]))

    def _rendered(self, order: Order, shot: Shot, cancelled: Cancelled, patience: float) -> Image.Image:
        """Have the browser render the scene, and explain its colours; the server's event loop must not call this.

        Raises:
            FormatError: the browser gave no PNG of this size.
            TimeoutError: it did not answer within `patience`, seconds.
            UnwantedError: it is cancelled; the browser is not waited for.
        """
        legends = self._page.pictures.legends

        def render() -> Image.Image:
            rgba = decoded(patches.rendered(self._page.client, order.size, shot._asdict(), 2 * patience), order.size)
            return explained(Image.fromarray(rgba, "RGBA"), legends, transparent=order.transparent)

        return awaited(render, BROWSER, cancelled, patience)

    def _film(self, order: Order, step: Step, cancelled: Cancelled) -> bytes:
        """Return a video as the content of a file, once the scene is at rest; see `picture`."""
        session, deadline = self._page.session, monotonic() + SETTINGS.patience
        while not session.wait_idle(LOOK):
            step(0.0)
            if monotonic() > deadline:
                raise TimeoutError(f"the scene was not at rest within {SETTINGS.patience:g} s")
        scenario = session.scenario

        def ended() -> bool:
            shown = self._frame.scenario.choices == scenario.choices and not self._page.previews
            if not shown or session.scenario is not scenario:
                raise FormatError("the scene", "an edit while it was filmed", "none until the video is saved")
            return cancelled()

        with Encoder(order.suffix, order.size, SETTINGS.rate) as encoder, self.drawing, self._filming():
            for part, image in self._images(order, scenario, ended):
                awaited(partial(encoder.write, image.tobytes()), "ffmpeg took no frame", ended, SETTINGS.patience)
                step(part)
            return awaited(encoder.finish, "ffmpeg wrote no file", ended, SETTINGS.patience)

    def _images(self, order: Order, scenario: Scenario, ended: Cancelled) -> Iterator[tuple[float, Image.Image]]:
        """Have the scene show a video's frames one after the other; yield each with the part that is done, to 1.

        A turntable, which is to be looped, leaves out the last one; else that is repeated for the rest.
        """
        end_if(ended)
        page, frame, reel, turns = self._page, self._frame, Replay(), order.what == TURNTABLE
        if not turns and (frame.blocked or (order.what == MOTION and frame.arm is None)):
            found = frame.blocked[0].text if frame.blocked else "none that the arm follows"
            raise FormatError("the motion", found, "one that is shown")
        first, depth = self._shot(order)
        reel.motion = frame.arm
        seconds = {MOTION: min(reel.duration, SETTINGS.motion), TURNTABLE: SETTINGS.turn, WARP: SETTINGS.warp}
        num = max(1, round(seconds[order.what] * SETTINGS.rate))
        for k in range(num if turns else num + 1):
            end_if(ended)
            part, shot = k / num, turned_shot(first, depth, 2 * np.pi * k / num) if turns else first
            if order.what == WARP:
                warped = page.session.engine.fine(replace(scenario, warp=part), ended)
                reel.motion = warped.arm
                with page.client.atomic():
                    page.pictures.draw(warped)
            if not turns:
                reel.seek((SETTINGS.along if order.what == WARP else part) * reel.duration)
                with page.changing():
                    page.robot.playback.film = reel
                    page.robot.pose(monotonic(), page.pictures.look.tubes)
            image = self._rendered(order, shot, ended, SETTINGS.patience)
            yield from repeat((part, image), 1 + round(SETTINGS.rest * SETTINGS.rate) * (k == num))

    @contextmanager
    def _filming(self) -> Iterator[None]:
        """Hold all that moves, as it is rendered, and restore the scene and what moved in the end."""
        page, playback = self._page, self._page.robot.playback
        with page.changing():
            playback.film = playback.arm
        try:
            with self._rendering():
                yield
        finally:
            if page.shown is not None:
                with page.client.atomic():
                    page.pictures.draw(page.shown)
            with page.changing():
                playback.film = None
                page.robot.adopt(page.session.scenario.view, page.pictures.look)
            page.camera.rest()
            page.client.flush()

    @contextmanager
    def _rendering(self) -> Iterator[None]:
        """Show the scene as pictures of it are, on white, for as long as they take."""
        self._renders = True
        self.paint()
        try:
            with self._page.pictures.without_handles(), self._page.robot.grip.hidden():
                yield
        finally:
            self._renders = False
            self.paint()
