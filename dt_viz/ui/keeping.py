"""What a visitor has made, kept in his browser: read when he connects, written with each edit.

One text is the scenario, the newest of all tabs. Each task of the visitor's own has a text of its own, in one of
`PLACES`, until it is deleted in the list of tasks: so each tab adds its tasks to those of the others. The scenario
names its task by the place of that.

The browser may keep nothing, too much or something else, tell it late or never, and write for two tabs: the page opens
in time all the same, and says once what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Protocol

from dt_viz.errors import DataError, FormatError, parsing
from dt_viz.scenario.own import Own
from dt_viz.scenario.relocation import in_its_frame, in_world
from dt_viz.scenario.saved import Known, Saved, ScenarioError, Sight, check_shapes, decode, encode, portable
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import OWN, Task
from dt_viz.session.engine import MOST_OWN
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.session import CHOICES, Session
from dt_viz.warning import Severity

KEY = "dt-viz"  # name of the scenario, among all that the browser keeps for pages of this address
PLACES = {f"{OWN}_{number}": f"{KEY}-task-{number}" for number in range(1, MOST_OWN + 1)}
"""Places of the visitor's own tasks, as a scenario there names them, and their names among all that the browser keeps.
"""
PATIENCE = 1.0  # time in which a browser must answer what it keeps, seconds
BUSY = 10.0
"""Factor of that for a task: the page does not wait for it, and the browser may be busy with the first pictures."""
ATTEMPTS = 30
"""Number of times that it is asked again after the page has opened, while nothing is edited."""
PAUSE = 0.5
"""Shortest time between two writes of a text up to `SMALL`, seconds; longer texts take in proportion longer."""
SMALL, MAX_KEPT = 100_000, 10**6
"""Numbers of bytes of a text that is quickly sent, and of the largest that is kept."""
LANE = "keeping"  # lane of the session's jobs that reads and writes what the browser keeps
KEPT = "What this browser keeps"  # source of its texts, for messages
SLOW = "This browser has not told yet what it keeps: the page goes on with it when it comes, unless you edit before."
SILENT = "This browser does not answer about all that it keeps: a task of yours may be missing until a reload."
BLOCKED = "This browser keeps nothing: after a reload, the page begins anew. Save makes a file of what you do."
FULL = "This browser has no room left to keep what you do: Save makes a file of it."
OWN_TAKES = "Takes as long as yours are not kept in this browser: save the scenario, and open that file again."
OWN_SHAPES = "Obstacles as large as yours are not kept in this browser: save the scenario, and open that file again."


class Storage(Protocol):
    """What a browser keeps, as viser has it."""

    def get_item(self, key: str, timeout: float | None = None) -> str | None:
        """Return a text; None if there is none. Raises TimeoutError, or RuntimeError if it is blocked or gone."""

    def set_item(self, key: str, value: str) -> None:
        """Keep a text; nobody is told where that fails."""

    def remove_item(self, key: str) -> None:
        """Keep it no longer."""


class Text:
    """One text in a browser, which other tabs may change."""

    def __init__(self, storage: Storage, key: str, patience: float = 1.0) -> None:
        """Take the name of the text among all that the browser keeps, and a factor of `PATIENCE`."""
        self._storage, self._key, self._patience = storage, key, patience
        self._digest = hash(None)  # hash of the text, as far as is known
        self._proven = 0
        """Number of characters of the longest text that the browser was asked for after it was written."""

    def read(self) -> str | None:
        """Return the text; None if there is none. Raises as `Storage.get_item`."""
        text = self._storage.get_item(self._key, timeout=self._patience * PATIENCE)
        self._digest = hash(text)
        return text

    def write(self, text: str) -> bool:
        """Have the browser keep another text; return False if it has no room for that."""
        before, self._digest = self._digest, hash(text)
        self._storage.set_item(self._key, text)
        if len(text) <= self._proven:
            return True
        with suppress(TimeoutError, RuntimeError):  # it is busy, or gone
            self.read()
            self._proven = len(text)
        return self.holds(text) or self._digest != before  # else it is another tab's

    def holds(self, text: str) -> bool:
        """Return whether it is this text, as far as is known."""
        return self._digest == hash(text)

    def remove(self) -> None:
        """Have the browser keep it no longer, unless another tab has changed it. Raises as `Storage.get_item`."""
        before = self._digest
        self.read()
        if self._digest == before:
            self.clear()

    def clear(self) -> None:
        """Have the browser keep it no longer."""
        self._storage.remove_item(self._key)
        self._digest = hash(None)


class Shelf:
    """The tasks of a visitor's own that his browser keeps: those in the list of tasks."""

    def __init__(self, storage: Storage, say: Callable[[str], None]) -> None:
        """Keep tasks in a storage; `say` says what is not kept."""
        self._texts = {place: Text(storage, key, BUSY) for place, key in PLACES.items()}
        self._say = say
        self._free: list[str] | None = None
        """Places without a task; None until the browser has answered."""
        self.places: dict[str, str] = {}
        """Places of those that the browser keeps, by their names on this page."""
        self._refused: set[str] = set()  # names of those that do not fit into the browser

    def read(self, session: Session) -> None:
        """Add the tasks that the browser keeps to the list, once; drop damaged ones with a message."""
        if self._free is not None:
            return
        free, silent = list[str](), list[str]()
        for place, there in self._texts.items():
            try:
                text = there.read()
            except TimeoutError:  # it is busy, or the text is larger than it may send
                silent.append(place)
                if silent == [*PLACES][:2]:
                    return
                continue
            except RuntimeError:
                return
            try:
                read = None if text is None else _task_of(text)
            except DataError as error:
                there.clear()
                self._say(f"A task of yours is lost. {error}")
                read = None
            if read is None:
                free.append(place)
            else:
                self._bring(session, place, *read)
        self._free = free
        if silent:
            self._say(SILENT)

    def _bring(self, session: Session, place: str, task: Task, arm: str) -> None:
        try:
            self.places[session.bring(task, arm, _number(place)).name] = place
        except DataError as error:  # there are too many
            self._say(str(error))

    def named(self, saved: Saved) -> Saved:
        """Return a scenario of the browser with its task named as on this page.

        Raises:
            DataError: the browser has no such task.
            TimeoutError: the browser has not answered which tasks it keeps.
        """
        names, task = {place: name for name, place in self.places.items()}, saved.scenario.task
        if task not in PLACES:
            return saved
        if self._free is None:
            raise TimeoutError
        if task not in names:
            raise DataError(KEPT, "task", repr(task), ", ".join(names) or "none of your own")
        return replace(saved, scenario=replace(saved.scenario, task=names[task]))

    def write(self, session: Session) -> None:
        """Keep the tasks in the list, and none that was deleted there.

        Raises:
            TimeoutError, RuntimeError: the browser does not answer; what is left is done the next time.
        """
        if self._free is None:
            return
        tasks = session.taught
        for name in self.places.keys() - tasks.keys():
            self._texts[self.places[name]].remove()
            self._free.append(self.places.pop(name))
            self._refused.clear()  # there is room again
        for name, (task, arm) in tasks.items():
            known = name in self.places or name in self._refused
            if not known and (reason := self._put(name, task, arm, self._free)):
                self._refused.add(name)
                self._say(f"“{task.title}” is not kept in this browser: {reason}. Save makes a file of it.")

    def _put(self, name: str, task: Task, arm: str, free: list[str]) -> str:
        """Keep a task in a free place, that of its name if possible; return why that cannot be, or nothing."""
        text = fitting(Saved(Scenario(OWN, in_world(task), arm=arm), own=Own.of(task)), self._say)
        if text is None:
            return f"found more than {MAX_KEPT / 1e6:g} MB; accepted: less"
        for place in sorted(free, key=lambda place: (place != name, _number(place))):
            there = self._texts[place]
            if there.read() is None and not there.write(text):
                return "found no room; accepted: some, after another task is deleted"
            free.remove(place)  # it may be another tab's
            if there.holds(text):
                self.places[name] = place
                return ""
        return f"found {len(PLACES)} of yours; accepted: at most {len(PLACES)}"


class Keeper:
    """Keeps what one visitor makes in his browser: the newest, at most twice a second."""

    def __init__(
        self,
        storage: Storage,
        known: Known,
        present: Callable[[Collection[str]], Saved],
        otherwise: Saved | None = None,
    ) -> None:
        """Ask the browser what it keeps, for `PATIENCE` at most.

        Args:
            storage: what the browser keeps.
            known: names of what there is on this page.
            present: says what is there now, with the task's demonstrations if it is none of some names; asked once
                there is a session.
            otherwise: what the page begins with where the browser keeps nothing; None is what the session begins with.
        """
        self._known, self._present, self._otherwise = known, present, otherwise
        self._there = Text(storage, KEY)  # the text that the browser has of the scenario
        self._shelf = Shelf(storage, self._say)  # the visitor's own tasks there
        self._page: tuple[Session, Callable[[Saved], None]] | None = None
        """The session, and what has it go on with something."""
        self._said: list[str] = []
        """What the visitor has been told, or will be once there is a session."""
        self._written: str | None = None  # text that was written last, or that needs no writing
        self._first: Scenario | None = None
        """Scenario that the page shows until it goes on with what the browser keeps; None if it does, or need not."""
        self.begun: Saved | None = None
        """What the page begins with, or goes on with; None if it begins anew, or has begun."""
        self._attempts = 0 if self._ask() else ATTEMPTS
        """Number of times that the browser is still asked; 0 once it has told."""

    def begin(self, session: Session, resume: Callable[[Saved], None]) -> None:
        """Keep what is there, from now on, when it is `changed`.

        `resume` goes on with what the browser tells late, or the session has not begun with. Until then only an edit is
        written in its place, not what the camera reports.
        """
        trouble = tuple(self._said)
        self._written = self._text()
        for text in trouble:
            session.say(text, Severity.WARNING)
        begun = self.begun
        late = None if begun is None or (begun.scenario == session.scenario and begun.lesson is None) else begun
        if BLOCKED in trouble:
            if late is not None:
                resume(late)
            return
        self._page = session, resume
        if late is not None or self._attempts:
            self._first = session.scenario
        if late is not None and late.scenario.task in PLACES:
            self._attempts = ATTEMPTS  # it goes on once its task is in the list
        elif late is not None:
            resume(late)
        self.changed()

    def go_on(self, saved: Saved) -> None:
        """Take note of what the page goes on with."""
        self.begun = saved

    def sight(self, frame: Frame) -> Sight | None:
        """Return where the camera begins with a frame; None where its task says it."""
        begun = self.begun
        if begun is None or not frame.scenario.begins_like(begun.scenario):
            return None
        if frame.stage is not Stage.ROLLOUTS:  # by now all stands in the scene that the camera may look at
            self.begun = None
        return begun.camera

    def read(self, content: bytes, source: str) -> Saved:
        """Read a scenario from the content of a file; see `decode`."""
        return decode(content, self._known, source)

    def changed(self) -> None:
        """Keep what is there now, soon. Never blocks for long."""
        if self._page is not None:  # the newest of these does what those before it would have done
            session, _resume = self._page
            session.jobs.submit(LANE, partial(self._keep, *self._page), latest=True)

    def _ask(self) -> bool:
        """Ask the browser what it keeps, which then is `begun`; return whether it has answered."""
        self.begun = None
        try:
            text = self._there.read()
            if text is not None:
                self.begun = decode(text, replace(self._known, tasks=(*self._known.tasks, *PLACES)), KEPT)
        except TimeoutError:
            self._say(SLOW)
            return False
        except RuntimeError:
            self._say(BLOCKED)
        except DataError as error:
            self._begin_anew(error)
        self.begun = self.begun or self._otherwise
        return True

    def _begin_anew(self, error: DataError) -> None:
        self._there.clear()
        self._say(f"The page begins anew. {error}")

    def _waits(self, session: Session) -> bool:
        """Whether the page has still to go on with what the browser keeps: an edit, or a take, takes its place."""
        if self._first is None:
            return False
        if session.scenario != self._first or self._present(self._known.tasks).lesson is not None:
            self._first = None
        return self._first is not None

    def _keep(self, session: Session, resume: Callable[[Saved], None]) -> None:
        """Ask the browser, until it tells, what it keeps, and go on with that; once that is done, write what is new."""
        while self._attempts and self._waits(session) and not session.jobs.closed:
            self._attempts -= 1
            if self._ask():
                self._attempts = 0
                self._shelf.read(session)
                self._name_task()
                session.jobs.wait_idle(CHOICES)  # a task, scene or file that is chosen meanwhile is an edit, too
                if self.begun is None or not self._waits(session):
                    self.begun = self._first = None
                else:
                    resume(self.begun)
        self._shelf.read(session)
        if not self._waits(session):
            with suppress(TimeoutError, RuntimeError):  # the browser is busy, or gone
                self._shelf.write(session)
            self._write(session)

    def _name_task(self) -> None:
        """Name the task that the page goes on with as on this page, or go on with what a new visitor begins with."""
        try:
            self.begun = self.begun and self._shelf.named(self.begun)
        except DataError as error:
            self._begin_anew(error)
            self.begun = self._otherwise
        except TimeoutError:
            self._say(SILENT)
            self.begun = self._otherwise

    def _write(self, session: Session) -> None:
        text = self._text()
        if text is None or text == self._written:
            return
        self._written = text
        if not self._there.write(text):
            self._say(FULL)
        session.jobs.rest(PAUSE * max(1.0, len(text) / SMALL))

    def _text(self) -> str | None:
        """What is to be written of the scenario; None where its task is not kept."""
        present = self._present((*self._known.tasks, *self._shelf.places))
        if present.own is not None:
            return None
        task = present.scenario.task
        named = replace(present.scenario, task=self._shelf.places.get(task, task))
        return fitting(replace(present, scenario=named), self._say)

    def _say(self, text: str) -> None:
        if text not in self._said:
            self._said.append(text)
            if self._page is not None:
                session, _resume = self._page
                session.say(text, Severity.WARNING)


def fitting(saved: Saved, say: Callable[[str], None]) -> str | None:
    """Return the saved text without parts that are too large, each with a message; None if the rest is too large."""
    small, num_left = portable(saved.scenario)
    said: list[str] = []
    if (text := _short(saved)) is None and num_left:
        said.append(OWN_SHAPES)
        text = _short(saved := replace(saved, scenario=small))
    own = saved.own
    if text is None and (saved.lesson or (own and own.lesson)):
        said.append(OWN_TAKES)
        text = _short(replace(saved, lesson=None, own=own and replace(own, lesson=None)))
    for each in () if text is None else said:
        say(each)
    return text


def _short(saved: Saved) -> str | None:
    """Return what is saved as a text that a browser keeps; None if it is too large for that."""
    try:
        text = encode(saved)
    except ScenarioError:
        return None
    return text if len(text.encode()) <= MAX_KEPT else None


def _task_of(text: str) -> tuple[Task, str]:
    """Read a task of a visitor's own, and the name of the arm with which it was opened. Raises DataError."""
    with parsing(ScenarioError, KEPT, "task", "one that this page wrote"):
        saved = decode(text, Known((), None), KEPT)
        if saved.own is None:
            raise FormatError("own", "nothing", "what a task is made from")
        check_shapes(saved.scenario, KEPT)
        task = saved.own.task
        return replace(task, layers=in_its_frame(saved.scenario.stack, task)), saved.scenario.arm


def _number(place: str) -> int:
    return int(place.rpartition("_")[2])
