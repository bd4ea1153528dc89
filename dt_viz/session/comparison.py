"""Other methods beside ours, around the obstacles of a page's scenario: their motions, and how all of them fare."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.baselines.base import INSTALL, Method, NotFittedError, Planner, Problem, is_trained
from dt_viz.baselines.registry import METHODS, problem_of
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array
from dt_viz.memo import Memo, kept
from dt_viz.metrics import discrete_frechet, distance_from_path, maximum_collision_distance, resample_by_arc_length
from dt_viz.motion.following import ArmMotion, Follower, arm_samples
from dt_viz.motion.nominal import Learned
from dt_viz.motion.profiles import NUM_SAMPLES
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError, track
from dt_viz.robot.joint_trajectory import within_velocity_limits
from dt_viz.scenario.scenario import View
from dt_viz.scenario.tasks import Task
from dt_viz.session.drawing import arm_along
from dt_viz.session.frame import Compared, Frame, Scores

OURS = METHODS["ours"]
OTHERS = tuple(method for method in METHODS.values() if method is not OURS)
"""Methods that a page can show beside ours."""
NEWEST = 32  # number of plans that are kept
TOLERANCE = 1e-4  # by how much a maximum collision distance may be too small, metres
WAITS, NEXT, NO_WAY = "waits for the obstacle to rest", "waits for its turn", "finds no way"


@dataclass(eq=False)
class _Record:
    """What is known of a method around an obstacle; it grows while the obstacle rests."""

    known: Compared | None = None  # without curves and arm; None until its motions are planned
    is_complete: bool = False  # whether nothing is left to work out


def _around(method: Method, learned: Learned, frame: Frame) -> tuple[Hashable, ...]:
    """What a method's motions depend on."""
    if method is OURS:
        return method.name, learned, frame.drawn, bool(frame.blocked)
    return method.name, learned, frame.scenario.obstacle


def is_offered(method: Method, task: str) -> bool:
    """Return whether a method can be shown for the task of a name: whether its weights, if any, are made for that."""
    return not method.weights or is_trained(method.weights, task)


def chosen(view: View, task: str) -> list[Method]:
    """Return the methods that a view shows beside ours for the task of a name."""
    return [method for method in OTHERS if method.name in view.compared and is_offered(method, task)]


class Comparison:
    """Motions of other methods, for one engine and on its thread; what an edit leaves unchanged is kept."""

    def __init__(self, follower: Follower, memo: Memo) -> None:
        self._follower, self.memo = follower, memo

    def of(self, frame: Frame, learned: Learned, notes: Mapping[str, str] | None = None) -> tuple[Compared, ...]:
        """The methods that the view of a frame shows, ours first; those that do not follow a drag as far as known.

        Our task is `learned`; `notes`, by the methods' names, say what is waited for.
        """
        return tuple(
            self._compared(method, frame, learned, (notes or {}).get(method.name, WAITS)) for method in _chosen(frame)
        )

    def complete(self, frame: Frame, learned: Learned, cancelled: Cancelled) -> Iterator[Mapping[str, str]]:
        """Work out what is left for a scenario that rests; stops whenever `of` would tell more, with notes for that.

        Raises:
            UnwantedError: it is cancelled, which is asked between parts of the work.
        """
        slow = [method for method in _chosen(frame) if self._record(method, learned, frame).known is None]
        for k, method in enumerate(slow, start=1):
            yield {method.name: f"planning … ({k} of {len(slow)})", **{later.name: NEXT for later in slow[k:]}}
            self._plan(method, frame, learned, cancelled)
        if slow:
            yield {}
        for method in _chosen(frame) if frame.scenario.obstacle.parts else ():
            if (record := self._record(method, learned, frame)).is_complete:
                continue
            if (known := record.known) is not None and known.scores is not None:
                depth = self._arm_depth(known, frame, learned, cancelled)
                record.known = replace(known, scores=replace(known.scores, arm_depth=depth))
            record.is_complete = True
            yield {}

    @kept(NEWEST, by=_around)
    def _record(self, method: Method, learned: Learned, frame: Frame) -> _Record:
        """What is known of a method around the obstacle of a frame: one place for all that is kept."""
        return _Record(_ours(frame) if method is OURS else None)

    def _compared(self, method: Method, frame: Frame, learned: Learned, waiting: str) -> Compared:
        """What is known of a method; `waiting` is its note while its motions are not."""
        if method.live:
            self._plan(method, frame, learned)
        record = self._record(method, learned, frame)
        known = record.known or Compared(method, note=waiting)
        if not known.paths:
            return known
        rollout = frame.chosen if frame.chosen is not None and frame.chosen < len(learned.task.starts) else 0
        shows_arm = frame.scenario.view.their_arm == method.name and len(known.times[rollout]) > 1
        arm = self._arm(record, learned, rollout) if shows_arm else None
        path, demonstration = known.paths[rollout], learned.task.paths[rollout]
        return replace(known, rollout=rollout, curves=curves(path, demonstration, frame.scenario.obstacle), arm=arm)

    def _plan(self, method: Method, frame: Frame, learned: Learned, cancelled: Cancelled = never) -> None:
        """Plan a method's motions unless they are known; those that do not avoid are the same around all obstacles."""
        record, obstacle = self._record(method, learned, frame), frame.scenario.obstacle
        if record.known is None:
            known = self._planned(method, learned, obstacle if method.avoids else Union(), cancelled)
            if known.scores is not None and not method.avoids:
                known = replace(known, scores=replace(known.scores, hand_depth=hand_depth(known.paths, obstacle)))
            record.known = known

    @kept(NEWEST, by=lambda method, learned, obstacle, _: (method.name, learned, obstacle))
    def _planned(self, method: Method, learned: Learned, obstacle: Union, cancelled: Cancelled) -> Compared:
        planner = self._planner(method, learned)
        if isinstance(planner, str):
            return Compared(method, note=planner)
        try:
            plan = planner(obstacle, learned.task.starts, cancelled)
        except UnreachableError as error:
            return Compared(method, note=str(error))
        stays = sum(len(path) < 2 for path in plan.paths)
        notes = (*plan.warnings, *([f"{NO_WAY} from {stays} of {len(plan.paths)} starts"] if stays else []))
        paths = tuple(path if len(path) > 1 else np.repeat(path, 2, axis=0) for path in plan.paths)
        scores = scored(paths, learned.task, learned.goal, obstacle)
        return Compared(method, paths, plan.times, plan.joints, scores, "; ".join(notes))

    @kept(NEWEST, by=lambda method, learned: (method.name, learned))
    def _planner(self, method: Method, learned: Learned) -> Planner | str:
        """The planner of a method for a task, or why there is none."""
        if method.missing:
            return f"needs {', '.join(method.missing)}: {INSTALL}"
        try:
            return method.fit(self._problem(learned))
        except (NotFittedError, UnreachableError) as error:
            return str(error)

    @kept(NEWEST)
    def _problem(self, learned: Learned) -> Problem:
        return problem_of(learned, self._follower)

    @kept(NEWEST, by=lambda record, _, rollout: (record, rollout))
    def _arm(self, record: _Record, learned: Learned, rollout: int) -> ArmMotion:
        assert record.known is not None
        q, times = self._joints(record.known, learned, rollout)
        return ArmMotion(within_velocity_limits(times, q, self._follower.robot.velocity_limits), q, q)

    def _joints(self, known: Compared, learned: Learned, rollout: int) -> tuple[Array, Array]:
        """Postures (N, n), rad, and times (N,), s, of a rollout: planned, or tracked from the demonstrated posture."""
        times = known.times[rollout]
        if known.joints is not None:
            return known.joints[rollout], times
        at, start = np.unique(arm_samples(len(times))), self._problem(learned).postures[rollout][0]
        return track(self._follower.robot, known.paths[rollout][at], start).q, times[at]

    def _arm_depth(self, known: Compared, frame: Frame, learned: Learned, cancelled: Cancelled) -> float | None:
        """How deep the arm's meshes enter the obstacle along motions, metres; None where it cannot follow."""
        model, depth, ours = self._follower.robot.collision, 0.0, known.method is OURS
        try:
            moving = np.flatnonzero(frame.motion.nominal.moving).tolist()
            for k in moving if ours else range(len(known.paths)):
                end_if(cancelled)
                q = arm_along(frame, k, self._follower)[0].q if ours else self._joints(known, learned, k)[0]
                depth = max(depth, -model.nearest_to_obstacle(q, frame.scenario.obstacle).distance)
        except UnreachableError:
            return None
        return depth


def scored(paths: tuple[Array, ...], task: Task, goal: Array, obstacle: Union) -> Scores:
    """Score motions, paths (N_i ≥ 2, 3) from a task's starts to a goal (3,), metres, around an obstacle."""
    even = np.stack([resample_by_arc_length(path, NUM_SAMPLES) for path in paths])
    demonstrated = np.stack([resample_by_arc_length(path, NUM_SAMPLES) for path in task.paths])
    return Scores(
        float(discrete_frechet(even, demonstrated).mean()),
        hand_depth(paths, obstacle),
        float(max(np.linalg.norm(path[-1] - goal) for path in paths)),
    )


def hand_depth(paths: tuple[Array, ...], obstacle: Union) -> float:
    """Maximum collision distance of the end effector on paths (N_i, 3), metres; 0 when all are clear."""
    if not obstacle.parts:
        return 0.0
    return max(maximum_collision_distance(path, obstacle.signed_distance, TOLERANCE) for path in paths) + 0.0


def curves(path: Array, demonstration: Array, obstacle: Union) -> Array:
    """The curves of figure 6 (`NUM_SAMPLES`, 2), metres: distance to the demonstration, and depth in the obstacle.

    They are sampled at even distances along the path (N, 3), metres, of the end effector.
    """
    even = resample_by_arc_length(path, NUM_SAMPLES)
    depth = np.maximum(-obstacle.signed_distance(even), 0.0) if obstacle.parts else np.zeros(len(even))
    return np.column_stack([distance_from_path(even, demonstration), depth])


def _chosen(frame: Frame) -> list[Method]:
    """The methods that the view of a frame shows, ours first; none where it shows no others."""
    others = chosen(frame.scenario.view, frame.task.name)
    return [OURS, *others] if others else []


def _ours(frame: Frame) -> Compared:
    if frame.blocked:
        return Compared(OURS, note=frame.blocked[0].text)
    num = len(frame.task.starts)
    if not frame.shaping[:num].all():
        return Compared(OURS, note=f"{NO_WAY} from some starts")
    paths = frame.rollouts[:num]
    scores = scored(paths, frame.task, frame.goal, frame.scenario.obstacle)
    return Compared(OURS, paths, frame.times[:num], scores=scores)
