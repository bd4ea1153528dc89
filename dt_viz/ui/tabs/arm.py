"""The tab "Arm": how the arm in the loop moves, which rollout it follows, and what disturbs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import viser

from dt_viz.scenario.roaming import Chase, MovingGoal
from dt_viz.scenario.scenario import Scenario
from dt_viz.session import player
from dt_viz.session.frame import Stage
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings

OBSTACLE_SPEEDS: Mapping[str, float] = {"Obstacle": 0.08, "Fast obstacle": 0.25}
"""Speeds of the obstacle that crosses the motion, by their names on the page, m/s."""
GOAL, STOP = "Goal", "Stop"
PUSH_HINT = (
    "a few centimetres to a side: it goes on from there, and still reaches the goal; or drag the ball at the hand"
)


MODEL_HINT = "the arm: the task is placed in its reach, with all that is there; one that is new takes up to a minute"


def add_arm(gui: viser.GuiApi, bindings: Bindings, arms: Mapping[str, str], begin: Callable[..., None]) -> None:
    """Build the controls where the panel is being built.

    Args:
        gui: controls of the visitor.
        bindings: of them.
        arms: titles of the arms that may be chosen, by their names.
        begin: as `ControlPanel.begin`.
    """
    names = {title: name for name, title in arms.items()}
    bindings.choice(
        gui.add_dropdown("Model", tuple(names), hint=MODEL_HINT),
        lambda s: arms[s.arm],
        partial(begin, lambda session, title: session.choose_arm(names[title])),
    )
    play = gui.add_button("Pause")
    bindings.properties(play, label=lambda s: "Pause" if s.view.playing else "Play")
    bindings.on(play, play_or_pause)
    bindings.slider(gui, "speed", 0.25, 3.0, 0.25)
    push = gui.add_button("Push the hand", icon=viser.Icon.HAND_FINGER, disabled=True, hint=PUSH_HINT)

    def stands(scenario: Scenario) -> bool:
        frame = bindings.frame
        has_no_motion = frame is None or (frame.arm is None and frame.stage >= Stage.FINE)
        return has_no_motion or scenario.view.replay or not scenario.view.playing

    bindings.properties(push, disabled=stands)
    bindings.on(push, lambda session, _pressed: session.engine.arm.push())
    bindings.checkbox(gui, "replay")
    add_disturbances(gui, bindings)
    hint = "number of the rollout that the arm follows: first those of the demonstrations, then added ones"
    followed = gui.add_slider("Follows rollout", 1, 8, 1, 1, hint=hint)

    def num_rollouts(_scenario: Scenario) -> int:
        frame = bindings.frame
        return KEEP if frame is None else len(frame.task.demonstrations) + len(frame.scenario.starts)

    bindings.properties(followed, max=num_rollouts)
    bindings.input(followed, lambda s: s.arm_rollout + 1, lambda _s, value: {"arm_rollout": int(value) - 1})


def play_or_pause(session: Session, _pressed: bool = True) -> None:
    """Let the arm move, or hold it."""
    view = session.scenario.view
    session.edit("play", view=replace(view, playing=not view.playing))


def add_disturbances(gui: viser.GuiApi, bindings: Bindings) -> None:
    """Build the buttons of what disturbs the arm by itself, which become a stop button meanwhile."""
    rng = np.random.default_rng(0)
    hint = "by itself: the selected obstacle crosses the motion again and again, or the goal moves"
    buttons = gui.add_button_group("Disturb", (*OBSTACLE_SPEEDS, GOAL), hint=hint)

    def show(playing: bool) -> None:
        buttons.options = (STOP,) if playing else (*OBSTACLE_SPEEDS, GOAL)

    def press(session: Session, button: str) -> None:
        frame = bindings.frame
        if button == STOP or frame is None:
            player.stop(session)
            return
        play: player.Play = MovingGoal(frame.task, frame.reached)
        if button != GOAL:
            play = Chase(frame.task, session.scenario, OBSTACLE_SPEEDS[button], rng)
        player.start(session, "Disturb", play, show, returns=True)

    bindings.on(buttons, press)
