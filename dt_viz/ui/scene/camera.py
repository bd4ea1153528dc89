"""The camera of a visitor: where it stands, and what moves it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import viser
from viser.transforms import SO3

from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import MAX_SIGHT
from dt_viz.scenario.slices import TITLE_ROOM, Slice, directions
from dt_viz.scenario.tasks import Task

HOME, HAND = "Home", "Hand"
"""Names of the views from the task's own direction: of all of it, and of the hand, from near."""
OFF_VERTICAL = 0.02  # slope from the vertical of a view from above
VIEWS = {"Front": (0.0, 1.0, -0.12), "Side": (-1.0, 0.12, -0.12), "Top": (0.0, OFF_VERTICAL, -1.0)}
"""Directions of sight, by name."""

MOVED = 1e-3
"""Distance of the camera from where it was put, metres, from which on the visitor has moved it."""
TURN = 2 * np.pi / 90  # angular velocity of the orbit, rad/s
PAUSE = 1.5  # time without a move of the visitor's after which the orbit goes on, seconds
LOWEST, STEEPEST, TILT = 0.1, np.pi / 3, np.pi / 90
"""Height over the table that a view begins at, metres, its steepest pitch for that, and the steps to it, rad."""

Pose = tuple[Array, Array]  # position (3,) and look-at (3,) of a camera, metres


class Shot(NamedTuple):
    """The camera of a picture."""

    wxyz: Array  # (4,) quaternion: x to the right, y down, z ahead
    position: Array  # (3,), metres
    fov: float  # vertical field of view, rad


@dataclass(frozen=True)
class Framing:
    """A window, and which part of it the scene is to fill."""

    size: tuple[int, int] = (1280, 720)
    """Width and height of the window, CSS pixels; these where they are not known."""
    panel: float = 350.0  # width of the panel and its margins, CSS pixels
    alone: bool = False  # whether there is a caption instead of the panel, as in a presentation
    narrow: int = 577
    """Width of a window, CSS pixels, below which viser puts the panel under the scene, not beside it: 36 em."""
    under: float = 0.6  # part of a narrow window's height that the panel takes
    caption: float = 0.2  # part of a window's height that the caption takes
    margin: float = 0.06  # part of the free window that stays empty on each side
    field_of_view: float = 0.75  # vertical field of view, rad
    arm_size: float = 1.0  # reach of the arm that is to be seen, relative to the JACO's

    @property
    def free(self) -> tuple[Array, Array]:
        """What the panel, or the caption, leaves of the window.

        Returns:
            The tangents (2,) of the angles between the line of sight and its left and right border, and those of its
            lower and upper border.
        """
        width, height = self.size
        narrow = width < self.narrow
        right = 1.0 if narrow or self.alone else 1 - 2 * self.panel / width
        bottom = 2 * (self.caption if self.alone else self.under if narrow else 0.0) - 1
        tangent = np.tan(self.field_of_view / 2)
        across, upright = (
            np.array([low, high]) + self.margin * (high - low) * np.array([1, -1])
            for low, high in ((-1.0, right), (bottom, 1.0))
        )
        return across * tangent * width / height, upright * tangent


def window_size(camera: Any, width: float | None = None) -> tuple[int, int]:  # noqa: ANN401
    """Return width and height of the window of viser's camera, CSS pixels, as the browser told, if it can be.

    The camera's picture has their ratio only: it is as large only while a CSS pixel is a pixel of the picture. A
    window that is higher than wide is a phone's until its width is known.

    Args:
        camera: viser's.
        width: the window's width, as of a `Ruler`; None if that is not known.
    """
    size = np.array((camera.image_width, camera.image_height), float)
    if not 100 <= size.min() <= size.max() <= 20_000:  # no window has it
        return Framing.size
    if width is None and size[0] < size[1]:
        width = min(size[0], Framing.narrow - 1)
    if width is not None:
        size *= width / size[0]
    return round(size[0]), round(size[1])


def view_of(
    task: Task, framing: Framing, view: str = HOME, panels: Sequence[Slice] = (), hand: Array | None = None
) -> Pose:
    """Return position (3,) and look-at (3,), metres, for a view of a task.

    Args:
        task: its motions and its usual direction of sight are taken.
        framing: the part of the window to be filled.
        view: one of `VIEWS`, `HAND`, or else the task's own: for panels straight onto them.
        panels: rectangles that are to be seen instead of the task.
        hand: (3,) where the hand is, metres; without it the view of the hand is that of the task.
    """
    position, look_at = (np.asarray(place) for place in task.camera)
    direction, places = look_at - position, places_of(task, framing.arm_size)
    if view == HAND and hand is not None:
        places = hand + _around(0.15)
    elif panels:
        right, up = directions(panels[0], task.camera)
        direction, above = np.cross(up, right), TITLE_ROOM * up
        if np.linalg.norm(direction[:2]) < OFF_VERTICAL:  # a camera that looks straight down has no right and left
            direction = direction + OFF_VERTICAL * up
        places = np.concatenate([area.border + offset for area in panels for offset in (np.zeros(3), above)])
    return framed_from_above(places, np.asarray(VIEWS.get(view, direction)), framing)


def places_of(task: Task, arm_size: float = 1.0) -> Array:
    """Return the places (N, 3) that are to be seen of a task, metres: its motions, its objects, and an arm there."""
    paths = np.concatenate(task.paths)
    wrist = paths + arm_size * np.array([0.0, 0.08, 0.12])
    base_to_elbow = arm_size * np.array(
        [(-0.10, -0.10, 0.0), (0.10, 0.10, 0.0), (-0.08, -0.12, 0.80), (0.08, 0.0, 0.80)]
    )
    obstacle = np.asarray(task.obstacle_position) + _around(0.09)
    pots = [pot.surface()[0] + (pot.x, pot.y, 0.0) for pot in task.pots]
    objects = [thing.surface()[0] + thing.start for thing in task.objects if thing.start is not None]
    return np.concatenate([paths, wrist, obstacle, base_to_elbow, *pots, *objects])


def _around(distance: float) -> Array:
    """Return the offsets (6, 3), metres, of the corners of an octahedron."""
    return distance * np.concatenate([np.eye(3), -np.eye(3)])


def turned(pose: Pose, framing: Framing, angle: float) -> Pose:
    """Return a pose turned by an angle, rad, around the vertical through the middle of the free part of the window."""
    position, look_at = pose
    across, upright = framing.free
    ahead, right, up = axes(look_at - position)
    depth = np.linalg.norm(look_at - position)
    middle = position + depth * (ahead + across.mean() * right + upright.mean() * up)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return middle + turn @ (position - middle), middle + turn @ (look_at - middle)


def axes(direction: Array) -> tuple[Array, Array, Array]:
    """Return the unit vectors (3,) ahead, to the right, and up in the picture of a camera that looks this way."""
    ahead = direction / np.linalg.norm(direction)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return ahead, right, np.cross(right, ahead)


def shot_of(pose: Pose) -> Shot:
    """Return the camera of a picture that stands where a pose is, and fills the picture as a view fills the window."""
    ahead, right, up = axes(pose[1] - pose[0])
    turn = SO3.from_matrix(np.stack([right, -up, ahead], axis=1))
    return Shot(turn.wxyz, pose[0], Framing.field_of_view)


def turned_shot(shot: Shot, depth: float, angle: float) -> Shot:
    """Return a shot turned by an angle, rad, around the vertical through what is in its middle at a depth, metres."""
    turn, wxyz = SO3.from_z_radians(angle), SO3(shot.wxyz)
    middle = shot.position + depth * wxyz.as_matrix()[:, 2]
    return Shot((turn @ wxyz).wxyz, middle + turn @ (shot.position - middle), shot.fov)


def shot_beside(pose: Pose, wxyz: Array, framing: Framing, size: tuple[int, int]) -> Shot:
    """Return the camera of a picture that has what the free part of the window shows in its middle, as large as can be.

    It looks the same way, from beside the window's camera: at the depth of what that looks at nothing is cut off.

    Args:
        pose: of the window's camera.
        wxyz: (4,) quaternion of the window's camera.
        framing: the window; its margin is part of what is shown.
        size: width and height of the picture, pixels.
    """
    position, look_at = pose
    across, upright = replace(framing, margin=0.0).free
    right, down, _ = SO3(wxyz).as_matrix().T
    depth = np.linalg.norm(look_at - position)
    width, height = size
    half = max(np.ptp(upright), np.ptp(across) * height / width) / 2
    beside = depth * (across.mean() * right - upright.mean() * down)
    return Shot(wxyz, position + beside, float(2 * np.arctan(half)))


def followed(pose: Pose, framing: Framing, own: Framing) -> Pose:
    """Return the camera that shows, in the free part of its own window, all that another one shows in that of its.

    Args:
        pose: of the other camera, metres; it does not look straight up or down.
        framing: the other window.
        own: the window of the camera that follows.
    """
    position, look_at = pose
    (ahead, right, up), depth = axes(look_at - position), np.linalg.norm(look_at - position)
    across, upright = (tangents[:, None] for tangents in framing.free)
    sides, heights = position + depth * (ahead + across * right), position + depth * (ahead + upright * up)
    return framed_from_above(np.concatenate([sides, heights]), ahead, own)


def framed_from_above(points: Array, direction: Array, framing: Framing) -> Pose:
    """Return the camera that sees all points (N, 3), metres, in the free part of a window, from above the table.

    The free part of a narrow window is its upper one: a level camera would stand far below what it shows. It looks
    down from the `direction` (3,) of sight as far as needed.
    """
    (ahead, _, up), pitch = axes(direction), 0.0
    pose = framed(points, ahead, *framing.free)
    while pose[0][2] < LOWEST and pitch < STEEPEST:
        pitch += TILT
        pose = framed(points, np.cos(pitch) * ahead - np.sin(pitch) * up, *framing.free)
    return pose


def framed(points: Array, direction: Array, across: Array, upright: Array) -> Pose:
    """Return the nearest camera that sees all points within a part of its picture.

    Args:
        points: (N, 3), metres.
        direction: (3,) of sight.
        across: (2,) tangents of the part's left and right border.
        upright: (2,) tangents of its lower and upper border.

    Returns:
        Position (3,) and look-at (3,), metres.
    """
    ahead, right, up = axes(direction)
    depth = points @ ahead
    # a camera at depth w and x across sees a point at X, Z between a and b where a (Z − w) ≤ X − x ≤ b (Z − w)
    bounds = []
    for axis, (low, high) in ((right, across), (up, upright)):
        place = points @ axis
        bounds.append(((place - high * depth).max(), (place - low * depth).min(), low, high))
    w = min((most - least) / (high - low) for least, most, low, high in bounds)
    x, y = ((least + high * w + most + low * w) / 2 for least, most, low, high in bounds)
    position = x * right + y * up + w * ahead
    return position, position + float((depth.min() + depth.max()) / 2 - w) * ahead


def _reported_pose(camera: Any) -> Pose | None:  # noqa: ANN401 - of viser
    """Return the pose of a camera; None where its numbers are no places."""
    position, look_at = np.array([camera.position, camera.look_at], float)
    return (position, look_at) if (np.abs([position, look_at]) <= MAX_SIGHT).all() else None


class CameraController:
    """Moves one visitor's camera.

    Where the visitor moves the camera, the orbit waits, and goes on from there; while it is locked, it is put back.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        hand: Callable[[], Array | None],
        arm_size: float = 1.0,
        moved: Callable[[], None] = lambda: None,
    ) -> None:
        """Take over the camera of a visitor, and leave it where it is until `look`.

        Args:
            client: connection of the visitor.
            hand: says where the hand is, (3,), metres, if it is anywhere.
            arm_size: reach of the arm, relative to the JACO's.
            moved: called when the visitor has moved it, or chosen a view. It must only submit.
        """
        self.locked = self.orbits = False
        """Whether the camera is put back where a visitor moves it, and turns slowly around what it shows."""
        self._client, self._hand, self._moved = client, hand, moved
        self._lock = threading.RLock()  # tasks, ticks and reports come from threads of their own
        self._given: deque[Pose] = deque(maxlen=128)
        """Poses that the camera was given, the newest last, and where it was before each.

        A browser reports late, and until it draws, a place where the camera was with the look-at that it was given.
        """
        self._chosen: Pose | None = None
        """Pose that the visitor has moved the camera to; None if it stands where it was put."""
        self._framing = Framing(arm_size=arm_size)  # the framing of the current view
        self._width: float | None = None
        self._shown: tuple[Task, Sequence[Slice], str] | None = None
        """Task, panels and view that the camera was put to show."""
        self._turned: float | None = None
        """Time to which the orbit has turned the camera, seconds; None while it does not."""
        reported: Any = self._reported  # viser takes coroutines, too, against its type hints
        client.camera.on_update(reported)

    @property
    def panels(self) -> Sequence[Slice]:
        """The panels that the camera was put to show."""
        return () if self._shown is None else self._shown[1]

    @property
    def chosen(self) -> Pose | None:
        """Pose of the camera; None while it shows all as it began, or nothing yet."""
        with self._lock:
            if self._shown is None:
                return None
            pose, home = self._chosen or self._given[-1], view_of(self._shown[0], self._framing, HOME, self.panels)
            return None if np.abs(np.subtract(pose, home)).max() <= MOVED else pose

    def choose(self, pose: Pose) -> None:
        """Move the camera to where a visitor has chosen."""
        with self._lock, self._client.atomic():
            self._chosen = pose
            self._client.camera.position, self._client.camera.look_at = pose

    @property
    def framing(self) -> Framing:
        """The framing in the window as it is now."""
        return replace(self._framing, size=window_size(self._client.camera, self._width))

    @property
    def seen(self) -> tuple[Pose, Framing] | None:
        """Where the camera is, as the browser told, and the window; None where it looks straight up or down."""
        pose = _reported_pose(self._client.camera)
        if pose is None or np.linalg.norm((pose[1] - pose[0])[:2]) < MOVED:
            return None
        return pose, self.framing

    def shot(self, size: tuple[int, int]) -> Shot:
        """Return the camera of a picture, of a width and height in pixels, of what is seen beside the panel."""
        camera = self._client.camera
        position, look_at = (np.asarray(at, dtype=float) for at in (camera.position, camera.look_at))
        return shot_beside((position, look_at), np.asarray(camera.wxyz, dtype=float), self.framing, size)

    @property
    def depth(self) -> float:
        """Distance of what the camera looks at, metres."""
        return float(np.linalg.norm(np.subtract(self._client.camera.look_at, self._client.camera.position)))

    def look(self, task: Task, panels: Sequence[Slice] = ()) -> None:
        """Move the camera to where the task, or the panels beside its scene, are seen best."""
        with self._lock:
            self._shown = task, panels, HOME
            self._frame()

    def view(self, name: str = HOME) -> None:
        """Move the camera to a view of what it shows; see `view_of`. Nothing is done before it shows anything."""
        with self._lock:
            if self._shown is not None:
                self._shown = (*self._shown[:2], name)
                self._frame()
        self._moved()

    def reframe(self, **changes: Any) -> None:  # noqa: ANN401 - the fields of Framing
        """Frame the view with other values of `Framing`."""
        with self._lock:
            self._framing = replace(self._framing, **changes)
            self._frame()

    def measured(self, width: float) -> None:
        """Take the width of the window, CSS pixels; that may fit the view."""
        with self._lock:
            self._width = width
            self._fit()

    def turn(self, now: float) -> None:
        """Turn the camera to where it is at a time, seconds, if it orbits; called again and again."""
        with self._lock:
            if not self.orbits or self._shown is None:
                self._turned = None
                return
            seconds = 0.0 if self._turned is None else now - self._turned
            if self._turned is None or seconds > 0:  # nobody holds the camera
                self._turned = now
            if seconds > 0:
                self._put(turned(self._chosen or self._given[-1], self.framing, TURN * seconds))

    def rest(self) -> None:
        """Have the orbit go on from where the camera is, however long ago it was turned."""
        with self._lock:
            self._turned = None

    def _frame(self) -> None:
        if self._shown is not None:
            task, panels, view = self._shown
            self._framing = self.framing
            self._put(view_of(task, self._framing, view, panels, self._hand()))
            self._client.camera.fov = self._framing.field_of_view

    def _fit(self) -> None:
        """Frame the view anew if the window has another size, unless the visitor has moved the camera."""
        if self._chosen is None and self.framing != self._framing:
            self._frame()

    def _put(self, pose: Pose) -> None:
        before = _reported_pose(self._client.camera)
        self._given.extend([pose] if before is None else [before, pose])
        self._chosen = None
        with self._client.atomic():  # one without the other would be a pose that nobody has given
            self._client.camera.position, self._client.camera.look_at = pose

    async def _reported(self, camera: viser.CameraHandle) -> None:
        """Take note of where the camera is: put it back, leave it, or fit the picture to a window of another size."""
        reported = _reported_pose(camera)
        if reported is None or self._shown is None:
            return
        with self._lock:
            before = self._chosen
            known = np.array([*self._given, *([] if before is None else [before])])
            # a move is to a place, or looks at one, where the camera was not
            moved = bool((np.abs(reported - known).max(axis=2).min(axis=0) > MOVED).any())
            if moved and self.locked:
                self._put(self._chosen or self._given[-1])
            elif moved:
                self._chosen = reported
                if self._turned is not None:
                    self._turned = time.monotonic() + PAUSE
            elif before is not None and np.abs(np.subtract(reported, self._given[-1])).max() <= MOVED:
                self._chosen = None
            changed = moved or self._chosen is not before
            self._fit()
        if changed:
            self._moved()
