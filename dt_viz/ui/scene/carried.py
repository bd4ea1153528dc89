"""The ball that the hand carries to the pots and drops at the goal (fig. 8)."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.scenario.tasks import Pot
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.pots import WALL

RADIUS = 0.022
"""Radius of the ball, metres."""
GRAVITY = 9.81
"""Acceleration of gravity, m/s²."""


def fallen(place: Array, pots: tuple[Pot, ...], seconds: float) -> Array:
    """Return the middle (3,) of a ball that was dropped at `place` (3,), metres, some `seconds` ago.

    It comes to rest on the bottom of the pot that catches it, or on the table.
    """
    bottom = WALL if any(pot.catches(place) for pot in pots) else 0.0
    x, y, z = place
    return np.array([x, y, min(z, max(bottom + RADIUS, z - GRAVITY * seconds**2 / 2))])


class Carried:
    """A ball in the hand, shown with the arm in tasks with pots."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.ball = scene.add_icosphere("/carried", radius=RADIUS, color=palette.CARRIED, visible=False)
        self._pots: tuple[Pot, ...] = ()
        self._arm = True
        self._held: Array | None = None
        """Where the hand was when it last held the ball."""

    def stand(self, pots: tuple[Pot, ...]) -> None:
        """Show the ball for these pots, if there are any."""
        self._pots = pots
        self._show()

    def show(self, *, arm: bool) -> None:
        """Show the ball only with the arm."""
        self._arm = arm
        self._show()

    def pose(self, hand: Array, dropped: float) -> None:
        """Put the ball in the hand at `hand` (3,), metres, or below where it was `dropped`, seconds ago; 0 if not."""
        if self._held is None or dropped == 0:
            self._held = hand
        if self._pots:
            self.ball.position = fallen(self._held, self._pots, dropped)
            self._show()

    def _show(self) -> None:
        self.ball.visible = bool(self._pots) and self._arm and self._held is not None
