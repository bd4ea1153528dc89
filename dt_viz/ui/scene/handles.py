"""Handles that come and go, and things in the scene that are dragged parallel to the slice."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import viser
from numpy.typing import ArrayLike

from dt_viz.engine.frame import Frame
from dt_viz.flows.fields import Array
from dt_viz.scenario.slices import Slice
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Drag
from dt_viz.ui.scene.picture import Picture

HIDDEN = 1e-6
"""Size of handles that are not shown: hiding their node would hide what hangs on it."""
MIN_SLOPE = 0.2
"""Of the line of sight to the slice, below which the slice counts as seen on edge."""

Moved = Callable[[Array, Array, str], None]
"""Told the position (3,) of handles, metres, their quaternion (4,), and the phase of the drag."""


class Handles:
    """The handles of a gizmo, on which other things hang: the browser moves both together, without the server."""

    def __init__(self, gizmo: viser.TransformControlsHandle, scale: float) -> None:
        """Hide them; `scale` is how far they stick out, metres."""
        self.gizmo, self.scale = gizmo, scale
        self._position, self._wxyz = np.array(gizmo.position), np.array(gizmo.wxyz)
        self._wanted = False
        self._refused = False
        """Whether the drag under way has led where nothing can be."""
        self._show(False)

    @property
    def shown(self) -> bool:
        """Whether they can be seen."""
        return self.gizmo.opacity is None or self.gizmo.opacity > 0

    def show(self, wanted: bool) -> None:
        """Show them, or hide them."""
        self._wanted = wanted
        self._show(wanted)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Hide them for as long as a picture takes."""
        self._show(False)
        try:
            yield
        finally:
            self._show(self._wanted)

    @property
    def position(self) -> Array:
        """(3,) where they stand, metres: where they were put, or the browser was allowed to put them."""
        return self._position.copy()

    def stand(self, position: ArrayLike, wxyz: ArrayLike) -> None:
        """Stand there (3,), metres, turned so (4,), unless that is where the browser has put the gizmo already."""
        position, wxyz = np.array(position, float), np.array(wxyz, float)
        if np.abs(self._position - position).max() > 1e-9:
            self._position = self.gizmo.position = position
        if np.abs(self._wxyz - wxyz).max() > 1e-9:
            self._wxyz = self.gizmo.wxyz = wxyz

    def on_move(self, moved: Moved) -> None:
        """Tell `moved`, which must only submit, each new pose that the user gives them while they are wanted."""

        @self.gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            position, wxyz = gestures.place(self.gizmo.position), gestures.turn(self.gizmo.wxyz)
            if position is None or wxyz is None or not self._can_move or event.phase not in gestures.PHASES:
                self._refused = True
                self._put_back()
                return
            if self._refused and event.phase == "end":  # the browser takes no pose for what it drags
                self._put_back()
            self._refused = self._refused and event.phase == "update"
            self._position, self._wxyz = position, wxyz
            moved(position.copy(), wxyz.copy(), event.phase)

    def drag(self, drag: Drag, shift: Array, moved: Moved) -> None:
        """Move them by (3,), metres, as an event of a drag asks for, where that can be, and tell `moved`."""
        place = gestures.place(self._position + shift)
        if place is not None:
            self.stand(place, self._wxyz)
        moved(self.position, self._wxyz.copy(), drag.phase)

    @property
    def _can_move(self) -> bool:
        return self._wanted and self.gizmo.visible

    def _put_back(self) -> None:
        # viser keeps what was sent, of whatever shape, and sends nothing that it holds already
        self.gizmo._impl.position, self.gizmo._impl.wxyz = np.full(3, np.nan), np.full(4, np.nan)
        self.gizmo.position, self.gizmo.wxyz = self._position, self._wxyz

    def _show(self, shown: bool) -> None:
        scale, opacity = (self.scale, 1.0) if shown else (HIDDEN, 0.0)
        if (self.gizmo.scale, self.gizmo.opacity) != (scale, opacity):
            self.gizmo.scale, self.gizmo.opacity = scale, opacity


class Dragged(Picture):
    """Union things that are dragged themselves, parallel to the slice, and one of them also by handles."""

    def __init__(self, node: viser.SceneNodeHandle) -> None:
        super().__init__(node)
        self._slice: Slice | None = None

    @property
    def handles(self) -> Iterable[Handles]:
        """Of all of them."""
        raise NotImplementedError

    def draw(self, frame: Frame) -> None:
        """See `Picture`: remembers the slice to be dragged in."""
        self._slice = frame.task.slice

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the handles, not what they move, for as long as a picture takes."""
        with ExitStack() as stack:
            for handles in self.handles:
                stack.enter_context(handles.hidden())
            yield

    def along(self, drag: Drag) -> Array:
        """How far (3,) an event drags what it has grabbed, metres."""
        return in_slice(self._slice, drag.camera, drag.grabbed, drag.pointer)


def in_slice(area: Slice | None, camera: Array, grabbed: Array, pointer: Array) -> Array:
    """How far (3,) the grabbed point must move, parallel to the slice, to lie under the pointer, metres."""
    shift = pointer - grabbed
    if area is None:
        return shift
    normal = np.cross(*area.axes.T)
    sight = pointer - camera
    sight = sight / max(float(np.linalg.norm(sight)), 1e-12)
    slope = float(sight @ normal)
    if abs(slope) < MIN_SLOPE:
        return shift  # the slice is seen on edge: move across the line of sight instead
    return shift - sight * float(shift @ normal) / slope
