"""The slice in the scene: handles that move and tilt it, and a thin frame once it is moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import as_point, as_quaternion
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice, SlicePose
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.scene.markers import Marker, MarkerGroup
from dt_viz.ui.scene.picture import Lines, Look
from dt_viz.ui.scene.style import STYLES


class MovableSlice(MarkerGroup[Marker]):
    """The frame of the slice as a child of a gizmo; the browser moves both, without the server."""

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        gizmo = scene.add_transform_controls("/slice", line_width=3.0, depth_test=False, visible=False)
        super().__init__(scene, gizmo, session)
        self.border = Lines(scene, "/slice/border", STYLES.slice_border)
        self._home: Slice | None = None
        """Slice of the task."""
        self._scenario: Scenario | None = None
        self._fit(1)

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice of the task."""
        if self._is_new(frame.task.slice):
            self._home = home = frame.task.slice
            flat = Slice(np.zeros(3), np.eye(3)[:, :2], home.half_size)
            self.border.show([flat.border], look.theme)
            if self._scenario is not None:
                self.adopt(self._scenario)

    def adopt(self, scenario: Scenario) -> None:
        """Move to the scenario's slice, unless the browser has moved there already."""
        self._scenario, view = scenario, scenario.view
        if self._home is None:
            return
        (marker,) = self.items
        pose = view.slice or self._home.pose
        marker.stand(pose.position, pose.wxyz)
        marker.has_handles = view.move_slice
        self.visible = view.move_slice or view.slice is not None

    def _new(self, index: int) -> Marker:
        return Marker(self, self.node, scale=0.24)

    def _move(self, session: Session, marker: Marker, position: Array, wxyz: Array) -> None:
        pose = SlicePose(as_point(position), as_quaternion(wxyz))
        session.edit("slice", view=replace(session.scenario.view, slice=pose))
