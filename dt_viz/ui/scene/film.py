"""Videos of the scene: what their frames show, and how they are rendered one after the other and encoded meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dt_viz.errors import Cancelled, end_if
from dt_viz.flows.fields import Array
from dt_viz.pictures.video import Encoder
from dt_viz.ui.playback import Replay
from dt_viz.ui.scene.camera import Shot, turned_shot
from dt_viz.ui.scene.key import Key
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.waiting import BROWSER, Worker

MOTION, TURNTABLE, WARP = "Motion", "Turntable", "Warp"
"""What videos show: the finished motion, the scene from all around, and the warp of the stack."""


@dataclass(frozen=True)
class FilmSettings:
    """Settings of videos; durations in seconds."""

    rate: int = 25
    """Frames a second; the delays of a GIF are hundredths of a second."""
    motion: float = 10.0
    """Longest duration of a motion: a longer one is played faster."""
    turn: float = 6.0
    """Duration of a turn."""
    warp: float = 4.0
    """Duration of the warp from 0 to 1."""
    rest: float = 1.0
    """Duration for which the end of a motion, or of the warp, stays."""
    along: float = 0.45
    """Part of its motion at which the arm is shown while the warp runs."""
    patience: float = 20.0
    """Longest time to wait for the browser, or for ffmpeg, with each frame."""


SETTINGS = FilmSettings()


class Rendering(NamedTuple):
    """What a frame is rendered with."""

    shot: Shot
    legends: Sequence[Legend | Key]


class Film(NamedTuple):
    """What the frames of a video show."""

    parts: Array
    """(N,) from 0 to 1, one for each frame that is rendered."""
    show: Callable[[float], Rendering]
    """Function that has the scene show a part."""
    rests: bool
    """Whether the last frame stays for a while."""


def turntable(rendering: Rendering, depth: float) -> Film:
    """Return a film, to be looped, that goes around what is in the middle of its frames, at a depth in metres."""

    def show(part: float) -> Rendering:
        return rendering._replace(shot=turned_shot(rendering.shot, depth, 2 * np.pi * part))

    return Film(_evenly(SETTINGS.turn)[:-1], show, rests=False)


def motion(reel: Replay, rendering: Rendering, pose: Callable[[], None]) -> Film:
    """Return a film of a motion; `pose` draws the arm where the reel has it."""

    def show(part: float) -> Rendering:
        reel.seek(part * reel.duration)
        pose()
        return rendering

    return Film(_evenly(min(reel.duration, SETTINGS.motion)), show, rests=True)


def warping(reel: Replay, draw: Callable[[float], Rendering], pose: Callable[[], None]) -> Film:
    """Return a film of the warp from 0 to 1; `draw` draws a warp, and gives the reel its motion."""

    def show(part: float) -> Rendering:
        rendering = draw(part)
        reel.seek(SETTINGS.along * reel.duration)
        pose()
        return rendering

    return Film(_evenly(SETTINGS.warp), show, rests=True)


def _evenly(seconds: float) -> Array:
    """Return the parts (N,) of a film of so many seconds, first and last included."""
    return np.linspace(0.0, 1.0, max(1, round(seconds * SETTINGS.rate)) + 1)


def encoded(
    film: Film,
    render: Callable[[Rendering], NDArray[np.uint8]],
    suffix: str,
    size: tuple[int, int],
    step: Callable[[float], None],
    cancelled: Cancelled,
) -> bytes:
    """Return a film as the content of a file.

    Frames are rendered and encoded on a thread of their own: whoever cancels does not wait for them.

    Args:
        film: what is shown.
        render: renders a frame (height, width, 3), RGB.
        suffix: suffix of the file, one of `VIDEO_SUFFIXES`.
        size: width and height, pixels.
        step: told which part is done, from 0 to 1.
        cancelled: asked again and again; it may raise, too.

    Raises:
        FormatError: ffmpeg is not installed, or fails.
        TimeoutError: the browser, or ffmpeg, does not answer.
        UnwantedError: it is cancelled.
    """
    with Worker(cancelled, SETTINGS.patience) as worker, Encoder(suffix, size, SETTINGS.rate) as encoder:
        frame = np.zeros((size[1], size[0], 3), np.uint8)
        for k, part in enumerate(film.parts.tolist()):
            end_if(cancelled)
            frame = worker.done(partial(render, film.show(part)), BROWSER)
            worker.done(partial(encoder.write, frame), "ffmpeg took no frame")
            step((k + 1) / (len(film.parts) + 1))
        for _ in range(round(SETTINGS.rest * SETTINGS.rate) if film.rests else 0):
            worker.done(partial(encoder.write, frame), "ffmpeg took no frame")
        return worker.done(encoder.finish, "ffmpeg wrote no file")
