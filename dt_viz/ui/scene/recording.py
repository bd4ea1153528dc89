"""A page that replays the motion of a frame by itself, without a server: viser's own player with a recording in it."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

from dt_viz.motion.following import Follower
from dt_viz.session.frame import Frame
from dt_viz.session.robot_loop import LiveArm, RoundSettings
from dt_viz.ui.patches import Tape
from dt_viz.ui.playback import Playback
from dt_viz.ui.scene.camera import Framing, Pose, view_of
from dt_viz.ui.scene.robot_scene import RobotScene
from dt_viz.ui.scene.scene import ScenePictures


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of `record`."""

    rate: float = 25.0
    """Number of postures of the arm a second."""


def record(
    frame: Frame,
    follower: Follower,
    pose: Pose | None = None,
    step: Callable[[float], None] = lambda _part: None,
    settings: RecordingSettings = RecordingSettings(),
) -> bytes:
    """Return an HTML page that shows a frame and plays its motion in a loop, as `Replay` does.

    It is drawn anew in a scene of its own: it holds what this frame shows, and nothing else of the server.

    Args:
        frame: what is shown; without a motion of the arm nothing moves.
        follower: of the arm.
        pose: camera; that which frames all in a window without a panel if None.
        step: told which part is done, from 0 to 1; it may raise to cancel.
        settings: of the recording.
    """
    tape = Tape()
    view = replace(frame.scenario.view, replay=True, playing=True, speed=1.0, handles=False)
    scenario = replace(frame.scenario, view=view)
    panels = [panel.shown for panel in frame.pictures.panels]
    tape.camera.position, tape.camera.look_at = pose or view_of(frame.task, Framing(panel=0.0), panels=panels)
    tape.camera.fov = Framing.field_of_view
    pictures = ScenePictures(tape.scene, follower.robot, _nobody)
    moment = 0.0
    robot = RobotScene(
        cast(Any, tape), follower.robot, Playback(LiveArm(follower), lambda: robot.pose(moment, pictures.look.tubes))
    )
    pictures.adopt(scenario)
    robot.adopt(view, pictures.look)
    pictures.draw(frame)
    robot.draw(frame, pictures.look)
    robot.playback.advance(0.0)
    duration = 0.0 if frame.arm is None else frame.arm.times[-1] + RoundSettings.rest
    while moment < duration:
        step(moment / duration)
        moment += 1 / settings.rate
        tape.wait(1 / settings.rate)
        robot.playback.advance(1 / settings.rate)
    title = f"<title>{html.escape(frame.task.title)} – DT-Viz</title>"
    return tape.html().replace("<title>Viser</title>", title, 1).encode()


def _nobody() -> Any:  # noqa: ANN401
    raise AssertionError("nobody edits a recording")
