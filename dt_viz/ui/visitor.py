"""The page of one visitor: a private scene, panel and session, tied together."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial

import viser

from dt_viz.files.uploads import keep_ready, let_go
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Sphere, as_point, as_quaternion
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.slices import SlicePose
from dt_viz.scenario.stack import selected, transform_of, with_avoidance, with_transform
from dt_viz.scenario.starts import followed, with_moved_start, with_start
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.progress import Display, Pace, Progress
from dt_viz.session.session import Session
from dt_viz.ui.controls import on_press
from dt_viz.ui.panel import ControlPanel
from dt_viz.ui.playback import Playback
from dt_viz.ui.ruler import Ruler
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.anchors import Anchors
from dt_viz.ui.scene.arm import ArmPicture
from dt_viz.ui.scene.arm_layers import Arms
from dt_viz.ui.scene.comparison import TheirArm
from dt_viz.ui.scene.drawing import Drawing
from dt_viz.ui.scene.export import RESOLUTIONS, render_png
from dt_viz.ui.scene.grip import Grip
from dt_viz.ui.scene.objects import Objects
from dt_viz.ui.scene.obstacles import Obstacles
from dt_viz.ui.scene.picture import Colour
from dt_viz.ui.scene.scene import ScenePictures
from dt_viz.ui.scene.slice import MovableSlice
from dt_viz.ui.scene.starts import Starts
from dt_viz.ui.scene.tripod import Tripod
from dt_viz.ui.scene.way import WayAhead


def initial_scenario(engine: Engine, task: str) -> Scenario:
    """Return the scenario that a task begins with. Raises what `Engine.task` raises."""
    scenario = Scenario(task)
    sphere = Sphere(engine.task(task).obstacle_position)
    return replace(scenario, stack=with_avoidance(scenario, obstacles=(sphere,)))


def notify(client: viser.ClientHandle, text: str, colour: Colour) -> None:
    """Show a text in a colour beside the panel of a visitor for a while."""
    client.add_notification("DT-Viz", text, color=colour, auto_close_seconds=12.0)


class Visitor(Display):
    """Shows a session in the browser of one visitor."""

    def __init__(
        self, client: viser.ClientHandle, engine: Engine, robot: Robot, titles: Mapping[str, str], task: str
    ) -> None:
        """Build the page and start computing.

        Args:
            client: connection of the visitor.
            engine: engine of this visitor only.
            robot: robot to draw.
            titles: titles of the tasks, by name.
            task: name of the first task.
        """
        self.client = client
        self.shown: Frame | None = None
        """The last drawn frame."""
        self._view = View()
        """The view that was adopted last."""
        self._dark = False
        self._set_theme()
        client.gui.set_panel_label("DT-Viz")
        with client.atomic():
            self.pictures = ScenePictures(
                client.scene,
                robot,
                Obstacles(client.scene, self._obstacle_moved, self._obstacle_grabbed, self._obstacle_clicked),
                Anchors(client.scene, self._anchor_moved, self._anchor_grabbed, self._anchor_clicked),
                MovableSlice(client.scene, self._slice_moved),
                Starts(client.scene, self._start_moved, self._start_chosen, self._start_clicked),
            )
            self.arms = Arms(client.scene, robot)
            self.their_arm = TheirArm(client.scene, robot)
            self.objects = Objects(client.scene)
            self.drawing = Drawing(client.scene, self.arm.frames[-1].name, robot.end_effector_offset)
            self.way = WayAhead(client.scene, self.pictures.middles)
            self.grip = Grip(client.scene, robot, self.arm.frames[-1].name, self._hand, self._hand_held)
        self._robot = robot
        self._posed: tuple[bytes, bool] | None = None
        """The posture that was drawn last, and whether with that without avoidance."""
        self.playback = Playback(engine.arm, self._pose)
        """What moves the arm."""
        self._tripod = Tripod(client, self._hand)
        self._panel = ControlPanel(
            client.gui, titles, robot, self._save_png, partial(notify, client), self._tripod, self._darken
        )
        self.session = Session(engine, lambda name: initial_scenario(engine, name), task, self)
        self._panel.connect(self.session)
        on_press(self._panel.push, engine.arm.push)
        self.ruler = Ruler()
        """What the visitor's window is measured with."""
        self.playback.begin(self.session.jobs, self.session.fail)
        keep_ready(self)

    @property
    def arm(self) -> ArmPicture:
        """The arm in the scene."""
        return self.arms.arm

    def measure(self) -> None:
        """Have the browser measure its window from now on."""
        self.client.gui.add_html(self.ruler.html)

    def measured(self, width: float) -> None:
        """Take the width that the window has at least, CSS pixels."""
        self._tripod.width = width

    def draw(self, frame: Frame, pace: Pace) -> None:
        beside = tuple(panel.shown for panel in frame.pictures.panels)
        others = frame.stage is not Stage.ROLLOUTS and len(beside) != len(self._tripod.panels)
        if self.shown is None or frame.task is not self.shown.task or others:
            self._tripod.look(frame.task, beside)
        with self.client.atomic():
            self.pictures.draw(frame)
            self.their_arm.draw(frame)
            self.their_arm.show(bool(self._view.their_arm))
            self.objects.stand(frame.task)
            self.drawing.stand(frame.task)
            if frame.blocked or frame.stage is not Stage.ROLLOUTS:  # until then the arm stays where it was
                self.arm.stale = self._view.replay and (bool(frame.blocked) or self.pictures.stale)
        if frame.stage is not Stage.ROLLOUTS:
            self.playback.replay.motion = frame.arm
            self.grip.draw(frame, live=not self._view.replay)
            self._panel.report(frame)
        self.client.flush()
        self.shown = frame

    def adopt(self, scenario: Scenario) -> None:
        with self.client.atomic():
            self.pictures.adopt(scenario)
            self._view = view = scenario.view
            self.arm.stale = view.replay and (self.arm.stale or self.pictures.stale)
            self.arms.show(view)
            self.their_arm.show(bool(view.their_arm))
            self.objects.show(arm=view.arm)
            self.drawing.show(arm=view.arm)
            self.way.visible = view.arm and not view.replay
            self.grip.ball.visible = not view.replay
            if view.replay:  # a drag of the ball ends without an event
                self.playback.live.release()
                self.way.forget()
        self.playback.play(view.playing, view.speed, replays=view.replay)
        self._panel.adopt(scenario)

    def tell(self, progress: Progress) -> None:
        self._panel.tell(progress)

    def close(self) -> None:
        """Stop all work: the visitor has left."""
        let_go(self)
        self.session.close()

    @contextmanager
    def _dragging(self, phase: str) -> Iterator[Scenario]:
        """Take the edits of a drag together for undo; yields the scenario to edit."""
        if phase == "start":
            self.session.begin_gesture()
        yield self.session.scenario
        if phase == "end":
            self.session.end_gesture()

    def _obstacle_moved(self, index: int, position: Array, wxyz: Array, phase: str) -> None:
        with self._dragging(phase) as scenario:
            obstacles = list(scenario.obstacles)
            if index < len(obstacles):  # or it was deleted a moment ago
                obstacles[index] = obstacles[index].moved(as_point(position), as_quaternion(wxyz))
                self.session.edit(f"obstacle {index}", stack=with_avoidance(scenario, obstacles=tuple(obstacles)))

    def _obstacle_grabbed(self, index: int) -> None:
        self.session.edit("select", view=replace(self.session.scenario.view, selected=index))

    def _obstacle_clicked(self, index: int) -> None:
        scenario = self.session.scenario
        handles = not (scenario.view.handles and index == scenario.selected)
        self.session.edit("select", view=replace(scenario.view, selected=index, handles=handles))

    def _anchor_moved(self, name: str, position: Array, phase: str) -> None:
        with self._dragging(phase) as scenario:
            transform = transform_of(scenario, name)
            if transform is not None:  # or it was deleted a moment ago
                moved = transform.anchored(as_point(position))
                self.session.edit(name, stack=with_transform(scenario, name, moved))

    def _start_moved(self, index: int, position: Array, phase: str) -> None:
        with self._dragging(phase) as scenario:
            self.session.edit(f"start {index}", starts=with_moved_start(scenario, index, position))

    def _start_chosen(self, index: int) -> None:
        if index < len(self.session.scenario.starts):  # or it was removed a moment ago
            self.session.edit("Follows rollout", arm_rollout=len(self.session.task.demonstrations) + index)

    def _start_clicked(self, place: Array) -> None:
        scenario = self.session.scenario
        arm_rollout = followed(scenario, len(self.session.task.demonstrations))
        self.session.edit("add start", starts=with_start(scenario, place), arm_rollout=arm_rollout)
        self.session.end_gesture()

    def _anchor_grabbed(self, name: str) -> None:
        self.session.edit("select", view=replace(self.session.scenario.view, bias=name))

    def _anchor_clicked(self, name: str) -> None:
        scenario = self.session.scenario
        handles = not (scenario.view.bias_handles and name == selected(scenario))
        self.session.edit("select", view=replace(scenario.view, bias=name, bias_handles=handles))

    def _slice_moved(self, position: Array, wxyz: Array, phase: str) -> None:
        with self._dragging(phase) as scenario:
            pose = SlicePose(as_point(position), as_quaternion(wxyz))
            self.session.edit("slice", view=replace(scenario.view, slice=pose))

    def _hand(self) -> Array | None:
        q = self.playback.q
        return None if q is None else self._robot.end_effector(q)

    def _hand_held(self, place: Array, phase: str) -> None:
        self.playback.live.hold(place)
        if phase == "end":
            self.playback.live.release()

    def _pose(self) -> None:
        """Draw the arm in its posture, its way, and what it carries."""
        q, view, now = self.playback.q, self._view, time.monotonic()
        self._tripod.turn(now)
        if q is None:
            return
        hand, live = self._robot.end_effector(q), self.playback.live
        posed = q.tobytes(), view.ghost_arm or view.body_points
        moves = posed != self._posed
        # a block wakes the connection, also if nothing is sent
        drawn = moves or bool(view.their_arm) or self.way.is_due(now)
        with self.client.atomic() if drawn else nullcontext():
            if moves:
                self._posed = posed
                without = self.playback.without if posed[1] else None
                self.arms.pose(q, q if without is None else without)
            self.their_arm.pose(q, view.speed if view.playing else 0.0, arrived=self.playback.arrived > 0)
            self.objects.pose(hand, self.playback.arrived)
            self.drawing.pose(now, hand, self.playback.arrived)
            self.pictures.rollouts.fade()
            if not view.replay:
                self.way.show(now, hand, lambda: live.ahead)
                self.grip.say(live.note)

    def _set_theme(self) -> None:
        self.client.gui.configure_theme(
            dark_mode=self._dark, show_logo=False, show_share_button=False, brand_color=palette.BRAND
        )

    def _darken(self, dark: bool) -> None:
        """Begin the dark theme, or the light one, on the panel and in the scene."""
        self._dark = dark
        self._set_theme()
        self._dye(dark)

    def _dye(self, dark: bool) -> None:
        with self.client.atomic():
            self.pictures.dye(dark)
            self.way.dye(dark)
            self.drawing.dye(dark)

    @contextmanager
    def _light(self) -> Iterator[None]:
        """Show the scene in light colours for as long as a picture takes, which is on white."""
        if self._dark:
            self._dye(False)
        try:
            yield
        finally:
            if self._dark:
                self._dye(True)

    def _save_png(self, resolution: str, transparent: bool) -> None:
        with self.pictures.without_handles(), self.grip.without_handles(), self._light():
            content = render_png(self.client, RESOLUTIONS[resolution], self._panel.legend, transparent=transparent)
        name = f"dt-viz-{self.session.scenario.task}.png"
        self.client.send_file_download(name, content, save_immediately=True)
