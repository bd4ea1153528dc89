"""What a visitor has made, kept in his browser: read when he connects, written with each edit.

The browser may keep nothing, too much or something else, tell it late or never, and write for two tabs: the page opens
in time all the same, and says once what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Protocol

from dt_viz.errors import DataError
from dt_viz.scenario.saved import Known, Saved, ScenarioError, Sight, decode, encode, portable
from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.session import CHOICES, Session
from dt_viz.warning import Severity

KEY = "dt-viz"
"""Name of what is kept, among all that the browser keeps for pages of this address."""
PATIENCE = 1.0
"""Time in which a browser must tell what it keeps, seconds."""
ATTEMPTS = 30
"""Number of times that it is asked again after the page has opened, while nothing is edited."""
PAUSE = 0.5
"""Shortest time between two writes of a text up to `SMALL`, seconds; longer texts take in proportion longer."""
SMALL, MAX_KEPT = 100_000, 10**6
"""Numbers of bytes of a text that is quickly sent, and of the largest that is kept."""
LANE = "keeping"
"""Lane of the session's jobs on which the browser is asked and told."""
SLOW = "This browser has not told yet what it keeps: the page goes on with it when it comes, unless you edit before."
BLOCKED = "This browser keeps nothing: after a reload, the page begins anew."
FULL = "This browser has no room left to keep what you do: after a reload, the page begins as before."
OWN_TASK = "Demonstrations as large as yours are not kept in this browser: save the scenario, and open that file again."
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


class Keeper:
    """Keeps the scenario and the camera of one visitor in his browser: the newest, at most twice a second."""

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
        self._storage, self._known, self._present, self._otherwise = storage, known, present, otherwise
        self._page: tuple[Session, Callable[[Saved], None]] | None = None
        """The session, and what has it go on with something."""
        self._said: list[str] = []
        """What the visitor has been told, or will be once there is a session."""
        self._kept: str | None = None
        """Text that the browser has, as far as is known."""
        self._written: str | None = None
        """Text that was written last, or that needs no writing."""
        self._proven = 0
        """Number of characters of the longest text of which the browser was asked if it keeps it."""
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
        if late is not None:
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

    def forget(self) -> None:
        """Keep nothing until the next edit."""
        if self._page is not None:
            self._first = None
            session, _resume = self._page
            session.jobs.submit(LANE, self._remove, latest=True)

    def _ask(self) -> bool:
        """Ask the browser what it keeps, which then is `begun`; return whether it has answered."""
        try:
            self._kept = self._storage.get_item(KEY, timeout=PATIENCE)
            if self._kept is not None:
                self.begun = decode(self._kept, self._known, "What this browser keeps")
        except TimeoutError:
            self._say(SLOW)
            return False
        except RuntimeError:
            self._say(BLOCKED)
        except DataError as error:
            self._storage.remove_item(KEY)
            self._say(f"The page begins anew. {error}")
        self.begun = self.begun or self._otherwise
        return True

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
                session.jobs.wait_idle(CHOICES)  # a task, scene or file that is chosen meanwhile is an edit, too
                if self.begun is None or not self._waits(session):
                    self.begun = self._first = None
                else:
                    resume(self.begun)
        if not self._waits(session):
            self._write(session)

    def _write(self, session: Session) -> None:
        text = self._text()
        if text is None or text == self._written:
            return
        self._storage.set_item(KEY, text)
        before, self._kept, self._written = self._kept, text, text
        if len(text) > self._proven:
            with suppress(TimeoutError, RuntimeError):  # it is busy, or gone
                self._kept = self._storage.get_item(KEY, timeout=PATIENCE)
                self._proven = len(text)
                if self._kept == before != text:  # else it is another tab's
                    self._say(FULL)
        session.jobs.pause(PAUSE * max(1.0, len(text) / SMALL))

    def _text(self) -> str | None:
        """What is to be written; None where it cannot be, which the visitor is told."""
        present = self._present(self._known.tasks)
        small, num_left = portable(present.scenario)
        said: list[str] = []
        if (text := _short(present)) is None and num_left:
            said.append(OWN_SHAPES)
            text = _short(present := replace(present, scenario=small))
        own = present.own
        if text is None and (present.lesson or (own and own.lesson)):
            said.append(OWN_TAKES)
            text = _short(replace(present, lesson=None, own=own and replace(own, lesson=None)))
        for each in [OWN_TASK] if text is None else said:
            self._say(each)
        return text

    def _remove(self) -> None:
        self._storage.remove_item(KEY)
        self._written = self._text()

    def _say(self, text: str) -> None:
        """Tell the visitor, once."""
        if text not in self._said:
            self._said.append(text)
            if self._page is not None:
                session, _resume = self._page
                session.say(text, Severity.WARNING)


def _short(saved: Saved) -> str | None:
    """Return what is saved as a text that a browser keeps; None if it is too large for that."""
    try:
        text = encode(saved)
    except ScenarioError:
        return None
    return text if len(text.encode()) <= MAX_KEPT else None
