"""A level of the stack in the scene: the rollouts on its manifold, beside those of the whole stack."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.motion.diagnostics import MAX_GOAL_MISS
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import IMITATION
from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Picture
from dt_viz.ui.scene.tubes import Tubes, middles_of

LABEL_GAP = 0.03
"""Height of the label above the slice, metres."""


class LevelRollouts(Picture):
    """Rollouts of the selected level, without the transforms stacked on it, and the name of its manifold."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/level", show_axes=False, visible=False))
        self.tubes = Tubes(scene, "/level/rollouts", palette.LEVEL, 0.0026, ball=0.006)
        self.end = scene.add_frame("/level/end", show_axes=False, visible=False)
        scene.add_icosphere("/level/end/ball", radius=0.009, color=palette.LEVEL)
        scene.add_label(
            "/level/end/label", "its end", position=(0.0, 0.0, 0.02), anchor="bottom-center", font_screen_scale=0.8
        )
        self.label = scene.add_label("/level/label", "", anchor="bottom-center", font_screen_scale=1.1)

    def draw(self, frame: Frame) -> None:
        if frame.level is not None:
            paths = frame.levels[frame.level]
            self.tubes.show(middles_of(paths))
            self.tubes.colour = palette.STALE if frame.blocked else palette.LEVEL
            self._mark(paths[0][-1], frame.goal)
            self.label.text, area = manifold(frame.scenario), frame.slice
            self.label.position = area.centre + np.array([0.0, 0.0, np.ptp(area.border[:, 2]) / 2 + LABEL_GAP])
        self.visible = frame.level is not None

    def _mark(self, end: Array, goal: Array) -> None:
        """Mark the end (3,) of the motions unless it is the goal (3,), metres."""
        self.end.position = end
        self.end.visible = bool(np.linalg.norm(end - goal) > MAX_GOAL_MISS)


def manifold(scenario: Scenario) -> str:
    """Return the name of the manifold of the level that the view shows."""
    level = scenario.view.level
    if level == IMITATION:
        return "manifold of the imitation" if scenario.imitation else "base attractor: straight motions"
    return f"manifold up to {level[:1].lower() + level[1:]}"
