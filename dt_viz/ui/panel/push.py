"""The button that pushes the hand aside, and the path that the hand then takes."""

from __future__ import annotations

from collections.abc import Callable

import viser

from dt_viz.engine.frame import Frame
from dt_viz.motion.pushing import Pushed
from dt_viz.scenario.scenario import Scenario
from dt_viz.ui.controls import on_press
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Lines


class PushButton:
    """Can be pressed while there is a motion and it is played."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Add the button where the panel is being built; it acts once `connect` has said how."""
        self.handle = gui.add_button(
            "Push the hand",
            icon=viser.Icon.HAND_FINGER,
            disabled=True,
            hint="a few centimetres to a side, while the arm moves: it goes on from there, and still reaches the goal; "
            "or drag the ball at the hand",
        )
        self._moves, self._plays = False, True

    def connect(self, push: Callable[[], None]) -> None:
        """Call `push`, which must only submit, when the button is pressed."""
        on_press(self.handle, push)

    def adopt(self, scenario: Scenario) -> None:
        """Nothing is pushed that stands still."""
        self._plays = scenario.view.playing
        self._update()

    def report(self, frame: Frame) -> None:
        """Nothing is pushed where there is no motion."""
        self._moves = frame.arm is not None and not frame.blocked
        self._update()

    def _update(self) -> None:
        disabled = not (self._moves and self._plays)
        if self.handle.disabled != disabled:
            self.handle.disabled = disabled


class PushedPath:
    """The path of the hand after a push, until the goal."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.lines = Lines(scene, "/pushed", palette.PUSHED, 0.0048)
        self.pushed: Pushed | None = None
        """What is shown, if anything."""
        self.lines.node.visible = False

    def show(self, pushed: Pushed) -> None:
        """Show this path."""
        self.pushed = pushed
        self.lines.show([pushed.path])
        self.lines.node.visible = True

    def hide(self) -> None:
        """The hand is at the goal, or there is another motion."""
        self.pushed = None
        self.lines.node.visible = False

    def is_of_another(self, scenario: Scenario) -> bool:
        """Whether what is shown belongs to another motion than this scenario's."""
        return self.pushed is not None and not scenario.moves_like(self.pushed.scenario)
