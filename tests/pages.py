"""Stand-ins for what a page is given: a frame without a motion, and a session that only keeps the scenario."""

from dataclasses import replace
from typing import Any

from dt_viz.engine.frame import Frame, Stage
from dt_viz.motion.certificates import Certificates
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS


def frame_of(scenario: Scenario, **changes: Any) -> Frame:
    """The last frame of a scenario, with nothing in it but what is given."""
    nothing: Any = None
    given: dict[str, Any] = {
        "task": nothing,
        "stage": Stage.CERTIFIED,
        "ghost": (),
        "rollouts": (),
        "times": (),
        "levels": (),
        "goal": nothing,
        "reached": nothing,
        "blocked": (),
        "certificates": Certificates(0.01),
    }
    return Frame(scenario=scenario, **(given | changes))


class Edited:
    """A session that keeps the scenario of its edits, and shows it on a panel if there is one."""

    def __init__(self, scenario: Scenario, panel: Any = None) -> None:
        self.scenario, self.task, self._panel = scenario, TASKS[scenario.task](), panel
        self.steps = 0
        """For undo."""
        self._adopt()

    def edit(self, _gesture: str, **changes: Any) -> None:
        self.scenario = replace(self.scenario, **changes)
        self._adopt()

    def end_gesture(self) -> None:
        self.steps += 1

    def _adopt(self) -> None:
        if self._panel is not None:
            self._panel.adopt(self.scenario)
