"""Panels beside the scene: each draws again only what has changed."""

from __future__ import annotations

import viser

from dt_viz.obstacles.shapes import Point
from dt_viz.pictures.panels import PanelPicture
from dt_viz.scenario.panels import directions
from dt_viz.session.frame import Frame
from dt_viz.ui.scene.palette import Theme
from dt_viz.ui.scene.picture import Arrows, Lines, Look, Picture, add_ball, add_label
from dt_viz.ui.scene.style import STYLES
from dt_viz.ui.scene.tubes import Tubes, middles_of


class PanelNodes:
    """The nodes of one panel."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        """Make an empty panel of this name in the scene tree."""
        self.frame = scene.add_frame(name, show_axes=False)
        self._border = Lines(scene, f"{name}/border", STYLES.panel_border)
        styles = {
            "grid": STYLES.panel_grid,
            "streamlines": STYLES.panel_streamline,
            "demonstrations": STYLES.demonstration,
            "outlines": STYLES.outline,
        }
        self.lines = {field: Lines(scene, f"{name}/{field}", style) for field, style in styles.items()}
        """Lines by the field of `PanelPicture` that they show."""
        self._arrows = Arrows(scene, f"{name}/arrows", STYLES.panel_generator)
        self.rollouts = Tubes(scene, f"{name}/rollouts", STYLES.panel_rollout)
        self._goal = add_ball(scene, f"{name}/goal", STYLES.panel_goal)
        self._title = add_label(scene, f"{name}/title", font_screen_scale=1.1)
        self._drawn: tuple[PanelPicture, Theme] | None = None

    def draw(self, panel: PanelPicture, camera: tuple[Point, Point], theme: Theme) -> None:
        """Show a panel, read by a camera with this position and look-at, metres."""
        before, known = self._drawn or (panel, None)
        self._drawn = panel, theme

        def is_new(field: str) -> bool:
            return known is not theme or getattr(before, field) is not getattr(panel, field)

        self.frame.position = panel.offset
        for field, lines in self.lines.items():
            if is_new(field):
                show = lines.show_segments if field in {"grid", "outlines"} else lines.show
                show(getattr(panel, field), theme)
        if is_new("rollouts"):
            self.rollouts.show(middles_of(panel.rollouts), theme)
        if is_new("points"):
            self._arrows.show(panel.points, panel.vectors, theme)
        self._goal.visible = panel.goal is not None
        if panel.goal is not None:
            self._goal.position = panel.goal
        if known is not theme or before.area.key != panel.area.key:
            self._border.show([panel.area.border], theme)
        _, up = directions(panel.area, camera)
        self._title.text = panel.title
        self._title.position = panel.area.centre + (panel.area.half_size[1] + 0.015) * up


class Panels(Picture):
    """Systems on panels beside the scene, and a frame with a title around the scene's own slice."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/panels", show_axes=False))
        self._scene = scene
        self.panels: list[PanelNodes] = []

    def draw(self, frame: Frame, look: Look) -> None:
        panels = frame.pictures.panels
        if not panels:
            return
        for k in range(len(self.panels), len(panels)):
            self.panels.append(PanelNodes(self._scene, f"/panels/{k}"))
        for k, nodes in enumerate(self.panels):
            nodes.frame.visible = k < len(panels)
            if k < len(panels):
                nodes.draw(panels[k], frame.task.camera, look.theme)
