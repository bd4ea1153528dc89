"""Panels beside the scene, drawn together: one node for each look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from dt_viz.engine.frame import Frame
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Point
from dt_viz.pictures.panels import PanelPicture
from dt_viz.scenario.panels import directions
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Arrows, Lines, Picture
from dt_viz.ui.scene.tubes import Tubes, middles_of

ARROW_LENGTH = 0.030
"""Length of the longest arrow of a generator, metres."""
TITLE_GAP = 0.015
"""Distance of a title from its panel, metres."""


class Panels(Picture):
    """Systems on panels beside the scene, and a frame with a title around the scene's own slice."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/panels", show_axes=False))
        self._scene = scene
        self._borders = Lines(scene, "/panels/borders", palette.PANEL, 0.0016)
        self._grid = Lines(scene, "/panels/grid", palette.GRID, 0.0010)
        self.streamlines = Lines(scene, "/panels/streamlines", palette.STREAMLINE, 0.0011)
        self._demonstrations = Lines(scene, "/panels/demonstrations", palette.DEMONSTRATION, 0.0018)
        self._outlines = Lines(scene, "/panels/outlines", palette.OUTLINE, 0.0030)
        weak, strong = palette.linear(palette.GENERATOR_WEAK), palette.linear(palette.GENERATOR)
        self._arrows = Arrows(scene, "/panels/arrows", weak, strong, ARROW_LENGTH)
        self.rollouts = Tubes(scene, "/panels/rollouts", palette.ROLLOUT, 0.0022, ball=0.0055)
        self._goals: list[viser.IcosphereHandle] = []
        self._titles: list[viser.LabelHandle] = []
        self._drawn: tuple[PanelPicture, ...] = ()

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        panels = frame.pictures.panels
        if not panels or panels is self._drawn:
            return
        self._drawn = panels
        self._borders.show([panel.area.border for panel in panels])
        self._grid.show([line for panel in panels for line in panel.grid])
        self.streamlines.show([line for panel in panels for line in panel.streamlines])
        self._demonstrations.show([path for panel in panels for path in panel.demonstrations])
        self._outlines.show_segments(np.concatenate([panel.outlines for panel in panels]))
        self.rollouts.show(middles_of([path for panel in panels for path in panel.rollouts]))
        lengths = [np.linalg.norm(panel.vectors, axis=1).max(initial=1e-12) for panel in panels]
        vectors = [panel.vectors / length for panel, length in zip(panels, lengths, strict=True)]
        self._arrows.show(np.concatenate([panel.points for panel in panels]), np.concatenate(vectors))
        self._mark([panel.goal for panel in panels if panel.goal is not None])
        self._write(panels, frame.task.camera)

    def _mark(self, goals: Sequence[Array]) -> None:
        for k in range(len(self._goals), len(goals)):
            self._goals.append(self._scene.add_icosphere(f"/panels/goal {k}", radius=0.009, color=palette.GOAL))
        for k, ball in enumerate(self._goals):
            ball.visible = k < len(goals)
            if ball.visible:
                ball.position = goals[k]

    def _write(self, panels: Sequence[PanelPicture], camera: tuple[Point, Point]) -> None:
        for k in range(len(self._titles), len(panels)):
            label = self._scene.add_label(f"/panels/title {k}", "", anchor="bottom-center", font_screen_scale=1.1)
            self._titles.append(label)
        for k, label in enumerate(self._titles):
            label.visible = k < len(panels)
            if label.visible:
                area = panels[k].area
                _, up = directions(area, camera)
                label.text, label.position = panels[k].title, area.centre + (area.half_size[1] + TITLE_GAP) * up
