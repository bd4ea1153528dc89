"""A level of the stack in the scene: the rollouts on its manifold, beside those of the whole stack."""

from __future__ import annotations

import viser

from dt_viz.engine import Frame
from dt_viz.scenario import Scenario
from dt_viz.stacking import levels
from dt_viz.ui import palette
from dt_viz.ui.picture import Lines, Picture


class LevelRollouts(Picture):
    """What the motions would be without what is stacked on the selected level."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.lines = Lines(scene, "/level", palette.LEVEL, 0.0036)
        super().__init__(self.lines.node)
        self._frame: Frame | None = None
        self._level = ""

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        self._frame = frame
        if self._level:
            self._show()

    def adopt(self, scenario: Scenario) -> None:
        """Show the level that the scenario's view names."""
        if scenario.view.level != self._level:
            self._level = scenario.view.level
            self._show()

    def _show(self) -> None:
        frame = self._frame
        names = () if frame is None else levels(frame.scenario)
        shown = frame is not None and self._level in names and names.index(self._level) < len(frame.levels)
        self.lines.show(frame.levels[names.index(self._level)] if frame is not None and shown else ())
