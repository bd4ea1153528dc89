"""The stage: lights, a background with a slight gradient, and a table without an edge, of the horizon's colour."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Picture

TABLE_RADIUS, TABLE_HEIGHT = 40.0, 0.02
"""Radius of the table, metres, whose edge is far away, and its thickness."""
BELOW = 5e-4
"""Distance of the table's top below the plane of the arm's base, metres: coinciding surfaces would flicker."""
BACKGROUND_HEIGHT = 128
"""Number of rows of the background image."""


def background(dark: bool = False) -> NDArray[np.uint8]:
    """Return the background (H, W, 3) of a theme, from the top down."""
    low, high = (np.array(palette.shade(colour, dark), float) for colour in (palette.HORIZON, palette.ZENITH))
    height = np.clip(np.linspace(1, -6, BACKGROUND_HEIGHT), 0, 1)[:, None] ** 1.5
    rows = np.round(low + height * (high - low)).astype(np.uint8)
    return np.repeat(rows[:, None], 2 * BACKGROUND_HEIGHT, axis=1)


def set_stage(scene: viser.SceneApi) -> None:
    """Set lights and background; the lights look the same in an exported picture, without an environment map."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(hdri=None)
    scene.set_background_image(background(), "png")
    scene.add_light_hemisphere("/lights/sky", sky_color=(255, 255, 255), ground_color=(206, 204, 204), intensity=1.5)
    scene.add_light_directional("/lights/key", position=(0.9, -1.5, 2.4), intensity=2.3, cast_shadow=True)
    scene.add_light_directional("/lights/fill", position=(-1.6, -1.0, 1.0), intensity=0.5)
    scene.add_light_directional("/lights/rim", position=(-0.8, 1.9, 1.5), intensity=1.6, color=(226, 236, 255))


class Table(Picture):
    """The work table under the arm."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(
            scene.add_cylinder(
                "/table",
                TABLE_RADIUS,
                TABLE_HEIGHT,
                palette.TABLE,
                radial_segments=96,
                position=(0.0, 0.0, -TABLE_HEIGHT / 2 - BELOW),
                cast_shadow=False,  # on itself it would show as stripes
                receive_shadow=0.25,
            )
        )

    def draw(self, frame: Frame) -> None:
        """It never changes."""

    def dye(self, dark: bool) -> None:
        self.node.color = palette.shade(palette.TABLE, dark)
