"""Controls of the obstacles: which there are, how large they are, and which one has handles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np
import viser

from dt_viz.errors import Cancelled, never
from dt_viz.obstacles import files as shapes
from dt_viz.obstacles.files import (
    CLOUD_SUFFIXES,
    MESH_SUFFIXES,
    UNITS,
    ShapeError,
    SizeError,
    is_cloud,
    read_cloud,
    read_mesh,
)
from dt_viz.obstacles.shapes import Box, CloudObstacle, Cylinder, MeshObstacle, Obstacle, Point, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import MAX_DIAMETER, MAX_MARGIN, MAX_OBSTACLES, MIN_DIAMETER, Scenario
from dt_viz.scenario.stack import with_avoidance
from dt_viz.scenario.tasks import Task
from dt_viz.session.session import Session
from dt_viz.ui.chores import Later
from dt_viz.ui.controls import Control, on_press
from dt_viz.ui.panel.bindings import KEEP, Bindings
from dt_viz.ui.reading import Reader

ORIGIN: Point = (0.0, 0.0, 0.0)
SHAPES: Mapping[str, Obstacle] = {
    "Sphere": Sphere(ORIGIN, 0.10),
    "Cylinder": Cylinder(ORIGIN, 0.08, 0.16),
    "Cube (fig. 3a)": Box(ORIGIN, (0.12, 0.12, 0.12)),
    "Box": Box(ORIGIN, (0.16, 0.10, 0.06)),
}
"""Shapes that can be added, by the name of their button."""
ASIDE = 0.4
"""Offset of a new obstacle from the motion, in its inner radii: dead ahead no side is the shorter one."""
MIN_SIZE, MAX_SIZE = 0.03, 0.40
"""Smallest and largest side of a box, and height of a cylinder, metres."""
FORMATS = ", ".join(dict.fromkeys(suffix[1:] for suffix in (*MESH_SUFFIXES, *CLOUD_SUFFIXES)))
NONE: str = "none"

Shape = type[Obstacle] | UnionType
"""Type of an obstacle, or several."""


class ObstaclePanel:
    """The folder "Obstacles" of one visitor's panel."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, say: Callable[[str, bool], None], later: Later) -> None:
        """Build the controls.

        Args:
            gui: controls of the visitor.
            bindings: bindings of the visitor's panel.
            say: shows a text for a while, given whether it is about an error.
            later: does work beside the server's event loop.
        """
        self._bindings, self._say = bindings, say
        self._refused: tuple[bytes, str, str] | None = None
        """Content and name of a file that was refused for its size, and the unit that would fit."""
        self._reader = Reader(lambda: say("Another visitor's file is being read; yours is read after it.", False))
        with gui.add_folder("Obstacles"):
            hint = "the obstacle that is changed here; a click in the scene selects one, too"
            choice = gui.add_dropdown("Selected", (NONE,), hint=hint)
            bindings.properties(choice, options=_names)
            bindings.input(
                choice,
                lambda s: _names(s)[s.selected or 0],
                lambda s, name: {"view": replace(s.view, selected=choice.options.index(name))},
            )
            hint = "arrows and arcs that move and turn it along axes; a click on an obstacle shows and hides them"
            handles = gui.add_checkbox("Handles", False, hint=hint)
            bindings.input(handles, lambda s: s.view.handles, lambda s, on: {"view": replace(s.view, handles=on)})
            group = gui.add_button_group("Add", tuple(SHAPES), hint=f"up to {MAX_OBSTACLES}, where there is room")
            bindings.properties(group, visible=_has_room)  # groups of buttons cannot be disabled
            bindings.on(group, lambda session, name: later(partial(add, session, SHAPES[name])))
            change = gui.add_button_group("Change", ("Duplicate", "Delete"), hint="the selected obstacle")
            bindings.properties(change, visible=lambda s: bool(s.obstacles))
            changes = {"Duplicate": duplicate, "Delete": delete}
            bindings.on(change, lambda session, name: later(partial(changes[name], session)))
            diameters = 100 * MIN_DIAMETER, 100 * MAX_DIAMETER, 0.5, 15.0
            for shape in (Sphere, Cylinder):
                self._size(
                    gui.add_slider("Diameter [cm]", *diameters),
                    shape,
                    lambda o: o.diameter,
                    lambda o, d: replace(o, diameter=d),
                )
            lengths = 100 * MIN_SIZE, 100 * MAX_SIZE, 0.5, 15.0
            self._size(
                gui.add_slider("Height [cm]", *lengths),
                Cylinder,
                lambda o: o.height,
                lambda o, size: replace(o, height=size),
            )
            for k, name in enumerate("xyz"):
                self._size(
                    gui.add_slider(f"Size {name} [cm]", *lengths),
                    Box,
                    lambda o, k=k: o.sizes[k],
                    lambda o, size, k=k: replace(o, sizes=(*o.sizes[:k], size, *o.sizes[k + 1 :])),
                )
            self._size(
                gui.add_slider(
                    "Size [cm]",
                    100 * shapes.MIN_SIZE,
                    100 * shapes.MAX_SIZE,
                    0.5,
                    15.0,
                    hint="largest side of its bounding box",
                ),
                MeshObstacle | CloudObstacle,
                lambda o: o.size,
                lambda o, size: o.resized(size),
            )
            bindings.input(
                gui.add_slider(
                    "Margin [cm]", 0.0, 100 * MAX_MARGIN, 0.1, 1.0, hint="clearance that the automatic flow time keeps"
                ),
                lambda s: round(100 * s.avoidance.margin, 3),
                lambda s, value: {"stack": with_avoidance(s, margin=value / 100)},
            )
            with gui.add_folder("From a file", expand_by_default=False):
                self.unit = Control(gui.add_dropdown("Unit of the file", tuple(UNITS)))
                hint = f"{FORMATS}; a mesh must be closed; a csv of points has columns x, y, z and perhaps occupied"
                self._upload = gui.add_upload_button("Mesh or point cloud", icon=viser.Icon.UPLOAD, hint=hint)
                bindings.properties(self._upload, visible=_has_room)
                self.again = gui.add_button(
                    "",
                    icon=viser.Icon.RULER,
                    visible=False,
                    hint="the file that was too large or too small in the other unit",
                )

        @self._upload.on_upload
        async def _(_event: viser.GuiEvent) -> None:
            file = self._upload.value
            self._begin(partial(self.load, file.content, file.name, UNITS[self.unit.value]))

        on_press(self.again, lambda: self._begin(self.load_again))

    def close(self) -> None:
        """Stop reading: the visitor has left."""
        self._reader.close()

    def _begin(self, load: Callable[[], None]) -> None:
        if not self._reader.begin(load):
            self._say("A file of yours is being read; load the next one after it.", False)

    def load(self, content: bytes, name: str, scale: float) -> None:
        """Add what a file holds, or ask or say why that cannot be; see `from_file`.

        Raises:
            UnwantedError: the visitor has left.
        """
        self._upload.disabled = True
        try:
            self._load(content, name, scale)
        finally:
            self._upload.disabled = False

    def load_again(self) -> None:
        """Add what the file holds that was refused for its size, in the unit that was suggested."""
        if self._refused is not None:
            content, name, unit = self._refused
            self.unit.value = unit
            self.load(content, name, UNITS[unit])

    def _load(self, content: bytes, name: str, scale: float) -> None:
        self._refused = None
        try:
            if not _has_room(self._bindings.session.scenario):
                raise ShapeError(
                    name, "scene", f"{MAX_OBSTACLES} obstacles", f"at most {MAX_OBSTACLES}: delete one first"
                )
            with self._reader.turn():
                obstacle, notes = from_file(content, name, scale, self._reader.left)
        except SizeError as error:
            if error.unit is not None:
                self._refused = content, name, error.unit
                self.again.label = f"Read it in {error.unit}"
            self._say(error.question or str(error), error.question is None)
        except ShapeError as error:
            self._say(str(error), True)
        else:
            add(self._bindings.session, obstacle)
            if notes:
                self._say(f"{name}: {'; '.join(notes)}", False)
        finally:
            self.again.visible = self._refused is not None

    def _size(
        self,
        handle: Any,  # noqa: ANN401
        shape: Shape,
        read: Callable[[Any], float],
        change: Callable[[Any, float], Obstacle],
    ) -> None:
        """Bind a slider [cm] to a size of the selected obstacle, metres, while that has this shape."""

        def shown(scenario: Scenario) -> float:
            chosen = _selected(scenario)
            return round(100 * read(chosen), 3) if isinstance(chosen, shape) else KEEP

        def changed(scenario: Scenario, value: float) -> dict[str, Any]:
            chosen = _selected(scenario)
            if not isinstance(chosen, shape):
                return {}
            index, before = scenario.selected or 0, scenario.obstacles
            changed = (*before[:index], change(chosen, value / 100), *before[index + 1 :])
            return {"stack": with_avoidance(scenario, obstacles=changed)}

        self._bindings.properties(handle, visible=lambda s: isinstance(_selected(s), shape))
        self._bindings.input(handle, shown, changed)


def add(session: Session, obstacle: Obstacle) -> None:
    """Put another obstacle, turned as it is, where there is room on the motion, and select it."""
    before = session.scenario.obstacles
    if _has_room(session.scenario):
        _replace(session, (*before, with_room(obstacle, before, session.task)), selected=len(before))


def duplicate(session: Session) -> None:
    """Add another obstacle like the selected one."""
    chosen = _selected(session.scenario)
    if chosen is not None:
        add(session, chosen)


def delete(session: Session) -> None:
    """Delete the selected obstacle."""
    index, before = session.scenario.selected, session.scenario.obstacles
    if index is not None:
        _replace(session, (*before[:index], *before[index + 1 :]), selected=max(0, index - 1))


def _replace(session: Session, obstacles: tuple[Obstacle, ...], selected: int) -> None:
    """Replace the obstacles, as one step for undo."""
    view = replace(session.scenario.view, selected=selected)
    session.edit("obstacles", stack=with_avoidance(session.scenario, obstacles=obstacles), view=view)
    session.end_gesture()


def _names(scenario: Scenario) -> tuple[str, ...]:
    """Return the numbers and shapes of the obstacles."""
    return tuple(f"{k}: {name_of(obstacle)}" for k, obstacle in enumerate(scenario.obstacles, 1)) or (NONE,)


def _has_room(scenario: Scenario) -> bool:
    return len(scenario.obstacles) < MAX_OBSTACLES


def _selected(scenario: Scenario) -> Obstacle | None:
    return None if scenario.selected is None else scenario.obstacles[scenario.selected]


def name_of(obstacle: Obstacle) -> str:
    """Return the name of its shape on the panel."""
    if isinstance(obstacle, Box) and len(set(obstacle.sizes)) == 1:
        return "cube"
    return type(obstacle).__name__.removesuffix("Obstacle").lower()


def from_file(
    content: bytes, name: str, scale: float, cancelled: Cancelled = never
) -> tuple[Obstacle, tuple[str, ...]]:
    """Return the obstacle that a file holds, around the origin, and notes about it for the page.

    Args:
        content: all bytes of the file.
        name: name of the file; its suffix says what it is. A PLY without faces is a point cloud.
        scale: metres for one unit of the file.
        cancelled: whether nobody wants it any more.

    Raises:
        ShapeError: the file cannot be used.
        UnwantedError: nobody wants it any more.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in (*MESH_SUFFIXES, *CLOUD_SUFFIXES):
        raise ShapeError(name, "suffix", repr(suffix) if suffix else "no suffix", FORMATS)
    if is_cloud(content, name):
        loaded = read_cloud(content, name, scale=scale, cancelled=cancelled)
        return CloudObstacle(ORIGIN, loaded.cloud), loaded.notes
    loaded = read_mesh(content, name, scale=scale, cancelled=cancelled)
    return MeshObstacle(ORIGIN, loaded.solid), loaded.notes


def with_room(obstacle: Obstacle, others: Sequence[Obstacle], task: Task) -> Obstacle:
    """Return the obstacle beside the mean demonstration, where that is farthest from its ends and other obstacles."""
    mean = task.mean_path
    ends = np.concatenate([task.starts, mean[-1:]])
    room = np.linalg.norm(mean[:, None] - ends, axis=-1).min(axis=1)
    room = np.minimum(room, Union(tuple(others)).signed_distance(mean))
    best = int(room.argmax())
    along = mean[min(best + 1, 100)] - mean[max(best - 1, 0)]
    aside = np.cross(along, np.cross(*task.slice.axes.T))
    aside /= max(float(np.linalg.norm(aside)), 1e-12)
    return obstacle.moved(as_point(mean[best] + ASIDE * obstacle.depth * aside), obstacle.wxyz)
