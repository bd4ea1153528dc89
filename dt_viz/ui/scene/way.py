"""The way of the hand that the arm in the loop is on: what lies ahead, and, fading, where it came."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Lines, Shown, assign
from dt_viz.ui.scene.rollouts import Middles

TRAIL_SECONDS = 2.5
"""Time after which the trail has faded, seconds."""
STEP = 0.006
"""Shortest way of the hand that becomes a piece of the trail, metres."""
BESIDE = 0.008
"""Distance from a rollout up to which the way ahead counts as along it, and is not drawn, metres."""
PERIOD = 0.2
"""Time between two drawings, seconds: each sends the whole line to the browser."""


class WayAhead(Shown):
    """A line from the hand to where it is going, and a fading one to where it was."""

    def __init__(self, scene: viser.SceneApi, middles: Middles) -> None:
        """Make an empty one; the way ahead is drawn where the rollouts of these middles are not."""
        self._middles = middles
        super().__init__(scene.add_frame("/way", show_axes=False, visible=False))
        self.ahead = Lines(scene, "/way/ahead", palette.WAY, 0.0055)
        self._trail = scene.add_line_segments(
            "/way/trail", np.zeros((1, 2, 3), np.float32), np.zeros(3, np.uint8), thickness=0.005
        )
        self._drawn, self._when = np.empty((0, 3)), -np.inf
        self._dark = False
        self._came: deque[tuple[float, Array]] = deque()
        """When the hand was where, the newest last."""

    def dye(self, dark: bool) -> None:
        """Take the colours of the dark theme, or of the light one."""
        self._dark = dark
        self.ahead.dye(dark)

    def is_due(self, moment: float) -> bool:
        """Whether `show` sends something at a moment, seconds."""
        return moment - self._when >= PERIOD

    def show(self, moment: float, hand: Array, going: Callable[[], Array]) -> None:
        """Show the way.

        Args:
            moment: now, seconds.
            hand: (3,) where the hand is, metres.
            going: returns (K, 3) where it is going, metres; asked for each drawing only.
        """
        if not self._came or np.linalg.norm(hand - self._came[-1][1]) > STEP:
            self._came.append((moment, hand))
        if not self.is_due(moment):
            return
        self._when, ahead = moment, going()
        if not np.array_equal(ahead, self._drawn):
            self._drawn = ahead
            self.ahead.show_segments(self._middles.beside(self.ahead.segments([ahead]), BESIDE))
        while self._came and moment - self._came[0][0] > TRAIL_SECONDS:
            self._came.popleft()
        times, places = np.array([t for t, _ in self._came]), [*(place for _, place in self._came), hand]
        pieces = np.stack([places[:-1], places[1:]], axis=1) if len(times) else np.zeros((0, 2, 3))
        if len(pieces) or len(self._trail.points):
            assign(self._trail, pieces, _faded((moment - times) / TRAIL_SECONDS, self._dark))

    def forget(self) -> None:
        """Forget where the hand came: it was put where it is."""
        self._came.clear()


def _faded(age: Array, dark: bool) -> NDArray[np.uint8]:
    """Colours (K, 2, 3) of pieces of an age (K,) from 0 to 1."""
    fresh, old = (np.array(palette.shade(colour, dark)) for colour in (palette.WAY, palette.WAY_FADED))
    colours = fresh + age[:, None] * (old - fresh)
    light = np.round(255 * (colours / 255) ** 2.2).astype(np.uint8)  # see `palette.linear`
    return np.repeat(light[:, None], 2, axis=1)
