"""Pictures and videos of the scene by the visitor's browser: rendered, waited for, decoded and encoded."""

from __future__ import annotations

import io
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from time import monotonic
from typing import NamedTuple, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image

from dt_viz.errors import Cancelled, FormatError, end_if
from dt_viz.pictures.video import VIDEO_SUFFIXES, Encoder
from dt_viz.scenario.saved import Sight
from dt_viz.ui import patches
from dt_viz.ui.scene.camera import Shot
from dt_viz.ui.scene.figure import SUFFIXES, Step
from dt_viz.ui.scene.legend import Legend, drawn_onto
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Key
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
    along: float = 0.45  # part of its motion at which the arm is shown while the warp runs
    patience: float = 20.0  # longest time to wait for the browser, or for ffmpeg, with each frame


SETTINGS = FilmSettings()


class Order(NamedTuple):
    """A file of what is shown."""

    suffix: str  # one of `FORMATS`
    size: tuple[int, int] = (1280, 720)  # width and height of a PNG or a video, pixels
    transparent: bool = False  # whether a PNG has no background; else it is white
    what: str = MOTION  # what a video shows: `MOTION`, `TURNTABLE` or `WARP`
    alone: bool = False  # whether all of it is framed in a PNG or a video; else as seen beside the panel
    sight: Sight | None = None
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


def rendered(
    client: viser.ClientHandle, order: Order, shot: Shot, legends: Iterable[Legend | Key], timeout: float
) -> Image.Image:
    """Render the scene of a visitor; the server's event loop must not call this.

    Args:
        client: the visitor.
        order: file that it is for.
        shot: camera of the picture.
        legends: what explains its colours, drawn onto it.
        timeout: longest time to wait for the browser, seconds.

    Raises:
        FormatError: the browser gave no PNG of this size.
        TimeoutError: the browser did not answer.
    """
    rgba = decoded(patches.rendered(client, order.size, shot._asdict(), timeout), order.size)
    return explained(Image.fromarray(rgba, "RGBA"), legends, transparent=order.transparent)


def explained(image: Image.Image, legends: Iterable[Legend | Key], *, transparent: bool) -> Image.Image:
    """Return an RGBA image with legends; on white, as RGB, unless it is to be transparent."""
    image = drawn_onto(image, legends)
    if transparent:
        return image
    white = Image.new("RGBA", image.size, "white")
    white.alpha_composite(image)
    return white.convert("RGB")


def as_png(image: Image.Image) -> bytes:
    """Return an image as the content of a PNG file."""
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def filmed(
    show: Callable[[float], Callable[[], Image.Image]], seconds: float, order: Order, step: Step, cancelled: Cancelled
) -> bytes:
    """Return a video as the content of a file; frames are rendered and encoded by other threads than this.

    Args:
        show: has the scene show a part, from 0 to 1, and returns a function that renders it.
        seconds: duration without the rest at its end.
        order: file; a turntable is to be looped.
        step: takes the part that is done.
        cancelled: see `awaited`.

    Raises:
        FormatError: the browser gives no frame of this size, or ffmpeg fails.
        TimeoutError: the browser or ffmpeg takes too long.
        UnwantedError: it is cancelled.
    """
    parts = np.linspace(0.0, 1.0, max(1, round(seconds * SETTINGS.rate)) + 1).tolist()
    loops, patience = order.what == TURNTABLE, SETTINGS.patience
    with Encoder(order.suffix, order.size, SETTINGS.rate) as encoder:
        for k, part in enumerate(parts[:-1] if loops else parts, start=1):
            end_if(cancelled)
            frame = awaited(show(part), BROWSER, cancelled, patience).tobytes()
            for _ in range(1 if k < len(parts) else 1 + round(SETTINGS.rest * SETTINGS.rate)):
                awaited(partial(encoder.write, frame), "ffmpeg took no frame", cancelled, patience)
            step(k / (len(parts) + 1))
        return awaited(encoder.finish, "ffmpeg wrote no file", cancelled, patience)


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


class Studio:
    """Paints a visitor's scene; what is rendered is in light colours, without handles."""

    def __init__(
        self,
        pictures: ScenePictures,
        robot: Callable[[], RobotScene],
        changing: Callable[[], AbstractContextManager[object]],
    ) -> None:
        """Take the scene; `changing` returns a block within which no other thread changes the arm."""
        self.theme = LIGHT  # theme of the page
        self.drawing = threading.Lock()  # held while a frame is drawn, or a video is made
        self._pictures, self._robot, self._changing = pictures, robot, changing
        self._renders = False

    def paint(self) -> None:
        """Paint all in the colours of the page, or of what is rendered now."""
        theme = LIGHT if self._renders else self.theme
        with self._changing():
            self._pictures.paint(theme)
            self._robot().paint(theme)

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Show the scene as pictures of it are, on white, for as long as they take."""
        self._renders = True
        self.paint()
        try:
            with self._pictures.without_handles(), self._robot().grip.hidden():
                yield
        finally:
            self._renders = False
            self.paint()
