"""Changes a session's scenario again and again by itself, until it is stopped or somebody else changes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.session import Session

STEP = 0.05
"""Interval of the edits, seconds, as of a dragged slider."""

Play = Callable[[Scenario, float], Mapping[str, Any] | None]
"""Function of the scenario and of the seconds since it began; it returns the fields that change, or None at the end."""


class Player:
    """Plays one thing at a time, as one gesture for undo."""

    def __init__(self, changed: Callable[[bool], None]) -> None:
        """Wait to be started.

        Args:
            changed: called with True when playing begins and with False when it ends.
        """
        self._changed = changed
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def playing(self) -> bool:
        """Whether it is under way."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, session: Session, gesture: str, play: Play, *, returns: bool = False) -> None:
        """Begin to play. Nothing is done while something is played.

        Args:
            session: whose scenario changes.
            gesture: name of the edits.
            play: what is played.
            returns: whether the motion is in the end as it was before, unless somebody else has changed it.
        """
        if not self.playing:
            self._stop.clear()
            arguments = (session, gesture, play, returns)
            self._thread = threading.Thread(target=self._play, args=arguments, name=gesture, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop playing after the current edit."""
        self._stop.set()

    def close(self) -> None:
        """Stop, and wait for the last edit."""
        self.stop()
        if self._thread is not None:
            self._thread.join(timeout=1)

    def _play(self, session: Session, gesture: str, play: Play, returns: bool) -> None:
        self._changed(True)
        session.begin_gesture()
        before, mine, began = session.scenario, None, time.monotonic()
        while mine is None or session.scenario.choices == mine.choices:  # else the user edits something
            changes = play(session.scenario, time.monotonic() - began)
            if changes is not None:
                session.edit(gesture, **changes)
                mine = session.scenario
            if changes is None or self._stop.wait(STEP):
                if returns:
                    session.edit(gesture, stack=before.stack)
                session.end_gesture()
                break
        self._changed(False)
