"""The tab "Arm": how the arm in the loop moves, which rollout it follows, and what disturbs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import viser

from dt_viz.control.settings import ControllerSettings
from dt_viz.errors import Cancelled, FormatError
from dt_viz.robot.joint_trajectory import FORMATS, rest_to_rest
from dt_viz.scenario.roaming import Chase, MovingGoal
from dt_viz.scenario.scenario import Scenario
from dt_viz.session.frame import Stage
from dt_viz.session.player import Play
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings, Control
from dt_viz.ui.playback import SPAN
from dt_viz.ui.scene.figure import Step
from dt_viz.ui.tabs.picture import SaveButton
from dt_viz.warning import Kind

OBSTACLE_SPEEDS: Mapping[str, float] = {"Obstacle": 0.08, "Fast obstacle": 0.25}
"""Speeds of the obstacle that crosses the motion, by their names on the page, m/s."""
GOAL = "Goal"
JOINT_FORMATS: Mapping[str, str] = {"ROS 2 YAML": ".yaml", "CSV": ".csv", "npz": ".npz"}
"""Suffixes of files of the joints, by their names on the page."""


def add_arm(
    gui: viser.GuiApi,
    bindings: Bindings,
    arms: Mapping[str, str],
    begin: Callable[..., None],
    rewind: Callable[[Session], None],
) -> None:
    """Build the controls where the panel is being built.

    For the titles of arms by name, and `ControlPanel.begin`; `rewind` shows what the robot did.
    """
    names = {title: name for name, title in arms.items()}
    hint = "the arm: the task is placed in its reach, with all that is there; one that is new takes up to a minute"
    bindings.choice(
        gui.add_dropdown("Model", tuple(names), hint=hint),
        lambda s: arms[s.arm],
        partial(begin, lambda session, title: session.choose_arm(names[title])),
    )
    robot = {"visible": lambda s: not s.view.replay}
    label = lambda s: "Pause" if s.view.playing else "Play"  # noqa: E731
    bindings.on(gui.add_button("Pause", hint="stops the robot, or lets it go on"), play_or_pause, label=label, **robot)
    bindings.slider(gui, "speed", **robot)

    def stands(scenario: Scenario) -> bool:
        frame = bindings.frame
        has_no_motion = frame is None or (frame.arm is None and frame.stage >= Stage.FINE)
        return has_no_motion or scenario.view.replay or not scenario.view.playing

    hint = (
        "a few centimetres to a side: it goes on from there, and still reaches the goal; or drag the ball at the hand"
    )
    push = gui.add_button("Push the hand", icon=viser.Icon.HAND_FINGER, disabled=True, hint=hint)
    bindings.on(push, lambda session, _pressed: session.engine.arm.push(), disabled=stands)
    bindings.checkbox(gui, "replay")
    hint = f"plays its last {SPAN:.0f} s in a timeline, while it goes on"
    past = gui.add_button("What the robot did", icon=viser.Icon.HISTORY, hint=hint)
    bindings.on(past, lambda session, _pressed: rewind(session))
    hint = "by itself: the selected obstacle crosses the motion again and again, or the goal moves"
    buttons, rng = gui.add_button_group("Disturb", (*OBSTACLE_SPEEDS, GOAL), hint=hint), np.random.default_rng(0)

    def disturbance(session: Session, button: str) -> Play | None:
        frame = bindings.frame
        if frame is None:
            return None
        if button == GOAL:
            return MovingGoal(frame.task, frame.reached)
        return Chase(frame.task, session.scenario, OBSTACLE_SPEEDS[button], rng)

    bindings.plays(buttons, "Disturb", disturbance, returns=True)

    def num_rollouts(_scenario: Scenario) -> int:
        frame = bindings.frame
        return KEEP if frame is None else len(frame.task.demonstrations) + len(frame.scenario.starts)

    hint = "number of the rollout that the arm follows: first those of the demonstrations, then added ones"
    bindings.input(
        gui.add_slider("Follows rollout", 1, 8, 1, 1, hint=hint),
        lambda s: s.arm_rollout + 1,
        lambda _s, value: {"arm_rollout": int(value) - 1},
        max=num_rollouts,
    )


def add_joints(gui: viser.GuiApi, bindings: Bindings, send: Callable[[str, bytes], None]) -> None:
    """Build what saves the motion of the joints where the panel is being built; `send` gets a suffix and a content."""
    hint = "the arm's motion for a robot of yours, from rest to rest within its limits: for ROS 2, or as a table"
    chosen = Control(gui.add_dropdown("Joints as", tuple(JOINT_FORMATS), hint=hint))

    def make(session: Session, step: Step, cancelled: Cancelled) -> tuple[str, bytes]:
        frame = bindings.frame
        if frame is None or frame.arm is None or frame.blocked:
            found = frame.blocked[0].text if frame is not None and frame.blocked else "none that is shown"
            raise FormatError("the arm's motion", found, "one that the arm follows, with “Arm” on in the tab “Show”")
        missed = [warning.text for warning in frame.certificates.warnings if warning.kind is Kind.PATH_MISSED]
        if missed:
            raise FormatError("the arm's motion", missed[0], "one that the arm follows")
        with session.engine.refining(cancelled):
            acceleration = ControllerSettings.acceleration
            trajectory = rest_to_rest(session.robot, frame.arm.times, frame.arm.q, acceleration)
        step(0.5)
        suffix = JOINT_FORMATS[chosen.value]
        return suffix, FORMATS[suffix](trajectory)

    hint = "of the rollout that the arm follows, as “Replay” shows it; press again to cancel"
    SaveButton(gui, bindings, "Save joints", make, send, icon=viser.Icon.DOWNLOAD, hint=hint)


def play_or_pause(session: Session, _pressed: bool = True) -> None:
    """Let the arm move, or hold it."""
    view = session.scenario.view
    session.edit("play", view=replace(view, playing=not view.playing))
