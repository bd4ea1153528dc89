"""Scenario → motion → frames. Knows no browser; keeps what an edit leaves unchanged."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace

from dt_viz.avoidance.transform import Transform
from dt_viz.errors import Cancelled, never
from dt_viz.flows.augmented_systems import frozen
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Rays
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.imitation import ImitationSettings, Progress
from dt_viz.learning.store import FitStore
from dt_viz.learning.style import Style
from dt_viz.memo import Memo
from dt_viz.motion.certificates import Certificates
from dt_viz.motion.following import NEWEST, Admission, ArmMotion, Follower
from dt_viz.motion.nominal import Learned, Nominal
from dt_viz.motion.solve import Solved, solve, warped
from dt_viz.motion.stack import FINE, LIVE, Precision
from dt_viz.pictures.arm_field import Lattice
from dt_viz.pictures.sketchbook import Pictures, Sketchbook, in_frame
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.robot import Robot
from dt_viz.scenario.panels import Panel
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import STYLES, Task, TaskEntry
from dt_viz.session import compose
from dt_viz.session.certify import certify, with_meshes
from dt_viz.session.comparison import Comparison
from dt_viz.session.cores import Cores
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.robot_loop import LiveArm
from dt_viz.warning import MotionWarning

_cores = Cores()
"""Slots of all engines."""

NUM_BOOKS = 8
"""Number of learned motions whose pictures are kept."""


class Engine:
    """Computes frames for one visitor; one thread calls it.

    The same scenario with the same passing always gives the same frame, but where there is no motion for it: then the
    last one that there was for the task is shown, marked by `Frame.blocked`.
    """

    def __init__(
        self, tasks: Mapping[str, TaskEntry], fits: FitStore, robot: Robot, shared: Memo | None = None
    ) -> None:
        """Take what engines share.

        Args:
            tasks: by name.
            fits: what was learned before.
            robot: the arm.
            shared: what keeps the results that no visitor's edits change; None keeps them for this engine alone.
        """
        self._tasks = tasks
        self._fits = fits
        self.memo, self._shared = Memo(), Memo() if shared is None else shared
        """All other results that are kept."""
        self.follower = Follower(robot, self.memo, self._shared)
        self.arm = LiveArm(self.follower)
        """The arm in the loop."""
        self.comparison = Comparison(self.follower, self.memo)
        """Other methods beside ours."""
        self._shown: dict[str, tuple[Frame, Solved]] = {}
        """The frame of each task that was computed last, and its motion."""
        self._seconds = 0.0
        """Time that the frames of a scenario have taken so far, seconds."""
        self._yielded: Solved | None = None
        """The motion of the frame that was yielded last; where that is blocked, the one before."""

    def task(self, name: str) -> Task:
        """The task of that name, which all engines share; any thread may ask for it.

        Raises:
            DemonstrationError: its file cannot be used.
        """
        return self._tasks[name]()

    def frames(
        self, scenario: Scenario, progress: Progress | None = None, cancelled: Cancelled = never
    ) -> Iterator[Frame]:
        """Frames for a scenario, one for each stage; stop iterating to skip what is not wanted any more.

        Args:
            scenario: what to show.
            progress: called while a task is fitted for the first time; see `dt_viz.learning.imitation.fit`.
            cancelled: asked after stage LIVE, before each part of the computation and while it waits for a slot.

        Raises:
            DemonstrationError: the task's demonstrations cannot be read.
            ImitationError: nothing can be learned from them.
            UnwantedError: it is cancelled.
        """
        self.nominal(scenario, progress)
        for panel in scenario.view.panels:
            if panel.task:
                self._imitated(panel, progress)
        self._seconds, began = 0.0, time.perf_counter()
        for frame in self._stages(scenario, cancelled):
            self._seconds += time.perf_counter() - began
            yield replace(frame, seconds=self._seconds)
            began = time.perf_counter()

    def nominal(self, scenario: Scenario, progress: Progress | None = None) -> Nominal:
        """The undisturbed motion of a scenario, from all of its starts; see `frames`."""
        if scenario.style and scenario.imitation:
            learned = self.memo("styled", scenario.learned, lambda: self._styled(scenario), newest=NEWEST)
        else:
            learned = self._shared("learned", scenario.learned, lambda: self._learned(scenario, progress))
        make = learned.trajectory  # a start that is dragged leaves nothing behind
        added = [self.memo("added start", (learned, s), lambda s=s: make(s), newest=NEWEST) for s in scenario.starts]
        return self.memo("nominal", (learned, scenario.starts), lambda: learned.nominal(added), newest=4)

    def _imitated(self, panel: Panel, progress: Progress | None = None) -> Nominal:
        """The undisturbed motion that a panel shows."""
        return self.nominal(Scenario(panel.task, state=panel.state), progress)

    def solved(self, scenario: Scenario, precision: Precision) -> Solved:
        """The motion of a scenario that is not blocked, at a precision; what it raises see `frames`.

        Raises:
            UnreachableError: the whole arm is to avoid, and cannot get to where the motions start.
        """
        return self._solved(scenario, self._admission(scenario, precision).nominal, precision)

    def _solved(self, scenario: Scenario, nominal: Nominal, precision: Precision) -> Solved:
        """The motion of a scenario from the starts that the arm can begin at."""
        motion, follower = scenario.motion, self.follower
        full = self.memo(
            "full",
            (replace(motion, warp=1.0), motion.passing, precision),
            lambda: solve(motion, nominal, precision, follower),
            newest=2,
        )
        if motion.warp == 1:
            return full
        below = self.memo("below", (full.nominal, motion.warp), lambda: full.nominal.warped(motion.warp), newest=1)
        return self.memo(
            "warped",
            (motion, motion.passing, precision),
            lambda: warped(full, below, motion.warp, precision, follower),
            newest=2,
        )

    def arm_motions(self, scenario: Scenario) -> tuple[Frame, tuple[ArmMotion, ...]]:
        """The frame of stage FINE, without pictures, and the arm's motion along each rollout; none if it is blocked.

        Raises:
            DemonstrationError, ImitationError: as `frames`.
            UnreachableError: the arm cannot get to where the motions start.
        """
        fine, blocked = self._motion(scenario, FINE)
        if fine is None:
            *_, frame = self._stages_without_motion(scenario, blocked)
            return frame, ()
        frame = self._rollouts(scenario, fine, FINE)
        arms, certificates = [], frame.certificates
        for rollout in range(len(frame.rollouts)):
            arm, warnings = compose.arm_along(frame, fine, rollout, self.follower)
            arms.append(arm)
            certificates = certificates.warning(*warnings)
        return replace(frame, stage=Stage.FINE, certificates=certificates), tuple(arms)

    def see(self, scenario: Scenario) -> None:
        """Let the arm know where the obstacles of a scenario are, long before its frames; any thread may."""
        self.arm.see(scenario.arm_avoidance)

    def drive(self, frame: Frame) -> None:
        """Have the arm go on with the motion of the frame that was yielded last.

        Where that is blocked it stays with the motion that is shown, and gives way to what is in its way now.
        """
        began, solved = time.perf_counter(), self._yielded
        if frame.blocked:
            solved = replace(self._shown[frame.scenario.task][1], scenario=frame.scenario.motion)
        assert solved is not None
        try:
            self.arm.follow(solved, frame.chosen)
        except UnreachableError:
            self.arm.stop()
        self._seconds += time.perf_counter() - began

    def _learned(self, scenario: Scenario, progress: Progress | None) -> Learned:
        task = self.task(scenario.task)
        state = scenario.state if scenario.imitation else "plain"  # without it there is nothing to remember
        imitation = self._fits.learned(task.demonstrations, ImitationSettings(scenario.objective), state, progress)
        return Learned.of(task, imitation, imitates=scenario.imitation)

    def _styled(self, scenario: Scenario) -> Learned:
        """What is learned for a scenario in the augmented state, in its style."""
        own, usual, other = (
            self.memo("augmented", name, lambda name=name: fit_augmented(self.task(name).demonstrations))
            for name in (scenario.task, *STYLES[scenario.style])
        )
        imitation = Style.between(usual, other).on(own, scenario.style_amount)
        return Learned.of(self.task(scenario.task), imitation, imitates=True)

    def _admission(self, scenario: Scenario, precision: Precision) -> Admission:
        """Whether the scenario has a motion, and from which starts.

        While an obstacle is dragged the arm keeps its stance; where it rests, another one may leave more starts free.
        """
        nominal, avoidance = self.nominal(scenario), scenario.arm_avoidance
        if avoidance is None:
            return Admission(nominal)
        passing = scenario.passing
        if passing is None or not passing.goes_on(avoidance.obstacle.parts):
            return self.follower.admission(nominal, avoidance)
        return self.follower.admission(nominal, avoidance, passing.stance, keeps=precision is LIVE)

    def _motion(self, scenario: Scenario, precision: Precision) -> tuple[Solved | None, tuple[MotionWarning, ...]]:
        """The motion of a scenario, and why it has none, at the ends or between them."""
        admission = self._admission(scenario, precision)
        if admission.blocked:
            return None, admission.blocked
        solved = self._solved(scenario, admission.nominal, precision)
        return (None, solved.blocked) if solved.blocked else (solved, ())

    def _stages(self, scenario: Scenario, cancelled: Cancelled) -> Iterator[Frame]:
        with _cores.slot():
            live, blocked = self._motion(scenario, LIVE)
            first = None if live is None else self._rollouts(scenario, live, LIVE)
        if live is None or first is None:
            yield from self._stages_without_motion(scenario, blocked, cancelled)
            return
        self._yielded = live
        yield first
        with _cores.slot():
            frame = self._with_arm(first, live, LIVE)
            frame = replace(frame, stage=Stage.LIVE, pictures=self._pictures(scenario, live, coarse=True))
            frame = self._compared(frame)
            self._shown[scenario.task] = frame, live
        yield frame
        with _cores.slot(cancelled):
            fine = self.solved(scenario, FINE)
        with _cores.slot(cancelled):
            frame = self._with_arm(self._rollouts(scenario, fine, FINE), fine, FINE)
            frame = replace(frame, stage=Stage.FINE, pictures=self._pictures(scenario, fine, coarse=False))
            frame = self._compared(replace(frame, blocked=fine.blocked))
            if scenario.view.health_plots and frame.chosen is not None:
                frame = replace(frame, profiles=compose.profiles(frame, fine, frame.chosen, self.follower))
            self._shown[scenario.task] = frame, fine
        self._yielded = fine
        yield frame
        with _cores.slot(cancelled):
            key = scenario.plain, scenario.passing
            certificates = self.memo("certificates", key, lambda: certify(frame, fine, self.follower), newest=1)
        if frame.arm is not None:
            with _cores.slot(cancelled):
                certificates = self.memo("meshes", key, lambda: with_meshes(certificates, frame, fine), newest=1)
        frame = replace(frame, stage=Stage.CERTIFIED, certificates=certificates)
        yield frame
        if fine.arm is not None:
            with _cores.slot(cancelled):
                self.follower.stances(fine.nominal.learned)  # a drag may need them at once
        yield from self._compared_at_rest(frame, fine, cancelled)

    def _compared(self, frame: Frame, notes: Mapping[str, str] | None = None) -> Frame:
        """The frame with other methods beside ours, as far as they are known; `notes` see `Comparison.of`."""
        if not frame.scenario.view.compared:
            return replace(frame, comparison=())
        return replace(frame, comparison=self.comparison.of(frame, self._plain(frame.scenario), notes))

    def _plain(self, scenario: Scenario) -> Learned:
        """What is learned for a scenario in the plain state, which other methods are compared with."""
        return self.nominal(replace(scenario, state="plain", style="")).learned

    def _compared_at_rest(self, frame: Frame, solved: Solved | None, cancelled: Cancelled) -> Iterator[Frame]:
        """The last frame again and again, each with more of what is known of other methods."""
        if not frame.scenario.view.compared:
            return
        left = self.comparison.complete(frame, self._plain(frame.scenario), solved, cancelled)
        while True:
            with _cores.slot(cancelled):
                notes = next(left, None)
                if notes is None:
                    return
                frame = self._compared(frame, notes)
            yield frame

    def _rollouts(self, scenario: Scenario, solved: Solved, precision: Precision) -> Frame:
        """The frame of stage ROLLOUTS."""
        frame = self.memo(
            "rollouts",
            (scenario.plain, scenario.passing, precision),
            lambda: compose.rollouts_frame(scenario, solved, self.follower),
            newest=2,
        )
        return replace(frame, scenario=scenario, level=compose.level_of(scenario, solved.stack))

    def _with_arm(self, frame: Frame, solved: Solved, precision: Precision) -> Frame:
        """The frame of stage ROLLOUTS, with the arm; at LIVE with its motion only if that is drawn."""
        scenario = frame.scenario
        moves = precision is not LIVE or scenario.view.shows_arm_motion
        with_arm = self.memo(
            "arm",
            (scenario.plain, scenario.passing, precision, moves),
            lambda: compose.with_arm(frame, solved, self.follower, moves=moves),
            newest=2,
        )
        return replace(with_arm, scenario=scenario, level=frame.level)

    def _pictures(self, scenario: Scenario, solved: Solved, *, coarse: bool) -> Pictures:
        others = {panel.shown: self._imitated(panel).learned for panel in scenario.view.panels if panel.shown}
        books = {panel: self._book(learned, learned.demonstrated.rest(0)) for panel, learned in others.items()}
        books[Panel(task=scenario.task)] = self._book(solved.below.learned, compose.rest(scenario, solved))
        arm, view = solved.arm, scenario.view
        carried = view.field and arm is not None and not view.level
        pictures = compose.pictures(scenario, solved, books, arrows=view.field and not carried, coarse=coarse)
        if arm is None or not carried:
            return pictures
        robot, reference = self.follower.robot, self.follower.reference(solved.nominal)
        rest, layers = compose.rest(scenario, solved), tuple(layer for _, layer in scenario.active)
        made_for = solved.below if solved.stack.built or scenario.warp < 1 else solved.below.learned
        places = compose.lattice(scenario, solved)
        lattice = self.memo(
            "lattice",
            (scenario.task, view.slice, reference.tobytes()),
            lambda: Lattice.of(places, robot, reference),
            newest=2,
        )
        of = view.slice, rest.tobytes()
        learned = self.memo(
            "learned velocities",
            (solved.below.learned, solved.stack.rays.base.goal.tobytes(), *of),
            lambda: compose.learned_system(scenario, solved).velocity(places),
            newest=2,
        )
        velocities = self.memo(
            "velocities",
            (made_for, layers, *solved.passing.hand.values(), *of),
            lambda: compose.velocities(scenario, solved, learned),
            newest=2,
        )
        return replace(pictures, field=lattice.carried(velocities, arm.transform, robot, scenario.obstacle))

    def _book(self, learned: Learned, rest: Array) -> Sketchbook:
        """The maker of pictures of ψ, at one phase and for one condition."""
        key = (learned, rest.tobytes())
        return self.memo("sketchbook", key, lambda: _sketchbook(learned, rest), newest=NUM_BOOKS)

    def _stages_without_motion(
        self, scenario: Scenario, blocked: tuple[MotionWarning, ...], cancelled: Cancelled = never
    ) -> Iterator[Frame]:
        """The last motion that was shown at every stage, or the undisturbed one, refined, if there is none."""
        if scenario.task not in self._shown:
            undisturbed = self._stages(replace(scenario, stack=_without_obstacles(scenario.stack)), cancelled)
            next(frame for frame in undisturbed if frame.stage is Stage.FINE)
        good, solved = self._shown[scenario.task]
        if good.arm is None and good.stage is Stage.LIVE:
            good = compose.with_arm(good, solved, self.follower)
            self._shown[scenario.task] = good, solved
        seen = replace(good.scenario, view=scenario.view)
        changed = not seen.computes_like(good.scenario)
        good = replace(good, level=compose.level_of(seen, solved.stack))
        q = self.follower.robot.home[None] if good.arm is None else good.arm.q
        certificates = Certificates(float(self.follower.whole_arm.clearance(q, scenario.obstacle).min()))
        for stage in Stage:
            if changed and stage in (Stage.LIVE, Stage.FINE):
                good = replace(good, pictures=self._pictures(seen, solved, coarse=stage is Stage.LIVE))
            good = replace(good, scenario=scenario, stage=stage, blocked=blocked, certificates=certificates)
            yield self._compared(good) if stage >= Stage.LIVE else replace(good, comparison=())
        yield from self._compared_at_rest(good, None, cancelled)


def _without_obstacles(stack: tuple[Layer, ...]) -> tuple[Layer, ...]:
    """The stack with all that avoids switched off."""
    return tuple(replace(layer, on=layer.on and not _avoids(layer.transform)) for layer in stack)


def _avoids(transform: Transform) -> bool:
    return transform.arm_avoidance is not None or bool(transform.avoided.parts)


def _sketchbook(learned: Learned, rest: Array) -> Sketchbook:
    shown, system = learned.demonstrated, frozen(learned.system, rest)
    rays = Rays(system.transform.forward(shown.starts), system.base)
    return Sketchbook(learned.task, in_frame(learned.system.transform), system, rays, shown.paths)
