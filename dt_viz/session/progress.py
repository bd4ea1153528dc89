"""What a session tells the page that shows it: frames, choices, and how what is shown relates to what is wanted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Frame, Stage
from dt_viz.warning import Severity


@dataclass(frozen=True)
class Pace:
    """How rebuilding goes."""

    latency: float
    """Time from the last edit until its live frame was ready, seconds."""
    rate: float
    """Live frames in the last second."""
    num_skipped: int
    """Edits that a newer one overtook, since the session began."""


@dataclass(frozen=True)
class Message:
    """A text for the visitor; it is of interest until another scenario is shown."""

    text: str
    severity: Severity
    scenario: Scenario
    """The scenario that was wanted when it came."""


@dataclass(frozen=True, eq=False)
class Progress:
    """How what is shown relates to what is wanted."""

    wanted: Scenario
    shown: Frame | None = None
    """The frame that is shown; None before the first one."""
    pace: Pace = Pace(0.0, 0.0, 0)
    expected: bool = False
    """Whether another task or scene is being read."""
    learning: tuple[float, str] | None = None
    """Fraction of the learning that is done, and name of its step; None while nothing is learned."""
    failed: bool = False
    """Whether the last work ended by an error, so that what is wanted may never be shown."""
    message: Message | None = None

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
