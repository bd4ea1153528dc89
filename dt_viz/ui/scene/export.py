"""Export of the page as PNG files."""

from __future__ import annotations

import io

import numpy as np
import viser
from PIL import Image

from dt_viz.ui.scene.legend import Legend

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
    legend: Legend | None,
    *,
    transparent: bool,
    timeout: float = TIMEOUT,
) -> bytes:
    """Render the visitor's view as a PNG file.

    Args:
        client: the visitor; the server's event loop must not call this.
        size: width and height, pixels.
        legend: legend of its colours, drawn onto it.
        transparent: keep the background transparent, else make it white.
        timeout: longest time to wait for the browser, seconds.

    Raises:
        TimeoutError: the browser did not answer.
    """
    width, height = size
    rgba = client.get_render(height, width, transport_format="png", timeout=timeout)
    return as_png(Image.fromarray(np.asarray(rgba), "RGBA"), legend, transparent=transparent)


def as_png(image: Image.Image, legend: Legend | None, *, transparent: bool) -> bytes:
    """Encode the RGBA image with its legend as PNG; see `render_png`."""
    if legend is not None:
        image = legend.drawn_onto(image)
    if not transparent:
        white = Image.new("RGBA", image.size, "white")
        white.alpha_composite(image)
        image = white.convert("RGB")
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
