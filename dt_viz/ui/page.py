"""The page of one visitor: a private scene, panel and session, tied together.

The trip of a drag, from the browser and back:

1. `scene.draggables` takes the new place on the server's event loop, checked, and calls `Session.edit`.
2. `Session.edit` puts it into the frozen scenario and submits that; the newest replaces what waits.
3. A thread of the session's jobs waits for its slot of `scheduler`, and iterates over `Engine.frames`.
4. `motion.solve` stacks the transforms on what was learned, and computes the rollouts; the arm follows one of them.
5. `Page.draw` gives the frame to `ScenePictures` and `RobotScene`, which change what differs in viser's scene.
6. `Page.adopt` shows the scenario on the controls, and `ControlPanel.report` the figures of the frame.
7. The field, finer rollouts and certificates come as frames of later stages, unless a newer edit waits.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import viser

from dt_viz.baselines.registry import others
from dt_viz.errors import Cancelled, DataError, never
from dt_viz.obstacles.shapes import TriangleObstacle, as_point
from dt_viz.robot.robot import Robot
from dt_viz.scenario.own import Own
from dt_viz.scenario.relocation import in_world
from dt_viz.scenario.saved import Known, Saved, Sight, encode, is_saved
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.stack import with_avoidance
from dt_viz.scenario.tasks import OWN, TASKS, Task
from dt_viz.scheduler import SCHEDULER, Rank
from dt_viz.serving.board import Share
from dt_viz.session.arms import ArmStore
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.opening import Preview
from dt_viz.session.progress import Display, Pace, Progress
from dt_viz.session.session import Session
from dt_viz.ui.bindings import EDITS
from dt_viz.ui.host import Host
from dt_viz.ui.keeping import Keeper
from dt_viz.ui.panel import ControlPanel
from dt_viz.ui.playback import Playback
from dt_viz.ui.scene.camera import CameraController, Pose
from dt_viz.ui.scene.export import Studio
from dt_viz.ui.scene.palette import DARK, LIGHT, Colour, Theme
from dt_viz.ui.scene.robot_scene import RobotScene
from dt_viz.ui.scene.scene import ScenePictures
from dt_viz.ui.scripts import KINDS, Window, report_window
from dt_viz.warning import Severity

BRIEF = 5.0
"""Time for which a notice lies over the scene whose text stays longer in the status line, seconds."""


def initial(task: Task) -> Scenario:
    """Return the scenario that a task begins with."""
    scenario = Scenario(task.name)
    if task.layers:
        return replace(scenario, stack=in_world(task))
    return replace(scenario, stack=with_avoidance(scenario, obstacles=(task.sphere(),)))


def known_names(tasks: Collection[str], arms: Collection[str]) -> Known:
    """Return the names that a scenario may have on a page of these tasks and arms."""
    return Known(tasks, arms, tuple(method.name for method in others()))


def _takes_long(saved: Saved) -> bool:
    """Whether another arm, surfaces of obstacles, or a task are to be made for a scenario before it is shown."""
    shapes = any(isinstance(obstacle, TriangleObstacle) for obstacle in saved.scenario.obstacles)
    return bool(saved.scenario.arm) or saved.scenario.task.startswith(OWN) or shapes


def pose_of(sight: Sight | None) -> Pose | None:
    """Return where a camera is that a scenario was saved with."""
    return None if sight is None else (np.array(sight[0]), np.array(sight[1]))


def _sight(pose: Pose | None) -> Sight | None:
    return None if pose is None else (as_point(pose[0]), as_point(pose[1]))


def notify(client: viser.ClientHandle, text: str, colour: Colour, seconds: float = 12.0) -> None:
    """Show a text in a colour over a corner of a visitor's scene for so long."""
    client.add_notification("DT-Viz", text, color=colour, auto_close_seconds=seconds)


class Page(Display, Host):
    """A visitor's scene, panel and session; what controls use of it is `host.Host`."""

    def __init__(
        self,
        client: viser.ClientHandle,
        engine: Engine,
        robot: Robot,
        titles: Mapping[str, str],
        task: str,
        arms: ArmStore | None = None,
        share: Share | None = None,
        begins: Saved | None = None,
        scenarios: Mapping[str, Saved] = MappingProxyType({}),
        cancelled: Cancelled = never,
    ) -> None:
        """Build the page for an engine of its own and start computing; there is one arm where there are no `arms`.

        Where the browser keeps nothing, the page `begins` with a scenario, or else as the task does; a link may name
        one of the `scenarios`. Edits and pictures are counted in the `share` of this process.

        Raises:
            UnwantedError: it is cancelled before the page is built.
        """
        self.client, self._share = client, share
        self.shown: Frame | None = None  # the last drawn frame
        self._previews: bool | None = False  # None: what was seen is being learned, and stays until then
        """Whether takes are seen that are not learned yet, and whether they are being learned."""
        self._dress(LIGHT)
        client.gui.set_panel_label("DT-Viz")
        titled = {"": robot.title} if arms is None else arms.titles
        self._keeper = Keeper(client.local_storage, known_names(titles, titled), self._made, begins)
        self._exchanging = threading.RLock()  # the arm is moved, drawn, and shown or hidden, by different threads
        with SCHEDULER.slot(Rank.FIRST_PICTURE, cancelled), client.atomic():
            self.pictures = ScenePictures(client.scene, robot, lambda: self.session)
            self.robot = RobotScene(client, robot, Playback(engine.arm, self._pose))
            self.studio = Studio(self)
            self.camera = CameraController(client, lambda: self.robot.hand, robot.size, self._keeper.changed)
            self._panel = ControlPanel(self, titles, titled, robot, scenarios)
        begun = self._keeper.begun
        at_once = None if begun is None or _takes_long(begun) else begun.scenario
        begins_like = lambda engine, name: initial(engine.task(name))  # noqa: E731
        self.session = Session(engine, begins_like, task, self, arms and arms.engine, at_once)
        self._panel.connect(self.session)
        self._keeper.begin(self.session, self.resume)
        self._panel.tour.begin(self.session)
        self.robot.playback.begin(self.session.jobs, self.session.fail)

    def measure(self) -> None:
        """Have the page report its window and its link from now on."""
        report_window(self.client, self.reported, KINDS)

    def reported(self, window: Window) -> None:
        """Frame the scene for the window's width, and open what the page's link asks for."""
        self.camera.measured(window.width)
        if window.link is not None:
            self._panel.follow(self.session, window.link)

    @property
    def headline(self) -> str:
        """What is shown, and its status, as HTML."""
        return self._panel.headline

    def draw(self, frame: Frame, pace: Pace) -> None:
        with self.studio.drawing:  # a video ends before what was edited meanwhile is drawn
            self._draw(frame)
        if self._share is not None:
            self._share.count("edits", pace.num_edits)
            if frame.stage is Stage.ROLLOUTS:
                self._share.answered(pace.latency)

    def _draw(self, frame: Frame) -> None:
        beside = tuple(panel.shown for panel in frame.pictures.panels)
        if frame.scenario.arm != (self.shown.scenario.arm if self.shown else ""):
            self._exchange(frame.scenario.arm)
        settled = frame.stage is not Stage.ROLLOUTS and not self.previews
        others = settled and len(beside) != len(self.camera.panels)
        if self.shown is not None and frame.task is not self.shown.task:
            self.robot.playback.resume()
        if self.shown is None or frame.task is not self.shown.task or others:
            self.camera.look(frame.task, beside)
        if (pose := pose_of(self._keeper.sight(frame))) is not None:
            self.camera.choose(pose)
            self._keeper.changed()
        with self.client.atomic():
            self.pictures.draw(frame)
            with self._exchanging:
                self.robot.draw(frame, self.pictures.look)
        if frame.stage is not Stage.ROLLOUTS:
            self._panel.report(frame)
        self.client.flush()
        self.shown = frame

    def adopt(self, scenario: Scenario) -> None:
        with self.changing():
            self.pictures.adopt(scenario)
            self.robot.adopt(scenario.view, self.pictures.look)
        self._panel.adopt(scenario)
        self._keeper.changed()

    def tell(self, progress: Progress) -> None:
        self._panel.tell(progress)
        if self._previews is None and (progress.failed or not progress.stale):
            self._end_preview()  # what was seen is learned, or will not be

    def close(self) -> None:
        """Stop all work: the visitor has left."""
        self.session.close()

    def _made(self, tasks: Collection[str]) -> Saved:
        """What the visitor has made, beside the tour, with the task unless it is one of these."""
        pose = self._panel.tour.pose if self.session.visits else self.camera.chosen
        scenario, lesson = self.session.own, self._panel.opening.lesson
        task = self.session.engines(scenario.arm).task(scenario.task)
        own = None if scenario.task in tasks else Own.of(task)
        return Saved(scenario, _sight(pose), own, None if task.lesson == lesson else lesson)

    def came_back(self, pose: Pose | None) -> None:
        self._keeper.go_on(Saved(self.session.own, _sight(pose)))

    def resume(self, saved: Saved) -> None:
        self._panel.resume(saved)

    def began(self, saved: Saved) -> None:
        self._keeper.go_on(saved)

    def save(self) -> None:

        def send() -> None:
            try:
                content = encode(self._made(TASKS)).encode()
            except DataError as error:
                self.session.say(str(error), Severity.ALARM)
            else:
                self.send(".json", content)

        self.session.jobs.submit(EDITS, send)

    def open(self, name: str, content: bytes) -> bool:
        if not is_saved(content):
            return False
        self.resume(self._keeper.read(content, name))
        return True

    def preview(self, seen: Preview | None, number: int | None) -> None:
        if number is None:
            self._previews = None
        elif seen is None:
            self._end_preview()
        else:
            before, self._previews = self._previews, True
            with self.client.atomic():
                self.pictures.preview(seen, number)
                self.robot.set_aside(True)
            if seen.task is not None and not before:
                self.camera.look(seen.task)
            self.client.flush()
        self._keeper.changed()

    def _end_preview(self) -> None:
        self._previews = False
        with self.client.atomic():
            self.pictures.preview(None, 0)
            self.robot.set_aside(False)
        if self.shown is not None:
            self.camera.look(self.shown.task, tuple(panel.shown for panel in self.shown.pictures.panels))
        self.client.flush()

    def face(self, board: Slice | None) -> None:
        if self.shown is not None:
            self.camera.look(self.shown.task, () if board is None else (board,))

    def _pose(self) -> None:
        now = time.monotonic()
        self.camera.turn(now)
        with self._exchanging:
            if self.robot.playback.film is None:
                self.robot.pose(now, self.pictures.look.tubes)
                self._panel.show.timeline.follow(self.robot.playback)
        self.session.let_pass()

    def _exchange(self, name: str) -> None:
        """Draw the arm of a name in place of the one that is drawn."""
        engine = self.session.engines(name)
        robot = engine.follower.robot
        with self.changing():
            self.robot.remove()
            self.robot = RobotScene(self.client, robot, Playback(engine.arm, self._pose))
            self.pictures.take(self.client.scene, robot)
            self.robot.paint(self.studio.theme)
            self.robot.adopt(self.session.scenario.view, self.pictures.look)
            self.robot.set_aside(self.previews)
            self._panel.take(robot)
        self.robot.playback.begin(self.session.jobs, self.session.fail)  # and the one before ends
        self.camera.reframe(arm_size=robot.size)

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Show what is changed within this block together, and have no other thread change the arm meanwhile."""
        with self.client.atomic(), self._exchanging:
            yield

    def _dress(self, theme: Theme) -> None:
        self.client.gui.configure_theme(
            dark_mode=theme is DARK, show_logo=False, show_share_button=False, brand_color=LIGHT.brand
        )

    def darken(self, dark: bool) -> None:
        self.studio.theme = DARK if dark else LIGHT
        self._dress(self.studio.theme)
        self.studio.paint()

    @property
    def previews(self) -> bool:
        """Whether takes that are not learned yet are seen in place of the motion."""
        return self._previews is not False

    def notify(self, text: str, colour: Colour) -> None:
        notify(self.client, text, colour, seconds=BRIEF)

    def send(self, suffix: str, content: bytes) -> None:
        name = "-".join(filter(None, ("dt-viz", self.session.scenario.task, self.session.scenario.arm)))
        self.client.send_file_download(f"{name}{suffix}", content, save_immediately=True)
