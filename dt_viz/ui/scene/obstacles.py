"""The obstacles in the scene: each can be dragged itself, the selected one also by handles that move and turn it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import CloudObstacle, MeshObstacle, Obstacle, Sphere
from dt_viz.scenario.scenario import MAX_DIAMETER, Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Drag
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.handles import Dragged, Handles
from dt_viz.ui.scene.links import simplified

HANDLE_SCALE = 0.2
"""Approximate size of the handles, metres."""
OPACITY, OPACITY_FAINT, OPACITY_OPENED = 0.8, 0.3, 0.12
"""Opacities of an obstacle: avoided, not avoided, and while its map is shown."""
CREASE = 0.6
"""Angle between neighbouring faces above which their edge is drawn sharp, rad."""
MAX_FACES = 30_000
"""Largest number of faces of a mesh that is drawn in full."""
FINEST = 0.035
"""Size of the cells in which a larger mesh's vertices are merged, in radii of the obstacle."""

Moved = Callable[[int, Array, Array, str], None]
"""Callback with the index of an obstacle, its new position (3,), metres, quaternion (4,), and the phase of the drag."""


class ObstaclePicture:
    """One obstacle, a child of a gizmo; the browser moves both, without the server."""

    def __init__(
        self,
        scene: viser.SceneApi,
        index: int,
        moved: Moved,
        grabbed: Callable[[int], None],
        clicked: Callable[[int], None],
        area: Callable[[], Slice | None],
    ) -> None:
        """Draw nothing yet.

        Args:
            scene: scene of the visitor.
            index: index of the obstacle in the scenario.
            moved: called with each new pose.
            grabbed: called with the index when a drag of the obstacle begins.
            clicked: called with the index when it is clicked.
            area: returns the slice that it is dragged parallel to.
        """
        self.gizmo = scene.add_transform_controls(f"/obstacles/{index}", line_width=3.0, depth_test=False)
        self.handles = Handles(self.gizmo, HANDLE_SCALE)
        self.mesh = scene.add_mesh_simple(
            f"/obstacles/{index}/surface",
            np.zeros((3, 3), np.float32),
            np.array([[0, 1, 2]], np.uint32),
            color=palette.OBSTACLE,
            opacity=OPACITY,
        )
        self._look: Obstacle | None = None

        def dragged(drag: Drag) -> None:
            if drag.phase == "start":
                grabbed(index)
            self.handles.drag(drag, area(), partial(moved, index))

        self.handles.on_move(partial(moved, index))
        gestures.on_drag(self.mesh, dragged)
        gestures.on_click(self.mesh, partial(clicked, index))

    def adopt(self, obstacle: Obstacle, *, handles: bool, avoided: bool, opened: bool) -> None:
        """Show the obstacle where it stands; a pose that the browser has already is not sent to it.

        Args:
            obstacle: obstacle to show.
            handles: whether it has handles.
            avoided: whether motions avoid it.
            opened: whether its front faces are left out, to show the inside.
        """
        self.handles.stand(obstacle.position, obstacle.wxyz)
        look, scale = unscaled(obstacle.moved((0.0, 0.0, 0.0)))
        if look != self._look:
            self._look = look
            self.mesh.vertices, self.mesh.faces = shaded(look)
            self.gizmo.disable_rotations = isinstance(look, Sphere)
        self.mesh.scale = scale
        self.handles.scale = HANDLE_SCALE * (0.5 + min(obstacle.radius / MAX_DIAMETER, 0.8))
        self.handles.show(handles)
        self.mesh.side = "back" if opened else "front"
        self.mesh.opacity = OPACITY_OPENED if opened else OPACITY if avoided else OPACITY_FAINT

    def remove(self) -> None:
        """Take it out of the scene."""
        self.gizmo.remove()


class Obstacles(Dragged):
    """All obstacles of a scenario."""

    def __init__(
        self, scene: viser.SceneApi, moved: Moved, grabbed: Callable[[int], None], clicked: Callable[[int], None]
    ) -> None:
        """Begin with none.

        Args:
            scene: scene of the visitor.
            moved: called with each new pose of one of them.
            grabbed: called with the index of one that a drag begins of.
            clicked: called with the index of one that is clicked.
        """
        super().__init__(scene.add_frame("/obstacles", show_axes=False))
        self._answered = scene.add_frame("/obstacles/answered", show_axes=False, visible=False)
        self._scene = scene
        self._moved, self._grabbed, self._clicked = moved, grabbed, clicked
        self.items: list[ObstaclePicture] = []
        """Pictures of the obstacles, in the order of the scenario."""

    def draw(self, frame: Frame) -> None:
        """Tell the page, for those who measure it, where the first obstacle is that the frame is computed for."""
        super().draw(frame)
        for obstacle in frame.scenario.obstacles[:1]:
            self._answered.position = obstacle.position

    @property
    def handles(self) -> Iterable[Handles]:
        return [item.handles for item in self.items]

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's obstacles where they stand."""
        while len(self.items) > len(scenario.obstacles):
            self.items.pop().remove()
        while len(self.items) < len(scenario.obstacles):
            index = len(self.items)
            told = self._moved, self._grabbed, self._clicked
            self.items.append(ObstaclePicture(self._scene, index, *told, self.area))
        handled = scenario.selected if scenario.view.handles and not scenario.view.move_slice else None
        for index, (item, obstacle) in enumerate(zip(self.items, scenario.obstacles, strict=True)):
            item.adopt(
                obstacle,
                handles=index == handled,
                avoided=scenario.avoids,
                opened=scenario.view.colour == "occupancy",
            )


def unscaled(obstacle: Obstacle) -> tuple[Obstacle, float]:
    """Return the obstacle with the triangles that are sent, and the scale that the browser gives them."""
    if isinstance(obstacle, MeshObstacle | CloudObstacle):
        return replace(obstacle, scale=1.0), obstacle.scale
    return obstacle, 1.0


def shaded(obstacle: Obstacle) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices (V, 3), metres, and faces (F, 3) of its surface; sharp edges have vertices for each side."""
    mesh = trimesh.Trimesh(*obstacle.surface(), process=False)
    if len(mesh.faces) > MAX_FACES:
        mesh = simplified(mesh, FINEST * obstacle.radius)
    if not isinstance(obstacle, Sphere):
        mesh = trimesh.graph.smooth_shade(mesh, angle=CREASE)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
