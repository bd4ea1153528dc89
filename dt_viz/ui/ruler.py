"""The width of a visitor's window, told by the browser itself.

viser's page reports the size of its canvas in the pixels that it is drawn with: device pixels, at most two for each CSS
pixel at first, and fewer where drawing is slow. What lies beside the canvas, such as the panel, is measured in CSS
pixels. So the page has a picture with a source for each range of widths; the browser asks for the one that suits its
window, again whenever that changes, and the address that it asks for is the message. No script is needed.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable
from itertools import accumulate
from math import ceil

FOLDER = "window"
STEP = 1.04
"""Ratio of a width to the next smaller one that is told apart."""
WIDTHS = tuple(accumulate(range(89), lambda width, _: ceil(STEP * width), initial=240))
"""Widths from which on another picture is asked for, CSS pixels, ascending."""
Measured = Callable[[str, float], None]
"""Callback that takes the token of a ruler, and what its window is at least wide, CSS pixels."""


class Ruler:
    """Measures the window of one visitor."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(12)
        """Name of this ruler in requests, which nobody else knows."""

    @property
    def html(self) -> str:
        """The picture, which is not to be seen."""
        address = f"{FOLDER}/{self.token}"
        sources = [f'<source media="(min-width: {width}px)" srcset="{address}/{width}">' for width in reversed(WIDTHS)]
        return f'<picture hidden>{"".join(sources)}<img src="{address}/{WIDTHS[0]}" alt=""></picture>'


def told(path: str) -> tuple[str, float] | None:
    """Return the token and the width, CSS pixels, that the path of a request tells; None if it is another request."""
    found = re.search(rf"/{FOLDER}/([\w-]+)/(\d{{1,5}})$", path, re.ASCII)
    return (found[1], float(found[2])) if found is not None and int(found[2]) in WIDTHS else None
