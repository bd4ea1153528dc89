"""Scenario → motion → pictures and checks of it, as frames. Knows no browser; keeps what an edit leaves unchanged."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import islice
from typing import TypeVar

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.passing import ANEW
from dt_viz.errors import Cancelled, DataError, never
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.imitation import Progress
from dt_viz.learning.store import FitStore
from dt_viz.memo import Memo, kept
from dt_viz.motion.certificates import Certificates, DrawnSamples
from dt_viz.motion.following import NEWEST, Admission, ArmMotion, Follower, far_starts, unreachable
from dt_viz.motion.nominal import Learned, Nominal, NominalTrajectory, augmented_of, learned_of, styled
from dt_viz.motion.profiles import profiles
from dt_viz.motion.solve import Solved, solve, warped
from dt_viz.motion.stack import FINE, LIVE, Precision
from dt_viz.obstacles.shapes import TriangleObstacle
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.robot import Robot
from dt_viz.scenario.own import Own
from dt_viz.scenario.scenario import Layer, Scenario, Start
from dt_viz.scenario.slices import Panel
from dt_viz.scenario.tasks import OWN, STYLES, Task, TaskEntry
from dt_viz.scheduler import SCHEDULER, Rank, checkpoint
from dt_viz.session.certify import certify, clearance, uncertified, with_meshes
from dt_viz.session.comparison import Comparison
from dt_viz.session.drawing import Drawing, arm_along, rollouts_of
from dt_viz.session.frame import Compared, Frame, Stage
from dt_viz.session.robot_loop import LiveArm
from dt_viz.session.tasks_in_reach import where_followed
from dt_viz.warning import MotionWarning

MOST_BEGINNINGS = 32
"""Largest number of motions, as tasks and scenes begin, that are kept for all visitors."""
MOST_OWN = 12  # largest number of a visitor's own tasks
NOT_TURNED = "the arm does not get there with the hand turned as demonstrated: it follows the places alone"
"""Warning where orientations are left out."""

_Result = TypeVar("_Result")


class Engine:
    """Computes frames for one visitor; one thread calls it.

    The same scenario with the same passing always gives the same frame, but where there is no motion for it: then the
    last one that there was for the task is shown, marked by `Frame.blocked`.
    """

    def __init__(
        self,
        tasks: Mapping[str, TaskEntry],
        fits: FitStore,
        robot: Robot,
        shared: Memo | None = None,
        name: str = "",
    ) -> None:
        """Take what engines share: tasks, what was learned, the arm, and what no visitor's edits change, if any.

        `name` is that of the arm.
        """
        self._tasks, self._name = tasks, name
        self._fits = fits
        self.memo, self._shared = Memo(), Memo() if shared is None else shared
        """All other results that are kept."""
        self.follower = Follower(robot, self.memo, self._shared)
        self.arm = LiveArm(self.follower)  # the arm in the loop
        self.comparison = Comparison(self.follower, self.memo)  # other methods beside ours
        self._drawing = Drawing(self.follower, self.memo)
        self._last: dict[str, Solved] = {}
        """The last motion of each task: what is shown where a scenario has none."""
        self.own: dict[str, tuple[Task, FitStore, str]] = {}
        """Tasks of the visitor's own by name, the oldest first, what was learned from each, and the name of the arm
        with which it was opened: one dict, which the visitor's engines share and `bring` changes in place."""

    def title(self, name: str) -> str:
        """Title of the task of that name."""
        return self.own[name][0].title if name in self.own else self._tasks[name].title

    def task(self, name: str) -> Task:
        """The task of that name, which all engines share but for a visitor's own; any thread may ask for it.

        Raises:
            DemonstrationError: its file cannot be used.
        """
        return self._own_task(name) if name in self.own else self._tasks[name]()

    @kept(MOST_OWN)
    def _own_task(self, name: str) -> Task:
        task, _, opened_with = self.own[name]
        return task if self._name == opened_with else where_followed(task, self.follower.robot)

    def bring(
        self, task: Task, arm: str = "", number: int = 0, deleted: Collection[str] = ()
    ) -> tuple[Task, str | None]:
        """Take a task of the visitor's own, once if it comes again.

        Args:
            task: the task.
            arm: name of the arm with which it was opened.
            number: smallest number that it gets: no other task has had it.
            deleted: names of own tasks that may go.

        Returns:
            The task with a name and a title of its own, and the name of the own task that had to go, if one had.

        Raises:
            DataError: there are `MOST_OWN`, none of which may go.
        """
        made_from = Own.of(task).digest, task.layers, arm
        for other, _, opened_with in self.own.values():
            if (Own.of(other).digest, other.layers, opened_with) == made_from:
                return other, None
        oldest = next((name for name in self.own if name in deleted), None) if len(self.own) >= MOST_OWN else None
        if oldest is None and len(self.own) >= MOST_OWN:
            raise DataError("Your data", "tasks", f"{MOST_OWN} of yours", f"at most {MOST_OWN}: delete one first")
        number = max(number, 1 + max((int(name.rpartition("_")[2]) for name in self.own), default=0))
        task = replace(task, name=f"{OWN}_{number}", title=f"Your data {number}" if number > 1 else "Your data")
        self.own[task.name] = task, FitStore(None), arm
        if oldest is not None:
            del self.own[oldest]
        return task, oldest

    def refining(self, cancelled: Cancelled) -> AbstractContextManager[None]:
        """Wait for the slot of a refinement, and have it within the block. Raises as `Scheduler.slot`."""
        return SCHEDULER.slot(Rank.REFINEMENT, cancelled)

    def frames(
        self,
        scenario: Scenario,
        progress: Progress | None = None,
        cancelled: Cancelled = never,
        newest: Callable[[Scenario], Scenario] = lambda scenario: scenario,
        draw: Callable[[Frame], None] = lambda frame: None,
    ) -> Iterator[Frame]:
        """Frames for a scenario, one for each stage; stop iterating to skip what is not wanted any more.

        Args:
            scenario: what to show.
            progress: told how far learning is; see `dt_viz.learning.imitation.fit`.
            cancelled: asked after stage LIVE, before each part of the computation and while it waits for a slot.
            newest: asked, once there is a slot, for the scenario to compute: it, or one with another stack.
            draw: called with frames of stages ROLLOUTS and LIVE before they come, in the slot that they were computed
                in: what a hand waits for is computed and drawn in one go. It takes no other slot.

        Raises:
            DemonstrationError: the task's demonstrations cannot be read.
            ImitationError: nothing can be learned from them.
            UnwantedError: it is cancelled.
        """
        steps = list[str]()

        def learn(fraction: float, message: str) -> None:
            checkpoint()
            steps.append(message)
            if progress is not None:
                progress(fraction, message)

        self.nominal(scenario, learn)
        learned = self._shown(scenario, learn)
        if steps:
            learn(1.0, "computing the motion; what is new to this processor is compiled, once")
        rank = Rank.FIRST_PICTURE if scenario.passing is ANEW else Rank.DRAG
        with SCHEDULER.slot(rank):
            scenario = newest(scenario)
            frame = self._rollouts(scenario, LIVE)
            draw(frame)
        yield frame
        with SCHEDULER.slot(rank):
            frame = self._seen(frame, Stage.LIVE, learned)
            draw(frame)
        yield frame
        frame = self._fine(scenario, learned, cancelled)
        yield frame
        frame = replace(frame, stage=Stage.CERTIFIED)
        if not frame.blocked:
            with self.refining(cancelled):
                frame = replace(frame, certificates=self._certified(frame))
            with self.refining(cancelled):
                frame = replace(frame, certificates=self._certified_with_meshes(frame))
        yield frame
        if frame.motion.arm is not None and not frame.blocked:
            with self.refining(cancelled):
                self.follower.reference_postures(frame.motion.nominal.learned)  # a drag may need them at once
        if scenario.view.compared:
            yield from self._compared_at_rest(frame, cancelled)

    def fine(self, scenario: Scenario, cancelled: Cancelled) -> Frame:
        """The frame of stage FINE of a learned scenario, which leaves no trace; it raises what `frames` raises."""
        last = self._last
        try:
            return self._fine(scenario, self._shown(scenario), cancelled)
        finally:
            self._last = last

    def _fine(self, scenario: Scenario, others: Mapping[Panel, Learned], cancelled: Cancelled) -> Frame:
        with self.refining(cancelled):
            frame = self._rollouts(scenario, FINE)
        with self.refining(cancelled):
            return self._seen(frame, Stage.FINE, others)

    def _shown(self, scenario: Scenario, progress: Progress | None = None) -> Mapping[Panel, Learned]:
        """What is learned of other tasks that panels beside the scene show."""
        shown = [panel.shown for panel in scenario.view.panels if panel.shown]
        others = {panel: Scenario(panel.task, state=panel.state, arm=scenario.arm) for panel in shown}
        return {panel: self.nominal(other, progress).learned for panel, other in others.items()}

    # --- motion ---

    def nominal(self, scenario: Scenario, progress: Progress | None = None) -> Nominal:
        """The undisturbed motion of a scenario, from all of its starts; see `frames`."""
        styled = scenario.style and scenario.imitation
        learned = self._styled(scenario) if styled else self._learned(scenario, progress)
        return self._nominal(learned, scenario.starts)

    @kept(4)
    def _nominal(self, learned: Learned, starts: tuple[Start, ...]) -> Nominal:
        return learned.nominal([self._added(learned, start) for start in starts])

    @kept(NEWEST)
    def _added(self, learned: Learned, start: Start) -> NominalTrajectory:
        return learned.trajectory(start)  # one that is dragged leaves nothing behind

    def _learned(self, scenario: Scenario, progress: Progress | None) -> Learned:
        learned = self._learned_own if scenario.task in self.own else self._learned_shared
        return learned(scenario, progress)

    @kept(by=lambda scenario, _: scenario.learned, of="_shared")
    def _learned_shared(self, scenario: Scenario, progress: Progress | None) -> Learned:
        return self._learn(scenario, self._fits, progress)

    @kept(MOST_OWN, by=lambda scenario, _: scenario.learned)
    def _learned_own(self, scenario: Scenario, progress: Progress | None) -> Learned:
        return self._learn(scenario, self.own[scenario.task][1], progress)

    def _learn(self, scenario: Scenario, fits: FitStore, progress: Progress | None) -> Learned:
        learned = learned_of(scenario, self.task(scenario.task), fits, progress)
        imitation = learned.imitation
        if isinstance(imitation, AugmentedImitation) and learned.poses and self.follower.unreached(learned):
            places = replace(imitation, goal_orientation=None, warnings=(*imitation.warnings, NOT_TURNED))
            alone = Learned.of(learned.task, places, imitates=scenario.imitation)
            return learned if self.follower.unreached(alone) else alone
        return learned

    @kept(NEWEST, by=lambda task: task)
    def _augmented(self, task: str) -> AugmentedImitation:
        return augmented_of(self.task(task))

    @kept(NEWEST, by=lambda scenario: scenario.learned)
    def _styled(self, scenario: Scenario) -> Learned:
        """What is learned for a scenario in the augmented state, in its style."""
        own, usual, other = (self._augmented(task) for task in (scenario.task, *STYLES[scenario.style]))
        return styled(self.task(scenario.task), own, usual, other, scenario.style_amount)

    def _admission(self, scenario: Scenario, precision: Precision) -> Admission:
        """Whether the scenario has a motion, and from which starts.

        While an obstacle is dragged the arm keeps its posture; where it rests, another one may leave more starts free.
        """
        nominal, avoidance = self.nominal(scenario), scenario.arm_avoidance
        if avoidance is None:
            return Admission(nominal)
        passing = scenario.passing
        if passing is None or not passing.goes_on(avoidance.avoided.parts):
            return self.follower.admission(nominal, avoidance)
        return self.follower.admission(nominal, avoidance, passing.posture, keeps=precision is LIVE)

    def solved(self, scenario: Scenario, precision: Precision) -> Solved:
        """The motion of a scenario whose goal and some start are free, at a precision; what it raises see `frames`.

        Raises:
            UnreachableError: the whole arm is to avoid, and cannot get to where the motions start.
        """
        return self._solved(scenario, self._admission(scenario, precision).nominal, precision)

    def _solved(self, scenario: Scenario, nominal: Nominal, precision: Precision) -> Solved:
        full = self._full(scenario, nominal, precision)
        return full if scenario.warp == 1 else self._warped(full, scenario.warp, precision)

    def _full(self, scenario: Scenario, nominal: Nominal, precision: Precision) -> Solved:
        key = scenario.full, scenario.passing, precision
        return self._kept(scenario, "full", key, lambda: solve(scenario.motion, nominal, precision, self.follower))

    def _kept(self, scenario: Scenario, kind: str, key: Hashable, make: Callable[[], _Result]) -> _Result:
        """What is kept of a scenario's motions: as tasks and scenes begin, they are the same for all visitors.

        What only one of them has, which may be large, goes with him.
        """
        owns = scenario.task in self.own or any(isinstance(shape, TriangleObstacle) for shape in scenario.obstacles)
        shared = scenario.passing is ANEW and not owns
        memo, newest = (self._shared, MOST_BEGINNINGS) if shared else (self.memo, 2)
        return memo(kind, key, make, newest=newest)

    @kept(2)
    def _warped(self, full: Solved, fraction: float, precision: Precision) -> Solved:
        return warped(full, self._below(full.nominal, fraction), fraction, precision, self.follower)

    @kept(1)
    def _below(self, nominal: Nominal, fraction: float) -> Nominal:
        return nominal.warped(fraction)

    def arm_motions(self, scenario: Scenario) -> tuple[Frame, dict[int, ArmMotion]]:
        """The frame of stage FINE, without pictures, and the arm's motions, by their places; none if it is blocked.

        Raises:
            DemonstrationError, ImitationError: as `frames`.
            UnreachableError: the arm cannot get to where the motions start.
        """
        frame = replace(self._rollouts(scenario, FINE), stage=Stage.FINE)
        places = [] if frame.blocked else np.flatnonzero(frame.motion.nominal.moving).tolist()
        found = {place: arm_along(frame, place, self.follower) for place in places}
        warnings = [warning for _, warnings in found.values() for warning in warnings]
        motions = {place: arm for place, (arm, _) in found.items()}
        return replace(frame, certificates=frame.certificates.warning(*warnings)), motions

    # --- frames of it ---

    def _rollouts(self, scenario: Scenario, precision: Precision) -> Frame:
        """The frame of stage ROLLOUTS, of the last motion of its task where the scenario has none.

        Where there is no last one it is the motion without obstacles.
        """
        admission = self._admission(scenario, precision)
        found = None if admission.blocked else self._solved(scenario, admission.nominal, precision)
        if found is not None and not found.blocked:
            known = {name: last for name, last in self._last.items() if name in self.own or name in self._tasks}
            self._last = known | {scenario.task: found}
            return Frame(scenario, Stage.ROLLOUTS, found, *self._drawn(found))
        blocked = admission.blocked if found is None else found.blocked
        free = replace(scenario, stack=_without_obstacles(scenario.stack))
        motion = self._last.get(scenario.task) or self.solved(free, precision)
        drawn, _ = self._drawn(motion)
        known = Certificates(clearance(motion, drawn, scenario.obstacle, self.follower))
        return Frame(scenario, Stage.ROLLOUTS, motion, drawn, known, blocked)

    @kept(2)
    def _drawn(self, motion: Solved) -> tuple[DrawnSamples, Certificates]:
        """The rollouts of a motion, and what is known of them before they are certified."""
        drawn = rollouts_of(motion, self.follower.robot)
        return drawn, uncertified(motion, drawn, self.follower)

    def _seen(self, frame: Frame, stage: Stage, others: Mapping[Panel, Learned]) -> Frame:
        """The frame with pictures and the arm, at LIVE with the arm's motion only if that is drawn."""
        view, live = frame.scenario.view, stage is Stage.LIVE
        arm, warnings = self._arm(frame, not live or view.shows_arm_motion)
        pictures = self._drawing.pictures(frame, others, live)
        known = frame.certificates if frame.blocked else frame.certificates.warning(*warnings)
        frame = replace(frame, stage=stage, arm=arm, certificates=known, pictures=pictures)
        if view.health_plots and not live and frame.chosen is not None:
            frame = replace(frame, profiles=profiles(frame.motion, frame.drawn, frame.chosen, self.follower))
        return replace(frame, comparison=next(self._compared(frame), ()))

    @kept(2, by=lambda frame, moves: (frame.motion, frame.chosen, moves))
    def _arm(self, frame: Frame, moves: bool) -> tuple[ArmMotion | None, tuple[MotionWarning, ...]]:
        """The arm's motion along the rollout that it follows, if that is wanted, and what is wrong with it."""
        nominal, rollout = frame.motion.nominal, frame.chosen
        try:
            far = nominal.moving & self.follower.out_of_reach(nominal)
            arm, warnings = None, ()
            if moves and rollout is not None and not far[rollout]:
                arm, warnings = arm_along(frame, rollout, self.follower)
        except UnreachableError as error:
            return None, (unreachable(error),)
        return arm, (*warnings, *far_starts(far, nominal.added))

    def _certified(self, frame: Frame) -> Certificates:
        key = frame.motion, frame.chosen
        return self._kept(frame.scenario, "certified", key, lambda: certify(frame, self.follower))

    def _certified_with_meshes(self, frame: Frame) -> Certificates:
        key = frame.motion, frame.chosen
        return self._kept(frame.scenario, "with meshes", key, lambda: with_meshes(frame, self.follower.robot))

    def _compared(self, frame: Frame, cancelled: Cancelled = never) -> Iterator[tuple[Compared, ...]]:
        """Other methods beside our motion in the plain state, as `Comparison.of`, if the view shows any."""
        if frame.scenario.view.compared:
            learned = self.nominal(replace(frame.scenario, state="plain", style="")).learned
            yield from self.comparison.of(frame, learned, cancelled)

    def _compared_at_rest(self, frame: Frame, cancelled: Cancelled) -> Iterator[Frame]:
        """The last frame again and again, each with more of what is known of other methods."""

        def asked() -> bool:
            checkpoint()
            return cancelled()

        left = islice(self._compared(frame, asked), 1, None)  # the frame has the first
        while True:
            with self.refining(cancelled):
                comparison = next(left, None)
            if comparison is None:
                return
            yield replace(frame, comparison=comparison)

    # --- the robot ---

    def see(self, scenario: Scenario) -> None:
        """Let the arm know where the obstacles of a scenario are, long before its frames; any thread may."""
        self.arm.see(scenario.arm_avoidance)

    def drive(self, frame: Frame) -> None:
        """Have the arm go on with the motion of a frame.

        Where that is blocked it stays with the motion that is shown, and gives way to what is in its way now.
        """
        motion = replace(frame.motion, scenario=frame.scenario.motion) if frame.blocked else frame.motion
        try:
            self.arm.follow(motion, frame.chosen)
        except UnreachableError:
            self.arm.stop()


def _without_obstacles(stack: tuple[Layer, ...]) -> tuple[Layer, ...]:
    avoids = [isinstance(layer.transform, Avoidance) or bool(layer.transform.avoided.parts) for layer in stack]
    return tuple(replace(layer, on=layer.on and not off) for layer, off in zip(stack, avoids, strict=True))
