"""One visitor: owns a scenario, edits it, and has it computed. Knows no browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from dt_viz.avoidance.passing import ANEW
from dt_viz.errors import DataError, UnwantedError, end_if
from dt_viz.learning.imitation import ImitationError
from dt_viz.robot.placement import is_jaco
from dt_viz.robot.robot import Robot
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.relocation import changes_of_place, relocated
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import IMITATION, as_fresh
from dt_viz.scenario.tasks import Task
from dt_viz.scheduler import Jobs
from dt_viz.session.arms import Engines, NewEngine
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.history import NO_CAMERA, Beside, Camera, History, Step
from dt_viz.session.progress import Display, Screen
from dt_viz.warning import Severity

HABITS = ("playing", "replay", "speed", "joint_plots", "health_plots", "large_plots")
"""Fields of the view that are a visitor's way of working, and stay when a scene of the paper comes or goes."""
REST = 0.1
"""Time that a scenario must rest before it is refined, seconds: while a hand moves, edits come faster."""
LANE, CHOICES = "session", "task"
"""Lanes of the jobs on which the newest scenario is computed, and the task, scene or arm that was chosen last read."""


def _with_a_level_of_its_own(scenario: Scenario) -> Scenario:
    """The scenario, its view naming no level that is gone: another layer may get its name."""
    level = scenario.view.level
    if not level or level in (IMITATION, *(layer.name for layer in scenario.stack)):
        return scenario
    return replace(scenario, view=replace(scenario.view, level=""))


class Session:
    """A scenario with its history, and the jobs that compute its frames."""

    def __init__(
        self,
        engine: Engine,
        initial: Callable[[Engine, str], Scenario],
        task: str,
        display: Display,
        new_engine: NewEngine | None = None,
        restored: Scenario | None = None,
    ) -> None:
        """Start with a task.

        Args:
            engine: for the first arm, used by this session only.
            initial: makes the scenario that a task of an engine begins with; raises what `Engine.task` raises.
            task: name of the first one.
            display: where results go.
            new_engine: makes engines for other arms; None if there are none.
            restored: scenario of the first arm to start with instead, if any; see also `restore`.
        """
        self.engines = Engines(engine, new_engine)  # engines of this session, by its arms
        self._initial = initial
        self._lock = threading.Lock()
        self.scenario = initial(engine, task) if restored is None else restored
        self._screen = Screen(display, self.scenario, restored)
        self._history = History()
        self._unadopted = False
        """Whether the scenario was edited by a drag and is not shown on the controls yet."""
        self._stopped = False
        """Whether the learning of the scenario was cancelled, and there is no other to go back to."""
        self._shown: Frame | None = None  # the newest frame; None before the first one
        self._computed = self.scenario  # scenario that is computed now, or was last
        self.jobs = Jobs(self.fail)  # all work of the visitor beside the server's event loop
        self._adopt()
        self._submit()

    @property
    def engine(self) -> Engine:
        """The engine for the scenario's arm."""
        return self.engines(self.scenario.arm)

    @property
    def taught(self) -> Mapping[str, tuple[Task, str]]:
        """The visitor's own tasks in the list by name, each with the name of the arm with which it was opened."""
        own = [*self.engine.own.items()]
        return {name: (task, arm) for name, (task, _, arm) in own if name not in self.engines.deleted}

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self.engine.follower.robot

    @property
    def task(self) -> Task:
        """The scenario's task. Raises what `Engine.task` raises."""
        return self.engine.task(self.scenario.task)

    def edit(
        self,
        gesture: str,
        *,
        anew: bool = False,
        camera: Camera | None = None,
        **changes: Any,  # noqa: ANN401 - the fields of Scenario
    ) -> None:
        """Replace fields of the scenario, all but `passing`, and have it computed anew.

        Edits by one gesture in quick succession are undone together. Detours and reference posture are those of the
        motion that is shown, or chosen `anew`. With a `camera`, undo brings back the view and the camera, too.
        """
        with self._lock:
            edited = _with_a_level_of_its_own(replace(self.scenario, **changes))
            failed, moved = self._screen.progress.failed, camera is not None and camera.chosen() is not None
            if edited == self.scenario and not failed and not moved:
                return
            if edited.full != self.scenario.full:
                edited = replace(edited, passing=ANEW if anew else None)
            self._history.edited(gesture, self.scenario, edited, camera)
            needs_frames = failed or not edited.computes_like(self.scenario)
            self.scenario = edited
            if needs_frames:
                self._submit()
            # a drag sends edits faster than the controls can show them: they are shown with the next frame
            self._unadopted = self._history.held and needs_frames
        if not self._unadopted:
            self._adopt()

    def step(self, gesture: str, **changes: Any) -> None:  # noqa: ANN401 - the fields of Scenario
        """Edit as `edit` does, as a step of its own for undo."""
        self.edit(gesture, **changes)
        self.end_gesture()

    def begin_gesture(self) -> None:
        """The user took hold of something: edits until `end_gesture` are undone together, however slow."""
        with self._lock:
            self._history.begin_gesture()

    def take_phase(self) -> None:
        """Show augmented motions on the slice at the phase at which the arm is."""
        self.step("phase", view=replace(self.scenario.view, phase=round(self.engine.arm.left, 2)))

    def end_gesture(self) -> None:
        """The user let go: the next edit is a step of its own for undo. What ends as it began is no step."""
        with self._lock:
            self._history.end_gesture(self.scenario)
        self._catch_up()

    def choose_task(self, name: str) -> None:
        """Begin another task, with what else was chosen.

        Raises:
            DemonstrationError: its demonstrations cannot be used; the session stays with its task.
        """
        if name == self.scenario.task:
            return
        if self.scenario.scene:  # of the paper: leaves nothing behind
            self.begin_task(name)
        else:
            fresh, view = self._initial(self.engine, name), replace(self.scenario.view, slice=None)
            stack = as_fresh(self.scenario, fresh)
            self.step("task", task=name, arm_rollout=0, starts=fresh.starts, stack=stack, view=view)

    def begin_task(self, name: str) -> None:
        """Begin with a task as it begins, seen as what is shown now; can be undone. Raises as `choose_task`."""
        self._begin("task", self._as_seen(self._initial(self.engine, name)))

    def bring(self, task: Task, arm: str | None = None, number: int = 0) -> Task:
        """Take a visitor's own task into the list of tasks, where it stays until it is deleted; see `Engine.bring`.

        It was opened with an arm, or the present one.

        Raises:
            DataError: there are as many as there may be.
        """
        engine = self.engine
        with self._lock:
            own, gone = engine.bring(task, self.scenario.arm if arm is None else arm, number, self.engines.deleted)
            self.engines.deleted -= {own.name, gone}
            if gone is not None:
                self._history.forget(gone)
        self._adopt()
        return own

    def delete(self, name: str, instead: str) -> None:
        """Take an own task out of the list, and begin another one `instead`; undo brings it back.

        Raises as `choose_task`.
        """
        self.choose_task(instead)
        self.engines.deleted.add(name)
        self._adopt()

    def choose_arm(self, name: str) -> None:
        """Go on with another arm, and all that is there where the task is in its reach; called on the lane `CHOICES`.

        Raises:
            DataError, FileNotFoundError: it cannot be loaded; the session stays with its own.
            UnwantedError: something else is chosen meanwhile.
        """
        if name == self.scenario.arm:
            return
        before, (engine, after) = self.task, self._task_of(name, self.scenario.task)
        there, gone = relocated(self.scenario, before, after, engine.follower.robot.reaches)
        scene = SCENES.get(there.scene)
        if scene is not None and scene.of_jaco and not is_jaco(engine.follower.robot):
            there = replace(there, scene="")
        elif scene is not None and not scene.is_changed(self.scenario, before):
            there = replace(there, stack=scene.scenario(after).stack)
        changes = ("scene", "stack", "starts", "view", "arm_rollout")
        self.step("arm", anew=True, arm=name, **{field: getattr(there, field) for field in changes})
        if text := changes_of_place(engine.follower.robot.title, before, after, gone):
            self.say(text, Severity.NOTE)

    def restore(self, scenario: Scenario) -> None:
        """Go on with a scenario from before, of any arm; called on the lane `CHOICES`. Raises as `choose_arm`."""
        self._task_of(scenario.arm, scenario.task)
        self._begin("restore", scenario, arm=scenario.arm)
        self._screen.tell(restored=scenario)

    def _task_of(self, arm: str, name: str) -> tuple[Engine, Task]:
        """The engine for an arm, loaded if need be, and its task of that name; see `choose_arm`."""

        def tell(fraction: float, message: str) -> None:
            end_if(partial(self.jobs.superseded, CHOICES))
            self._screen.tell(learning=(fraction, f"Loading the arm: {message}"))

        try:
            engine = self.engines(arm, tell)
            if arm != self.scenario.arm:
                tell(1.0, "placing the task in its reach")
            return engine, engine.task(name)
        finally:
            self._screen.tell(learning=None)

    def reset(self, camera: Camera = NO_CAMERA) -> None:
        """Back to how the task or the scene began, and was looked at, by a `camera`, too; all of it can be undone."""
        scene = SCENES.get(self.scenario.scene)
        fresh = self._initial(self.engine, self.scenario.task) if scene is None else scene.scenario(self.task)
        self._begin("reset", fresh, camera=camera)

    def leave_scene(self) -> None:
        """Back to how the task of the scene begins; can be undone. Nothing is done while there is no scene."""
        if self.scenario.scene:
            self.begin_task(self.scenario.task)

    def load(self, task: str, scenario: Callable[[Task], Scenario]) -> None:
        """Begin with a scenario for a task, seen as its scene wants it, or else as what is shown now; can be undone.

        Raises:
            DemonstrationError: the task's demonstrations cannot be used; the session stays with its own.
        """
        self._begin("load", self._as_seen(scenario(self.engine.task(task))))

    def visit(self, task: str, scenario: Callable[[Task], Scenario]) -> None:
        """Begin with a scenario for a task, with the present arm and a history of its own, until `come_back`.

        Raises:
            DemonstrationError: the task's demonstrations cannot be used; the session stays with what it has.
        """
        fresh = scenario(self.engine.task(task))
        with self._lock:
            self._history.set_aside(self.scenario)
            self.scenario = replace(fresh, arm=self.scenario.arm, passing=ANEW)
            self._submit()
        self._adopt()

    def come_back(self) -> None:
        """Go on with the scenario that `visit` set aside, and its history, as if nothing had been since."""

        def taken_back(_present: Scenario) -> Step | None:
            own = self._history.taken_back()
            return own and Step(own)

        self._travel(taken_back)

    @property
    def own(self) -> Scenario:
        """The visitor's own scenario: the one that is set aside for a visit, or else the present one."""
        with self._lock:
            return self._history.aside or self.scenario

    @property
    def visits(self) -> bool:
        """Whether a scenario is set aside."""
        return self._history.aside is not None

    def _begin(self, gesture: str, fresh: Scenario, **changes: Any) -> None:  # noqa: ANN401 - the fields of Scenario
        own = {name: getattr(fresh, name) for name in fresh.__dataclass_fields__ if name not in ("arm", "passing")}
        self.step(gesture, anew=True, **own, **changes)

    def _as_seen(self, other: Scenario) -> Scenario:
        """Another scenario, looked at as this one, on the slice that it had.

        If one of them is of a scene of the paper, and the other is not, it is looked at as it was, but for habits.
        """
        view = self.scenario.view
        if other.scene == self.scenario.scene:
            view = replace(view, slice=other.view.slice)
        else:
            view = replace(other.view, **{name: getattr(view, name) for name in HABITS})
        return _with_a_level_of_its_own(replace(other, view=view))

    def undo(self) -> None:
        """Take the last gesture back, or the last step of what is open beside the scenario."""
        beside = self._history.beside
        if beside is None:
            self._travel(self._history.undone, seen=True)
        else:
            beside.undo()

    def redo(self) -> None:
        """Do again what was undone last, of the scenario or of what is open beside it."""
        beside = self._history.beside
        if beside is None:
            self._travel(self._history.redone, seen=True)
        else:
            beside.redo()

    def put_beside(self, beside: Beside | None) -> None:
        """Have `undo` and `redo` act on what is open beside the scenario, as it is now; None: on the scenario again."""
        self._history.beside = beside
        self._screen.tell(beside=None if beside is None else beside.steps)

    def cancel(self) -> None:
        """Stop learning a task, or loading an arm, and go back to what was shown; nothing is done without either."""
        with self._lock:
            abandoned, shown = self.scenario, self._shown
            if self._screen.progress.learning is None or (shown is not None and abandoned.fit == shown.scenario.fit):
                self.jobs.submit(CHOICES, lambda: None, latest=True)  # of an arm, which is not the scenario's yet
                return
            self._stopped = not self._retreat(abandoned)
        self._adopt()
        instead = "Choose another task, or move the obstacle to start again."
        if shown is not None:
            instead = f"This is “{self.task.title}” as before."
        self._screen.tell(learning=None)
        self.say(f"Learning “{self.engine.title(abandoned.task)}” was cancelled. {instead}", Severity.WARNING)

    def expect(self, expected: bool) -> None:
        """Take note that another task or scene is being read for this session, or no more."""
        self._screen.tell(expected=expected)

    def say(self, text: str, severity: Severity) -> None:
        """Show a message until another scenario is shown, for `READ` at most; in place of what has failed it stays."""
        self._screen.say(text, severity, self.scenario)

    def let_pass(self) -> None:
        """Show a message no longer that was shown for `READ`; called again and again."""
        self._screen.let_pass(time.monotonic())

    def fail(self, error: Exception) -> None:
        """Show what went wrong; what is shown stays."""
        expected = isinstance(error, DataError | ImitationError | FileNotFoundError)
        self._screen.tell(failed=True, learning=None)
        self.say(str(error) if expected else f"{type(error).__name__}: {error}", Severity.ALARM)

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait until the newest scenario is computed to the end; False if that took longer than `timeout` seconds."""
        return self.jobs.wait_idle(LANE, timeout)

    def close(self) -> None:
        """Stop computing and let go of everything."""
        self.jobs.close()

    def _travel(self, moved: Callable[[Scenario], Step | None], *, seen: bool = False) -> None:
        """Go to the step that the present scenario is `moved` to, if any; `seen` as what is shown now, or as it was."""
        with self._lock:
            there = moved(self.scenario)
            if there is None:
                return
            self.scenario = self._as_seen(there.scenario) if seen and there.camera is None else there.scenario
            self._submit()
        if there.camera is not None:
            there.camera.put_back(there.pose)
        self._adopt()

    def _adopt(self) -> None:
        self._unadopted = False
        self._screen.adopt(self._wanted)

    def _wanted(self) -> tuple[Scenario, tuple[bool, bool]]:
        """The scenario, whose task is in the list again if it was deleted, and whether there are steps."""
        wanted = self.scenario
        self.engines.deleted.discard(wanted.task)
        return wanted, self._history.steps

    def _catch_up(self) -> None:
        if self._unadopted:
            self._adopt()

    def _retreat(self, abandoned: Scenario) -> bool:
        """Go back from a scenario that has no picture to the one shown last, as if it had never been chosen.

        Called with the lock held. False if there is none, or if `abandoned` is not what is wanted any more.
        """
        shown = self._shown
        if shown is None or shown.scenario.fit == abandoned.fit or self.scenario.fit != abandoned.fit:
            return False
        self.scenario = self._as_seen(self._history.without(abandoned, shown.scenario))
        self._submit()
        return True

    def _submit(self) -> None:
        self._stopped = False
        if self._screen.progress.failed:
            self._screen.tell(failed=False)
        engine = self.engines.get(self.scenario.arm)
        if engine is not None:
            engine.see(self.scenario)
        self._screen.num_edits += 1
        self._screen.edited = time.perf_counter()
        work = partial(self._compute, self.scenario, self._screen.edited)
        self._screen.num_skipped += self.jobs.submit(LANE, work, latest=True)

    def _compute(self, scenario: Scenario, edited: float) -> None:
        """Show the frames of a scenario that was wanted at a time, of `time.perf_counter`."""
        superseded = partial(self.jobs.superseded, LANE)
        self._computed = scenario
        try:
            self._show_frames(self._decided(scenario), edited, superseded)
        except UnwantedError:
            raise
        except Exception as error:
            with self._lock:
                self._screen.tell(failed=True)
                returned = isinstance(error, DataError | ImitationError) and self._retreat(self._computed)
                if not returned and self.scenario != self._computed and not superseded():
                    self._submit()  # it was edited meanwhile, and seemed to need no frames of its own
            if returned:
                self._adopt()
            raise
        finally:
            self._catch_up()
            if self._screen.progress.learning is not None:
                self._screen.tell(learning=None)

    def _learn(self, scenario: Scenario, fraction: float, message: str) -> None:
        """Show how far learning is; end it when something else is to be learned, not when the obstacle moves."""
        with self._lock:
            if self._stopped or self.jobs.closed or self.scenario.fit != scenario.fit:
                raise UnwantedError
        self._screen.tell(learning=(fraction, message))

    def _decided(self, scenario: Scenario) -> Scenario:
        """The scenario with a passing: that of the motion that is shown, of the same fit, where none is decided yet."""
        if scenario.passing is not None:
            return scenario
        shown = self._shown
        passing = shown.passing if shown is not None and scenario.learned == shown.scenario.learned else ANEW
        with self._lock:
            if self.scenario.passing is None and self.scenario.full == scenario.full:
                self.scenario = replace(self.scenario, passing=passing)
        return replace(scenario, passing=passing)

    def _show_frames(self, scenario: Scenario, edited: float, superseded: Callable[[], bool]) -> None:
        learn = partial(self._learn, scenario)
        engine, begun, pause = self.engines(scenario.arm, learn), edited, 0.0

        def newest(before: Scenario) -> Scenario:
            """Where somebody drags and others compute, the place in the queue is the same for the newest scenario."""
            nonlocal edited
            with self._lock:
                newest = self.scenario
                if replace(newest, stack=before.stack, passing=before.passing) != before or newest == before:
                    return before
                self._computed, edited = newest, self._screen.edited
                self._screen.num_skipped += self.jobs.drop(LANE)
            return self._decided(newest)

        def draw(frame: Frame) -> None:
            nonlocal pause
            drawn = self._shown is not None and frame.scenario.choices == self._shown.scenario.choices
            self._shown, pause = frame, 0.0
            if frame.stage is Stage.ROLLOUTS and drawn:
                return  # it is only looked at in another way: the next stage is what changes
            self._screen.draw(frame, edited)
            if frame.stage in (Stage.ROLLOUTS, Stage.FINE):
                engine.drive(frame)
            if frame.stage is Stage.ROLLOUTS:
                pause = self._screen.live_pause(time.perf_counter() - begun)

        for frame in engine.frames(scenario, learn, superseded, newest, draw=draw):
            self._catch_up()
            if frame.stage is Stage.ROLLOUTS and pause <= 0:
                continue  # the field is due, whatever is waiting
            if frame.stage > Stage.LIVE:
                draw(frame)
            else:
                self.jobs.rest(REST if frame.stage is Stage.LIVE else pause, LANE)
            if superseded():
                return
