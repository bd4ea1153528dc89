"""Changes a session's scenario again and again by itself, until it is stopped or somebody else changes it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.session import Session

STEP = 0.05  # interval of the edits, seconds, as of a dragged slider
LANE = "player"
"""Lane of the session's jobs on which one thing is played at a time, the one that was started last."""

Play = Callable[[Scenario, float], Mapping[str, Any] | None]
"""Function of the scenario and of the seconds since it began; it returns the fields that change, or None at the end."""


def start(
    session: Session, gesture: str, play: Play, changed: Callable[[bool], None], *, returns: bool = False
) -> None:
    """Begin to play, as one gesture for undo.

    Args:
        session: whose scenario changes.
        gesture: name of the edits.
        play: what is played.
        changed: called with True when playing begins and with False when it ends.
        returns: whether the motion is in the end as it was before, unless somebody else has changed it.
    """

    def work() -> None:
        changed(True)
        session.begin_gesture()
        before, mine, began = session.scenario, None, time.monotonic()
        while mine is None or session.scenario.choices == mine.choices:  # else the user edits something
            changes = play(session.scenario, time.monotonic() - began)
            if changes is not None:
                session.edit(gesture, **changes)
                mine = session.scenario
                session.jobs.rest(STEP, LANE)
            if changes is None or session.jobs.superseded(LANE):
                if returns:
                    session.edit(gesture, stack=before.stack)
                session.end_gesture()
                break
        changed(False)

    session.jobs.submit(LANE, work, latest=True)


def stop(session: Session) -> None:
    """Stop what is played after the current edit."""
    session.jobs.submit(LANE, lambda: None, latest=True)
