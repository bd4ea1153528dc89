"""Checks of what a browser sends about places in the scene, before it is used.

viser passes on any numbers; a forged message can also click and drag a hidden node.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import MAX_DISTANCE, MAX_SIGHT, MAX_TURN, MIN_TURN

PHASES = ("start", "update", "end")


def vector(values: Any, size: int, limit: float) -> Array | None:  # noqa: ANN401 - whatever a browser sends
    """Return the numbers (size,) that were sent; None if they are none, not finite, or beyond ±limit."""
    try:
        numbers = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if numbers.shape == (size,) and (np.abs(numbers) <= limit).all() else None


def place(values: Any) -> Array | None:  # noqa: ANN401
    """Return the place (3,), metres, that was sent; None if nothing can be put there."""
    return vector(values, 3, MAX_DISTANCE)


def turn(values: Any) -> Array | None:  # noqa: ANN401
    """Return the quaternion (4,) w, x, y, z that was sent; None if it is no rotation."""
    wxyz = vector(values, 4, MAX_TURN)
    return wxyz if wxyz is not None and MIN_TURN <= np.linalg.norm(wxyz) <= MAX_TURN else None


@dataclass(frozen=True)
class Drag:
    """An event of dragging something in the scene; places (3,) in metres."""

    phase: str
    """One of `PHASES`."""
    camera: Array
    grabbed: Array
    """Grabbed point, which moves with the thing in the browser: after the start it may lag behind the server."""
    pointer: Array
    """Pointer, on the plane through the grabbed point that faces the camera."""


def on_drag(node: Any, act: Callable[[Drag], None]) -> None:  # noqa: ANN401 - viser's nodes of all kinds
    """Call `act`, which must only submit, with each event of dragging a visible node."""

    @node.on_drag
    async def _(event: viser.SceneNodeDragEvent) -> None:
        camera = vector(event.client.camera.position, 3, MAX_SIGHT)
        grabbed, pointer = (vector(at, 3, MAX_SIGHT) for at in (event.start_position, event.end_position))
        if node.visible and event.phase in PHASES and not (camera is None or grabbed is None or pointer is None):
            act(Drag(event.phase, camera, grabbed, pointer))


def on_click(node: Any, act: Callable[[], None]) -> None:  # noqa: ANN401
    """Call `act`, which must only submit, when a visible node is clicked."""

    @node.on_click
    async def _(_event: viser.SceneNodePointerEvent) -> None:
        if node.visible:
            act()


class Clicks:
    """Clicks anywhere in the scene, while listening."""

    def __init__(self, scene: viser.SceneApi, act: Callable[[Array, Array], None]) -> None:
        """Wait for `listen`; `act`, which must only submit, is called with a ray's origin and direction (3,), m."""
        self._scene, self._act = scene, act
        self._listens = False

    def listen(self, wanted: bool) -> None:
        """Start or stop listening."""
        if wanted != self._listens:
            self._listens = wanted
            listener: Any = self._clicked  # viser takes coroutines, too, against its type hints
            if wanted:
                self._scene.on_click()(listener)
            else:
                self._scene.remove_click_callback(listener)

    async def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = vector(event.ray_origin, 3, MAX_SIGHT), vector(event.ray_direction, 3, MAX_TURN)
        if origin is not None and direction is not None and np.linalg.norm(direction) >= MIN_TURN:
            self._act(origin, direction)
