"""Perceptually uniform colour scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.ui.scene.palette import Colour

NUM_SHADES = 256
Number = TypeVar("Number", float, Array)

# B. Ottosson, "A perceptual color space for image processing" (2020): linear sRGB → cone responses → OKLab
_TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_TO_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def oklab(colours: Array) -> Array:
    """Convert sRGB colours (*B, 3) from 0 to 255 to OKLab (*B, 3), whose distances are perceived differences."""
    c = np.asarray(colours) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ _TO_CONES.T) @ _TO_LAB.T


def from_oklab(lab: Array) -> Array:
    """Convert OKLab (*B, 3) to sRGB colours (*B, 3) from 0 to 255, clipped to the gamut."""
    linear = (lab @ np.linalg.inv(_TO_LAB).T) ** 3 @ np.linalg.inv(_TO_CONES).T
    linear = np.clip(linear, 0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def ramp(anchors: Sequence[Colour]) -> NDArray[np.uint8]:
    """Return sRGB colours (NUM_SHADES, 3) through the anchors, in perceptually equal steps."""
    # finely along straight lines in OKLab, then evenly along the whole path
    lab, u = oklab(np.array(anchors, float)), np.linspace(0, len(anchors) - 1, 4 * NUM_SHADES)
    path = np.stack([np.interp(u, np.arange(len(anchors)), c) for c in lab.T], axis=1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    even = np.linspace(0, length[-1], NUM_SHADES)
    return np.round(from_oklab(np.stack([np.interp(even, length, c) for c in path.T], axis=1))).astype(np.uint8)


def diverging(anchors: Sequence[Colour]) -> NDArray[np.uint8]:
    """Return sRGB colours (NUM_SHADES, 3) with the middle anchor in the middle and as many on either side."""
    middle = len(anchors) // 2
    low, high = ramp(anchors[: middle + 1]), ramp(anchors[middle:])
    return np.concatenate([low[::2], high[1::2]])


@dataclass(frozen=True)
class Scale:
    """Map from numbers to colours; those beyond `low` and `high` get the end colours."""

    shades: NDArray[np.uint8]  # (NUM_SHADES, 3) sRGB colours
    low: float
    high: float

    def colours(self, values: Array) -> NDArray[np.uint8]:
        """Return the colours (*B, 3) of values (*B,)."""
        return self.shades[np.round((NUM_SHADES - 1) * np.clip(self.relative(values), 0, 1)).astype(int)]

    def relative(self, value: Number) -> Number:
        """Return the place of a value on the scale: 0 at `low`, 1 at `high`."""
        return (value - self.low) / (self.high - self.low)
