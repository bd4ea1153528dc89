"""The stand of a visitor's camera: puts it where a view wants it, turns it slowly, and holds it against stray drags."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.ui import gestures
from dt_viz.ui.scene.camera import FIELD_OF_VIEW, HOME, PANEL, Pose, camera_for, turned, window

MOVED = 1e-3
"""Distance of the camera from where it was put, metres, from which on the visitor has moved it."""
TURN = 2 * np.pi / 90
"""Angular velocity of the orbit, rad/s."""
PAUSE = 1.5
"""Time without a move of the visitor's after which the orbit goes on, seconds."""
REMEMBERED = 64
"""Number of the poses last given: what a browser reports is late, so it may be any of them."""


class Tripod:
    """Stand of one visitor's camera.

    Where the visitor moves the camera, the orbit waits, and goes on from there; while it is locked, it is put back.
    """

    def __init__(self, client: viser.ClientHandle, hand: Callable[[], Array | None]) -> None:
        """Take over the camera of a visitor, and leave it where it is until `look`.

        Args:
            client: connection of the visitor.
            hand: says where the hand is, (3,), metres, if it is anywhere.
        """
        self._client, self._hand = client, hand
        self._lock = threading.RLock()  # tasks, ticks and reports come from threads of their own
        self._given: deque[Pose] = deque(maxlen=REMEMBERED)
        """Poses that the camera was given since it took another view, the newest last."""
        self._chosen: Pose | None = None
        """Pose that the visitor has moved the camera to; None if it stands where it was put."""
        self._fitted = (0, 0)
        """Width and height of the window that the view was framed for, CSS pixels."""
        self._width: float | None = None
        self._panel: float = PANEL
        self._shown: tuple[Task, Sequence[Slice], str] | None = None
        """Task, panels and view that the camera was put to show."""
        self._locked = self._alone = False
        self._turned: float | None = None
        """Time to which the orbit has turned the camera, seconds; None while it does not."""
        reported: Any = self._reported  # viser takes coroutines, too, against its type hints
        client.camera.on_update(reported)

    @property
    def panels(self) -> Sequence[Slice]:
        """The panels that the camera was put to show."""
        return () if self._shown is None else self._shown[1]

    def look(self, task: Task, panels: Sequence[Slice] = ()) -> None:
        """Move the camera to where the task, or the panels beside its scene, are seen best."""
        with self._lock:
            self._shown = task, panels, HOME
            self._given.clear()
            self._frame()

    def view(self, name: str = HOME) -> None:
        """Move the camera to a view of what it shows; see `camera_for`. Nothing is done before it shows anything."""
        with self._lock:
            if self._shown is not None:
                self._shown = (*self._shown[:2], name)
                self._given.clear()
                self._frame()

    @property
    def locked(self) -> bool:
        """Whether the camera is put back where a visitor moves it."""
        return self._locked

    @locked.setter
    def locked(self, locked: bool) -> None:
        with self._lock:
            self._locked = locked
            if locked and self._chosen is not None:
                self._given = deque([self._chosen], REMEMBERED)

    @property
    def alone(self) -> bool:
        """Whether there is a caption instead of the panel, and so more room; a change frames the view again."""
        return self._alone

    @alone.setter
    def alone(self, alone: bool) -> None:
        with self._lock:
            self._alone = alone
            if self._shown is not None:
                self._frame()

    @property
    def width(self) -> float | None:
        """Smallest width that the window can have, CSS pixels; None before it is known. A change may fit the view."""
        return self._width

    @width.setter
    def width(self, width: float) -> None:
        with self._lock:
            self._width = width
            self._fit()

    @property
    def panel(self) -> float:
        """Width of the panel and its margins, CSS pixels; a change frames the view again."""
        return self._panel

    @panel.setter
    def panel(self, panel: float) -> None:
        with self._lock:
            self._panel = panel
            if self._shown is not None:
                self._frame()

    @property
    def window(self) -> tuple[int, int]:
        """Width and height of the window, CSS pixels."""
        return window(self._client.camera, self._width)

    @property
    def orbits(self) -> bool:
        """Whether the camera turns slowly around what it shows."""
        return self._turned is not None

    @orbits.setter
    def orbits(self, orbits: bool) -> None:
        with self._lock:
            self._turned = time.monotonic() if orbits else None

    def turn(self, now: float) -> None:
        """Turn the camera to where it is at a time, seconds, if it orbits; called again and again."""
        if self._turned is None or self._shown is None:
            return
        with self._lock:
            seconds = 0.0 if self._turned is None else now - self._turned
            if seconds > 0:  # it does still orbit, and nobody holds the camera
                self._turned = now
                pose = self._chosen or self._given[-1]
                self._put(turned(pose, self.window, TURN * seconds, alone=self._alone, panel=self._panel))

    def _frame(self) -> None:
        assert self._shown is not None
        task, panels, view = self._shown
        self._fitted, camera = self.window, self._client.camera
        how = {"alone": self._alone, "width": self._width, "panel": self._panel}
        self._put(camera_for(task, camera, view, panels, self._hand(), **how))
        camera.fov = FIELD_OF_VIEW

    def _fit(self) -> None:
        """Frame the view anew if the window has another size, unless the visitor has moved the camera."""
        if self._shown is not None and self._chosen is None and self.window != self._fitted:
            self._frame()

    def _put(self, pose: Pose) -> None:
        self._given.append(pose)
        self._chosen = None
        with self._client.atomic():  # one without the other would be a pose that nobody has given
            self._client.camera.position, self._client.camera.look_at = pose

    async def _reported(self, camera: viser.CameraHandle) -> None:
        """Take note of where the camera is: put it back, leave it, or fit the picture to a window of another size."""
        position, look_at = (
            gestures.vector(place, 3, gestures.MAX_SIGHT) for place in (camera.position, camera.look_at)
        )
        if position is None or look_at is None or self._shown is None:
            return
        with self._lock:
            reported = np.stack([position, look_at])
            moved = all(np.abs(reported - given).max() > MOVED for given in self._given)
            if moved and self._locked:
                self._put(self._given[-1])
            elif moved:
                self._chosen = position, look_at
                if self._turned is not None:
                    self._turned = time.monotonic() + PAUSE
            elif self._chosen is not None and np.abs(reported - self._given[-1]).max() <= MOVED:
                self._chosen = None
            self._fit()
