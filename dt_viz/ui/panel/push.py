"""The button that pushes the hand aside."""

from __future__ import annotations

from collections.abc import Callable

import viser

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Stage
from dt_viz.ui.controls import on_press
from dt_viz.ui.panel.bindings import Bindings


class PushButton:
    """The button, which can be pressed while the arm in the loop moves."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Add the button where the panel is being built; it acts once `connect` has said how."""
        self.handle = gui.add_button(
            "Push the hand",
            icon=viser.Icon.HAND_FINGER,
            disabled=True,
            hint="a few centimetres to a side: it goes on from there, and still reaches the goal; or drag the ball at "
            "the hand",
        )

        def disabled(scenario: Scenario) -> bool:
            frame = bindings.frame
            stands = frame is None or (frame.arm is None and frame.stage >= Stage.FINE)
            return stands or scenario.view.replay or not scenario.view.playing

        bindings.properties(self.handle, disabled=disabled)

    def connect(self, push: Callable[[], None]) -> None:
        """Call `push`, which must only submit, when the button is pressed."""
        on_press(self.handle, push)
