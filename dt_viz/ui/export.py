"""Pictures to take home."""

from __future__ import annotations

import io

import numpy as np
import viser
from PIL import Image

RESOLUTIONS = {
    "1280 × 720": (1280, 720),
    "1920 × 1080": (1920, 1080),
    "2560 × 1440": (2560, 1440),
    "3840 × 2160": (3840, 2160),
}
"""Width and height in pixels, by name."""
TIMEOUT = 60.0
"""Seconds to wait for the browser."""


def render_png(client: viser.ClientHandle, size: tuple[int, int], *, transparent: bool) -> bytes:
    """What the visitor sees, as a PNG file.

    Args:
        client: the visitor; must not be called on the server's event loop.
        size: width and height, pixels.
        transparent: keep the background transparent, else make it white.

    Raises:
        TimeoutError: the browser did not answer.
    """
    width, height = size
    rgba = client.get_render(height, width, transport_format="png", timeout=TIMEOUT)
    image = Image.fromarray(np.asarray(rgba), "RGBA")
    if not transparent:
        white = Image.new("RGBA", image.size, "white")
        white.alpha_composite(image)
        image = white.convert("RGB")
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
