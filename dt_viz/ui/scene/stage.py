"""The stage: lights, a background with a slight gradient, and a table without an edge, of the horizon's colour."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.session.teaching import drawn_beyond
from dt_viz.ui.scene.palette import LIGHT, STYLES, Theme
from dt_viz.ui.scene.picture import Lines, Look, Picture, Shown


def background(theme: Theme) -> NDArray[np.uint8]:
    """Return the background (H, W, 3) of a theme, from the top down."""
    low, high = np.array(theme.horizon, float), np.array(theme.zenith, float)
    height = np.clip(np.linspace(1, -6, 128), 0, 1)[:, None] ** 1.5
    rows = np.round(low + height * (high - low)).astype(np.uint8)
    return np.repeat(rows[:, None], 256, axis=1)


class Stage(Picture):
    """Lights and background, and the work table under the arm, which can be hidden.

    The lights look the same in an exported picture, without an environment map.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_hemisphere(
            "/lights/sky", sky_color=(255, 255, 255), ground_color=(206, 204, 204), intensity=1.5
        )
        scene.add_light_directional("/lights/key", position=(0.9, -1.5, 2.4), intensity=2.3, cast_shadow=True)
        scene.add_light_directional("/lights/fill", position=(-1.6, -1.0, 1.0), intensity=0.5)
        scene.add_light_directional("/lights/rim", position=(-0.8, 1.9, 1.5), intensity=1.6, color=(226, 236, 255))
        table = scene.add_cylinder(
            "/table",
            40.0,  # its edge is far away
            0.02,
            LIGHT.table,
            radial_segments=96,
            position=(0.0, 0.0, -0.0105),  # half a millimetre below the arm's base: coinciding surfaces would flicker
            cast_shadow=False,  # on itself it would show as stripes
            receive_shadow=0.25,
        )
        super().__init__(table)
        self._paint(LIGHT)

    def draw(self, frame: Frame, look: Look) -> None:
        if look.theme.table != self.node.color:
            self._paint(look.theme)

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the background, and the table, which would end at the horizon of a white picture."""
        shown, self.visible = self.visible, False
        self._scene.set_background_image(None)
        try:
            yield
        finally:
            self.visible = shown
            self._scene.set_background_image(background(self._theme), "png")

    def _paint(self, theme: Theme) -> None:
        self._theme = theme
        self._scene.set_background_image(background(theme), "png")
        self.node.color = theme.table


SPACING = 2 / 7  # distance of the lines on the board, relative to half its height


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
