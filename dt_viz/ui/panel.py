"""The control panel: task and scene, the status, the tabs, commands and the foot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import viser

from dt_viz.avoidance.avoidance import Space
from dt_viz.robot.placement import is_jaco
from dt_viz.robot.robot import Robot
from dt_viz.scenario.paper_scenes import SCENES, PaperScene, found, offered
from dt_viz.scenario.saved import Saved, check_shapes
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoidance_layer, avoiding_with
from dt_viz.scenario.tasks import Task
from dt_viz.session.frame import Frame
from dt_viz.session.history import Camera
from dt_viz.session.progress import Progress
from dt_viz.session.session import CHOICES, Session
from dt_viz.ui import patches
from dt_viz.ui.bindings import Bindings, Control
from dt_viz.ui.host import Host
from dt_viz.ui.scene.camera import Pose
from dt_viz.ui.scripts import Link
from dt_viz.ui.tabs.about import Command, add_about, add_commands, numbered
from dt_viz.ui.tabs.arm import add_arm, add_joints
from dt_viz.ui.tabs.compare import ComparePanel
from dt_viz.ui.tabs.opening import OpenPanel, TeachPanel
from dt_viz.ui.tabs.picture import PictureTab, Presentation, big_type
from dt_viz.ui.tabs.show import ShowTab
from dt_viz.ui.tabs.stack import StackPanel
from dt_viz.ui.tabs.status import COLOURS, StatusLine, hint, hint_html, sentence
from dt_viz.ui.tabs.timeline import PAST
from dt_viz.ui.tabs.tour import NUMBERS, Tour
from dt_viz.ui.tabs.world import add_obstacles, add_starts, add_transforms
from dt_viz.warning import Severity

NO_SCENE = "–"
OFF = "Off"
DELETE = "Delete this task"
HISTORY = {
    "Undo": "takes the last change back (key Z)",
    "Redo": "makes the change again that was taken back (Shift Z)",
    "Reset": "back to how all began, camera too (R); Undo brings it back",
    "Save": "a file of what is shown; “Open a file” goes on with it",
}
"""Hints of the buttons of the history."""
SPACES: Mapping[str, Space] = {"Hand": "task", "Arm": "cspace"}
"""Spaces of the avoidance, by their names on the page."""


class ControlPanel:
    """The control panel of one visitor."""

    def __init__(
        self,
        page: Host,
        titles: Mapping[str, str],
        arms: Mapping[str, str],
        robot: Robot,
        scenarios: Mapping[str, Saved] = MappingProxyType({}),
    ) -> None:
        """Build the controls of a page; they act once `connect` has given a session.

        Args:
            page: what the controls act on.
            titles: of the tasks, by name.
            arms: titles of the arms, by name.
            robot: the first arm.
            scenarios: those that a link may name.
        """
        gui, self._page, self._titles, self._scenarios = page.client.gui, page, lambda: titles, scenarios
        self._scenes = {scene.title: scene for scene in offered(titles)}
        self.bindings = bindings = Bindings()
        self.presentation = Presentation(gui, self._turn, lambda alone: page.camera.reframe(alone=alone))
        bindings.show(self._title, lambda title: self.presentation.write(title=title))
        enlarge = big_type(gui, page.camera)
        self.tour = Tour(gui, bindings, page, self.choose)
        self._scene, self.opening = self._add_choices(
            gui, lambda name, content: page.open(name, content) or loader.takes(name, content)
        )
        self.hint = gui.add_html(hint_html(""))
        add_avoid_and_imitate(gui, bindings)
        self.status = StatusLine(gui, bindings)
        save = lambda _session: page.save()  # noqa: E731
        travels = {"Undo": Session.undo, "Redo": Session.redo, "Reset": self._reset, "Save": save}
        for button, act in travels.items():
            group = gui.add_button_group("History" if button == "Undo" else button, (button,), hint=HISTORY[button])
            bindings.on(group, lambda session, _pressed, act=act: act(session))
        gui.add_html(patches.PANEL)
        tabs = gui.add_tab_group()
        with tabs.add_tab("World"):
            loader = add_obstacles(gui, bindings)
            add_transforms(gui, bindings)
            add_starts(gui, bindings)
        with tabs.add_tab("Stack"):
            StackPanel(gui, bindings)
        with tabs.add_tab("Show"):
            self.show = ShowTab(gui, bindings, page.send)
        with tabs.add_tab("Arm"):
            add_arm(gui, bindings, arms, self.begin, lambda session: self.show.timeline.show(session, PAST))
            add_joints(gui, bindings, page.send)
        with tabs.add_tab("Compare"):
            ComparePanel(gui, bindings, page.send)
        with tabs.add_tab("Picture"):
            picture = PictureTab(gui, bindings, page, self.presentation, enlarge)
        commands = self._commands(gui.main_panel, picture, save)
        add_commands(gui, bindings, commands)
        add_about(gui, bindings, commands, self.tour.take)
        self.take(robot)

    def take(self, robot: Robot) -> None:
        """Plot the joints of another arm, and offer the scenes that it has."""
        self.show.plots.take(robot)
        offers = {scene.title: scene for scene in offered(self._titles(), jaco=is_jaco(robot))}
        if offers != self._scenes:
            self._scenes, self._scene.handle.options = offers, (NO_SCENE, *offers)

    def connect(self, session: Session) -> None:
        """Let the controls edit this session."""
        shipped = self._titles()
        self._titles = lambda: {**shipped, **{name: task.title for name, (task, _) in session.taught.items()}}
        self.bindings.connect(session)

    @property
    def headline(self) -> str:
        """Title and status of what is shown, as HTML."""
        return f"<h3 style='margin:0.4em 0.7em'>{self.presentation.title}</h3>{self.status.judgement}"

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's choices."""
        self.bindings.adopt(scenario)

    def report(self, frame: Frame) -> None:
        """Show what a frame tells, unless another task or scene was chosen meanwhile."""
        wanted = self.bindings.scenario
        if wanted is None or frame.scenario.begins_like(wanted):
            self.bindings.report(frame)
            self.show.plots.draw(frame)

    def tell(self, progress: Progress) -> None:
        """Show the verdict on what is shown, its hint, and a message, which is for a while beside the panel, too."""
        notified = self.status.message
        self.status.tell(progress)
        text = "" if progress.shown is None or progress.stale else hint(progress.shown)
        step = self.tour.step
        self.hint.content = hint_html(text if step is None else "")
        self.presentation.write(caption=text if step is None else step.text)
        message = progress.message
        if message is not None and message is not notified:
            self._page.notify(sentence(message.text), COLOURS[message.severity][0])

    def _add_choices(self, gui: viser.GuiApi, take: Callable[[str, bytes], bool]) -> tuple[Control, OpenPanel]:
        """Add the dropdowns of tasks and scenes, and what opens recordings; return that of the scenes, and this."""

        def choose(session: Session, title: str) -> None:
            session.choose_task(next(name for name, other in self._titles().items() if other == title))

        shipped = self._titles()
        tasks = gui.add_dropdown("Task", tuple(shipped.values()), hint="what is learned from demonstrations")
        self.bindings.properties(tasks, options=lambda _: tuple(self._titles().values()))
        self.bindings.choice(tasks, lambda s: self._titles()[s.task], partial(self.begin, choose))
        hint = "out of the list and of this browser; Undo brings it back"
        delete = gui.add_button_group("Own task", (DELETE,), hint=hint, visible=False)
        self.bindings.on(delete, partial(self.begin, self._delete), visible=lambda s: s.task not in shipped)
        opening = OpenPanel(gui, self.bindings, self._page, self._learn, take)
        scenes = self.bindings.choice(
            gui.add_dropdown("Scene", (NO_SCENE, *self._scenes), hint="scenes of the paper's figures"),
            lambda s: SCENES[s.scene].title if s.scene in SCENES else NO_SCENE,
            partial(self.begin, self._load),
        )
        TeachPanel(gui, self.bindings, opening)
        return scenes, opening

    def _learn(self, session: Session, task: Task) -> None:
        """Begin with a task of the visitor's own: with the present choices, or as a saved motion begins."""

        def begin(session: Session, _title: str) -> None:
            choose = session.choose_task if task.imitation is None else session.begin_task
            choose(session.bring(task).name)

        self.begin(begin, session, task.title)

    def _delete(self, session: Session, _title: str) -> None:
        """Take the visitor's own task that is shown out of the list, and begin the one before it."""
        name, titles = session.scenario.task, self._titles()
        if name in session.taught:
            session.delete(name, [*titles][[*titles].index(name) - 1])
            session.say(f"“{titles[name]}” is deleted; Undo brings it back.", Severity.NOTE)

    def resume(self, saved: Saved) -> None:
        """Go on with what was saved, beside the server's event loop. If that fails, say why and stay."""

        def begin(session: Session, _title: str) -> None:
            scenario = saved.scenario
            check_shapes(scenario)
            if saved.own is not None:
                scenario = replace(scenario, task=session.bring(saved.own.task, scenario.arm).name)
            self._page.began(replace(saved, scenario=scenario))
            session.restore(scenario)
            if saved.lesson is not None:
                self.opening.reopen(saved.lesson)

        self.begin(begin, self._page.session, "")

    def _title(self, scenario: Scenario) -> str:
        if self.tour.step is not None:
            return self.tour.step.title
        return SCENES[scenario.scene].title if scenario.scene in SCENES else self._titles()[scenario.task]

    def _turn(self, step: int) -> None:
        """Go to a scene so many places after the shown one, before the first is the last; or to a step of the tour."""
        scenario, titles = self.bindings.scenario, tuple(self._scenes)
        if self.tour.step is not None:
            self.tour.turn(self.bindings.session, step)
        elif scenario is not None:
            title = self._title(scenario)
            shown = titles.index(title) if title in titles else min(-step, 0)
            self.begin(self._load, self.bindings.session, titles[(shown + step) % len(titles)])

    def _load(self, session: Session, title: str) -> None:
        if title == NO_SCENE:
            session.leave_scene()
        elif title in self._scenes:
            session.load(self._scenes[title].task, prepared(self._scenes[title]))
        else:
            session.say(f"“{title}” is made for the JACO: choose it in Arm → Model.", Severity.WARNING)

    def follow(self, session: Session, link: Link) -> None:
        """Begin the scene, the task, the tour or the scenario that a link asks for; where there is none, say so."""
        scene = found(link.name, self._scenes.values()) if link.kind == "scene" else None
        names = {"scene": [each.name for each in self._scenes.values()], "task": self._titles(), "tour": NUMBERS}
        names["scenario"] = self._scenarios
        if scene is not None:
            self.begin(self._load, session, scene.title)
        elif link.kind == "task" and link.name in names["task"]:
            self.begin(lambda session, _title: session.begin_task(link.name), session, self._titles()[link.name])
        elif link.kind == "tour" and link.name in ("", *NUMBERS):
            self.tour.take(session, int(link.name or 1) - 1)
        elif link.kind == "scenario" and link.name in self._scenarios:
            self._page.resume(self._scenarios[link.name])
        else:
            accepted = ", ".join(names[link.kind])[:200] or "none: this server offers none"
            text = f"The link: {link.kind}: found {link.name!r}; accepted: {accepted}"
            session.say(text, Severity.WARNING)

    def begin(self, begin: Callable[[Session, str], None], session: Session, title: str) -> None:
        """Begin a task, a scene or an arm, with the visitor's own scenario where the tour was on; see `choose`."""

        def own(session: Session, title: str) -> None:
            self.tour.leave(session)
            begin(session, title)

        self.choose(own, session, title)

    def choose(self, begin: Callable[[Session, str], None], session: Session, title: str) -> None:
        """Begin something beside the server's event loop; if that fails, show why and stay."""

        def work() -> None:
            session.expect(True)
            try:
                begin(session, title)
            except Exception:
                self.bindings.restore()
                raise
            finally:
                session.expect(False)

        session.expect(True)
        session.jobs.submit(CHOICES, work, latest=True)

    def _commands(
        self,
        panel: Any,  # noqa: ANN401 - viser's, without a name
        picture: PictureTab,
        save: Callable[[Session], None],
    ) -> list[Command]:
        folded = False  # a visitor may unfold it by hand, which nobody is told of

        def fold(_session: Session) -> None:
            nonlocal folded
            if not self.presentation.on:  # its caption would go, too
                folded = not folded
                (panel.minimize if folded else panel.expand)()

        def leave(session: Session) -> None:
            if not (self.presentation.on or self.opening.folder.visible):
                self.tour.end(session)
            self.presentation.show(False)
            self.opening.later(self.opening.close)

        return [
            *self.show.timeline.commands,
            Command("Reset the scene and the camera", self._reset, "R"),
            Command("Undo", Session.undo, "Z"),
            Command("Redo", Session.redo, "Z", shifted=True),
            Command("Save the scenario as a file", save),
            *picture.commands,
            Command("Take the tour", self.tour.take),
            Command("Hide the panel, or show it", fold, "H"),
            Command("End the presentation, what is taught or opened, or else the tour", leave, "escape"),
            *self.presentation.commands,
            *numbered(tuple(self._scenes), partial(self.begin, self._load)),
        ]

    def _reset(self, session: Session) -> None:
        """Reset the session and the camera; in the tour, begin the step anew."""
        camera = self._page.camera

        def put_back(pose: Pose | None) -> None:
            camera.view()
            self._page.came_back(pose)

        if self.tour.step is not None:
            self.tour.turn(session, 0)
            return
        session.reset(Camera(lambda: camera.chosen, put_back))
        camera.view()


def add_avoid_and_imitate(gui: viser.GuiApi, bindings: Bindings) -> None:
    """Build the dropdown "Avoid" and the checkbox "Imitate" where the panel is being built."""
    hint = "what gives way to the obstacles. Hand: the path of the hand, and the arm follows it. Arm: the whole arm"
    bindings.input(
        gui.add_dropdown("Avoid", (OFF, *SPACES), hint=hint),
        avoids_with,
        lambda s, name: {"stack": avoiding_with(s, SPACES.get(name))},
    )
    hint = "off: without what was learned, every motion is straight to the goal, and still avoids"
    bindings.field(gui.add_checkbox("Imitate", True, hint=hint), "imitation")


def avoids_with(scenario: Scenario) -> str:
    """Name of what avoids the page's obstacles."""
    layer = avoidance_layer(scenario)
    return ("Hand" if scenario.arm_avoidance is None else "Arm") if layer.on else OFF


def prepared(scene: PaperScene) -> Callable[[Task], Scenario]:
    """Return a function that makes the scene's scenario, with the surfaces of its obstacles, which take seconds."""

    def scenario(task: Task) -> Scenario:
        begun = scene.scenario(task)
        for obstacle in begun.obstacles:
            obstacle.surface()
        return begun

    return scenario
