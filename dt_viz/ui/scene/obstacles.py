"""The obstacles in the scene: each can be dragged itself, the selected one also by handles that move and turn it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import CloudObstacle, MeshObstacle, Obstacle, Sphere, as_point, as_quaternion
from dt_viz.scenario.scenario import MAX_DIAMETER, Scenario
from dt_viz.scenario.stack import with_avoidance
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.scene.links import simplified
from dt_viz.ui.scene.markers import Marker, MarkerGroup
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.style import STYLES

CREASE = 0.6
"""Angle between neighbouring faces above which their edge is drawn sharp, rad."""
MAX_FACES = 30_000
"""Largest number of faces of a mesh that is drawn in full."""
FINEST = 0.035
"""Size of the cells in which a larger mesh's vertices are merged, in radii of the obstacle."""


class ObstacleMarker(Marker):
    """One obstacle."""

    def __init__(self, group: Obstacles, index: int) -> None:
        """Draw nothing yet; `index` is that of the obstacle in the scenario."""
        scene, node = group.scene, f"/obstacles/{index}"
        gizmo = scene.add_transform_controls(node, line_width=3.0, depth_test=False)
        style, nothing = STYLES.obstacle, (np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32))
        self.mesh = scene.add_mesh_simple(f"{node}/surface", *nothing, color=style.on(LIGHT), opacity=style.opacity)
        self._shape: Obstacle | None = None
        super().__init__(group, gizmo, self.mesh, key=index, scale=0.2)

    def adopt(self, obstacle: Obstacle, *, handles: bool, avoided: bool, opened: bool) -> None:
        """Show the obstacle where it stands; a pose that the browser has already is not sent to it.

        Args:
            obstacle: obstacle to show.
            handles: whether it has handles.
            avoided: whether motions avoid it.
            opened: whether its front faces are left out, to show the inside.
        """
        self.stand(obstacle.position, obstacle.wxyz)
        shape, scale = unscaled(obstacle.moved((0.0, 0.0, 0.0)))
        if shape != self._shape:
            self._shape = shape
            self.mesh.vertices, self.mesh.faces = shaded(shape)
            self.node.disable_rotations = isinstance(shape, Sphere)
        self.mesh.scale = scale
        self.scale = 0.1 + 0.2 * min(obstacle.radius / MAX_DIAMETER, 0.8)
        self.has_handles = handles
        self.mesh.side = "back" if opened else "front"
        style = STYLES.obstacle_opened if opened else STYLES.obstacle if avoided else STYLES.obstacle_faint
        self.mesh.opacity = style.opacity


class Obstacles(MarkerGroup[ObstacleMarker]):
    """All obstacles of a scenario."""

    chosen, handles = "selected", "handles"

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        super().__init__(scene, scene.add_frame("/obstacles", show_axes=False), session)
        self._answered = scene.add_frame("/obstacles/answered", show_axes=False, visible=False)

    def draw(self, frame: Frame, look: Look) -> None:
        """Tell the page, for those who measure it, where the first obstacle is that the frame is computed for."""
        super().draw(frame, look)
        for obstacle in frame.scenario.obstacles[:1]:
            self._answered.position = obstacle.position

    def adopt(self, scenario: Scenario) -> None:
        self._fit(len(scenario.obstacles))
        handled, opened = self._handled(scenario), scenario.view.colour == "occupancy"
        for marker, obstacle in zip(self.items, scenario.obstacles, strict=True):
            marker.adopt(obstacle, handles=marker.key == handled, avoided=scenario.avoids, opened=opened)

    def _new(self, index: int) -> ObstacleMarker:
        return ObstacleMarker(self, index)

    def _selected(self, scenario: Scenario) -> int | None:
        return scenario.selected

    def _move(self, session: Session, marker: ObstacleMarker, position: Array, wxyz: Array) -> None:
        obstacles, index = list(session.scenario.obstacles), cast(int, marker.key)
        if index < len(obstacles):  # or it was deleted a moment ago
            obstacles[index] = obstacles[index].moved(as_point(position), as_quaternion(wxyz))
            session.edit(f"obstacle {index}", stack=with_avoidance(session.scenario, obstacles=tuple(obstacles)))


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
