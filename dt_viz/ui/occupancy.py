"""The learned occupancy in the scene: how sure the map is, its level 1/2 and the true outline beside it."""

from __future__ import annotations

import numpy as np
import viser
from viser import transforms

from dt_viz.engine import Frame
from dt_viz.fields import Array
from dt_viz.tasks import Slice
from dt_viz.ui import palette
from dt_viz.ui.picture import Lines, Picture

MOST_OPAQUE = 0.85
"""Opacity where the map is sure that something is there."""
POINT_SIZE = 0.0025
"""Metres."""


class OccupancySlice(Picture):
    """What the map believes, as colour on the slice: the more opaque the more likely."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/occupancy", show_axes=False))
        self._scene = scene
        self.image: viser.ImageHandle | None = None
        self._area: Slice | None = None
        self.level = Lines(scene, "/occupancy/level", palette.OCCUPANCY_LEVEL, 0.0035)
        self.outline = Lines(scene, "/occupancy/outline", palette.GHOST, 0.0016)
        self.points = scene.add_point_cloud(
            "/occupancy/points", np.zeros((0, 3), np.float32), palette.FREE, point_size=POINT_SIZE, point_shape="circle"
        )
        self._shown: object = None

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        picture = frame.pictures.occupancy
        if picture is None or picture is self._shown:
            return
        self._shown = picture
        self._paint(picture.area, picture.probability)
        self.level.show_segments(picture.level)
        self.outline.show_segments(picture.outline)
        self.points.points = picture.points.astype(np.float32)
        self.points.colors = np.where(picture.occupied[:, None], palette.OCCUPIED, palette.FREE).astype(np.uint8)

    def _paint(self, area: Slice, probability: Array) -> None:
        pixels = np.empty((*probability.T.shape, 4), np.uint8)
        pixels[..., :3] = palette.OCCUPANCY
        pixels[..., 3] = np.round(255 * MOST_OPAQUE * probability.T[::-1])  # the first row is the upper one
        if self.image is not None and self._area is area:
            self.image.image = pixels
            return
        self._area = area
        right, up = area.axes.T
        turn = transforms.SO3.from_matrix(np.stack([right, -up, np.cross(right, -up)], axis=1))
        width, height = (2 * half for half in area.half_size)
        self.image = self._scene.add_image(
            "/occupancy/image",
            pixels,
            width,
            height,
            format="png",
            wxyz=turn.wxyz,
            position=area.centre,
            cast_shadow=False,
            receive_shadow=False,
        )
