"""Pictures of ψ: its generator, the warped grid, and the base attractor beside the learned system."""

from __future__ import annotations

import viser

from dt_viz.engine.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Arrows, Lines, Picture
from dt_viz.ui.scene.tubes import Tubes

GENERATOR_LENGTH = 0.030
"""Length of the largest arrow, metres."""
THICK, THIN = 0.0011, 0.0007
"""Thickness of the warped grid's lines, metres: by itself, and beside the rollouts of a level."""
INSET_LENGTH = 0.026
"""Length of the fastest arrow in the inset, metres."""


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
        """See `Picture`."""
        picture = frame.pictures.generator
        if picture is not None and picture is not self._shown:
            self._shown = picture
            self.arrows.show(picture.points, picture.displacements)
            self._motions.show(picture.motions)


class WarpedGrid(Picture):
    """Image of a grid of base space under ψ⁻¹ of the stack; thinner and paler beside the rollouts of a level."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.lines = Lines(scene, "/grid", palette.GRID, THICK)
        super().__init__(self.lines.node)

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        if frame.pictures.grid is not None:
            beside = frame.level is not None
            self.lines.show(frame.pictures.grid.lines)
            self.lines.colour = palette.GRID_BESIDE if beside else palette.GRID
            self.lines.node.thickness = THIN if beside else THICK


class BaseInset(Picture):
    """The base attractor, with straight motions, beside the learned system."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/base", show_axes=False))
        self._border = Lines(scene, "/base/border", palette.INSET, 0.0016)
        self._grid = Lines(scene, "/base/grid", palette.GRID, 0.0010)
        self.arrows = Arrows(scene, "/base/field", palette.INSET, palette.ARROW_FAST, INSET_LENGTH)
        self.rays = Tubes(scene, "/base/rays", palette.ROLLOUT, 0.0018, ball=0.0045)
        self._goal = scene.add_icosphere("/base/goal", radius=0.009, color=palette.GOAL)
        self._labels = tuple(
            scene.add_label(f"/base/{text}", text, anchor="bottom-center", font_screen_scale=0.8)
            for text in ("base attractor", "learned system")
        )

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        picture = frame.pictures.base
        if picture is None:
            return
        self.rays.show(picture.rays)
        self.arrows.show(picture.points, picture.velocities)
        self._border.show([picture.border])
        self._grid.node.visible = frame.scenario.view.grid
        self._grid.show(picture.grid)
        self._goal.position = picture.rays[0][-1]
        for label, position in zip(self._labels, picture.labels, strict=True):
            label.position = position
