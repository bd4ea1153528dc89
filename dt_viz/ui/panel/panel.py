"""Controls ↔ scenario, and the status."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import viser

from dt_viz.errors import DataError
from dt_viz.learning.imitation import ImitationError
from dt_viz.robot.robot import Robot
from dt_viz.scenario.paper_scenes import SCENES, PaperScene, offered
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import side_by_side
from dt_viz.scenario.tasks import Task
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.session import Pace, Session
from dt_viz.session.worker import LatestWorker
from dt_viz.ui.chores import Chores
from dt_viz.ui.controls import Control, on_press
from dt_viz.ui.panel.about import add_about
from dt_viz.ui.panel.avoid import add_avoid_and_imitate
from dt_viz.ui.panel.big_type import BigType
from dt_viz.ui.panel.bindings import KEEP, Bindings
from dt_viz.ui.panel.camera import CameraControls
from dt_viz.ui.panel.commands import Command, Curtain, add_commands, numbered
from dt_viz.ui.panel.compare import ComparePanel
from dt_viz.ui.panel.disturbances import Disturbances
from dt_viz.ui.panel.health_plots import HealthPlots
from dt_viz.ui.panel.obstacles import ObstaclePanel
from dt_viz.ui.panel.plots import JointPlots
from dt_viz.ui.panel.presentation import Presentation
from dt_viz.ui.panel.push import PushButton
from dt_viz.ui.panel.slice import SlicePanel
from dt_viz.ui.panel.stack import StackPanel
from dt_viz.ui.panel.starts import StartsPanel
from dt_viz.ui.panel.status import COLOURS, HINT, INK, hint, place_html, sentence
from dt_viz.ui.panel.status_line import StatusLine
from dt_viz.ui.panel.transforms import add_transform_controls
from dt_viz.ui.panel.verdict import Level
from dt_viz.ui.scene.arm import NUM_ARMS
from dt_viz.ui.scene.camera import CameraController
from dt_viz.ui.scene.export import RESOLUTIONS, PictureSaver
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import Colour

VIEW_LABELS: Mapping[str, str] = {
    "rollouts": "Rollouts",
    "ghost": "Undisturbed motions",
    "demonstrations": "Demonstrations",
    "field": "Vector field",
    "streamlines": "Streamlines",
    "arm": "Arm",
    "ghost_arm": "Arm without avoidance",
    "onion": "Arms along the motion",
    "body_points": "Body points",
    "joint_plots": "Joint plots",
    "health_plots": "Plots along the path",
    "table": "Table",
    "grid": "Warped grid ψ⁻¹(grid)",
    "panels": "Stack side by side",
    "generator": "Learned generator",
}
PLOTS = {"joint_plots", "health_plots"}
"""Fields of `View` whose pictures are in the panel, not in the scene."""
VIEW_HINTS: Mapping[str, str] = {
    "field": "velocities on the slice: longer and darker is faster",
    "streamlines": "motions from all over the slice, exact; of an augmented motion the lines of its field at one "
    "phase, which no motion follows for long",
    "ghost": "what was learned, without obstacles and bias points",
    "ghost_arm": "at the same moment; links that coincide are left out",
    "onion": f"{NUM_ARMS} of them, from start to goal, evenly along the path of the hand",
    "body_points": "spheres that cover the arm; lines from where each would be without avoidance",
    "grid": "straight lines of base space, as all transforms together bend them",
    "panels": "the base attractor, with motions straight to the goal, and each level of the stack",
    "generator": "vector field whose flow is the imitation",
    "joint_plots": "angles and speeds over time, with their limits",
    "health_plots": "Lyapunov value, distance to the demonstration and clearance along the arm's rollout",
}
FOLLOWS_HINT = "number of the rollout that the arm follows: first those of the demonstrations, then added ones"
_NO_SCENE = "–"
NARROW_TABS = "<style>[data-dock-tab] { padding: 0 0.45em !important }</style>"
"""Style with which all tabs lie in one row."""
MAX_FLOWS = 3
"""Number of flows that ψ is composed of until a picture of the generator brings its own."""


class ControlPanel:
    """The control panel of one visitor."""

    def __init__(
        self,
        gui: viser.GuiApi,
        titles: Mapping[str, str],
        robot: Robot,
        save_png: Callable[[str, bool], None],
        notify: Callable[[str, Colour], None],
        tripod: CameraController,
        darken: Callable[[bool], None],
    ) -> None:
        """Build the controls; they act once `connect` has given them a session.

        Args:
            gui: controls of the visitor.
            titles: titles of the tasks, by name.
            robot: robot whose joints are plotted.
            save_png: makes a picture, given the resolution's name and whether it is transparent.
            notify: shows a text in a colour beside the panel, however far that is scrolled.
            tripod: stand of the visitor's camera.
            darken: begins the dark theme, or the light one.
        """
        self._notify, self._tripod = notify, tripod
        self._gui = gui
        self._titles = dict(titles)
        self._scenes = {scene.title: scene for scene in offered(self._titles)}
        self._bindings = Bindings()
        self._reported: Scenario | None = None
        self._settled = ""
        """Hint of the last reported scenario."""
        self._waits = False
        """Whether another task or scene than the reported one is being computed."""
        self._beginnings = LatestWorker[Callable[[], None]](lambda begin, _: begin(), self._stay, name="beginnings")
        self._presentation = Presentation(gui, self._turn, lambda alone: tripod.reframe(alone=alone))
        self._bindings.show(self._title, self._presentation.entitle)
        big = BigType(gui, tripod)
        self._build_task()
        add_avoid_and_imitate(gui, self._bindings)
        self.status = StatusLine(gui, self._bindings)
        self._bindings.on(gui.add_button_group("History", ("Undo", "Redo", "Reset")), self._travel)
        gui.add_html(NARROW_TABS)
        tabs = gui.add_tab_group()
        self._chores = Chores(self.fail)
        later = self._chores.later
        with tabs.add_tab("World"):
            self._obstacles = ObstaclePanel(
                gui, self._bindings, lambda text, wrong: self._say(text, Level.ALARM if wrong else Level.WARNING), later
            )
            add_transform_controls(gui, self._bindings, later)
            StartsPanel(gui, self._bindings, lambda text: self._say(text, Level.WARNING), later)
        with tabs.add_tab("Stack"):
            self._stack = StackPanel(gui, self._bindings)
        with tabs.add_tab("Show"):
            self._slice = SlicePanel(gui, self._bindings)
            self._build_plots(robot)
            self._build_view()
        with tabs.add_tab("Arm"):
            self._build_arm()
        with tabs.add_tab("Compare"):
            self._compare = ComparePanel(gui, self._bindings)
        with tabs.add_tab("Picture"):
            self._camera = CameraControls(gui, tripod, lambda dark: self._chores.later(partial(darken, dark)), big.show)
            on_press(gui.add_button("Presentation", icon=viser.Icon.PRESENTATION), self._presentation.begin)
            self._build_export(save_png)
        commands = self._commands(Curtain(gui))
        add_commands(gui, self._bindings, commands)
        add_about(gui, commands)

    def connect(self, session: Session) -> None:
        """Let the controls edit this session."""
        self._bindings.connect(session)

    def close(self) -> None:
        """Stop playing and reading: the visitor has left."""
        self._obstacles.close()
        self._stack.close()
        self._disturbances.close()
        self._saver.close()
        self._beginnings.close()
        self._chores.close()

    @property
    def legend(self) -> Legend | None:
        """Legend of the colours on the slice."""
        return self._slice.legend

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's choices."""
        self._bindings.adopt(scenario)
        self.status.adopt(scenario)
        if self._reported is not None and not self._reported.begins_like(scenario):
            self._wait()

    def report(self, frame: Frame, pace: Pace) -> None:
        """Show the speed of the rebuild, its warnings and its certificates."""
        if frame.stage is Stage.ROLLOUTS:
            return  # the next stage is a few milliseconds away
        adopted = self._bindings.scenario
        if adopted is not None and not frame.scenario.begins_like(adopted):
            return  # another task or scene was chosen meanwhile
        self._reported, self._settled, self._waits = frame.scenario, hint(frame), False
        self._give_hint(self._settled)
        self._bindings.report(frame)
        self.joints.follow(frame.arm)
        self.health.draw(frame.profiles)
        self._compare.draw(frame.comparison)
        self.status.report(frame, pace)

    def _wait(self) -> None:
        """Show that another task or scene is being computed."""
        if not self._waits:
            self._waits = True
            self._give_hint("")
            self.status.wait(waits=True)

    def _settle(self) -> None:
        """Stop waiting for a report, if the last frame is of the adopted task and scene."""
        adopted = self._bindings.scenario
        if self._waits and self._reported and adopted and self._reported.begins_like(adopted):
            self._waits = False
            self._give_hint(self._settled)
            self.status.wait(waits=False)

    def _give_hint(self, text: str) -> None:
        self.hint.content = place_html(text, INK, HINT)
        self._presentation.caption(text)

    def learning(self, fraction: float, message: str) -> None:
        """Show the progress of learning a task."""
        self.status.learn(fraction, message)

    def fail(self, error: Exception) -> None:
        """Show what went wrong; the picture stays as it was."""
        self._settle()
        expected = isinstance(error, DataError | ImitationError)
        self._say(str(error) if expected else f"{type(error).__name__}: {error}", Level.ALARM, failed=True)

    def cancelled(self, task: str) -> None:
        """Show that learning a task was cancelled, and what is shown instead."""
        adopted = self._bindings.scenario
        if self._reported is not None and adopted is not None:
            instead = f"This is “{self._titles[adopted.task]}” as before."
        else:
            instead = "Choose another task, or move the obstacle to start again."
        self._say(f"Learning “{self._titles[task]}” was cancelled. {instead}", Level.WARNING)

    def _say(self, text: str, level: Level, *, failed: bool = False) -> None:
        """Show a text in the status until the next scenario is shown, and for a while beside the panel."""
        self._notify(sentence(text), COLOURS[level][0])
        self.status.say(text, level, failed=failed)

    def _build_task(self) -> None:
        names = {title: name for name, title in self._titles.items()}

        def choose(session: Session, title: str) -> None:
            session.choose_task(names[title])

        self._bindings.choice(
            self._gui.add_dropdown("Task", tuple(names), hint="what is learned from demonstrations"),
            lambda s: self._titles[s.task],
            partial(self._begin, choose),
        )
        self._bindings.choice(
            self._gui.add_dropdown("Scene", (_NO_SCENE, *self._scenes), hint="scenes of the paper's figures"),
            lambda s: SCENES[s.scene].title if s.scene in SCENES else _NO_SCENE,
            partial(self._begin, self._load),
        )
        self.hint = self._gui.add_html("")
        self._give_hint("")

    def _title(self, scenario: Scenario) -> str:
        return SCENES[scenario.scene].title if scenario.scene in SCENES else self._titles[scenario.task]

    def _turn(self, step: int) -> None:
        """Go to a scene so many places after the shown one; before the first is the last."""
        scenario, titles = self._bindings.scenario, tuple(self._scenes)
        if scenario is not None:
            shown = titles.index(self._title(scenario)) if scenario.scene in SCENES else min(-step, 0)
            self._begin(self._load, self._bindings.session, titles[(shown + step) % len(titles)])

    def _load(self, session: Session, title: str) -> None:
        if title == _NO_SCENE:
            session.leave_scene()
        else:
            session.load(self._scenes[title].task, prepared(self._scenes[title]))

    def _commands(self, curtain: Curtain) -> list[Command]:
        return [
            Command("Pause, or play", lambda session: _play_or_pause(session, True), "space"),
            Command("Reset the scene and the camera", lambda session: self._travel(session, "Reset"), "R"),
            Command("Undo", lambda session: self._travel(session, "Undo"), "Z"),
            Command("Redo", lambda session: self._travel(session, "Redo"), "Z", shifted=True),
            *self._camera.commands,
            Command("Hide the panel, or show it", lambda _session: self._fold(curtain), "H"),
            *self._presentation.commands,
            *numbered(tuple(self._scenes), partial(self._begin, self._load)),
        ]

    def _fold(self, curtain: Curtain) -> None:
        if not self._presentation.on:  # its caption would go, too
            curtain.pull()

    def _begin(self, begin: Callable[[Session, str], None], session: Session, title: str) -> None:
        """Begin a task or a scene; if that fails, show why and stay."""
        self._wait()
        self._beginnings.submit(partial(self._begun, begin, session, title))

    def _begun(self, begin: Callable[[Session, str], None], session: Session, title: str) -> None:
        begin(session, title)
        if self._reported is not None and self._reported.begins_like(session.scenario):
            self._settle()  # the shown task was chosen again before it was left

    def _stay(self, error: Exception) -> None:
        self.fail(error)
        self._bindings.restore()

    def _travel(self, session: Session, button: str) -> None:
        {"Undo": session.undo, "Redo": session.redo, "Reset": session.reset}[button]()
        if button == "Reset":
            self._tripod.view()

    def _build_arm(self) -> None:
        gui = self._gui
        play = gui.add_button("Pause")
        self._bindings.properties(play, label=lambda s: "Pause" if s.view.playing else "Play")
        self._bindings.on(play, _play_or_pause)
        self._bindings.input(
            gui.add_slider("Speed", 0.25, 3.0, 0.25, 1.0, hint="of the arm: 1 is real time"),
            lambda s: s.view.speed,
            lambda s, value: {"view": replace(s.view, speed=value)},
        )
        self.push = PushButton(gui, self._bindings)
        self._bindings.input(
            gui.add_checkbox(
                "Replay", False, hint="its motion again and again, finished, instead of an arm that reacts"
            ),
            lambda s: s.view.replay,
            lambda s, value: {"view": replace(s.view, replay=value)},
        )
        self._disturbances = Disturbances(gui, self._bindings)
        followed = gui.add_slider("Follows rollout", 1, 8, 1, 1, hint=FOLLOWS_HINT)
        self._bindings.properties(followed, max=self._num_rollouts)
        self._bindings.input(followed, lambda s: s.arm_rollout + 1, lambda _s, value: {"arm_rollout": int(value) - 1})

    def _num_rollouts(self, _scenario: Scenario) -> int:
        frame = self._bindings.frame
        return KEEP if frame is None else len(frame.task.demonstrations) + len(frame.scenario.starts)

    def _num_flows(self, _scenario: Scenario) -> int:
        picture = None if self._bindings.frame is None else self._bindings.frame.pictures.generator
        return KEEP if picture is None else picture.num_flows

    def _build_plots(self, robot: Robot) -> None:
        """Build the plots, each under its checkbox, high up in the tab, to be seen when they open."""
        self._build_checkbox("joint_plots")
        self.joints = JointPlots(self._gui, robot)
        self._bindings.properties(self.joints, visible=lambda s: s.view.joint_plots)
        self._build_checkbox("health_plots")
        self.health = HealthPlots(self._gui)
        self._bindings.properties(self.health, visible=lambda s: s.view.health_plots)

    def _build_checkbox(self, name: str) -> None:
        def change(scenario: Scenario, value: bool) -> dict[str, Any]:
            chosen = (side_by_side(scenario) if value else ()) if name == "panels" else value
            return {"view": replace(scenario.view, **{name: chosen})}

        self._bindings.input(
            self._gui.add_checkbox(VIEW_LABELS[name], bool(getattr(View(), name)), hint=VIEW_HINTS.get(name)),
            lambda s: bool(getattr(s.view, name)),
            change,
        )

    def _build_view(self) -> None:
        for name in VIEW_LABELS:
            if name not in PLOTS:
                self._build_checkbox(name)
        hint = "the imitation is several flows, one after the other: 1 is the first; 0: the mean of all"
        flow = self._gui.add_slider("Generator of flow", 0, MAX_FLOWS, 1, 0, visible=False, hint=hint)
        self._bindings.properties(flow, visible=lambda s: s.view.generator, max=self._num_flows)
        self._bindings.input(
            flow,
            lambda s: s.view.generator_layer,
            lambda s, value: {"view": replace(s.view, generator_layer=int(value))},
        )

    def _build_export(self, save_png: Callable[[str, bool], None]) -> None:
        resolution = Control(self._gui.add_dropdown("Resolution", tuple(RESOLUTIONS)))
        transparent = Control(self._gui.add_checkbox("Transparent", False))
        save = self._gui.add_button("Save PNG", icon=viser.Icon.CAMERA)

        def show(saving: bool) -> None:
            save.disabled = saving

        self._saver = PictureSaver(save_png, show, self.fail)
        on_press(save, lambda: self._saver.request(resolution.value, transparent.value))


def _play_or_pause(session: Session, _pressed: bool) -> None:
    view = session.scenario.view
    session.edit("play", view=replace(view, playing=not view.playing))


def prepared(scene: PaperScene) -> Callable[[Task], Scenario]:
    """Return a function that makes the scene's scenario, with the surfaces of its obstacles, which take seconds."""

    def scenario(task: Task) -> Scenario:
        begun = scene.scenario(task)
        for obstacle in begun.obstacles:
            obstacle.surface()
        return begun

    return scenario
