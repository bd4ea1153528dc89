"""Scenario → transforms → frames. Knows no browser; keeps what an edit leaves unchanged."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np

from dt_viz.arm.collision import load_collision_model
from dt_viz.arm.retiming import within_velocity_limits
from dt_viz.arm.robot import Robot
from dt_viz.arm.tracking import UnreachableError
from dt_viz.arm.whole_arm import ArmSolution
from dt_viz.engine.frame import Frame, Stage
from dt_viz.engine.turns import Turns
from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Bundle
from dt_viz.interruption import Checkpoint, interruptible
from dt_viz.learning.imitation import ImitationSettings, Progress
from dt_viz.learning.store import FitStore
from dt_viz.metrics import maximum_collision_distance
from dt_viz.motion.certificates import (
    MAX_OFF,
    MAX_OFF_TRACKED,
    Certificates,
    Shown,
    certified,
    certified_arm,
    clearance_warnings,
    delay_warnings,
    hand_warnings,
)
from dt_viz.motion.diagnostics import anchor_warnings, fold_warnings, margin_warnings, motion_warnings, target_warnings
from dt_viz.motion.following import ArmMotion, Follower, arm_samples, far_starts, unreachable
from dt_viz.motion.holding import held
from dt_viz.motion.nominal import Learned, Nominal
from dt_viz.motion.profiles import Profiles, body_profile, hand_profile
from dt_viz.motion.pushing import Pushed, pushed
from dt_viz.motion.solve import FINE, LIVE, Precision, Solution, Solved, cut_off, solve
from dt_viz.motion.warp import warped
from dt_viz.obstacles.union import Union
from dt_viz.pictures.occupancy import occupancy_picture
from dt_viz.pictures.sketchbook import Pictures, Sketchbook, in_frame
from dt_viz.pictures.slice_fields import arrows_and_colour, streamlines
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import WHOLE_ARM, levels
from dt_viz.scenario.starts import followed
from dt_viz.scenario.tasks import Task, TaskEntry
from dt_viz.transforms.base import Transform
from dt_viz.warning import ARM, Kind, MotionWarning


@dataclass
class _Kept:
    """What has been worked out of one motion, which is not again when only the view changes."""

    scenario: Scenario
    nominal: Nominal
    solved: dict[Precision, Solved] = field(default_factory=dict)
    rollouts: dict[Precision, Frame] = field(default_factory=dict)
    """Frames of stage ROLLOUTS."""
    arms: dict[Precision, Frame] = field(default_factory=dict)
    """The same with the arm."""
    certificates: Certificates | None = None


_turns = Turns()
"""Engines take turns. Small array operations of several threads would fight for the interpreter, and all would lose:
four sessions that drag at once get twice as many frames this way."""


def let_drags_pass(longest: float) -> None:
    """Wait while an engine follows a hand, at most so many seconds; called often by what takes long beside engines."""
    _turns.let_pass(longest)


@contextmanager
def _in_turn(checkpoint: Checkpoint | None = None) -> Iterator[None]:
    """Within this block compute when it is this engine's turn, letting others go first when they are due.

    Args:
        checkpoint: of what refines: others that follow a hand are due before it, and what this raises ends it, also
            while it waits for its turn.
    """
    wanted = checkpoint or (lambda: None)

    def pause() -> None:
        wanted()
        _turns.give_way(wanted)

    with _turns.taken(patient=checkpoint is not None, checkpoint=wanted), interruptible(pause):
        yield


class Engine:
    """Computes frames for one visitor. Not thread-safe: one worker thread calls it, but for `task`.

    The same scenario always gives the same frame, with two exceptions. Where there is no motion for it the last one
    that there was for the task is shown, marked by `Frame.blocked`. And up to stage LIVE joints are looked for from
    those shown before: they differ by less than a milliradian.
    """

    def __init__(self, tasks: Mapping[str, TaskEntry], fits: FitStore, robot: Robot) -> None:
        self._loaders = tasks
        self._fits = fits
        self._robot = robot
        self._follower = Follower(robot)
        self._tasks: dict[str, Task] = {}
        self._learned: dict[tuple[str, bool, str], Learned] = {}
        self._good: dict[str, tuple[Frame, Solved]] = {}
        """The last motion of each task."""
        self._kept: _Kept | None = None
        """Of the newest motion."""
        self._full: dict[Precision, Solved] = {}
        """The last full stacks: while only the warp changes, nothing of them does."""
        self._shown: Solved | None = None
        """The last motion that an arm was shown for."""
        self._live: Solved | None = None
        """The same as it was at stage LIVE: quicker, and exact enough for a hand that moves."""
        self._sketchbook = lru_cache(maxsize=2)(_sketchbook)

    def task(self, name: str) -> Task:
        """The task of that name, loaded on first use; may be called by any thread.

        Raises:
            DemonstrationError: its file cannot be used.
        """
        known = self._tasks.get(name)
        return self._tasks.setdefault(name, self._loaders[name]()) if known is None else known

    def frames(
        self, scenario: Scenario, progress: Progress | None = None, checkpoint: Checkpoint = lambda: None
    ) -> Iterator[Frame]:
        """Frames for a scenario, one for each stage; stop iterating to skip what is not wanted any more.

        Args:
            scenario: what to show.
            progress: called while a task is fitted for the first time; see `dt_viz.learning.imitation.fit`.
            checkpoint: called often after stage LIVE; what it raises ends the computation.

        Raises:
            DemonstrationError: the task's demonstrations cannot be read.
            ImitationError: nothing can be learned from them.
        """
        nominal = self._nominal(scenario, progress)
        began = time.perf_counter()
        for frame in self._stages(nominal, scenario, checkpoint):
            yield replace(frame, seconds=time.perf_counter() - began)

    def arm_motions(self, scenario: Scenario) -> tuple[Frame, tuple[ArmMotion, ...]]:
        """The frame of stage FINE, without pictures, and the arm's motion along each rollout; none if it is blocked.

        Raises:
            DemonstrationError, ImitationError: as `frames`.
            UnreachableError: the arm cannot get to where the motions start.
        """
        nominal = self._nominal(scenario, None)
        avoidance = scenario.arm_avoidance
        if avoidance is not None:
            blocked = self._follower.obstructions(nominal, avoidance.obstacle)
            if blocked:
                *_, frame = self._stages_without_motion(nominal, scenario, blocked)
                return frame, ()
            nominal = self._follower.admitted(nominal, avoidance.obstacle)
        fine = self._solved(nominal, scenario, FINE)
        frame = self._frame(scenario, fine)
        arms, certificates = [], frame.certificates
        for rollout in range(len(frame.rollouts)):
            arm, warnings = self._arm(frame, fine, rollout, exact=True)
            arms.append(arm)
            certificates = certificates.warning(*warnings)
        return replace(frame, stage=Stage.FINE, certificates=certificates), tuple(arms)

    def pushed(self, scenario: Scenario, q: Array, rng: np.random.Generator) -> Pushed | None:
        """The arm's motion after the hand is pushed aside; None unless a motion of this scenario is shown.

        Args:
            scenario: whose frames were computed last.
            q: (6,) joint angles when the push begins, rad.
            rng: for its direction.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        if self._shown is None or not self._shown.scenario.moves_like(scenario):
            return None
        with _in_turn():
            return pushed(self._follower, self._shown, q, rng)

    def held(self, scenario: Scenario, q: Array, place: Array) -> Pushed | None:
        """The arm with its hand held at a place; None unless a motion of this scenario is shown.

        Args:
            scenario: whose frames were computed last.
            q: (6,) joint angles now, rad.
            place: (3,) where the hand should be, metres.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        if self._live is None or not self._live.scenario.moves_like(scenario):
            return None
        with _in_turn():
            return held(self._follower, self._live, q, place)

    def _stages(self, nominal: Nominal, scenario: Scenario, checkpoint: Checkpoint = lambda: None) -> Iterator[Frame]:
        kept = self._kept
        if kept is None or not kept.scenario.moves_like(scenario):
            avoidance = scenario.arm_avoidance
            if avoidance is not None:
                with _in_turn():
                    blocked = self._follower.obstructions(nominal, avoidance.obstacle)
                    admitted = nominal if blocked else self._follower.admitted(nominal, avoidance.obstacle)
                if blocked:
                    yield from self._stages_without_motion(nominal, scenario, blocked, checkpoint)
                    return
                nominal = admitted
            kept = self._kept = _Kept(scenario, nominal)
        nominal = kept.nominal
        with _in_turn():
            live = _once(kept.solved, LIVE, lambda: self._solved(nominal, scenario, LIVE))
            first = _once(kept.rollouts, LIVE, lambda: self._frame(scenario, live))
            first = replace(first, scenario=scenario, level=_level(scenario, live.stack))
        yield first
        with _in_turn():
            frame = _once(kept.arms, LIVE, lambda: self._with_arm(first, live, exact=False))
            pictures = self._pictures(scenario, live, coarse=True)
            frame = replace(frame, scenario=scenario, level=first.level, stage=Stage.LIVE, pictures=pictures)
            self._good[scenario.task] = frame, live
            self._shown = self._live = live
        yield frame

        with _in_turn(checkpoint):
            fine = _once(kept.solved, FINE, lambda: self._solved(nominal, scenario, FINE))
            exact = _once(kept.rollouts, FINE, lambda: self._frame(scenario, fine))
            frame = _once(kept.arms, FINE, lambda: self._with_arm(exact, fine, exact=True))
            pictures = self._pictures(scenario, fine, coarse=False)
            frame = replace(frame, scenario=scenario, level=first.level, stage=Stage.FINE, pictures=pictures)
            if scenario.view.health_plots and frame.chosen is not None:
                frame = replace(frame, profiles=self._profiles(frame, fine, frame.chosen))
            self._good[scenario.task] = frame, fine
            self._shown = fine
        yield frame
        if kept.certificates is None:
            with _in_turn(checkpoint):
                certificates = self._certified(frame, fine)
            if frame.arm is not None:
                with interruptible(checkpoint):  # out of turn: the first time it prepares meshes for seconds
                    certificates = _with_meshes(certificates, frame, fine)
            kept.certificates = certificates
        yield replace(frame, stage=Stage.CERTIFIED, certificates=kept.certificates)

    def _certified(self, frame: Frame, fine: Solved) -> Certificates:
        """Certificates of the motions that the frame shows, with the transforms that they were solved with."""
        known = self._certified_hand(frame, fine) if fine.arm is None else self._certified_arm(frame, fine, fine.arm)
        if frame.arm is None or frame.chosen is None:
            return known
        path, due = frame.rollouts[frame.chosen], frame.times[frame.chosen]
        if fine.arm is None:
            keep = arm_samples(len(path))
            known = known.warning(*hand_warnings(self._robot, frame.arm.q, path[keep], source=ARM))
            due = due[keep]
        return known.warning(*delay_warnings(self._robot, frame.arm.q, frame.arm.times, due))

    def _certified_hand(self, frame: Frame, fine: Solved) -> Certificates:
        stack, obstacle, path = fine.stack, frame.scenario.obstacle, np.concatenate(frame.rollouts)
        shown = Shown(stack.bundle.index, stack.bundle.fraction, np.concatenate(frame.times), path)
        known = certified(frame.certificates, stack, fine.ends, shown)
        known = known.warning(*clearance_warnings(known.clearance, float(obstacle.signed_distance(path).min())))
        depth = max(maximum_collision_distance(path, obstacle.signed_distance) for path in frame.rollouts)
        return replace(known, clearance=-depth if depth > 0 else known.clearance)

    def _certified_arm(self, frame: Frame, fine: Solved, arm: ArmSolution) -> Certificates:
        scenario, robot, whole_arm = frame.scenario, self._robot, self._follower.whole_arm
        p, undisturbed, known = arm.p.copy(), whole_arm.limits.inside(arm.q), frame.certificates
        if frame.arm is not None:
            p[arm.index == frame.chosen] = frame.arm.q
        path, times = np.concatenate(frame.rollouts), np.concatenate(frame.times)
        avoidance = scenario.arm_avoidance
        assert avoidance is not None
        integration = avoidance.integration
        known = known.warning(
            *hand_warnings(robot, p, path, tolerance=MAX_OFF),
            *fold_warnings(WHOLE_ARM, arm.transform, integration, p, undisturbed),
        )
        known, q = certified_arm(known, arm.transform, p, undisturbed, by_hand=integration.by_hand)
        shown = Shown(arm.index, arm.fraction, times, robot.end_effector(q))
        known = certified(known, fine.stack, fine.ends, shown, tolerance=MAX_OFF_TRACKED)
        hosts = arm.index < len(frame.rollouts) - fine.nominal.num_added
        kept = float(whole_arm.clearance(p[hosts], avoidance.obstacle).min())
        return known.warning(*clearance_warnings(known.clearance, kept))

    def _stages_without_motion(
        self,
        nominal: Nominal,
        scenario: Scenario,
        blocked: tuple[MotionWarning, ...],
        checkpoint: Checkpoint = lambda: None,
    ) -> Iterator[Frame]:
        """The last good motion at every stage, or the undisturbed one, refined, if there is none."""
        if scenario.task not in self._good:
            undisturbed = self._stages(nominal, replace(scenario, stack=_without_obstacles(scenario.stack)), checkpoint)
            next(frame for frame in undisturbed if frame.stage is Stage.FINE)
        good, solved = self._good[scenario.task]
        seen = replace(good.scenario, view=scenario.view)
        changed = not seen.computes_like(good.scenario)
        good = replace(good, level=_level(seen, solved.stack))
        clearance = float(self._follower.whole_arm.clearance(self._any_arm(good), scenario.obstacle).min())
        certificates = Certificates(clearance)
        for stage in Stage:
            if changed and stage in (Stage.LIVE, Stage.FINE):
                good = replace(good, pictures=self._pictures(seen, solved, coarse=stage is Stage.LIVE))
            yield replace(good, scenario=scenario, stage=stage, blocked=blocked, certificates=certificates)

    def _nominal(self, scenario: Scenario, progress: Progress | None) -> Nominal:
        key = (scenario.task, scenario.imitation, scenario.objective)
        if key not in self._learned:
            task = self.task(scenario.task)
            imitation = self._fits.get(task.demonstrations, ImitationSettings(scenario.objective), progress)
            self._learned[key] = Learned.of(task, imitation, imitates=scenario.imitation)
        return self._learned[key].nominal(scenario.starts)

    def _solved(self, nominal: Nominal, scenario: Scenario, precision: Precision) -> Solved:
        full = self._fully_solved(nominal, replace(scenario, warp=1.0), precision)
        if scenario.warp == 1:
            return full
        below = nominal.warped(scenario.warp)
        stack = warped(below, full.stack, scenario.warp, precision)
        if full.arm is None:
            return Solved(scenario, nominal, below, stack, None, None)
        exact = precision is not LIVE
        lifted, whole_arm = self._follower.behaving(nominal, stack, exact=exact), self._follower.whole_arm
        assert scenario.arm_avoidance is not None
        arm = whole_arm.warped(full.arm, lifted, scenario.arm_avoidance, scenario.warp, precision.spacing)
        return Solved(scenario, nominal, below, stack, arm, lifted)

    def _fully_solved(self, nominal: Nominal, scenario: Scenario, precision: Precision) -> Solved:
        known = self._full.get(precision)
        if known is not None and nominal.moves_like(known.nominal) and scenario.moves_like(known.scenario):
            return known
        stack, arm, lifted, follower = solve(nominal, scenario.active, precision), None, None, self._follower
        avoidance = scenario.arm_avoidance
        if avoidance is not None:
            exact = precision is not LIVE
            lifted = follower.behaving(nominal, stack, exact=exact) if stack.built else follower.undisturbed(nominal)
            arm = follower.whole_arm.avoiding(lifted, avoidance, precision.spacing, coarse=precision is LIVE)
        solved = self._full[precision] = Solved(scenario, nominal, nominal, stack, arm, lifted)
        return solved

    def _frame(self, scenario: Scenario, solved: Solved) -> Frame:
        """The frame of stage ROLLOUTS."""
        nominal, stack, arm = solved.nominal, solved.stack, solved.arm
        if arm is None:
            index, fraction, positions = stack.bundle.index, stack.bundle.fraction, stack.bundle.positions
            clearance = float(scenario.obstacle.signed_distance(positions).min())
        else:
            index, fraction, positions = arm.index, arm.fraction, self._robot.end_effector(arm.p)
            clearance = arm.clearance
        shown = Bundle(index, fraction, positions[:, None])
        reached = positions[-1]
        warnings = motion_warnings(solved, float(np.linalg.norm(reached - nominal.goal)))
        warnings += anchor_warnings(stack)
        if scenario.avoids and scenario.warp == 1:
            warnings += target_warnings(solved, self._robot)
        made = [stack.at(place) for place in range(len(scenario.stack))]
        return Frame(
            scenario=scenario,
            task=nominal.task,
            stage=Stage.ROLLOUTS,
            ghost=nominal.paths,
            rollouts=shown.paths,
            chosen=nominal.rollout(followed(scenario, nominal.num_demonstrated)),
            times=shown.split(stack.rays.times(index, fraction)),
            levels=tuple(stack.bundle.split(level) for level in np.moveaxis(stack.bundle.levels, 1, 0)),
            level=_level(scenario, stack),
            goal=nominal.goal,
            reached=reached,
            blocked=(),
            certificates=Certificates(clearance, found=warnings),
            learned_steps=_learned_steps(nominal),
            durations=tuple(applied.made.duration if applied else None for applied in made),
            chosen_values=tuple(applied.made.chosen if applied else {} for applied in made),
            arm_duration=arm.duration if arm else None,
        )

    def _with_arm(self, frame: Frame, solved: Solved, *, exact: bool) -> Frame:
        nominal = solved.nominal
        arm, warnings = None, ()
        try:
            far = self._follower.out_of_reach(nominal)
            if frame.chosen is not None and not far[frame.chosen]:
                arm, warnings = self._arm(frame, solved, frame.chosen, exact=exact)
            warnings += tuple(far_starts(np.flatnonzero(far), nominal.num_demonstrated))
        except UnreachableError as error:
            warnings = (unreachable(error),)
        return replace(frame, arm=arm, certificates=frame.certificates.warning(*warnings))

    def _arm(
        self, frame: Frame, solved: Solved, chosen: int, *, exact: bool
    ) -> tuple[ArmMotion, tuple[MotionWarning, ...]]:
        """The joint motion along a rollout, and what is wrong with it."""
        nominal, times = solved.nominal, frame.times[chosen]
        if solved.arm is not None and solved.lifted is not None:
            rows = solved.arm.index == chosen
            q, fraction = solved.arm.p[rows], solved.arm.fraction[rows]
            warnings = self._follower.warnings(solved.lifted.tracked, chosen)
        else:
            bundle = solved.stack.bundle
            path, fraction = frame.rollouts[chosen], bundle.split(bundle.fraction)[chosen]
            keep = arm_samples(len(path))
            joints = self._follower.along(nominal, chosen, path[keep], exact=exact)
            q, times, fraction = joints.q, times[keep], fraction[keep]
            warnings = self._follower.warnings(joints, chosen)
        without = self._follower.undisturbed(nominal.only([chosen])).at(np.zeros(len(fraction), int), fraction)
        return ArmMotion(within_velocity_limits(times, q, self._robot.velocity_limits), q, without), warnings

    def _profiles(self, frame: Frame, solved: Solved, chosen: int) -> Profiles:
        """Of a rollout, with and without behaviours."""
        nominal = solved.nominal
        obstacle, arm, task = frame.scenario.obstacle, solved.arm, nominal.task
        path, undisturbed = frame.rollouts[chosen], nominal.paths[chosen]
        of_mean, system = chosen >= nominal.num_demonstrated, solved.stack.system
        demonstration = task.mean_path if of_mean else task.paths[chosen]
        if arm is None:
            return Profiles(
                hand_profile(path, demonstration, system, obstacle),
                hand_profile(undisturbed, demonstration, nominal.system, obstacle),
                of_mean=of_mean,
            )
        p, only = arm.p[arm.index == chosen], nominal.only([chosen])
        below = self._robot.end_effector(arm.transform.forward(p))
        q = self._follower.undisturbed(only).at(only.bundle.index, only.bundle.fraction)
        clearance = self._follower.whole_arm.clearance
        return Profiles(
            body_profile(path, demonstration, system.lyapunov(below), clearance(p, obstacle)),
            body_profile(undisturbed, demonstration, nominal.system.lyapunov(undisturbed), clearance(q, obstacle)),
            of_body=True,
            of_mean=of_mean,
        )

    def _pictures(self, scenario: Scenario, solved: Solved, *, coarse: bool) -> Pictures:
        """Those that the view shows, on its slice and of its level."""
        nominal, stack = solved.below, solved.stack
        view, book, area = (
            scenario.view,
            self._sketchbook(nominal.learned),
            nominal.task.slice.posed(scenario.view.slice),
        )
        level = _level(scenario, stack)
        built = stack.built[:level]
        system = stack.system if level is None else cut_off(nominal, stack, level)
        # no motion comes to where an obstacle is that is avoided below this level
        clearance = Union(tuple(part for applied in built for part in applied.transform.avoided.parts)).signed_distance
        field, colour = arrows_and_colour(system, area, clearance, view.colour, arrows=view.field, coarse=coarse)
        return Pictures(
            field=field,
            streamlines=streamlines(system, area, clearance, coarse=coarse) if view.streamlines else None,
            colour=colour,
            generator=book.generator(area, view.generator_layer) if view.generator else None,
            grid=book.grid(area, [applied.made.transform for applied in built], coarse=coarse) if view.grid else None,
            base=book.base(stack.rays) if view.base else None,
            occupancy=occupancy_picture(area, scenario.obstacles, coarse=coarse)
            if view.colour == "occupancy"
            else None,
        )

    def _any_arm(self, frame: Frame) -> Array:
        return self._robot.home[None] if frame.arm is None else frame.arm.q


def _with_meshes(known: Certificates, frame: Frame, fine: Solved) -> Certificates:
    """What is known with what the meshes of the arm come near to: of the one that is shown, and of all that avoid."""
    assert frame.arm is not None
    model, scenario, avoidance = load_collision_model(), frame.scenario, frame.scenario.arm_avoidance
    report = model.report(frame.arm.q, scenario.obstacle)
    # what gives way only in part may still be in the obstacle
    apart = {Kind.ARM_ENTERS} if scenario.warp < 1 else set()
    known = replace(known, collision=report).warning(*(w for w in report.warnings if w.kind not in apart))
    if fine.arm is None or avoidance is None:
        return known
    hosts = range(len(frame.rollouts) - fine.nominal.num_added)
    nearest = [model.nearest_to_obstacle(fine.arm.p[fine.arm.index == host], avoidance.obstacle) for host in hosts]
    return known.warning(*margin_warnings(scenario, nearest))


_Made = TypeVar("_Made")


def _once(kept: dict[Precision, _Made], precision: Precision, make: Callable[[], _Made]) -> _Made:
    """What was made at this precision, or is now."""
    if precision not in kept:
        kept[precision] = make()
    return kept[precision]


def _without_obstacles(stack: tuple[Layer, ...]) -> tuple[Layer, ...]:
    """The stack with all that avoids switched off."""
    return tuple(replace(layer, on=layer.on and not _avoids(layer.transform)) for layer in stack)


def _avoids(transform: Transform) -> bool:
    return transform.arm_avoidance is not None or bool(transform.avoided.parts)


def _learned_steps(nominal: Nominal) -> tuple[int, ...]:
    flows = in_frame(nominal.system.transform)
    return () if flows is None else tuple(flow.steps for flow in flows.parts if isinstance(flow, Flow))


def _level(scenario: Scenario, stack: Solution) -> int | None:
    """Which level the view names, if it is in the stack."""
    names = levels(scenario)[: 1 + len(stack.built)]
    return names.index(scenario.view.level) if scenario.view.level in names else None


def _sketchbook(learned: Learned) -> Sketchbook:
    """What makes the pictures of ψ."""
    return Sketchbook(learned.task, in_frame(learned.system.transform), learned.system, learned.demonstrated.rays)
