"""Markers: things in the scene that are dragged, themselves parallel to the slice, and by handles along axes."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import viser
from numpy.typing import ArrayLike

from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Drag
from dt_viz.ui.scene.picture import Look, Picture


class Marker:
    """A thing in the scene that is dragged parallel to the slice, and, where its node is a gizmo, by handles.

    The browser moves a gizmo and its children by the handles, without the server.
    """

    def __init__(
        self,
        group: Draggable[Any],
        node: Any,  # noqa: ANN401 - nodes of all kinds
        body: Any = None,  # noqa: ANN401
        *,
        key: int | str = 0,
        scale: float = 0.0,
    ) -> None:
        """Begin without handles.

        Args:
            group: told of drags.
            node: node of the scene that stands where the thing does.
            body: what is dragged, the node or a child of it; None has handles only.
            key: index or name of the thing in the scenario.
            scale: approximate size of the handles, metres.
        """
        self.node, self.body, self.key, self.scale = node, body, key, scale
        self._group = group
        self._position, self._wxyz = np.array(node.position), np.array(node.wxyz)
        self._drag: tuple[Array, Array] | None = None
        """Point (3,) at which the current drag of the body has grabbed it, and its position (3,) then, metres."""
        self._asked = self._position
        """Last permitted position (3,) that the drag asked for, metres."""
        self._wanted = False
        """Whether it has handles, also while they are hidden for a picture."""
        self._refused = False
        """Whether the current drag of a handle has left the permitted space."""
        if isinstance(node, viser.TransformControlsHandle):
            handled: Any = self._handled  # viser takes coroutines, too, against its type hints
            node.on_update(handled)
            self._show(False)
        if body is not None:
            gestures.on_drag(body, self._dragged)

    @property
    def position(self) -> Array:
        """Position (3,), metres, assigned here or accepted from the browser."""
        return self._position.copy()

    def stand(self, position: ArrayLike, wxyz: ArrayLike | None = None) -> None:
        """Move to a position (3,), metres, and a quaternion (4,), unless the browser has already done so."""
        position, wxyz = np.array(position, float), np.array(self._wxyz if wxyz is None else wxyz, float)
        if np.abs(self._position - position).max() > 1e-9:
            self._position = self.node.position = position
        if np.abs(self._wxyz - wxyz).max() > 1e-9:
            self._wxyz = self.node.wxyz = wxyz

    @property
    def has_handles(self) -> bool:
        """Whether the handles are visible."""
        return bool(self.scale) and self.node.opacity > 0

    @has_handles.setter
    def has_handles(self, wanted: bool) -> None:
        self._wanted = wanted
        self._show(wanted)

    def hide_handles(self, hidden: bool) -> None:
        """Hide the handles while a picture is made, or show them again."""
        if self.scale:
            self._show(self._wanted and not hidden)

    def _show(self, shown: bool) -> None:
        # hiding the node would hide its children, too
        self.node.scale, self.node.opacity = (self.scale, 1.0) if shown else (1e-6, 0.0)

    async def _handled(self, event: viser.TransformControlsEvent) -> None:
        """Take a pose that the user gives it by the handles, if they are shown; else put it back."""
        position, wxyz = gestures.place(self.node.position), gestures.turn(self.node.wxyz)
        can_move = self._wanted and self.node.visible and event.phase in gestures.PHASES
        if position is None or wxyz is None or not can_move:
            self._refused = True
            self._put_back()
            return
        if self._refused and event.phase == "end":  # during the drag the browser ignores poses
            self._put_back()
        self._refused = self._refused and event.phase == "update"
        self._position, self._wxyz = position, wxyz
        self._group.moved(self, position.copy(), wxyz.copy(), event.phase)

    def _put_back(self) -> None:
        # viser stores whatever was sent, and skips values that it has already
        self.node._impl.position, self.node._impl.wxyz = np.full(3, np.nan), np.full(4, np.nan)
        self.node.position, self.node.wxyz = self._position, self._wxyz

    def _stands(self, drag: Drag) -> Array:
        """Return where the thing stands when a drag begins, (3,), metres."""
        return self.position

    def _dragged(self, drag: Drag) -> None:
        """Move parallel to the slice.

        What the pointer has moved since the drag began is added to where the thing stood then. A shift added at each
        event would be added twice where the next event leaves the browser before the moved thing reaches it.
        """
        if drag.phase == "start":
            self._group.grabbed(self)
        if drag.phase == "start" or self._drag is None:
            self._asked = self._stands(drag)
            self._drag = drag.grabbed, self._asked
        grabbed, stood = self._drag
        place = gestures.place(stood + in_slice(self._group.area, drag.camera, grabbed, drag.pointer))
        self._asked = self._asked if place is None else place
        if drag.phase == "end":
            self._drag = None
        self.stand(self._asked)
        self._group.moved(self, self._asked.copy(), self._wxyz.copy(), drag.phase)


M = TypeVar("M", bound=Marker)


class Draggable(Picture, Generic[M]):
    """A picture with markers, which is told what is done to them. It must only submit what follows."""

    area: Slice | None = None
    """Slice that the markers are dragged parallel to; None before a picture is drawn."""

    def grabbed(self, marker: M) -> None:
        """Take the beginning of a drag of a marker, if that means anything."""

    @abstractmethod
    def moved(self, marker: M, position: Array, wxyz: Array, phase: str) -> None:
        """Take a new pose of a marker, (3,), metres, and (4,), and the phase of the drag."""


class MarkerGroup(Draggable[M]):
    """Markers of all things of one kind, in the order of the scenario."""

    chosen: ClassVar[str]
    """Field of the view that names the thing with handles."""
    handles: ClassVar[str]
    """Field of the view that says whether it has handles."""

    def __init__(self, scene: viser.SceneApi, node: Any, session: Callable[[], Session]) -> None:  # noqa: ANN401
        """Begin with none, under a node of the scene; `session` returns the one that is edited."""
        super().__init__(node)
        self.scene, self._session = scene, session
        self.items: list[M] = []
        self._changing = threading.Lock()  # one thread draws, another makes and removes markers

    @abstractmethod
    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's things where they stand."""

    @abstractmethod
    def _new(self, index: int) -> M:
        """Make the marker of this index."""

    @abstractmethod
    def _move(self, session: Session, marker: M, position: Array, wxyz: Array) -> None:
        """Give a thing, if it is still there, a new pose, (3,), metres, and (4,)."""

    def _selected(self, scenario: Scenario) -> int | str | None:
        """Key of the thing that has handles if any has."""

    def moved(self, marker: M, position: Array, wxyz: Array, phase: str) -> None:
        """Take the edits of a drag together for undo."""
        session = self._session()
        if phase == "start":
            session.begin_gesture()
        self._move(session, marker, position, wxyz)
        if phase == "end":
            session.end_gesture()

    def grabbed(self, marker: M) -> None:
        session = self._session()
        session.edit("select", view=replace(session.scenario.view, **{self.chosen: marker.key}))

    def clicked(self, marker: M) -> None:
        """Take a click on a marker: it gets handles, or loses them."""
        session = self._session()
        view, is_selected = session.scenario.view, marker.key == self._selected(session.scenario)
        handles = not (getattr(view, self.handles) and is_selected)
        session.edit("select", view=replace(view, **{self.chosen: marker.key, self.handles: handles}))

    def _handled(self, scenario: Scenario) -> int | str | None:
        """Key of the thing that has handles."""
        view = scenario.view
        return self._selected(scenario) if getattr(view, self.handles) and not view.move_slice else None

    def _fit(self, num: int) -> None:
        """Make or remove markers until there are so many."""
        with self._changing:
            while len(self.items) > num:
                self.items.pop().node.remove()
            while len(self.items) < num:
                marker = self._new(len(self.items))
                self.items.append(marker)
                if marker.body is not None:
                    gestures.on_click(marker.body, partial(self.clicked, marker))

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice for drags."""
        self.area = frame.task.slice

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the handles, not what they move, while a picture is made."""
        self._hide_handles(True)
        try:
            yield
        finally:
            self._hide_handles(False)

    def _hide_handles(self, hidden: bool) -> None:
        with self._changing:
            for marker in self.items:
                marker.hide_handles(hidden)


def in_slice(area: Slice | None, camera: Array, grabbed: Array, pointer: Array) -> Array:
    """Return the shift (3,), metres, parallel to the slice that puts the grabbed point under the pointer."""
    shift = pointer - grabbed
    if area is None:
        return shift
    normal = area.normal
    sight = pointer - camera
    sight = sight / max(float(np.linalg.norm(sight)), 1e-12)
    slope = float(sight @ normal)
    if abs(slope) < 0.2:  # the sine of the angle between them
        return shift  # seen on edge: move across the line of sight instead
    return shift - sight * float(shift @ normal) / slope
