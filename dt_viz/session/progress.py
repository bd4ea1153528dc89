"""What a session tells the page that shows it: frames, choices, and how what is shown relates to what is wanted."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Frame, Stage
from dt_viz.warning import Severity

LIVE_PAUSE, LIVE_LATENCIES = 0.05, 2.0
"""Shortest time between two drawings of the field while edits come faster, in seconds and in times that the rollouts
take with what they wait for: these are drawn more often, the more so the longer they take."""


@dataclass(frozen=True)
class Pace:
    """How rebuilding goes."""

    latency: float  # time from the last edit until its live frame was ready, seconds
    rate: float  # live frames in the last second
    num_skipped: int  # edits that a newer one overtook, since the session began
    num_edits: int = 0  # edits that were computed or overtaken since the last frame


READ = 30.0
"""Time that a message is shown, seconds: enough to look up from the scene, and read it twice."""


@dataclass(frozen=True)
class Message:
    """A text for the visitor; it is of interest until another scenario is shown, for a while."""

    text: str
    severity: Severity
    scenario: Scenario  # the scenario that was wanted when it came
    came: float = 0.0  # when that was, seconds, of `time.monotonic`


@dataclass(frozen=True, eq=False)
class Progress:
    """How what is shown relates to what is wanted."""

    wanted: Scenario
    shown: Frame | None = None  # the frame that is shown; None before the first one
    pace: Pace = Pace(0.0, 0.0, 0)
    expected: bool = False  # whether another task or scene is being read
    learning: tuple[float, str] | None = None
    """Fraction of the learning that is done, and name of its step; None while nothing is learned."""
    failed: bool = False
    """Whether the last work ended by an error, so that what is wanted may never be shown."""
    message: Message | None = None
    restored: Scenario | None = None
    """The saved scenario that the page began or went on with, of the browser, a file or the server; None if none."""
    steps: tuple[bool, bool] = (False, False)  # whether there is something to undo, and to redo
    beside: tuple[bool, bool] | None = None
    """The same of what is open beside the scenario; None if nothing is."""

    @property
    def stale(self) -> bool:
        """Whether what is shown is of another task, scene or fit than what is wanted."""
        shown = self.shown is not None and self.shown.scenario.begins_like(self.wanted)
        return self.expected or self.learning is not None or not shown

    @property
    def complete(self) -> bool:
        """Whether all that is wanted is shown, and certified."""
        shown = self.shown
        certified = shown is not None and shown.stage is Stage.CERTIFIED and self.wanted.computes_like(shown.scenario)
        return certified and not self.stale


class Display(Protocol):
    """Receiver of a session's results: a page, or a measurement."""

    def draw(self, frame: Frame, pace: Pace) -> None:
        """Show a frame. Called on the worker thread, in the order of the edits."""

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's choices on the controls, and what is to be visible."""

    def tell(self, progress: Progress) -> None:
        """Show how what is shown relates to what is wanted: after each change of one of them."""


class Screen:
    """A display and what it shows: one thread after the other, so that the newest is shown last."""

    def __init__(self, display: Display, wanted: Scenario, restored: Scenario | None = None) -> None:
        self._display = display
        self._adopting, self._telling = threading.RLock(), threading.RLock()
        self.progress = Progress(wanted, restored=restored)
        self._pace, self._num_shown = self.progress.pace, 0  # of the newest frame: pace, and number of edits until then
        self.num_edits, self.num_skipped = 0, 0  # that need frames, and those of them that a newer one overtook
        self.edited = 0.0  # time of the newest, of `time.perf_counter`
        self._live_frames: deque[float] = deque(maxlen=120)
        """Times of the newest frames of stage LIVE, of `time.perf_counter`."""

    def adopt(self, newest: Callable[[], tuple[Scenario, tuple[bool, bool]]]) -> None:
        """Show the newest scenario, asked for in its turn with `Progress.steps`, on the controls: it is wanted now."""
        with self._adopting:
            wanted, steps = newest()
            self._display.adopt(wanted)
            self.tell(wanted=wanted, steps=steps)

    def tell(self, **changes: Any) -> None:  # noqa: ANN401 - the fields of Progress
        """Change the progress and show it."""
        with self._telling:
            self.progress = replace(self.progress, **changes)
            self._display.tell(self.progress)

    def say(self, text: str, severity: Severity, wanted: Scenario) -> None:
        """Show a message while a scenario is wanted."""
        self.tell(message=Message(text, severity, wanted, time.monotonic()))

    def let_pass(self, now: float) -> None:
        """Show a message no longer that came `READ` before now, seconds; what tells of a failure stays."""
        if self.progress.message is not None:
            with self._telling:
                message = self.progress.message
                if message is not None and now - message.came >= READ and not self.progress.failed:
                    self.tell(message=None)

    def draw(self, frame: Frame, edited: float) -> None:
        """Show a frame whose scenario was asked for at a time, of `time.perf_counter`; learning is no rebuild."""
        now = time.perf_counter()
        if frame.stage is Stage.LIVE:
            self._live_frames.append(now)
        rate = sum(now - t <= 1.0 for t in self._live_frames)
        is_rebuilt = frame.stage <= Stage.LIVE and self.progress.learning is None
        latency = now - edited if is_rebuilt else self._pace.latency
        num_new, self._num_shown = self.num_edits - self._num_shown, self.num_edits
        self._pace = Pace(latency, rate, self.num_skipped, num_new)
        self._display.draw(frame, self._pace)
        if frame.stage is not Stage.ROLLOUTS:  # the next stage is a few milliseconds away
            with self._telling:
                message = self.progress.message
                kept = message if message is not None and message.scenario == frame.scenario else None
                self.tell(shown=frame, pace=self._pace, learning=None, failed=False, message=kept)

    def live_pause(self, taken: float) -> float:
        """Time until the field is due to be drawn again, where the rollouts took so long, seconds."""
        last = self._live_frames[-1] if self._live_frames else -math.inf
        return last + max(LIVE_PAUSE, LIVE_LATENCIES * taken) - time.perf_counter()
