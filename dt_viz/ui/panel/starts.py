"""Controls of the added starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import viser

from dt_viz.arm.robot import load_jaco
from dt_viz.arm.tracking import UnreachableError
from dt_viz.engine.session import Session
from dt_viz.motion.following import room_at_rest
from dt_viz.scenario.scenario import MAX_STARTS, Scenario
from dt_viz.scenario.starts import followed, with_grid
from dt_viz.ui.chores import Later
from dt_viz.ui.controls import Control
from dt_viz.ui.panel.transform_settings import Bind


class StartsPanel:
    """Adds starts by clicks and in a grid, and removes them."""

    def __init__(self, gui: viser.GuiApi, bind: Bind, say: Callable[[str], None], later: Later) -> None:
        """Build the controls; they act once `connect` has given them a session. `say` shows a message."""
        self._session: Session | None = None
        self._say = say
        with gui.add_folder("Starts", expand_by_default=False):
            bind(
                gui.add_checkbox(
                    "Click to start a rollout", False, hint=f"on the slice, up to {MAX_STARTS}; drag a ball to move it"
                ),
                lambda s: s.view.click_to_start,
                lambda s, value: {"view": replace(s.view, click_to_start=value)},
            )
            self._buttons = gui.add_button_group(
                "Starts", ("Grid", "Remove", "Clear"), hint="Remove: the one that the arm follows, or else the newest"
            )

        acts = {"Grid": self.add_grid, "Remove": self.remove, "Clear": self.clear}
        Control(self._buttons, lambda name: later(acts[name]))

    def connect(self, session: Session) -> None:
        """Let the controls edit this session."""
        self._session = session

    def add_grid(self) -> None:
        """Starts all over the slice."""
        if self._session is None:
            return
        scenario = self._session.scenario
        task = self._session.task
        arm_room = partial(room_at_rest, load_jaco(), task, scenario.obstacle)
        try:
            grid = with_grid(scenario, task.slice.posed(scenario.view.slice), arm_room)
        except UnreachableError as error:
            self._say(f"the arm cannot reach the starts: {error}")
            return
        arm_rollout = followed(scenario, len(task.demonstrations))
        self._session.edit("grid of starts", starts=grid.starts, arm_rollout=arm_rollout)
        self._session.end_gesture()
        reasons = (
            (grid.num_blocked, "at or inside an obstacle, or the arm is there"),
            (grid.num_far, "where the hand cannot be"),
        )
        left_out = [f"{num} {why}" for num, why in reasons if num]
        if left_out:
            self._say(f"places of the grid left out: {', '.join(left_out)}")

    def remove(self) -> None:
        """The one that the arm follows, or else the newest."""
        if self._session is not None and self._session.scenario.starts:
            scenario = self._session.scenario
            index = _followed(scenario, len(self._session.task.demonstrations))
            starts = list(scenario.starts)
            del starts[-1 if index is None else index]
            arm_rollout = followed(scenario, len(self._session.task.demonstrations)) if index is None else 0
            self._session.edit("remove start", starts=tuple(starts), arm_rollout=arm_rollout)
            self._session.end_gesture()

    def clear(self) -> None:
        """Remove all added starts."""
        if self._session is not None:
            number = followed(self._session.scenario, len(self._session.task.demonstrations))
            arm_rollout = number if number < len(self._session.task.demonstrations) else 0
            self._session.edit("clear starts", starts=(), arm_rollout=arm_rollout)
            self._session.end_gesture()


def _followed(scenario: Scenario, num_demonstrated: int) -> int | None:
    """Which added start the arm begins at, if it does."""
    index = followed(scenario, num_demonstrated) - num_demonstrated
    return index if index >= 0 else None
