"""The path of the hand of the arm in the loop: ahead, and, fading, where it came."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.ui.scene.palette import Theme
from dt_viz.ui.scene.picture import Lines, Shown, assign
from dt_viz.ui.scene.style import STYLES
from dt_viz.ui.scene.tubes import RolloutTubes

TRAIL_SECONDS = 2.5
"""Time after which the trail has faded, seconds."""
TRAIL_STEP = 0.006
"""Shortest path of the hand that becomes a piece of the trail, metres."""
ALONG = 0.008
"""Distance from a rollout up to which the path ahead counts as along it, and is not drawn, metres."""
PATH_PERIOD = 0.2
"""Time between two drawings, seconds: each sends the whole line to the browser."""


class HandPath(Shown):
    """A line from the hand to where it is going, and a fading one to where it was."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/way", show_axes=False, visible=False))
        self.ahead = Lines(scene, "/way/ahead", STYLES.way)
        self._trail = Lines(scene, "/way/trail", STYLES.trail).node
        self._drawn, self._when = np.empty((0, 3)), -np.inf
        self._came: deque[tuple[float, Array]] = deque()
        """When the hand was where, the newest last."""

    def is_due(self, moment: float) -> bool:
        """Whether `show` sends something at a moment, seconds."""
        return moment - self._when >= PATH_PERIOD

    def show(self, moment: float, hand: Array, going: Callable[[], Array], tubes: RolloutTubes, theme: Theme) -> None:
        """Show the path.

        Args:
            moment: now, seconds.
            hand: (3,) where the hand is, metres.
            going: returns (K, 3) where it is going, metres; asked for each drawing only.
            tubes: tubes of the rollouts, along which the path ahead is not drawn.
            theme: colours.
        """
        if not self._came or np.linalg.norm(hand - self._came[-1][1]) > TRAIL_STEP:
            self._came.append((moment, hand))
        if not self.is_due(moment):
            return
        self._when, ahead = moment, going()
        if not np.array_equal(ahead, self._drawn):
            self._drawn = ahead
            self.ahead.show_segments(tubes.outside(self.ahead.segments([ahead]), ALONG), theme)
        while self._came and moment - self._came[0][0] > TRAIL_SECONDS:
            self._came.popleft()
        times, places = np.array([t for t, _ in self._came]), [*(place for _, place in self._came), hand]
        pieces = np.stack([places[:-1], places[1:]], axis=1) if len(times) else np.zeros((0, 2, 3))
        if len(pieces) or len(self._trail.points):
            assign(self._trail, pieces, _faded((moment - times) / TRAIL_SECONDS, theme))

    def forget(self) -> None:
        """Forget where the hand came: it was put where it is."""
        self._came.clear()


def _faded(age: Array, theme: Theme) -> NDArray[np.uint8]:
    """Colours (K, 2, 3) of pieces of an age (K,) from 0 to 1."""
    fresh, old = (np.array(colour) for colour in (theme.way, theme.way_faded))
    colours = fresh + age[:, None] * (old - fresh)
    light = np.round(255 * (colours / 255) ** 2.2).astype(np.uint8)  # see `palette.linear`
    return np.repeat(light[:, None], 2, axis=1)
