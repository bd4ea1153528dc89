"""Markers: things in the scene that are dragged, themselves parallel to the slice, and by handles along axes."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import viser
from numpy.typing import ArrayLike

from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import MAX_DISTANCE, MAX_SIGHT, MAX_TURN, MIN_TURN, Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui import patches
from dt_viz.ui.scene.picture import Look, Picture


@dataclass(frozen=True)
class Drag:
    """An event of dragging something in the scene; places (3,) in metres."""

    phase: str  # one of "start", "update" and "end"
    camera: Array
    grabbed: Array
    """Grabbed point, which moves with the thing in the browser: after the start it may lag behind the server."""
    pointer: Array  # pointer, on the plane through the grabbed point that faces the camera


def on_drag(node: Any, act: Callable[[Drag], None]) -> None:  # noqa: ANN401 - viser's nodes of all kinds
    """Call `act`, which must only submit, with each event of dragging a visible node, among places that can be seen."""

    @node.on_drag
    async def _(event: viser.SceneNodeDragEvent) -> None:
        places = np.array([event.client.camera.position, event.start_position, event.end_position], float)
        if node.visible and (np.abs(places) <= MAX_SIGHT).all():
            act(Drag(event.phase, *places))


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
        scale: float = 0.0,
        where: Callable[[], Array | None] | None = None,
    ) -> None:
        """Begin without handles.

        Args:
            group: told of drags.
            node: node of the scene that stands where the thing does.
            body: what is dragged, the node or a child of it; None has handles only.
            scale: approximate size of the handles, metres; 0 has none.
            where: returns the place (3,), metres, of a thing that moves by itself, and not where it is dragged.
        """
        self.node, self.body, self.scale = node, body, scale
        self.key: int | str = 0  # index or name of the thing in the scenario
        self._group, self._where = group, where
        self._position, self._wxyz = np.array(node.position), np.array(node.wxyz)
        self._drag: tuple[Array, Array] | None = None
        """Point (3,) at which the current drag of the body has grabbed it, and its position (3,) then, metres."""
        self._asked = self._position  # last permitted position (3,) that the drag asked for, metres
        self._wanted = False  # whether it has handles, also while they are hidden for a picture
        self._refused = False  # whether the current drag of a handle has left the permitted space
        if scale:
            handled: Any = self._handled  # viser takes coroutines, too, against its type hints
            node.on_update(handled)
            self.hide_handles(True)
        if body is not None:
            on_drag(body, self._dragged)

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
        self.hide_handles(False)

    def hide_handles(self, hidden: bool) -> None:
        """Hide the handles while a picture is made, or show them again."""
        if self.scale:  # hiding the node would hide its children, too
            shown = self._wanted and not hidden
            self.node.scale, self.node.opacity = (self.scale, 1.0) if shown else (1e-6, 0.0)

    async def _handled(self, event: viser.TransformControlsEvent) -> None:
        """Take a pose that the user gives it by the handles, if they are shown; else put it back."""
        position, wxyz = np.array(self.node.position, float), np.array(self.node.wxyz, float)
        is_pose = (np.abs(position) <= MAX_DISTANCE).all() and MIN_TURN <= np.linalg.norm(wxyz) <= MAX_TURN
        taken = is_pose and self._wanted and self.node.visible  # a message may name a hidden one
        if not taken or (self._refused and event.phase == "end"):  # during the drag the browser ignores poses
            self._put_back()
        self._refused = not taken or (self._refused and event.phase == "update")
        if taken:
            self._position, self._wxyz = position, wxyz
            self._group.moved(self, position.copy(), wxyz.copy(), event.phase)

    async def clicked(self, _event: viser.SceneNodePointerEvent) -> None:
        """Take a click, which a message may say of a hidden body, too."""
        if self.body.visible:
            self._group.clicked(self)

    def _put_back(self) -> None:
        patches.put_back_pose(self.node, self._position, self._wxyz)

    def _dragged(self, drag: Drag) -> None:
        """Move parallel to the slice.

        What the pointer has moved since the drag began is added to where the thing stood then. A shift added at each
        event would be added twice where the next event leaves the browser before the moved thing reaches it.
        """
        if drag.phase == "start":
            self._group.grabbed(self)
        if drag.phase == "start" or self._drag is None:
            stands = self.position if self._where is None else self._where()
            self._asked = drag.grabbed if stands is None else stands
            self._drag = drag.grabbed, self._asked
        grabbed, stood = self._drag
        place = stood + in_slice(self._group.area, drag.camera, grabbed, drag.pointer)
        self._asked = place if (np.abs(place) <= MAX_DISTANCE).all() else self._asked
        if drag.phase == "end":
            self._drag = None
        if self._where is None:
            self.stand(self._asked)
        self._group.moved(self, self._asked.copy(), self._wxyz.copy(), drag.phase)


M = TypeVar("M", bound=Marker)


class Draggable(Picture, Generic[M]):
    """A picture with markers, which is told what is done to them. It must only submit what follows."""

    area: Slice | None = None
    """Slice that the markers are dragged parallel to; None before a picture is drawn."""

    def grabbed(self, marker: M) -> None:
        """Take the beginning of a drag of a marker, if that means anything."""

    def clicked(self, marker: M) -> None:
        """Take a click on a marker, if that means anything."""

    @abstractmethod
    def moved(self, marker: M, position: Array, wxyz: Array, phase: str) -> None:
        """Take a new pose of a marker, (3,), metres, and (4,), and the phase of the drag."""


class MarkerGroup(Draggable[M]):
    """Markers of all things of one kind, in the order of the scenario."""

    gesture: ClassVar[str]  # name of the edits that move one, for undo; its key is filled in
    chosen: ClassVar[str] = ""
    """Field of the view that names the thing with handles; empty where none can be chosen."""
    handles: ClassVar[str] = ""  # field of the view that says whether it has handles

    def __init__(self, scene: viser.SceneApi, node: Any, session: Callable[[], Session]) -> None:  # noqa: ANN401
        """Begin with none, under a node of the scene; `session` returns the one that is edited."""
        super().__init__(node)
        self.scene, self._session = scene, session
        self.items: list[M] = []
        self._changing = threading.Lock()  # one thread draws, another makes and removes markers

    @abstractmethod
    def _things(self, scenario: Scenario) -> Mapping[Any, Any]:
        """The things of a scenario, by index or name."""

    @abstractmethod
    def _new(self, index: int) -> M:
        """Make the marker of this index."""

    @abstractmethod
    def _show(self, marker: M, thing: Any, scenario: Scenario) -> None:  # noqa: ANN401 - things of all kinds
        """Show a thing where it stands."""

    @abstractmethod
    def _moved(self, scenario: Scenario, key: Any, position: Array, wxyz: Array) -> Mapping[str, Any]:  # noqa: ANN401
        """Fields of the scenario that change when the thing of this key has a new pose, (3,), metres, and (4,)."""

    def _selected(self, scenario: Scenario) -> int | str | None:
        """Key of the thing that has handles if any has."""

    def _handled(self, scenario: Scenario) -> int | str | None:
        """Key of the thing that has handles."""
        shown = self.chosen and getattr(scenario.view, self.handles) and not scenario.view.move_slice
        return self._selected(scenario) if shown else None

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice for drags."""
        self.area = frame.task.slice

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's things where they stand; a pose that the browser has already is not sent to it."""
        things, handled = self._things(scenario), self._handled(scenario)
        with self._changing:
            while len(self.items) > len(things):
                self.items.pop().node.remove()
            while len(self.items) < len(things):
                self.items.append(marker := self._new(len(self.items)))
                if marker.body is not None:
                    marker.body.on_click(marker.clicked)
        for marker, (key, thing) in zip(self.items, things.items(), strict=True):
            marker.key = key
            self._show(marker, thing, scenario)
            marker.has_handles = key == handled

    def moved(self, marker: M, position: Array, wxyz: Array, phase: str) -> None:
        """Edit the scenario, if the thing is still there; the edits of a drag are one step for undo."""
        session = self._session()
        if phase == "start":
            session.begin_gesture()
        scenario, key = session.scenario, marker.key  # which other threads replace
        if key in self._things(scenario):
            session.edit(self.gesture.format(key), **self._moved(scenario, key, position, wxyz))
        if phase == "end":
            session.end_gesture()

    def grabbed(self, marker: M) -> None:
        self._select(**{self.chosen: marker.key} if self.chosen else {})

    def clicked(self, marker: M) -> None:
        """Give the marker handles, or take them from it."""
        scenario = self._session().scenario
        has_handles = getattr(scenario.view, self.handles) and marker.key == self._selected(scenario)
        self._select(**{self.chosen: marker.key, self.handles: not has_handles})

    def _select(self, **view: Any) -> None:  # noqa: ANN401 - fields of the view
        session = self._session()
        if view:
            session.edit("select", view=replace(session.scenario.view, **view))

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the handles, not what they move, while a picture is made."""

        def hide(hidden: bool) -> None:
            with self._changing:
                for marker in self.items:
                    marker.hide_handles(hidden)

        hide(True)
        try:
            yield
        finally:
            hide(False)


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
