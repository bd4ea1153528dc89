"""The slice in the scene: handles that move and tilt it, and a thin frame once it is moved."""

from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np
import viser

from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.handles import Handles, Moved
from dt_viz.ui.scene.picture import Lines, Picture

HANDLE_SCALE = 0.24
"""Approximate size of the handles, metres."""


class MovableSlice(Picture):
    """The frame of the slice as a child of a gizmo; the browser moves both, without the server."""

    def __init__(self, scene: viser.SceneApi, moved: Moved) -> None:
        """Begin hidden; `moved` is called with each new pose, the position being the slice's centre."""
        self.gizmo = scene.add_transform_controls("/slice", line_width=3.0, depth_test=False, visible=False)
        super().__init__(self.gizmo)
        self.border = Lines(scene, "/slice/border", palette.SLICE, 0.0022)
        self._home: Slice | None = None
        self._handles = Handles(self.gizmo, HANDLE_SCALE)
        self._handles.on_move(moved)
        self._scenario: Scenario | None = None

    def draw(self, frame: Frame) -> None:
        """Remembers the slice of the task."""
        home = frame.task.slice
        if home is not self._home:
            self._home = home
            flat = Slice(np.zeros(3), np.eye(3)[:, :2], home.half_size)
            self.border.show([flat.border])
            if self._scenario is not None:
                self.adopt(self._scenario)

    def adopt(self, scenario: Scenario) -> None:
        """Move to the scenario's slice, unless the browser has moved there already."""
        self._scenario, view = scenario, scenario.view
        if self._home is None:
            return
        pose = view.slice or self._home.pose
        self._handles.stand(pose.position, pose.wxyz)
        self._handles.show(view.move_slice)
        self.visible = view.move_slice or view.slice is not None

    def without_handles(self) -> AbstractContextManager[None]:
        """Hide the handles, not the frame, while a picture is made."""
        return self._handles.hidden()
