"""Handles that come and go, and things in the scene that are dragged parallel to the slice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np
import viser
from numpy.typing import ArrayLike

from dt_viz.engine import Frame
from dt_viz.fields import Array
from dt_viz.slices import Slice
from dt_viz.ui.picture import Picture

HIDDEN = 1e-6
"""Size of handles that are not shown: hiding their node would hide what hangs on it."""
MIN_SLOPE = 0.2
"""Of the line of sight to the slice, below which the slice counts as seen on edge."""


class Handles:
    """The handles of a gizmo, on which other things hang: the browser moves both together, without the server."""

    def __init__(self, gizmo: viser.TransformControlsHandle, scale: float) -> None:
        """Hide them; `scale` is how far they stick out, metres."""
        self.gizmo, self.scale = gizmo, scale
        self._wanted = False
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

    def stand(self, position: ArrayLike, wxyz: ArrayLike) -> None:
        """Stand there (3,), metres, turned so (4,), unless that is where the browser has put the gizmo already."""
        if np.abs(self.gizmo.position - np.asarray(position)).max() > 1e-9:
            self.gizmo.position = np.asarray(position)
        if np.abs(self.gizmo.wxyz - np.asarray(wxyz)).max() > 1e-9:
            self.gizmo.wxyz = np.asarray(wxyz)

    def _show(self, shown: bool) -> None:
        scale, opacity = (self.scale, 1.0) if shown else (HIDDEN, 0.0)
        if (self.gizmo.scale, self.gizmo.opacity) != (scale, opacity):
            self.gizmo.scale, self.gizmo.opacity = scale, opacity


class Dragged(Picture):
    """Several things that are dragged themselves, parallel to the slice, and one of them also by handles."""

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

    def along(self, event: viser.SceneNodeDragEvent) -> Array:
        """How far (3,) an event drags what it has grabbed, metres."""
        return in_slice(self._slice, np.asarray(event.client.camera.position), event.start_position, event.end_position)


def in_slice(area: Slice | None, camera: Array, grabbed: Sequence[float], pointer: Sequence[float]) -> Array:
    """How far (3,) the grabbed point must move, parallel to the slice, to lie under the pointer, metres."""
    shift = np.asarray(pointer) - np.asarray(grabbed)
    if area is None:
        return shift
    normal = np.cross(*area.axes.T)
    sight = np.asarray(pointer) - camera
    sight /= np.linalg.norm(sight)
    slope = float(sight @ normal)
    if abs(slope) < MIN_SLOPE:
        return shift  # the slice is seen on edge: move across the line of sight instead
    return shift - sight * float(shift @ normal) / slope
