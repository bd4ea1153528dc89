"""Other methods beside ours, around the obstacles of a page's scenario: their motions, and how all of them fare."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.baselines.base import INSTALL, Method, NotFittedError, Planner, Problem
from dt_viz.baselines.registry import OURS, others, problem_of
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

NEWEST = 32  # number of plans that are kept
TOLERANCE = 1e-4  # by how much a maximum collision distance may be too small, metres
WAITS, NEXT, NO_WAY = "waits for the obstacle to rest", "waits for its turn", "finds no way"


def chosen(view: View, task: str) -> list[Method]:
    """Return the methods that a view shows beside ours for the task of a name."""
    return [method for method in others() if method.name in view.compared and method.is_offered(task)]


@dataclass(eq=False)
class _Result:
    """What is known of a method around an obstacle; it grows while the obstacle rests."""

    known: Compared | None = None  # without curves and arm; None until its motions are planned


def _around(method: Method, learned: Learned, frame: Frame) -> tuple[Hashable, ...]:
    """What a method's motions depend on."""
    if method is OURS:
        return method.name, learned, frame.drawn, bool(frame.blocked)
    return method.name, learned, frame.scenario.obstacle


class Comparison:
    """Motions of the compared methods, for one engine and on its thread; what an edit leaves unchanged is kept."""

    def __init__(self, follower: Follower, memo: Memo) -> None:
        self._follower, self.memo = follower, memo

    def of(self, frame: Frame, learned: Learned, cancelled: Cancelled = never) -> Iterator[tuple[Compared, ...]]:
        """The methods that the view of a frame shows, ours first, again each time that more is known of them.

        First with what follows a drag and what is kept; then, for an obstacle that rests, methods that do not follow a
        drag are planned one after the other, and at last the depth of the arm's meshes is worked out. The task of ours
        is `learned`.

        Raises:
            UnwantedError: it is cancelled, which is asked between parts of the work.
        """
        beside = chosen(frame.scenario.view, frame.task.name)
        results = {method: self._result(method, learned, frame) for method in ((OURS, *beside) if beside else ())}

        def so_far(notes: Mapping[Method, str]) -> tuple[Compared, ...]:
            known = {m: result.known or Compared(m, note=notes.get(m, WAITS)) for m, result in results.items()}
            return tuple(self._of_frame(compared, frame, learned) for compared in known.values())

        for method, result in results.items():
            if method is OURS or method.live:
                result.known = result.known or self._scored(method, frame, learned, cancelled)
        yield so_far({})
        slow = [method for method, result in results.items() if result.known is None]
        for k, method in enumerate(slow, start=1):
            yield so_far({method: f"planning … ({k} of {len(slow)})", **dict.fromkeys(slow[k:], NEXT)})
            results[method].known = self._scored(method, frame, learned, cancelled)
        if slow:
            yield so_far({})
        for result in results.values() if frame.scenario.obstacle.parts else ():
            known = result.known
            if known is not None and known.scores is not None and known.scores.arm_depth is None:
                depth = self._arm_depth(known, frame, learned, cancelled)
                result.known = replace(known, scores=replace(known.scores, arm_depth=depth))
                yield so_far({})

    @kept(NEWEST, by=_around)
    def _result(self, method: Method, learned: Learned, frame: Frame) -> _Result:
        """The place of all that is kept of a method around the obstacle of a frame."""
        return _Result()

    def _scored(self, method: Method, frame: Frame, learned: Learned, cancelled: Cancelled) -> Compared:
        """A method's motions around the obstacle of a frame with their scores, or a note why there are none."""
        if method is OURS:
            return _ours(frame)
        obstacle = frame.scenario.obstacle
        try:
            known = self._planned(method, learned, obstacle if method.avoids else Union(), cancelled)
        except (NotFittedError, UnreachableError) as error:
            return Compared(method, note=str(error))
        if method.avoids or known.scores is None:
            return known
        return replace(known, scores=replace(known.scores, hand_depth=hand_depth(known.paths, obstacle)))

    @kept(NEWEST, by=lambda method, learned, obstacle, _: (method.name, learned, obstacle))
    def _planned(self, method: Method, learned: Learned, obstacle: Union, cancelled: Cancelled) -> Compared:
        plan = self._planner(method, learned)(obstacle, learned.task.starts, cancelled)
        stays = sum(len(path) < 2 for path in plan.paths)
        notes = (*plan.warnings, *([f"{NO_WAY} from {stays} of {len(plan.paths)} starts"] if stays else []))
        paths = tuple(path if len(path) > 1 else np.repeat(path, 2, axis=0) for path in plan.paths)
        scores = scored(paths, learned.task, learned.goal, obstacle)
        return Compared(method, paths, plan.times, plan.joints, scores, "; ".join(notes))

    @kept(NEWEST, by=lambda method, learned: (method.name, learned))
    def _planner(self, method: Method, learned: Learned) -> Planner:
        if method.missing:
            raise NotFittedError(f"needs {', '.join(method.missing)}: {INSTALL}")
        return method.fit(self._problem(learned))

    @kept(NEWEST)
    def _problem(self, learned: Learned) -> Problem:
        return problem_of(learned, self._follower)

    def _of_frame(self, known: Compared, frame: Frame, learned: Learned) -> Compared:
        """The same with the curves of the motion that the arm of a frame follows, and the arm where it is shown."""
        if not known.paths:
            return known
        rollout = frame.chosen if frame.chosen is not None and frame.chosen < len(learned.task.starts) else 0
        shows_arm = frame.scenario.view.their_arm == known.method.name and len(known.times[rollout]) > 1
        drawn = curves(known.paths[rollout], learned.task.paths[rollout], frame.scenario.obstacle)
        arm = self._arm(known, learned, rollout) if shows_arm else None
        return replace(known, rollout=rollout, curves=drawn, arm=arm)

    @kept(NEWEST)
    def _arm(self, known: Compared, learned: Learned, rollout: int) -> ArmMotion:
        """The arm along a motion, as planned, or tracking it from the demonstrated posture."""
        times = known.times[rollout]
        if known.joints is not None:
            q = known.joints[rollout]
        else:
            at, start = np.unique(arm_samples(len(times))), self._problem(learned).postures[rollout][0]
            q, times = track(self._follower.robot, known.paths[rollout][at], start).q, times[at]
        return ArmMotion(within_velocity_limits(times, q, self._follower.robot.velocity_limits), q, q)

    def _arm_depth(self, known: Compared, frame: Frame, learned: Learned, cancelled: Cancelled) -> float | None:
        """How deep the arm's meshes enter the obstacle along motions, metres; None where it cannot follow."""
        model, depth, is_ours = self._follower.robot.collision, 0.0, known.method is OURS
        try:
            moving = np.flatnonzero(frame.motion.nominal.moving).tolist()
            for k in moving if is_ours else range(len(known.paths)):
                end_if(cancelled)
                arm = arm_along(frame, k, self._follower)[0] if is_ours else self._arm(known, learned, k)
                depth = max(depth, -model.nearest_to_obstacle(arm.q, frame.scenario.obstacle).distance)
        except UnreachableError:
            return None
        return depth


def _ours(frame: Frame) -> Compared:
    """Our motions from the task's starts, as the frame has them."""
    num = len(frame.task.starts)
    if frame.blocked or not frame.shaping[:num].all():
        return Compared(OURS, note=frame.blocked[0].text if frame.blocked else f"{NO_WAY} from some starts")
    paths = frame.rollouts[:num]
    scores = scored(paths, frame.task, frame.goal, frame.scenario.obstacle)
    return Compared(OURS, paths, frame.times[:num], scores=scores)


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
