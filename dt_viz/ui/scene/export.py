"""Export of the page as PNG files."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import viser
from PIL import Image

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
"""Longest time to wait for the browser, seconds."""


def render_png(
    client: viser.ClientHandle,
    size: tuple[int, int],
    shot: Shot,
    legends: Sequence[Legend | Key],
    *,
    transparent: bool,
    timeout: float = TIMEOUT,
) -> bytes:
    """Render the scene of a visitor as a PNG file.

    Args:
        client: the visitor; the server's event loop must not call this.
        size: width and height, pixels.
        shot: camera of the picture.
        legends: what explains its colours, drawn onto it.
        transparent: keep the background transparent, else make it white.
        timeout: longest time to wait for the browser, seconds.

    Raises:
        TimeoutError: the browser did not answer.
    """
    width, height = size
    rgba = client.get_render(height, width, **shot._asdict(), transport_format="png", timeout=timeout)
    return as_png(Image.fromarray(np.asarray(rgba), "RGBA"), legends, transparent=transparent)


def as_png(image: Image.Image, legends: Sequence[Legend | Key], *, transparent: bool) -> bytes:
    """Encode the RGBA image with its legends as PNG; see `render_png`."""
    image = drawn_onto(image, legends)
    if not transparent:
        white = Image.new("RGBA", image.size, "white")
        white.alpha_composite(image)
        image = white.convert("RGB")
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
