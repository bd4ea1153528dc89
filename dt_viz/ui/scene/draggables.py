"""What a visitor drags in the scene: obstacles, transforms that have a place, added starts, the slice, and the hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
import viser
import viser.transforms
from numpy.typing import NDArray

from dt_viz.avoidance.transform import Anchored, axes_of
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import DIAMETER, CloudObstacle, MeshObstacle, Obstacle, Sphere, as_point, as_quaternion
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import MAX_SIGHT, MAX_TURN, MIN_TURN, Scenario, Start
from dt_viz.scenario.slices import Slice, SlicePose
from dt_viz.scenario.stack import anchored, selected, with_avoidance, with_transform
from dt_viz.scenario.starts import followed, struck, with_moved_start, with_start
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.scene.arm import simplified
from dt_viz.ui.scene.markers import Draggable, Marker, MarkerGroup
from dt_viz.ui.scene.palette import LIGHT, STYLES
from dt_viz.ui.scene.picture import Lines, Look, add_ball, add_label

CREASE = 0.6  # angle between neighbouring faces above which their edge is drawn sharp, rad
MAX_FACES = 30_000  # largest number of faces of a mesh that is drawn in full
FINEST = 0.035
"""Size of the cells in which a larger mesh's vertices are merged, in radii of the obstacle."""


class ObstacleMarker(Marker):
    """One obstacle."""

    def __init__(self, group: Obstacles, node: str) -> None:
        """Draw nothing yet."""
        gizmo = group.scene.add_transform_controls(node, line_width=3.0, depth_test=False)
        nothing = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
        self.mesh = group.scene.add_mesh_simple(f"{node}/surface", *nothing, color=STYLES.obstacle.on(LIGHT))
        self._shape: Obstacle | None = None
        super().__init__(group, gizmo, self.mesh, scale=0.2)


class Obstacles(MarkerGroup[ObstacleMarker]):
    """All obstacles of a scenario."""

    gesture, chosen, handles = "obstacle {}", "selected", "handles"

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        super().__init__(scene, scene.add_frame("/obstacles", show_axes=False), session)
        self._answered = scene.add_frame("/obstacles/answered", show_axes=False, visible=False)

    def draw(self, frame: Frame, look: Look) -> None:
        """Tell the page, for those who measure it, where the first obstacle is that the frame is computed for."""
        super().draw(frame, look)
        for obstacle in frame.scenario.obstacles[:1]:
            self._answered.position = obstacle.position

    def _things(self, scenario: Scenario) -> Mapping[int, Obstacle]:
        return dict(enumerate(scenario.obstacles))

    def _new(self, index: int) -> ObstacleMarker:
        return ObstacleMarker(self, f"/obstacles/{index}")

    def _show(self, marker: ObstacleMarker, thing: Obstacle, scenario: Scenario) -> None:
        marker.stand(thing.position, thing.wxyz)
        shape, scale = unscaled(thing.moved((0.0, 0.0, 0.0)))
        if shape != marker._shape:
            marker._shape = shape
            marker.mesh.vertices, marker.mesh.faces = shaded(shape)
            marker.node.disable_rotations = isinstance(shape, Sphere)
        marker.mesh.scale = scale
        marker.scale = 0.1 + 0.2 * min(thing.radius / DIAMETER[1], 0.8)
        opened = scenario.view.colour == "occupancy"  # without the front faces the inside is seen
        marker.mesh.side = "back" if opened else "front"
        style = STYLES.obstacle if scenario.avoids else STYLES.obstacle_faint
        marker.mesh.opacity = (STYLES.obstacle_opened if opened else style).opacity

    def _selected(self, scenario: Scenario) -> int | None:
        return scenario.selected

    def _moved(self, scenario: Scenario, key: int, position: Array, wxyz: Array) -> Mapping[str, Any]:
        obstacles = list(scenario.obstacles)
        obstacles[key] = obstacles[key].moved(as_point(position), as_quaternion(wxyz))
        return {"stack": with_avoidance(scenario, obstacles=tuple(obstacles))}


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


class BiasMarker(Marker):
    """A ball at a transform's place and, while it has handles, a ring around the region that it acts in."""

    def __init__(self, group: BiasPoints, node: str) -> None:
        """Make the marker of no transform yet."""
        scene = group.scene
        gizmo = scene.add_transform_controls(node, line_width=3.0, disable_rotations=True, depth_test=False)
        self.ball = add_ball(scene, f"{node}/ball", STYLES.bias)
        # lines, not a surface: what lies behind and inside, such as colours on the slice, stays as it is
        look = {"thickness": 1.6, "thickness_units": "screen", "visible": False}
        self.region = scene.add_line_segments(f"{node}/region", _rings(flat=True), LIGHT.region, **look)
        self.label = add_label(scene, f"{node}/label", anchor="top-left")
        super().__init__(group, gizmo, self.ball, scale=0.11)


@lru_cache(maxsize=2)
def _rings(*, flat: bool) -> Array:
    """Return segments (K, 2, 3) of a unit circle in the plane of the first two axes, or of one in each such plane."""
    turn = np.linspace(0, 2 * np.pi, 97)
    circle = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    circles = [circle] if flat else [np.roll(circle, shift, axis=1) for shift in range(3)]
    return np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in circles]).astype(np.float32)


class BiasPoints(MarkerGroup[BiasMarker]):
    """All transforms of a scenario that have a place; in a drawing the handles move them in its plane."""

    gesture, chosen, handles = "{}", "bias", "bias_handles"

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        super().__init__(scene, scene.add_frame("/bias", show_axes=False), session)
        self._adopted: Mapping[int | str, Anchored] = {}
        self._used: Mapping[int | str, float | None] = {}
        """Radii that the last frame's transforms were computed with, metres, by name."""

    def draw(self, frame: Frame, look: Look) -> None:
        """Shows the regions, and remembers the slice for drags."""
        super().draw(frame, look)
        self._used = {name: chosen.get("radius") for name, chosen in frame.chosen_values.items()}
        self._show_regions()

    def adopt(self, scenario: Scenario) -> None:
        super().adopt(scenario)
        self._adopted = self._things(scenario)
        self._show_regions()

    def _show_regions(self) -> None:
        """Show the regions of those that have handles and a radius that is known."""
        with self._changing:
            for marker in self.items:
                known = self._adopted.get(marker.key)
                radius = self._used.get(marker.key) or (known and known.radius)
                if radius:
                    marker.region.scale = (radius, radius, radius)
                marker.region.visible = marker.has_handles and bool(radius)

    def _things(self, scenario: Scenario) -> Mapping[Any, Anchored]:
        return anchored(scenario)

    def _new(self, index: int) -> BiasMarker:
        return BiasMarker(self, f"/bias/{index}")

    def _show(self, marker: BiasMarker, thing: Anchored, scenario: Scenario) -> None:
        name, flat = str(marker.key), thing.plane is not None
        marker.stand(thing.position, viser.transforms.SO3.from_matrix(axes_of(thing.plane)).wxyz)
        marker.node.active_axes = (True, True, not flat)
        marker.region.points = _rings(flat=flat)
        marker.label.text = f"{name.lower()}: goal" if thing.moves_goal else name.lower()
        on = any(layer.on for layer in scenario.stack if layer.name == name)
        marker.ball.color = LIGHT.bias if on else LIGHT.stale
        marker.region.colors = np.array(LIGHT.region if on else LIGHT.stale, dtype=np.uint8)

    def _selected(self, scenario: Scenario) -> str | None:
        return selected(scenario)

    def _moved(self, scenario: Scenario, key: str, position: Array, wxyz: Array) -> Mapping[str, Any]:
        moved = replace(anchored(scenario)[key], position=as_point(position))
        return {"stack": with_transform(scenario, key, moved)}


class Starts(MarkerGroup[Marker]):
    """All added starts of a scenario, each with its number as in warnings; clicks on the slice add one."""

    gesture = "start {}"

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        super().__init__(scene, scene.add_frame("/starts", show_axes=False), session)
        self._listens = False

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice; starts without a motion are grey."""
        self.area = frame.slice
        with self._changing:
            for marker in self.items:
                marker.node.color = look.theme.added

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's starts, and listen to clicks on the slice if the view says so."""
        super().adopt(scenario)
        if scenario.view.click_to_start != self._listens:
            self._listens = not self._listens
            listener: Any = self._aimed  # viser takes coroutines, too, against its type hints
            if self._listens:
                self.scene.on_click()(listener)
            else:
                self.scene.remove_click_callback(listener)

    async def _aimed(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.array(event.ray_origin, float), np.array(event.ray_direction, float)  # NaN without one
        if (np.abs(origin) <= MAX_SIGHT).all() and MIN_TURN <= np.linalg.norm(direction) <= MAX_TURN:
            self.click(origin, direction)

    def clicked(self, marker: Marker) -> None:
        """Have the arm begin there."""
        session = self._session()
        if marker.key in self._things(session.scenario):  # or it was removed a moment ago
            session.edit("Follows rollout", arm_rollout=len(session.task.demonstrations) + int(marker.key))

    def click(self, origin: Array, direction: Array) -> None:
        """Add a start where a ray, given by `origin` and `direction` (3,), meets the slice, unless it hits a start."""
        place = None if self.area is None else struck(self.area, origin, direction)
        if place is None or any(_hits(marker.position, origin, direction) for marker in self.items):
            return
        session = self._session()
        scenario = session.scenario
        arm_rollout = followed(scenario, session.task)
        session.edit("add start", starts=with_start(scenario, place), arm_rollout=arm_rollout)
        session.end_gesture()

    def _things(self, scenario: Scenario) -> Mapping[Any, Start]:
        return dict(enumerate(scenario.starts))

    def _new(self, index: int) -> Marker:
        node = f"/starts/{index}"
        ball = add_ball(self.scene, node, STYLES.start, subdivisions=2, cast_shadow=False)
        add_label(self.scene, f"{node}/label", str(index + 1), font_screen_scale=0.6, height=STYLES.start.radius)
        return Marker(self, ball, ball)

    def _show(self, marker: Marker, thing: Start, scenario: Scenario) -> None:
        marker.stand(thing.place)

    def _moved(self, scenario: Scenario, key: int, position: Array, wxyz: Array) -> Mapping[str, Any]:
        return {"starts": with_moved_start(scenario, key, position)}


def _hits(place: Array, origin: Array, direction: Array) -> bool:
    """Whether a ray hits the ball of a start at a place (3,), metres."""
    away = np.cross(place - origin, direction / np.linalg.norm(direction))
    return bool(np.linalg.norm(away) <= 1.1 * STYLES.start.radius)


class MovableSlice(MarkerGroup[Marker]):
    """The slice's handles, and a thin frame once it is moved, as a child of theirs."""

    gesture = "slice"

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        gizmo = scene.add_transform_controls("/slice", line_width=3.0, depth_test=False, visible=False)
        super().__init__(scene, gizmo, session)
        self.border = Lines(scene, "/slice/border", STYLES.slice_border)
        self.items.append(self._new(0))
        self._scenario: Scenario | None = None

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice of the task."""
        super().draw(frame, look)
        if self._is_new(frame.task.slice):
            flat = Slice(np.zeros(3), np.eye(3)[:, :2], frame.task.slice.half_size)
            self.border.show([flat.border], look.theme)
            if self._scenario is not None:
                self.adopt(self._scenario)

    def adopt(self, scenario: Scenario) -> None:
        self._scenario, view = scenario, scenario.view
        if self.area is not None:
            super().adopt(scenario)
            self.visible = view.move_slice or view.slice is not None

    def _things(self, scenario: Scenario) -> Mapping[Any, SlicePose | None]:
        return {0: scenario.view.slice or (self.area and self.area.pose)}

    def _new(self, index: int) -> Marker:
        return Marker(self, self.node, scale=0.24)

    def _show(self, marker: Marker, thing: SlicePose, scenario: Scenario) -> None:
        marker.stand(thing.position, thing.wxyz)

    def _handled(self, scenario: Scenario) -> int | None:
        return 0 if scenario.view.move_slice else None

    def _moved(self, scenario: Scenario, key: int, position: Array, wxyz: Array) -> Mapping[str, Any]:
        pose = SlicePose(as_point(position), as_quaternion(wxyz))
        return {"view": replace(scenario.view, slice=pose)}


class Grip(Draggable[Marker]):
    """A ball that moves with the hand, and is dragged parallel to the slice: the arm takes it there."""

    _slice: Slice | None = None  # slice of the last frame

    def __init__(
        self,
        scene: viser.SceneApi,
        robot: Robot,
        node: str,
        where: Callable[[], Array | None],
        held: Callable[[Array, str], None],
    ) -> None:
        """Attach the ball to the hand.

        Args:
            scene: scene of the visitor.
            robot: the arm.
            node: node of the hand.
            where: returns the current place of the hand, (3,), metres; None before it moves.
            held: called with the desired place of the hand, (3,), metres, and the phase of the drag.
        """
        offset = tuple(robot.end_effector_offset)
        options = {"position": offset, "opacity": 0.85, "cast_shadow": False, "visible": False}
        super().__init__(add_ball(scene, f"{node}/grip", STYLES.grip, **options))
        self._note = add_label(scene, f"{node}/grip/note", anchor="bottom-left", visible=False)
        self._said = ""
        self._held = held
        self._guided: Callable[[Array, str], None] | None = None
        """Told of drags instead, which are then across the line of sight, not parallel to the slice."""
        Marker(self, self.node, self.node, where=where)

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice for drags."""
        self._slice = frame.slice
        self.guide(self._guided)

    def guide(self, told: Callable[[Array, str], None] | None) -> None:
        """Have drags told in place of holding the hand, in any direction across the line of sight; None ends that."""
        self._guided = told
        self.area = None if told is not None else self._slice

    @property
    def guides(self) -> bool:
        """Whether drags are told in place of holding the hand."""
        return self._guided is not None

    def moved(self, marker: Marker, position: Array, wxyz: Array, phase: str) -> None:
        (self._guided or self._held)(position, phase)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Hide the ball while a picture is made."""
        shown, self.visible = self.visible, False
        try:
            yield
        finally:
            self.visible = shown

    def say(self, warning: str) -> None:
        """Show a warning beside the hand; none if it is empty."""
        if warning != self._said:
            self._said = warning
            self._note.text = warning or self._note.text
            self._note.visible = bool(warning)
