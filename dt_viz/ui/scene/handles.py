"""Handles of gizmos, and things in the scene that are dragged parallel to the slice."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import viser
from numpy.typing import ArrayLike

from dt_viz.flows.fields import Array
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Drag
from dt_viz.ui.scene.picture import Picture

HIDDEN = 1e-6
"""Size of hidden handles: hiding their node would hide its children, too."""
MIN_SLOPE = 0.2
"""Sine of the angle between line of sight and slice below which the slice counts as seen on edge."""

Moved = Callable[[Array, Array, str], None]
"""Callback with the position (3,) of handles, metres, their quaternion (4,), and the phase of the drag."""


class Handles:
    """The handles of a gizmo; the browser moves its children with it, without the server."""

    def __init__(self, gizmo: viser.TransformControlsHandle, scale: float) -> None:
        """Begin hidden; `scale` is the size of the handles, metres."""
        self.gizmo, self.scale = gizmo, scale
        self._position, self._wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)
        self._pull = Pull()
        self._wanted = False
        self._refused = False
        """Whether the current drag has left the permitted space."""
        self._show(False)

    @property
    def shown(self) -> bool:
        """Whether they are visible."""
        return self.gizmo.opacity is None or self.gizmo.opacity > 0

    def show(self, wanted: bool) -> None:
        """Show or hide them."""
        self._wanted = wanted
        self._show(wanted)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Hide them while a picture is made."""
        self._show(False)
        try:
            yield
        finally:
            self._show(self._wanted)

    @property
    def position(self) -> Array:
        """Position (3,), metres, assigned here or accepted from the browser."""
        return self._position.copy()

    def stand(self, position: ArrayLike, wxyz: ArrayLike) -> None:
        """Move to a position (3,), metres, and a quaternion (4,), unless the browser has already done so."""
        position, wxyz = np.array(position, float), np.array(wxyz, float)
        if np.abs(self._position - position).max() > 1e-9:
            self._position = self.gizmo.position = position
        if np.abs(self._wxyz - wxyz).max() > 1e-9:
            self._wxyz = self.gizmo.wxyz = wxyz

    def on_move(self, moved: Moved) -> None:
        """Call `moved`, which must only submit, with each new pose from the user while the handles are shown."""

        @self.gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            position, wxyz = gestures.place(self.gizmo.position), gestures.turn(self.gizmo.wxyz)
            if position is None or wxyz is None or not self._can_move or event.phase not in gestures.PHASES:
                self._refused = True
                self._put_back()
                return
            if self._refused and event.phase == "end":  # during the drag the browser ignores poses
                self._put_back()
            self._refused = self._refused and event.phase == "update"
            self._position, self._wxyz = position, wxyz
            moved(position.copy(), wxyz.copy(), event.phase)

    def drag(self, drag: Drag, area: Slice | None, moved: Moved) -> None:
        """Move them parallel to a slice by an event of a drag of what they move, and call `moved`."""
        self.stand(self._pull.place(drag, self._position, area), self._wxyz)
        moved(self.position, self._wxyz.copy(), drag.phase)

    @property
    def _can_move(self) -> bool:
        return self._wanted and self.gizmo.visible

    def _put_back(self) -> None:
        # viser stores whatever was sent, and skips values that it has already
        self.gizmo._impl.position, self.gizmo._impl.wxyz = np.full(3, np.nan), np.full(4, np.nan)
        self.gizmo.position, self.gizmo.wxyz = self._position, self._wxyz

    def _show(self, shown: bool) -> None:
        self.gizmo.scale, self.gizmo.opacity = (self.scale, 1.0) if shown else (HIDDEN, 0.0)


class Pull:
    """A drag of something parallel to the slice.

    What the pointer has moved since the drag began is added to where the thing stood then. A shift added at each event
    would be added twice where the next event leaves the browser before the moved thing reaches it.
    """

    def __init__(self) -> None:
        self._grabbed: Array | None = None
        """Point that was grabbed; None while nothing is dragged."""
        self._stood = self._place = np.zeros(3)

    def place(self, drag: Drag, stands: Array, area: Slice | None) -> Array:
        """Return the place (3,), metres, that an event drags a thing to; its last one if that is not permitted.

        Args:
            drag: the event.
            stands: (3,), where the thing stands, metres; read when a drag begins.
            area: slice that the thing is dragged parallel to; without one it moves across the line of sight.
        """
        if drag.phase == "start" or self._grabbed is None:
            self._grabbed, self._stood, self._place = drag.grabbed, np.array(stands), np.array(stands)
        place = gestures.place(self._stood + in_slice(area, drag.camera, self._grabbed, drag.pointer))
        if place is not None:
            self._place = place
        if drag.phase == "end":
            self._grabbed = None
        return self._place.copy()


class Dragged(Picture):
    """Several things that are dragged parallel to the slice, one of them also by handles."""

    def __init__(self, node: viser.SceneNodeHandle) -> None:
        super().__init__(node)
        self._slice: Slice | None = None

    @property
    def handles(self) -> Iterable[Handles]:
        """Handles of all of them."""
        raise NotImplementedError

    def draw(self, frame: Frame) -> None:
        """Remembers the slice for drags."""
        self._slice = frame.task.slice

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the handles, not what they move, while a picture is made."""
        with ExitStack() as stack:
            for handles in self.handles:
                stack.enter_context(handles.hidden())
            yield

    def area(self) -> Slice | None:
        """Return the slice that they are dragged parallel to; None before a picture is drawn."""
        return self._slice


def in_slice(area: Slice | None, camera: Array, grabbed: Array, pointer: Array) -> Array:
    """Return the shift (3,), metres, parallel to the slice that puts the grabbed point under the pointer."""
    shift = pointer - grabbed
    if area is None:
        return shift
    normal = area.normal
    sight = pointer - camera
    sight = sight / max(float(np.linalg.norm(sight)), 1e-12)
    slope = float(sight @ normal)
    if abs(slope) < MIN_SLOPE:
        return shift  # seen on edge: move across the line of sight instead
    return shift - sight * float(shift @ normal) / slope
