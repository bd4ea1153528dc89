"""The board that a visitor draws on, and what is being drawn or guided at the moment."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot
from dt_viz.scenario.slices import Slice
from dt_viz.session.teaching import drawn_beyond
from dt_viz.ui.scene.palette import LIGHT, Theme
from dt_viz.ui.scene.picture import Lines, Shown
from dt_viz.ui.scene.style import STYLES

SPACING = 2 / 7
"""Distance of the lines on the board, relative to half its height."""


class Board(Shown):
    """A plate with lines before the arm, and the line that the pen leaves, red where the hand does not get to."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/teaching", show_axes=False, visible=False))
        corners, triangles = np.zeros((4, 3), np.float32), np.array([[0, 1, 2], [0, 2, 3]])
        look = {"side": "double", "cast_shadow": False, "receive_shadow": False}
        style = STYLES.teaching_board
        self.plate = scene.add_mesh_simple(
            "/teaching/board", corners, triangles, color=style.on(LIGHT), opacity=style.opacity, visible=False, **look
        )
        self._lines = Lines(scene, "/teaching/board/lines", STYLES.teaching_lines)
        self._line, self._beyond = Lines(scene, "/teaching/line", STYLES.pen), Lines(scene, "/teaching/red", STYLES.far)

    def stand(self, area: Slice | None, theme: Theme) -> None:
        """Stand on a rectangle; None leaves only the line."""
        self.plate.visible = area is not None
        if area is not None:
            self.plate.vertices = area.border[:4].astype(np.float32)
            grid = area.grid(SPACING * area.half_size[1])
            self._lines.show([*grid, *grid.swapaxes(0, 1)], theme)

    def ink(self, points: Array, robot: Robot, theme: Theme) -> None:
        """Show the line through points (N, 3), metres."""
        self._line.show([points], theme)
        self._beyond.show(drawn_beyond(robot, [points]), theme)
