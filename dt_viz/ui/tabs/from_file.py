"""The folder "From a file": obstacles that visitors bring along, read one at a time over all visitors."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import viser

from dt_viz.errors import Cancelled, end_if, never
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
from dt_viz.obstacles.shapes import ORIGIN, CloudObstacle, MeshObstacle, Obstacle
from dt_viz.scenario.scenario import MAX_OBSTACLES, Scenario
from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings, Control
from dt_viz.warning import Severity

FORMATS = ", ".join(dict.fromkeys(suffix[1:] for suffix in (*MESH_SUFFIXES, *CLOUD_SUFFIXES)))
PLACED = "put where there is room beside the motion, not where the file has it: drag it to its place"
LANE = "file"  # lane of the session's jobs on which one file is read

_one_file = threading.Lock()
"""Lock of the reader: a file takes up to a gigabyte, in another process, on its way to an obstacle."""


def has_room(scenario: Scenario) -> bool:
    """Return whether there may be another obstacle."""
    return len(scenario.obstacles) < MAX_OBSTACLES


@contextmanager
def turn(say: Callable[[str, Severity], None], left: Cancelled) -> Iterator[None]:
    """Wait until no other visitor's file is being read, which is said, and read within the block.

    Raises:
        UnwantedError: the visitor has left, before the block or within it.
    """
    if not _one_file.acquire(blocking=False):
        say("Another visitor's file is being read; yours is read after it.", Severity.WARNING)
        while not _one_file.acquire(timeout=0.1):  # the visitor may leave meanwhile
            end_if(left)
    try:
        yield
    finally:
        _one_file.release()
    end_if(left)


class FileLoader:
    """The folder of one visitor's panel."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, add: Callable[[Session, Obstacle], None]) -> None:
        """Build the controls where the panel is being built; `add` adds an obstacle that was read."""
        self._bindings, self._add = bindings, add
        self._refused: tuple[bytes, str, str] | None = None
        """Content and name of a file that was refused for its size, and the unit that would fit."""
        with gui.add_folder("From a file", expand_by_default=False):
            self.unit = Control(gui.add_dropdown("Unit of the file", tuple(UNITS), hint="of its coordinates"))
            hint = f"{FORMATS}; a mesh must be closed; a csv of points has columns x, y, z and perhaps occupied"
            self._upload = gui.add_upload_button("Mesh or point cloud", icon=viser.Icon.UPLOAD, hint=hint)
            bindings.properties(self._upload, visible=has_room)
            hint = "the file that was too large or too small in the other unit"
            self.again = gui.add_button("", icon=viser.Icon.RULER, visible=False, hint=hint)

        @self._upload.on_upload
        async def _(_event: viser.GuiEvent) -> None:
            file = self._upload.value
            self._begin(partial(self.load, file.content, file.name, UNITS[self.unit.value]))

        Control(self.again, lambda _pressed: self._begin(self.load_again))

    def takes(self, name: str, content: bytes) -> bool:
        """Add what a file holds if its suffix says that this is a shape, and nothing else; return whether it does."""
        is_shape = Path(name).suffix.lower() in MESH_SUFFIXES
        if is_shape:
            self._begin(partial(self.load, content, name, UNITS[self.unit.value]))
        return is_shape

    def _begin(self, load: Callable[[], None]) -> None:
        session = self._bindings.session
        if session.jobs.busy(LANE):
            session.say("A file of yours is being read; load the next one after it.", Severity.WARNING)
        else:
            session.jobs.submit(LANE, load)

    def load(self, content: bytes, name: str, scale: float) -> None:
        """Add what a file holds, or ask or say why that cannot be; see `from_file`.

        Raises:
            UnwantedError: the visitor has left.
        """
        session, self._refused, self._upload.disabled = self._bindings.session, None, True
        left = partial(session.jobs.superseded, LANE)
        try:
            if not has_room(session.scenario):
                raise ShapeError(
                    name, "scene", f"{MAX_OBSTACLES} obstacles", f"at most {MAX_OBSTACLES}: delete one first"
                )
            with turn(session.say, left):
                obstacle, notes = from_file(content, name, scale, left)
            self._add(session, obstacle)
            severity = Severity.WARNING if notes else Severity.NOTE
            session.say(f"{name}: {'; '.join((*notes, PLACED))}", severity)
        except SizeError as error:
            if error.unit is not None:
                self._refused = content, name, error.unit
                self.again.label = f"Read it in {error.unit}"
            session.say(error.question or str(error), Severity.WARNING if error.question else Severity.ALARM)
        except ShapeError as error:
            session.say(str(error), Severity.ALARM)
        finally:
            self._upload.disabled, self.again.visible = False, self._refused is not None

    def load_again(self) -> None:
        """Add what the file holds that was refused for its size, in the unit that was suggested."""
        if self._refused is not None:
            content, name, unit = self._refused
            self.unit.value = unit
            self.load(content, name, UNITS[unit])


def from_file(
    content: bytes, name: str, scale: float, cancelled: Cancelled = never
) -> tuple[Obstacle, tuple[str, ...]]:
    """Return the obstacle that a file of such a suffix holds, around the origin, and notes about it for the page.

    Args:
        content: all bytes of the file; a PLY without faces is a point cloud.
        name: name of the file.
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
        cloud, notes = read_cloud(content, name, scale=scale, cancelled=cancelled)
        return CloudObstacle(ORIGIN, cloud), notes
    solid, notes = read_mesh(content, name, scale=scale, cancelled=cancelled)
    return MeshObstacle(ORIGIN, solid), notes
