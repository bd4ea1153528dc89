"""The warp: how far the flows of the stack have run, by hand or played from straight rays to the full stack."""

from __future__ import annotations

import viser

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.player import Player
from dt_viz.session.session import Session
from dt_viz.ui.panel.bindings import Bindings

SECONDS = 5.0
"""Duration of playing."""
PLAY, STOP = "▶ 0 → 1", "Stop"
NAME = "Warp"
"""Name of the slider, and of its gesture for undo."""


def grown(scenario: Scenario, seconds: float) -> dict[str, float] | None:
    """Return the warp some seconds after playing began; None once it is full."""
    return None if scenario.warp == 1 and seconds > SECONDS else {"warp": round(min(1.0, seconds / SECONDS), 3)}


class WarpControls:
    """The slider and the button that plays it."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, order: float) -> None:
        """Build them.

        Args:
            gui: controls of the visitor, in the folder that they go into.
            bindings: bindings of the visitor's panel.
            order: order of the first of them in the folder.
        """
        self._player = Player(self._show)
        hint = "part of its time that each flow runs. 0: motions and space are straight; 1: the stack is complete"
        bindings.input(
            gui.add_slider(NAME, 0.0, 1.0, 0.01, 1.0, order=order, hint=hint),
            lambda s: s.warp,
            lambda _s, value: {"warp": value},
        )
        self._play = gui.add_button_group("Play warp", (PLAY,), order=order + 1)
        bindings.on(self._play, lambda session, _button: self._toggle(session))

    def close(self) -> None:
        """Stop playing."""
        self._player.close()

    def _toggle(self, session: Session) -> None:
        if self._player.playing:
            self._player.stop()
        else:
            self._player.start(session, NAME, grown)

    def _show(self, playing: bool) -> None:
        self._play.options = (STOP,) if playing else (PLAY,)
