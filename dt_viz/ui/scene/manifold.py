"""Pictures of ψ: its generator, and the warped grid."""

from __future__ import annotations

import viser

from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Arrows, Lines, Picture

GENERATOR_LENGTH = 0.030
"""Length of the largest arrow, metres."""
THICK, THIN = 0.0011, 0.0007
"""Thickness of the warped grid's lines, metres: by itself, and beside the rollouts of a level."""


class Generator(Picture):
    """The learned generator as arrows, with the demonstrations on the manifold that it acts on."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/generator", show_axes=False))
        self.arrows = Arrows(
            scene,
            "/generator/arrows",
            palette.linear(palette.GENERATOR_WEAK),
            palette.linear(palette.GENERATOR),
            GENERATOR_LENGTH,
            thickness=1.25,
        )
        self._motions = Lines(scene, "/generator/motions", palette.GENERATOR, 0.0026)
        self._shown: object = None

    def draw(self, frame: Frame) -> None:
        picture = frame.pictures.generator
        if picture is not None and picture is not self._shown:
            self._shown = picture
            self.arrows.show(picture.points, picture.displacements)
            self._motions.show(picture.motions)


class WarpedGrid(Picture):
    """Image of a grid of base space under ψ⁻¹ of the stack; thinner and paler beside the rollouts of a level."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.lines, self._dark = Lines(scene, "/grid", palette.GRID, THICK), False
        super().__init__(self.lines.node)

    def draw(self, frame: Frame) -> None:
        if frame.pictures.grid is not None:
            beside = frame.level is not None
            self.lines.show_segments(frame.pictures.grid)
            self.lines.colour = palette.shade(palette.GRID_BESIDE if beside else palette.GRID, self._dark)
            self.lines.node.thickness = THIN if beside else THICK

    def dye(self, dark: bool) -> None:
        self._dark = dark
