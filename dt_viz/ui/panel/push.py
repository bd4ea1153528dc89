"""The button that pushes the hand aside, and the path that the hand then takes."""

from __future__ import annotations

from collections.abc import Callable

import viser

from dt_viz.motion.pushing import Pushed
from dt_viz.scenario.scenario import Scenario
from dt_viz.ui.controls import on_press
from dt_viz.ui.panel.bindings import Bindings
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Lines


class PushButton:
    """The button, which can be pressed while a motion is played."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Add the button where the panel is being built; it acts once `connect` has said how."""
        self.handle = gui.add_button(
            "Push the hand",
            icon=viser.Icon.HAND_FINGER,
            disabled=True,
            hint="a few centimetres to a side, while the arm moves: it goes on from there, and still reaches the goal; "
            "or drag the ball at the hand",
        )

        def disabled(scenario: Scenario) -> bool:
            frame = bindings.frame
            return frame is None or frame.arm is None or bool(frame.blocked) or not scenario.view.playing

        bindings.properties(self.handle, disabled=disabled)

    def connect(self, push: Callable[[], None]) -> None:
        """Call `push`, which must only submit, when the button is pressed."""
        on_press(self.handle, push)


class PushedPath:
    """The path of the hand after a push, until the goal."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.lines = Lines(scene, "/pushed", palette.PUSHED, 0.0048)
        self.pushed: Pushed | None = None
        """Motion that is shown, if any."""
        self.lines.node.visible = False

    def show(self, pushed: Pushed) -> None:
        """Show this path."""
        self.pushed = pushed
        self.lines.show([pushed.path])
        self.lines.node.visible = True

    def hide(self) -> None:
        """Hide the path: the hand is at the goal, or there is another motion."""
        self.pushed = None
        self.lines.node.visible = False

    def is_of_another(self, scenario: Scenario) -> bool:
        """Whether what is shown belongs to another motion than this scenario's."""
        return self.pushed is not None and not scenario.moves_like(self.pushed.scenario)
