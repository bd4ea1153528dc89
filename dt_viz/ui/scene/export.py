"""Export of the page as PNG files."""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Callable

import numpy as np
import viser
from PIL import Image

from dt_viz.ui.scene.legend import Legend

logger = logging.getLogger(__name__)

RESOLUTIONS = {
    "1280 × 720": (1280, 720),
    "1920 × 1080": (1920, 1080),
    "2560 × 1440": (2560, 1440),
    "3840 × 2160": (3840, 2160),
}
"""Width and height in pixels, by name."""
TIMEOUT = 60.0
"""Longest time to wait for the browser, seconds."""


class PictureSaver:
    """Saves pictures for one visitor, one at a time.

    A browser may take a minute to render, or never answer. A thread of the visitor's own waits for it, since viser's
    pool also serves new visitors.
    """

    def __init__(
        self, save: Callable[[str, bool], None], show: Callable[[bool], None], fail: Callable[[Exception], None]
    ) -> None:
        """Wait for requests.

        Args:
            save: makes a picture, given the resolution's name and whether it is transparent; raises when the visitor
                leaves.
            show: called with True when a picture is begun, and with False when it is done.
            fail: called with what `save` raises while the visitor is there.
        """
        self._save, self._show, self._fail = save, show, fail
        self._thread: threading.Thread | None = None
        self._closed = False

    def request(self, resolution: str, transparent: bool) -> None:
        """Begin a picture unless one is under way, without blocking; called by one thread only."""
        if self._closed or (self._thread is not None and self._thread.is_alive()):
            return
        self._thread = threading.Thread(target=self._run, args=(resolution, transparent), name="picture", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Report nothing more: the visitor has left."""
        self._closed = True

    def _run(self, resolution: str, transparent: bool) -> None:
        self._show(True)
        try:
            self._save(resolution, transparent)
        except Exception as error:  # the browser may send anything for a picture
            if not self._closed:
                logger.exception("a picture could not be saved")
                self._fail(error)
        finally:
            self._show(False)


def render_png(client: viser.ClientHandle, size: tuple[int, int], legend: Legend | None, *, transparent: bool) -> bytes:
    """Render the visitor's view as a PNG file.

    Args:
        client: the visitor; the server's event loop must not call this.
        size: width and height, pixels.
        legend: legend of its colours, drawn onto it.
        transparent: keep the background transparent, else make it white.

    Raises:
        TimeoutError: the browser did not answer.
    """
    width, height = size
    rgba = client.get_render(height, width, transport_format="png", timeout=TIMEOUT)
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
