"""Scenarios to go back to: undo and redo, gesture by gesture."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dt_viz.scenario.scenario import Scenario

GESTURE_PAUSE = 1.0
"""Time without an edit, seconds, after which the next edit of the same control is a step of its own for undo."""
MAX_UNDO = 200


@dataclass(frozen=True)
class Beside:
    """What is open beside the scenario, and has steps of its own that are undone meanwhile."""

    steps: tuple[bool, bool]  # whether there is something to undo, and to redo
    undo: Callable[[], None]  # takes the last step back; it must only submit
    redo: Callable[[], None]  # does again what was undone last; it must only submit


@dataclass(frozen=True)
class Camera:
    """The camera of a page, where undo brings it back, too."""

    chosen: Callable[[], Any]  # returns the pose that was chosen; None where it stands as it began
    put_back: Callable[[Any], None]  # takes the camera to a pose that was chosen


NO_CAMERA = Camera(lambda: None, lambda _pose: None)


@dataclass(frozen=True)
class Step:
    """A scenario to go back to."""

    scenario: Scenario
    camera: Camera | None = None
    """Camera that goes back with it, and with its view, to a pose; None where both stay as they are."""
    pose: Any = None


class History:
    """The scenarios before and after the present one. Whoever has it asks one thing at a time."""

    def __init__(self) -> None:
        self._past, self._future = deque[Step](maxlen=MAX_UNDO), list[Step]()
        self._gesture: tuple[str, float] = ("", 0.0)
        """Name of the gesture that is under way, and when it edited last."""
        self.held = False
        """Whether something is held, so that the gesture goes on however slow it is."""
        self._aside: tuple[Scenario, deque[Step], list[Step]] | None = None
        """What was set aside: the scenario, and those before and after it."""
        self.beside: Beside | None = None  # what is open beside the scenario; None if nothing is

    @property
    def aside(self) -> Scenario | None:
        """The scenario that is set aside; None if none is."""
        return None if self._aside is None else self._aside[0]

    def set_aside(self, present: Scenario) -> None:
        """Begin anew: the present scenario and its history are set aside, unless others are already."""
        if self._aside is None:
            self._aside = present, self._past, self._future
        self._past, self._future = deque(maxlen=MAX_UNDO), []
        self._gesture, self.held = ("", 0.0), False

    def taken_back(self) -> Scenario | None:
        """The scenario that was set aside, with its history; None if none was."""
        if self._aside is None:
            return None
        own, self._past, self._future = self._aside
        self._aside, self._gesture, self.held = None, ("", 0.0), False
        return own

    @property
    def steps(self) -> tuple[bool, bool]:
        """Whether there is something to undo, and to redo."""
        return bool(self._past), bool(self._future)

    def begin_gesture(self) -> None:
        """The user took hold of something."""
        self._gesture, self.held = ("", 0.0), True

    def end_gesture(self, present: Scenario) -> None:
        """The user let go. What ends as it began is no step."""
        if self.held and self._gesture[0] and self._past and not _is_step(present, self._past[-1].scenario):
            self._past.pop()
        self._gesture, self.held = ("", 0.0), False

    def edited(self, gesture: str, before: Scenario, after: Scenario, camera: Camera | None = None) -> None:
        """Take note of an edit by a gesture; with a `camera`, undo brings back the view and the camera, too."""
        if camera is None and not _is_step(after, before):
            return
        now, (name, when) = time.monotonic(), self._gesture
        # another control is moved, so whatever was held has been let go, even if nobody said so
        self.held = self.held and name in {"", gesture}
        if name != gesture or (now - when > GESTURE_PAUSE and not self.held):
            self._past.append(Step(before, camera, camera and camera.chosen()))
        self._gesture = (gesture, now)
        self._future.clear()

    def undone(self, present: Scenario) -> Step | None:
        """The step before the last gesture, to which one goes back; None if there is none."""
        return self._moved(present, self._past, self._future)

    def redone(self, present: Scenario) -> Step | None:
        """The step after the gesture that was undone last, to which one goes; None if there is none."""
        return self._moved(present, self._future, self._past)

    def without(self, abandoned: Scenario, shown: Scenario) -> Scenario:
        """The newest scenario with the fit of the one that is shown, after forgetting those with the abandoned fit."""
        self._gesture = ("", 0.0)
        while self._past and self._past[-1].scenario.fit == abandoned.fit:
            self._past.pop()
        for steps in (self._past, self._future):
            if steps and steps[-1].scenario.fit == shown.fit:
                return steps.pop().scenario
        return shown

    def forget(self, task: str) -> None:
        """Forget the scenarios of a task that is gone."""
        for steps in (self._past, self._future):
            left = [step for step in steps if step.scenario.task != task]
            steps.clear()
            steps.extend(left)

    def _moved(
        self, present: Scenario, source: deque[Step] | list[Step], target: deque[Step] | list[Step]
    ) -> Step | None:
        if not source:
            return None
        self._gesture, there = ("", 0.0), source.pop()
        target.append(Step(present, there.camera, there.camera and there.camera.chosen()))
        return there


def _is_step(after: Scenario, before: Scenario) -> bool:
    """Whether the change from one to the other is a step for undo: what moves is, and where the slice lies."""
    return after.choices != before.choices or after.view.slice != before.view.slice
