"""A button of the panel that makes a file beside the server's event loop, with progress, and cancels it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import viser

from dt_viz.checkpoints import checkpoint
from dt_viz.errors import Cancelled, FormatError, end_if
from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings
from dt_viz.warning import Severity

CANCEL = "Cancel"
Step = Callable[[float], None]
"""Function that is told which part of a file is made, from 0 to 1; it raises UnwantedError where that is cancelled."""
Make = Callable[[Session, Step, Cancelled], tuple[str, bytes]]
"""Function that makes a file; it returns the suffix and the content, and raises FormatError where there is none."""


class SaveButton:
    """A button that makes and sends one file at a time; while it does so, it is the one that cancels that.

    A bar below it shows progress, once a file's maker has told any.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        bindings: Bindings,
        label: str,
        make: Make,
        send: Callable[[str, bytes], None],
        *,
        icon: viser.IconName,
        hint: str,
    ) -> None:
        """Build the button where the panel is being built; its lane of the session's jobs has this `label`."""
        self._lane = self._label = label
        self._make, self._send = make, send
        self.button = gui.add_button(label, icon=icon, hint=hint)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        bindings.on(self.button, self._press)

    def rename(self, label: str) -> None:
        """Give the button another label, once it does not cancel."""
        self._label = label
        if self.button.label != CANCEL:
            self.button.label = label

    def _press(self, session: Session, _pressed: bool) -> None:
        if session.jobs.busy(self._lane):
            session.jobs.submit(self._lane, lambda: None, latest=True)
        else:
            session.jobs.submit(self._lane, partial(self._work, session))

    def _work(self, session: Session) -> None:
        cancelled = partial(session.jobs.superseded, self._lane)

        def step(fraction: float) -> None:
            end_if(cancelled)
            checkpoint()
            self._bar.value, self._bar.visible = 100 * fraction, True

        label, self.button.label = self._label, CANCEL
        try:
            suffix, content = self._make(session, step, cancelled)
            end_if(cancelled)
            self._send(suffix, content)
        except (FormatError, TimeoutError) as error:
            session.say(f"{label}: {error}", Severity.WARNING)
        finally:
            self.button.label, self._bar.visible = self._label, False
            self._bar.value = 0.0
