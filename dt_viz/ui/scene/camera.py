"""Where the camera stands: so that a task's motions and its arm fill the part of the window beside the panel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.scenario.panels import TITLE_ROOM, directions
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.ui import gestures
from dt_viz.ui.ruler import STEP

FIELD_OF_VIEW = 0.75
"""Vertical field of view, rad."""
PANEL = 350
"""Width of the panel and its margins, pixels."""
NARROW = 577
"""Width of a window, pixels, below which viser puts the panel under the picture, not beside it: from 36 em down."""
UNDER = 0.6
"""Part of a narrow window's height that the panel takes."""
CAPTION = 0.2
"""Part of a window's height that the caption of a presentation takes."""
MARGIN = 0.06
"""Part of the free window that stays empty on each side."""
MIN_SIZE, MAX_SIZE = 100, 20_000
"""Sides of a window that are believed, pixels."""
USUAL = (1280, 720)
"""Width and height that are taken for a window whose size is not known, pixels."""
HOME, HAND = "Home", "Hand"
"""Names of the views from the task's own direction: of all of it, and of the hand, from near."""
VIEWS = {"Front": (0.0, 1.0, -0.12), "Side": (-1.0, 0.12, -0.12), "Top": (0.0, 0.02, -1.0)}
"""Directions of sight, by name."""
ARM_SPACE = ((-0.10, -0.10, 0.0), (0.10, 0.10, 0.0), (-0.08, -0.12, 0.80), (0.08, 0.0, 0.80))
"""Places, metres, between which the arm's base, shoulder and elbow are."""
HAND_ROOM = (0.0, 0.08, 0.12)
"""Offset of the wrist from a place of the hand, about, metres."""
OBSTACLE_ROOM, HAND_AROUND = 0.09, 0.15
"""Room around the obstacle's first place, and around the hand in the view of it, metres."""

Pose = tuple[Array, Array]
"""Position (3,) and look-at (3,) of a camera, metres."""


def camera_for(
    task: Task,
    camera: Any,  # noqa: ANN401
    view: str = HOME,
    panels: Sequence[Slice] = (),
    hand: Array | None = None,
    *,
    alone: bool = False,
    width: float | None = None,
    panel: float = PANEL,
) -> Pose:
    """Return position (3,) and look-at (3,), metres, for a view of a task.

    Args:
        task: its motions and its usual direction of sight are taken.
        camera: viser's, of which the size of the window is taken.
        view: one of `VIEWS`, `HAND`, or else the task's own: for panels straight onto them.
        panels: rectangles that are to be seen instead of the task.
        hand: (3,) where the hand is, metres; without it the view of the hand is that of the task.
        alone: whether there is a caption instead of the panel.
        width: smallest width that the window can have, CSS pixels; None if that is not known.
        panel: width of the panel and its margins, CSS pixels.
    """
    position, look_at = (np.asarray(place) for place in task.camera)
    direction, places = look_at - position, shown(task)
    if view == HAND and hand is not None:
        places = hand + around(HAND_AROUND)
    elif panels:
        right, up = directions(panels[0], task.camera)
        direction, above = np.cross(up, right), TITLE_ROOM * up
        places = np.concatenate([area.border + offset for area in panels for offset in (np.zeros(3), above)])
    free = free_part(window(camera, width), alone=alone, panel=panel)
    return framed(places, np.asarray(VIEWS.get(view, direction)), *free)


def shown(task: Task) -> Array:
    """Return the places (N, 3) that are to be seen of a task, metres."""
    paths = np.concatenate(task.paths)
    obstacle = np.asarray(task.obstacle_position) + around(OBSTACLE_ROOM)
    pots = [pot.surface()[0] + (pot.x, pot.y, 0.0) for pot in task.pots]
    objects = [thing.surface()[0] + thing.start for thing in task.objects if thing.start is not None]
    return np.concatenate([paths, paths + HAND_ROOM, obstacle, ARM_SPACE, *pots, *objects])


def around(distance: float) -> Array:
    """Return the offsets (6, 3), metres, of the corners of an octahedron."""
    return distance * np.concatenate([np.eye(3), -np.eye(3)])


def free_part(size: tuple[int, int], *, alone: bool = False, panel: float = PANEL) -> tuple[Array, Array]:
    """Return what the panel, or the caption of a presentation, leaves of a window of this width and height, CSS pixels.

    Returns:
        The tangents (2,) of the angles between the line of sight and its left and right border, and those of its lower
        and upper border.
    """
    width, height = size
    narrow = width < NARROW
    right = 1.0 if narrow or alone else 1 - 2 * panel / width
    bottom = 2 * (CAPTION if alone else UNDER if narrow else 0.0) - 1
    tangent = np.tan(FIELD_OF_VIEW / 2)

    def within(low: float, high: float) -> Array:
        return np.array([low, high]) + MARGIN * (high - low) * np.array([1, -1])

    return within(-1.0, right) * tangent * width / height, within(bottom, 1.0) * tangent


def window(camera: Any, width: float | None = None) -> tuple[int, int]:  # noqa: ANN401
    """Return width and height of the window of viser's camera, CSS pixels, as the browser told, if it can be.

    The camera's picture has their ratio only: it is as large only while a CSS pixel is a pixel of the picture.

    Args:
        camera: viser's.
        width: smallest width that the window can have, as of a `Ruler`; None if that is not known.
    """
    size = gestures.vector((camera.image_width, camera.image_height), 2, MAX_SIZE)
    if size is None or size.min() < MIN_SIZE:
        return USUAL
    if width is not None and not width <= size[0] < STEP * width:
        size *= width * STEP**0.5 / size[0]
    return round(size[0]), round(size[1])


def turned(pose: Pose, size: tuple[int, int], angle: float, *, alone: bool = False, panel: float = PANEL) -> Pose:
    """Return a camera's position and look-at, metres, turned around the vertical through the middle of its picture.

    Args:
        pose: position (3,) and look-at (3,), metres.
        size: width and height of the window, pixels; the picture is the part of it that the panel leaves.
        angle: rad.
        alone: whether there is a caption instead of the panel.
        panel: width of the panel and its margins, CSS pixels.
    """
    position, look_at = pose
    across, upright = free_part(size, alone=alone, panel=panel)
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
