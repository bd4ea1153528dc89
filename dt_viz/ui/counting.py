"""What a visitor does and gets, counted on the board of the processes."""

from __future__ import annotations

from dt_viz.scenario.scenario import Scenario
from dt_viz.serving.board import Share
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.progress import Display, Pace, Progress


class Counted(Display):
    """A display whose edits and pictures of rollouts count."""

    def __init__(self, display: Display, share: Share) -> None:
        """Count what goes to a display, in the row of this process."""
        self._display, self._share, self._num_edits = display, share, 0

    def draw(self, frame: Frame, pace: Pace) -> None:
        self._display.draw(frame, pace)
        if frame.stage is Stage.ROLLOUTS:
            self._share.answered(pace.latency)
        self._share.edited(pace.num_edits - self._num_edits)
        self._num_edits = pace.num_edits

    def adopt(self, scenario: Scenario) -> None:
        self._display.adopt(scenario)

    def tell(self, progress: Progress) -> None:
        self._display.tell(progress)
