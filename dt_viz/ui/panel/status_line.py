"""The status in the panel: one line, one reason in a place of a fixed height, a button that mends it, the details."""

from __future__ import annotations

import threading

import viser

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Frame
from dt_viz.session.session import Pace, Session
from dt_viz.ui.panel.bindings import Bindings
from dt_viz.ui.panel.remedies import Remedy, remedy
from dt_viz.ui.panel.status import COLOURS, PALE, details_html, line_html, place_html, progress_html
from dt_viz.ui.panel.verdict import BUSY, FAILED, Level, Verdict, verdict

HEIGHT, BUTTON = 4.5, 2.25
"""Heights of the place of the reason and of a button in it, em."""


class StatusLine:
    """The controls of the status, drawn from what is known: the newest frame, learning, and a message.

    All of them keep their height whatever comes: a button takes its room from the reason's.
    """

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build the controls where the panel is being built; the buttons act on the session of the bindings."""
        self._lock = threading.RLock()  # edits, frames and messages come from threads of their own
        self._adopted: Scenario | None = None
        self._reported: tuple[Frame, Pace] | None = None
        self._learning: tuple[float, str] | None = None
        self._message: tuple[str, Level, Scenario | None] | None = None
        """A text, its level, and the scenario that it was said of."""
        self._waits = self._failed = False
        self.line = gui.add_html("")
        self.mend = gui.add_button("Mend", icon=viser.Icon.SHIELD_CHECK, visible=False)
        self.cancel = gui.add_button("Cancel", icon=viser.Icon.X, visible=False)
        with gui.add_folder("Details", expand_by_default=False):
            self.details = gui.add_html("")
        bindings.on(self.cancel, lambda session, _pressed: session.cancel())
        bindings.on(self.mend, lambda session, _pressed: self._mend(session))
        self._draw()

    def adopt(self, scenario: Scenario) -> None:
        """Take a scenario as the one that is wanted."""
        with self._lock:
            self._adopted, self._failed = scenario, False
            self._draw()

    def report(self, frame: Frame, pace: Pace) -> None:
        """Show a frame; a message of another scenario goes."""
        with self._lock:
            self._reported, self._learning, self._waits, self._failed = (frame, pace), None, False, False
            if self._message is not None and self._message[2] != frame.scenario:
                self._message = None
            self._draw()

    def wait(self, *, waits: bool) -> None:
        """Show that what is shown is of another task or scene than what is wanted, or that it is not."""
        with self._lock:
            self._waits = waits
            self._draw()

    def learn(self, fraction: float, message: str) -> None:
        """Show how far learning is, from 0 to 1."""
        with self._lock:
            self._learning = fraction, message
            self._draw()

    def say(self, text: str, level: Level, *, failed: bool = False) -> None:
        """Show a message in the place of the reason, until a frame of another scenario is shown.

        Args:
            text: the message.
            level: its gravity.
            failed: whether something has failed, so that what was being computed may never come.
        """
        with self._lock:
            self._learning, self._message, self._failed = None, (text, level, self._adopted), failed
            self._draw()

    def _mend(self, session: Session) -> None:
        with self._lock:
            found = remedy(self._reported[0], session.scenario) if self._reported else None
        if found is not None:
            session.edit(found.label, **found.changes)
            session.end_gesture()

    def _draw(self) -> None:
        known, below = self._known(), ""
        text, level = (known.reason, known.level) if self._message is None else self._message[:2]
        if self._learning is not None:
            (fraction, text), level = self._learning, Level.NOTE
            below = progress_html(fraction)
        mends = self._remedy()
        if mends is not None:
            self.mend.label = mends.label
        self.mend.visible, self.cancel.visible = mends is not None, self._learning is not None
        room = HEIGHT - BUTTON if self.mend.visible or self.cancel.visible else HEIGHT
        self.line.content = line_html(known) + place_html(text, COLOURS[level][0], room, below)
        if self._reported is not None and self._adopted is not None:
            details = details_html(*self._reported, self._adopted.view)
            self.details.content = f"<div style='{PALE}'>{details}</div>" if self._stale else details

    @property
    def _stale(self) -> bool:
        return self._waits or self._learning is not None

    def _known(self) -> Verdict:
        if self._learning is not None:
            return Verdict(f"learning the motion … {100 * self._learning[0]:.0f} %", busy=True)
        known = BUSY
        if self._reported is not None and self._adopted is not None and not self._waits:
            known = verdict(*self._reported, self._adopted)
        return FAILED if known.busy and self._failed else known

    def _remedy(self) -> Remedy | None:
        if self._stale or self._message is not None or self._reported is None or self._adopted is None:
            return None
        return remedy(self._reported[0], self._adopted)
