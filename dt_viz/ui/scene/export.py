"""Export of the page as PNG files and frames of videos."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image

from dt_viz.errors import FormatError
from dt_viz.ui.scene.camera import Shot
from dt_viz.ui.scene.key import Key
from dt_viz.ui.scene.legend import Legend, drawn_onto

RESOLUTIONS = {
    "1280 × 720": (1280, 720),
    "1920 × 1080": (1920, 1080),
    "2560 × 1440": (2560, 1440),
    "3840 × 2160": (3840, 2160),
}
"""Width and height in pixels, by name."""
TIMEOUT = 60.0
"""Longest time to wait for the browser with a PNG, seconds."""


def render_png(
    client: viser.ClientHandle,
    size: tuple[int, int],
    shot: Shot,
    legends: Sequence[Legend | Key],
    timeout: float,
    *,
    transparent: bool,
) -> bytes:
    """Render the scene of a visitor as a PNG file.

    Args:
        client: the visitor; the server's event loop must not call this.
        size: width and height, pixels.
        shot: camera of the picture.
        legends: what explains its colours, drawn onto it.
        timeout: longest time to wait for the browser, seconds.
        transparent: keep the background transparent, else make it white.

    Raises:
        TimeoutError: the browser did not answer.
    """
    return as_png(Image.fromarray(_rendered(client, size, shot, timeout), "RGBA"), legends, transparent=transparent)


def render_frame(
    client: viser.ClientHandle, size: tuple[int, int], shot: Shot, legends: Sequence[Legend | Key], timeout: float
) -> NDArray[np.uint8]:
    """Render the scene of a visitor as a frame of a video, (height, width, 3), RGB; see `render_png`.

    Raises:
        FormatError: what the browser gave is no picture of this size.
        TimeoutError: the browser did not answer.
    """
    try:
        rgba = _rendered(client, size, shot, timeout)
    except RuntimeError as error:  # of viser, whose page has failed or has gone
        raise FormatError("the browser", "no picture", "one of each frame") from error
    if rgba.shape != (size[1], size[0], 4):
        raise FormatError("the browser", f"a picture of shape {rgba.shape}", f"{size[0]}x{size[1]} pixels")
    return np.asarray(_on_white(drawn_onto(Image.fromarray(rgba, "RGBA"), legends)))


def _rendered(client: viser.ClientHandle, size: tuple[int, int], shot: Shot, timeout: float) -> NDArray[np.uint8]:
    width, height = size
    return np.asarray(client.get_render(height, width, **shot._asdict(), transport_format="png", timeout=timeout))


def as_png(image: Image.Image, legends: Sequence[Legend | Key], *, transparent: bool) -> bytes:
    """Encode the RGBA image with its legends as PNG; see `render_png`."""
    image = drawn_onto(image, legends)
    if not transparent:
        image = _on_white(image)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def _on_white(image: Image.Image) -> Image.Image:
    white = Image.new("RGBA", image.size, "white")
    white.alpha_composite(image)
    return white.convert("RGB")
