"""Panels beside the scene: each draws again only what has changed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from dt_viz.obstacles.shapes import Point
from dt_viz.pictures.panels import PanelPicture
from dt_viz.scenario.panels import directions
from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Arrows, Lines, Picture
from dt_viz.ui.scene.tubes import Tubes, middles_of

ARROW_LENGTH = 0.030
"""Length of the longest arrow of a generator, metres."""
TITLE_GAP = 0.015
"""Distance of a title from its panel, metres."""


class PanelNodes:
    """The nodes of one panel."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        """Make an empty panel of this name in the scene tree."""
        self.frame = scene.add_frame(name, show_axes=False)
        self._border = Lines(scene, f"{name}/border", palette.PANEL, 0.0016)
        grid = Lines(scene, f"{name}/grid", palette.GRID, 0.0010)
        self.streamlines = Lines(scene, f"{name}/streamlines", palette.STREAMLINE, 0.0011)
        demonstrations = Lines(scene, f"{name}/demonstrations", palette.DEMONSTRATION, 0.0018)
        outlines = Lines(scene, f"{name}/outlines", palette.OUTLINE, 0.0030)
        weak, strong = palette.linear(palette.GENERATOR_WEAK), palette.linear(palette.GENERATOR)
        self._arrows = Arrows(scene, f"{name}/arrows", weak, strong, ARROW_LENGTH)
        self.rollouts = Tubes(scene, f"{name}/rollouts", palette.ROLLOUT, 0.0022, ball=0.0055)
        self._goal = scene.add_icosphere(f"{name}/goal", radius=0.009, color=palette.GOAL)
        self._title = scene.add_label(f"{name}/title", "", anchor="bottom-center", font_screen_scale=1.1)
        self._show: dict[str, Callable[[Any], None]] = {
            "grid": grid.show,
            "streamlines": self.streamlines.show,
            "demonstrations": demonstrations.show,
            "outlines": outlines.show_segments,
            "rollouts": lambda paths: self.rollouts.show(middles_of(paths)),
        }
        """What shows each field of a `PanelPicture`."""
        self._drawn: PanelPicture | None = None
        self._lines = (self._border, grid, self.streamlines, demonstrations, outlines)

    def dye(self, dark: bool) -> None:
        """Take the colours of the dark theme, or of the light one."""
        for lines in self._lines:
            lines.dye(dark)

    def draw(self, panel: PanelPicture, camera: tuple[Point, Point]) -> None:
        """Show a panel, read by a camera with this position and look-at, metres."""
        before, self._drawn = self._drawn, panel
        self.frame.position = panel.offset
        for name, show in self._show.items():
            if before is None or getattr(before, name) is not getattr(panel, name):
                show(getattr(panel, name))
        if before is None or before.points is not panel.points:
            self._arrows.show(panel.points, panel.vectors)
        self._goal.visible = panel.goal is not None
        if panel.goal is not None:
            self._goal.position = panel.goal
        if before is None or before.area.key != panel.area.key:
            self._border.show([panel.area.border])
        _, up = directions(panel.area, camera)
        self._title.text = panel.title
        self._title.position = panel.area.centre + (panel.area.half_size[1] + TITLE_GAP) * up


class Panels(Picture):
    """Systems on panels beside the scene, and a frame with a title around the scene's own slice."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/panels", show_axes=False))
        self._scene = scene
        self.panels: list[PanelNodes] = []
        self._dark = False

    def dye(self, dark: bool) -> None:
        self._dark = dark
        for nodes in self.panels:
            nodes.dye(dark)

    def draw(self, frame: Frame) -> None:
        panels = frame.pictures.panels
        if not panels:
            return
        for k in range(len(self.panels), len(panels)):
            self.panels.append(PanelNodes(self._scene, f"/panels/{k}"))
            self.panels[k].dye(self._dark)
        for k, nodes in enumerate(self.panels):
            nodes.frame.visible = k < len(panels)
            if k < len(panels):
                nodes.draw(panels[k], frame.task.camera)
                nodes.rollouts.colour = palette.STALE if frame.blocked else palette.ROLLOUT
