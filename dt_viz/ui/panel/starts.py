"""Controls of the added starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import viser

from dt_viz.motion.following import room_at_rest
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.robot import load_jaco
from dt_viz.scenario.scenario import MAX_STARTS, Scenario
from dt_viz.scenario.starts import followed, label_of, with_grid, with_label
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.chores import Later
from dt_viz.ui.panel.bindings import Bindings

NEAREST = "nearest"
MOST_NAMED = 3
"""Largest number of demonstrations by which a label is named."""
LABEL_HINT = (
    "which of the patterns that the demonstrations show is followed, where they differ although they begin at one "
    "place: of new starts, and of an added start that the arm follows. Numbers are those of demonstrations with that "
    "pattern, as in Follows rollout. nearest: that of the nearest demonstration"
)


class StartsPanel:
    """The folder "Starts": adds starts by clicks and in a grid, labels and removes them."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, say: Callable[[str], None], later: Later) -> None:
        """Build the controls; `say` shows a message."""
        self._say = say
        with gui.add_folder("Starts", expand_by_default=False):
            bindings.input(
                gui.add_checkbox(
                    "Click to start a rollout", False, hint=f"on the slice, up to {MAX_STARTS}; drag a ball to move it"
                ),
                lambda s: s.view.click_to_start,
                lambda s, value: {"view": replace(s.view, click_to_start=value)},
            )
            label = gui.add_dropdown("Label", (NEAREST,), initial_value=NEAREST, hint=LABEL_HINT)
            labels = partial(_labels, bindings)
            bindings.properties(label, options=lambda _s: (NEAREST, *labels()), visible=lambda _s: bool(labels()))
            bindings.input(
                label,
                lambda s: _label_shown(s, bindings.frame),
                lambda s, name: _labelled(s, len(bindings.session.task.demonstrations), labels().get(name)),
            )
            buttons = gui.add_button_group(
                "Starts",
                ("Grid", "Remove", "Clear"),
                hint="Grid: starts all over the slice. Remove: the start that the arm follows, or else the newest",
            )
        acts = {"Grid": self.add_grid, "Remove": remove, "Clear": clear}
        bindings.on(buttons, lambda session, name: later(partial(acts[name], session)))

    def add_grid(self, session: Session) -> None:
        """Add starts all over the slice."""
        scenario, task = session.scenario, session.task
        arm_room = partial(room_at_rest, load_jaco(), task, scenario.obstacle)
        try:
            grid = with_grid(scenario, task.slice.posed(scenario.view.slice), arm_room)
        except UnreachableError as error:
            self._say(f"the arm cannot reach the starts: {error}")
            return
        arm_rollout = followed(scenario, len(task.demonstrations))
        session.edit("grid of starts", starts=grid.starts, arm_rollout=arm_rollout)
        session.end_gesture()
        reasons = (
            (grid.num_blocked, "at or inside an obstacle, or the arm is there"),
            (grid.num_far, "where the hand cannot be"),
        )
        left_out = [f"{num} {why}" for num, why in reasons if num]
        if left_out:
            self._say(f"places of the grid left out: {', '.join(left_out)}")


def remove(session: Session) -> None:
    """Remove the start that the arm follows, or else the newest."""
    starts, num_demonstrated = session.scenario.starts, len(session.task.demonstrations)
    if starts:
        arm_rollout = followed(session.scenario, num_demonstrated)
        index = len(starts) - 1
        if arm_rollout >= num_demonstrated:
            index, arm_rollout = arm_rollout - num_demonstrated, 0
        session.edit("remove start", starts=(*starts[:index], *starts[index + 1 :]), arm_rollout=arm_rollout)
        session.end_gesture()


def clear(session: Session) -> None:
    """Remove all added starts."""
    number = followed(session.scenario, len(session.task.demonstrations))
    arm_rollout = number if number < len(session.task.demonstrations) else 0
    session.edit("clear starts", starts=(), arm_rollout=arm_rollout)
    session.end_gesture()


def _labelled(scenario: Scenario, num_demonstrated: int, label: float | None) -> dict[str, Any]:
    """What changes when new starts, and the added start that the arm follows, get a label."""
    starts = with_label(scenario, num_demonstrated, label)
    return {"starts": starts, "view": replace(scenario.view, start_label=label)}


def _labels(bindings: Bindings) -> dict[str, float]:
    """The labels of the frame that is shown, by their names."""
    if bindings.frame is None:
        return {}
    labels = bindings.frame.labels
    return {_named(label, labels): label for label in sorted(set(labels))}


def _label_shown(scenario: Scenario, frame: Frame | None) -> str:
    """The name of the label that starts of the scenario have in a frame."""
    if frame is None:
        return NEAREST
    label = label_of(scenario, len(frame.task.demonstrations))
    return NEAREST if label is None or label not in frame.labels else _named(label, frame.labels)


def _named(label: float, labels: Sequence[float]) -> str:
    """The name of a label, which tells the first demonstrations that have it."""
    numbers = [str(k + 1) for k, other in enumerate(labels) if other == label]
    more = " …" if len(numbers) > MOST_NAMED else ""
    return f"{label:g}".replace("-", "−") + f": as {', '.join(numbers[:MOST_NAMED])}{more}"
