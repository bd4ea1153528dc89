"""A level of the stack in the scene: the rollouts on its manifold, beside those of the whole stack."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.engine import Frame
from dt_viz.stacking import IMITATION
from dt_viz.ui import palette
from dt_viz.ui.picture import Lines, Picture

LABEL_GAP = 0.03
"""Above the slice, metres."""


class LevelRollouts(Picture):
    """What the motions would be without what is stacked on the selected level, and the name of its manifold."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/level", show_axes=False, visible=False))
        self.lines = Lines(scene, "/level/rollouts", palette.LEVEL, 0.0052)
        self.label = scene.add_label("/level/label", "", anchor="bottom-center", font_screen_scale=1.1)

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        shown = frame.level is not None
        if frame.level is not None:
            self.lines.show(frame.levels[frame.level])
            area, text = frame.slice, manifold(frame.scenario.view.level)
            if self.label.text != text:
                self.label.text = text
            self.label.position = area.centre + np.array([0.0, 0.0, np.ptp(area.border[:, 2]) / 2 + LABEL_GAP])
        if self._node.visible != shown:
            self._node.visible = shown


def manifold(level: str) -> str:
    """What the manifold of a level is called."""
    return "manifold of the imitation" if level == IMITATION else f"manifold with {level}"
