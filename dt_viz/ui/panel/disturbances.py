"""Buttons that disturb the arm in the loop: an obstacle that crosses its motion by itself, and a goal that moves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import viser

from dt_viz.scenario.roaming import Chase, MovingGoal
from dt_viz.session.player import Play, Player
from dt_viz.session.session import Session
from dt_viz.ui.panel.bindings import Bindings

SPEEDS: Mapping[str, float] = {"Obstacle": 0.08, "Fast obstacle": 0.25}
"""Speeds of the obstacle by their names on the page, m/s."""
GOAL, STOP = "Goal", "Stop"
NAME = "Disturb"
HINT = "by itself: the selected obstacle crosses the motion again and again, or the goal moves"


class Disturbances:
    """The buttons, which become a stop button meanwhile."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build them.

        Args:
            gui: controls of the visitor, in the folder that they go into.
            bindings: bindings of the visitor's panel.
        """
        self._rng, self._player = np.random.default_rng(0), Player(self._show)
        self._bindings = bindings
        self._buttons = gui.add_button_group("Disturb", (*SPEEDS, GOAL), hint=HINT)
        bindings.on(self._buttons, self._pressed)

    def close(self) -> None:
        """Stop."""
        self._player.close()

    def _pressed(self, session: Session, button: str) -> None:
        play = None if button == STOP else self._play(session, button)
        if play is None:
            self._player.stop()
        else:
            self._player.start(session, NAME, play, returns=True)

    def _play(self, session: Session, button: str) -> Play | None:
        frame = self._bindings.frame
        if frame is None:
            return None
        if button == GOAL:
            return MovingGoal(frame.task, frame.reached)
        return Chase(frame.task, session.scenario, SPEEDS[button], self._rng)

    def _show(self, playing: bool) -> None:
        self._buttons.options = (STOP,) if playing else (*SPEEDS, GOAL)
