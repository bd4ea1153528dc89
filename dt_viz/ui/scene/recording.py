"""A page that replays the motion of a frame by itself, without a server: viser's own player with a recording in it."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import Any, cast

from dt_viz.motion.following import Follower
from dt_viz.session.frame import Frame
from dt_viz.session.robot_loop import LiveArm, RoundSettings
from dt_viz.ui.patches import Tape
from dt_viz.ui.playback import Playback
from dt_viz.ui.scene.camera import Framing, Pose, view_of
from dt_viz.ui.scene.figure import Step, ignored, key_of, render_figure
from dt_viz.ui.scene.robot_scene import RobotScene
from dt_viz.ui.scene.scene import ScenePictures
from dt_viz.ui.scene.slice_layers import legend_in

HOLD = """
const clock = Date.now, curtain = document.createElement('canvas');
let stopped = null, lost = 0, frames = 0, hooked = false;
Date.now = () => (stopped ?? clock()) - lost;
const hold = picture => {
  frames = 0;
  if (stopped !== null) return;
  stopped = clock();
  const all = {left: 0, top: 0, width: innerWidth, height: innerHeight};
  const {left, top, width, height} = picture ? picture.getBoundingClientRect() : all;
  const place = `left:${left}px;top:${top}px;width:${width}px;height:${height}px`;
  curtain.style.cssText = `position:fixed;z-index:1;background:#e3e3e4;pointer-events:none;${place}`;
  Object.assign(curtain, {width: picture?.width ?? width, height: picture?.height ?? height, hidden: false});
  const paint = curtain.getContext('2d');
  paint.font = '16px sans-serif';
  if (picture) paint.drawImage(picture, 0, 0);
  else paint.fillText('Loading …', 24, 40);
};
const look = () => {
  const viewer = window.__viserMutable, nodes = Object.entries(window.__viserSceneTree?.getState() ?? {});
  if (viewer && !hooked) {
    const queue = viewer.messageQueue, push = queue.push;
    queue.push = message => {
      if (message.type === 'SetCameraPositionMessage') hold(viewer.canvas);
      return push.call(queue, message);
    };
    hooked = true;
  }
  if (stopped !== null) {
    const settled = ([name, node]) => {
      const pose = viewer.nodePoseData[name], isLabel = node.message.type === 'LabelMessage';
      return !node.effectiveVisibility || !pose || isLabel || pose.poseUpdateState === 'updated';
    };
    frames = viewer && !viewer.messageQueue.length && nodes.length > 2 && nodes.every(settled) ? frames + 1 : 0;
    viewer?.requestRender();
    if (frames > 3 || clock() - stopped > 30000) {
      lost += clock() - stopped;
      stopped = null;
      curtain.hidden = true;
    }
  }
  requestAnimationFrame(look);
};
document.body.append(curtain);
hold();
look();
"""
"""Script that stops the clock of viser's player until all is in its place, and covers the scene meanwhile.

At the start of each round the player hides all, puts it at the origin in another light, and plays on, while objects
come into their places some frames later. The cover is the last picture; the clock is stopped for 3 more, for 30 s at
most. Hook: a player that waits for what it has added.
"""
RATE = 25.0  # number of postures of the arm a second


def drawn(frame: Frame, suffix: str, follower: Follower, pose: Pose | None, step: Step = ignored) -> bytes:
    """Return a frame as the content of a file without a browser: a page (".html", see `record`) or a figure."""
    return record(frame, follower, pose, step) if suffix == ".html" else render_figure(frame, suffix, step)


def record(frame: Frame, follower: Follower, pose: Pose | None = None, step: Step = ignored) -> bytes:
    """Return an HTML page that shows a frame and plays its motion in a loop, as `Replay` does.

    It is drawn anew in a scene of its own: it holds what this frame shows, and nothing else of the server.

    Args:
        frame: what is shown; without a motion of the arm nothing moves.
        follower: of the arm.
        pose: camera; that which frames all in a window without a panel if None.
        step: takes the part that is done, from 0 to 1; it may raise to cancel.
    """
    tape = Tape()
    view = replace(frame.scenario.view, replay=True, playing=True, speed=1.0, handles=False)
    scenario = replace(frame.scenario, view=view)
    panels = [panel.shown for panel in frame.pictures.panels]
    tape.camera.position, tape.camera.look_at = pose or view_of(frame.task, Framing(panel=0.0), panels=panels)
    tape.camera.fov = Framing.field_of_view
    pictures = ScenePictures(tape.scene, follower.robot, cast(Any, None))  # without handles nothing is edited
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
        moment += 1 / RATE
        tape.recording.insert_sleep(1 / RATE)
        robot.playback.advance(1 / RATE)
    title = f"<title>{html.escape(frame.task.title)} – DT-Viz</title>"
    head, body, foot = tape.recording.as_html().replace("<title>Viser</title>", title, 1).rpartition("</body>")
    return f"{head}{_legend(frame)}<script>(() => {{{HOLD}}})()</script>{body}{foot}".encode()


def _legend(frame: Frame) -> str:
    """Return HTML that names what is shown, in the lower left corner; a click folds it."""
    colours = legend_in(frame, frame.scenario.view.colour)
    return (
        "<details open style='position:fixed;z-index:2;left:1em;bottom:4.5em;padding:0.4em 0.8em;border-radius:4px;"
        "background:rgba(255,255,255,0.88);color:#343a44;font:13px/1.5 sans-serif'><summary>Legend</summary>"
        f"{key_of(frame).html}{'' if colours is None else colours.html}</details>"
    )
