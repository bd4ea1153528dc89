"""The stage: lights, a background with a slight gradient, and a table without an edge, of the horizon's colour."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.session.frame import Frame
from dt_viz.ui.scene.palette import LIGHT, Theme
from dt_viz.ui.scene.picture import Look, Picture


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
