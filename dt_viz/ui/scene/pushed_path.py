"""The path that the hand takes after a push, in the scene."""

from __future__ import annotations

import viser

from dt_viz.motion.pushing import Pushed
from dt_viz.scenario.scenario import Scenario
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Lines


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
