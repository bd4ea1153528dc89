"""Other methods beside ours, around the obstacles of a page's scenario: their motions, and how all of them fare."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.arm.collision import load_collision_model
from dt_viz.arm.retiming import within_velocity_limits
from dt_viz.arm.tracking import UnreachableError, track
from dt_viz.baselines.base import INSTALL, Method, NotFittedError, Planner, Problem
from dt_viz.baselines.registry import METHODS, problem_of
from dt_viz.engine.compose import arm_along
from dt_viz.engine.frame import Compared, Frame, Scores
from dt_viz.flows.fields import Array, Indices
from dt_viz.interruption import checkpoint
from dt_viz.memo import Memo
from dt_viz.metrics import discrete_frechet, distance_from_path, maximum_collision_distance, resample_by_arc_length
from dt_viz.motion.following import ArmMotion, Follower, arm_samples
from dt_viz.motion.nominal import Learned
from dt_viz.motion.profiles import NUM_SAMPLES
from dt_viz.motion.solve import Solved
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import Task

OURS = METHODS["ours"]
OTHERS = tuple(method for method in METHODS.values() if method is not OURS)
"""Methods that a page can show beside ours."""
NEWEST = 32
"""Number of plans that are kept."""
TOLERANCE = 1e-4
"""By how much a maximum collision distance may be too small, metres."""
WAITS, NO_WAY = "planned when the obstacle rests", "finds no way"


@dataclass(frozen=True, eq=False)
class _Planned:
    """Motions of a method, from the starts of the demonstrations."""

    paths: tuple[Array, ...] = ()
    """(N_i, 3), metres; none where there are no motions."""
    times: tuple[Array, ...] = ()
    """(N_i,), s."""
    joints: tuple[Array, ...] | None = None
    """(N_i, 6), rad, where the method plans them."""
    scores: Scores | None = None
    note: str = ""


class Comparison:
    """Motions of other methods, for one engine and on its thread; what an edit leaves unchanged is kept."""

    def __init__(self, follower: Follower, memo: Memo) -> None:
        """Compare methods for this arm."""
        self._follower, self._memo = follower, memo

    def of(self, frame: Frame, learned: Learned) -> tuple[Compared, ...]:
        """The methods that the view of a frame shows, ours first; those that do not follow a drag as far as known.

        Args:
            frame: ours, at any stage.
            learned: its task, learned.
        """
        scenario = frame.scenario
        chosen = _chosen(scenario)
        if not chosen:
            return ()
        known = [self._known(method, learned, scenario.obstacle) for method in chosen]
        rollout = frame.chosen if frame.chosen is not None and frame.chosen < len(learned.task.starts) else 0
        return tuple(
            Compared(
                method,
                planned.paths,
                self._with_arm_depth(method, planned.scores, scenario, learned),
                curves(planned.paths[rollout], learned.task.paths[rollout], scenario.obstacle)
                if planned.paths
                else None,
                rollout,
                planned.note,
                self._their_arm(method, planned, learned, scenario, rollout),
            )
            for method, planned in ((OURS, _ours(frame)), *zip(chosen, known, strict=True))
        )

    def steps(self, frame: Frame, learned: Learned, solved: Solved | None) -> Iterator[Callable[[], object]]:
        """What is left to work out for a scenario that rests, in steps after each of which `of` tells more.

        Args:
            frame: ours.
            learned: its task, learned.
            solved: our motion; None where there is none.
        """
        scenario = frame.scenario
        for method in _chosen(scenario):
            if not method.live and not self._memo.has("their plan", (method.name, learned, scenario.obstacle)):
                yield lambda method=method: self._planned(method, learned, scenario.obstacle)
        if not scenario.obstacle.parts or not _chosen(scenario):
            return
        if solved is not None and not self._memo.has("arm depth", _depth_key(OURS, scenario, learned)):
            yield lambda: self._memo(
                "arm depth", _depth_key(OURS, scenario, learned), lambda: self._our_depth(frame, solved), newest=NEWEST
            )
        for method in _chosen(scenario):
            if not self._memo.has("arm depth", _depth_key(method, scenario, learned)):
                yield lambda method=method: self._memo(
                    "arm depth",
                    _depth_key(method, scenario, learned),
                    lambda: self._depth(method, learned, scenario.obstacle),
                    newest=NEWEST,
                )

    def _known(self, method: Method, learned: Learned, obstacle: Union) -> _Planned:
        if method.live or self._memo.has("their plan", (method.name, learned, obstacle)):
            return self._planned(method, learned, obstacle)
        return _Planned(note=WAITS)

    def _planned(self, method: Method, learned: Learned, obstacle: Union) -> _Planned:
        return self._memo(
            "their plan",
            (method.name, learned, obstacle),
            lambda: self._scored(method, learned, obstacle),
            newest=NEWEST,
        )

    def _scored(self, method: Method, learned: Learned, obstacle: Union) -> _Planned:
        """The motions of a method, scored; those that do not avoid are planned once for all obstacles."""
        seen = obstacle if method.avoids else Union()
        planned = self._memo(
            "their motions", (method.name, learned, seen), lambda: self._plan(method, learned, seen), newest=NEWEST
        )
        if planned.scores is None or method.avoids:
            return planned
        return replace(planned, scores=replace(planned.scores, hand_depth=hand_depth(planned.paths, obstacle)))

    def _plan(self, method: Method, learned: Learned, obstacle: Union) -> _Planned:
        planner = self._memo("planner", (method.name, learned), lambda: self._fitted(method, learned), newest=NEWEST)
        if isinstance(planner, str):
            return _Planned(note=planner)
        try:
            plan = planner.plan(obstacle, learned.task.starts)
        except UnreachableError as error:
            return _Planned(note=str(error))
        stays = sum(len(path) < 2 for path in plan.paths)
        notes = (*plan.warnings, *([f"{NO_WAY} from {stays} of {len(plan.paths)} starts"] if stays else []))
        paths = tuple(path if len(path) > 1 else np.repeat(path, 2, axis=0) for path in plan.paths)
        scores = scored(paths, learned.task, learned.goal, obstacle)
        return _Planned(paths, plan.times, plan.joints, scores, "; ".join(notes))

    def _fitted(self, method: Method, learned: Learned) -> Planner | str:
        """The planner of a method for a task, or why there is none."""
        if method.missing:
            return f"needs {', '.join(method.missing)}: {INSTALL}"
        try:
            return method.fit(self._problem(learned))
        except (NotFittedError, UnreachableError) as error:
            return str(error)

    def _problem(self, learned: Learned) -> Problem:
        return self._memo("problem", learned, lambda: problem_of(learned, self._follower), newest=NEWEST)

    def _with_arm_depth(
        self, method: Method, scores: Scores | None, scenario: Scenario, learned: Learned
    ) -> Scores | None:
        key = _depth_key(method, scenario, learned)
        if scores is None or not self._memo.has("arm depth", key):
            return scores
        return replace(scores, arm_depth=self._memo("arm depth", key, lambda: None))

    def _their_arm(
        self, method: Method, planned: _Planned, learned: Learned, scenario: Scenario, rollout: int
    ) -> ArmMotion | None:
        """The arm's motion along a rollout of a method, where the view shows it."""
        if scenario.view.their_arm != method.name or not planned.times or len(planned.times[rollout]) < 2:
            return None
        key = (method.name, learned, scenario.obstacle, rollout)
        return self._memo("their arm", key, lambda: self._moved(planned, learned, rollout), newest=2)

    def _moved(self, planned: _Planned, learned: Learned, rollout: int) -> ArmMotion:
        q = self._joints(planned, learned, rollout)
        times = planned.times[rollout]
        if planned.joints is None:
            times = times[_tracked(len(times))]
        return ArmMotion(within_velocity_limits(times, q, self._follower.robot.velocity_limits), q, q)

    def _joints(self, planned: _Planned, learned: Learned, rollout: int) -> Array:
        """Postures (N, 6), rad, along a rollout: planned, or tracking it from the demonstration's first posture."""
        if planned.joints is not None:
            return planned.joints[rollout]
        path = planned.paths[rollout]
        start = self._problem(learned).postures[rollout][0]
        return track(self._follower.robot, path[_tracked(len(path))], start).q

    def _depth(self, method: Method, learned: Learned, obstacle: Union) -> float | None:
        """How deep the arm's meshes enter the obstacle along a method's motions, metres; None where there are none."""
        planned = self._planned(method, learned, obstacle)
        if not planned.paths:
            return None
        return self._deepest([self._joints(planned, learned, k) for k in range(len(planned.paths))], obstacle)

    def _our_depth(self, frame: Frame, solved: Solved) -> float | None:
        try:
            arms = [arm_along(frame, solved, k, self._follower)[0] for k in range(len(frame.rollouts))]
        except UnreachableError:
            return None
        return self._deepest([arm.q for arm in arms], frame.scenario.obstacle)

    def _deepest(self, joints: list[Array], obstacle: Union) -> float:
        model, depth = load_collision_model(), 0.0
        for q in joints:
            checkpoint()
            depth = max(depth, -model.nearest_to_obstacle(q, obstacle).distance)
        return depth


def scored(paths: tuple[Array, ...], task: Task, goal: Array, obstacle: Union) -> Scores:
    """Score motions from a task's starts.

    Args:
        paths: (N_i, 3) of the end effector, metres, each of at least two samples.
        task: whose demonstrations they are compared with.
        goal: (3,) where they are to end, metres.
        obstacle: what they are to keep clear of.
    """
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


def _tracked(num: int) -> Indices:
    """Indices of the samples that the arm follows, of the `num` of a path."""
    return np.unique(arm_samples(num))


def _chosen(scenario: Scenario) -> list[Method]:
    return [method for method in OTHERS if method.name in scenario.view.compared]


def _depth_key(method: Method, scenario: Scenario, learned: Learned) -> tuple[object, ...]:
    return (scenario.motion,) if method is OURS else (method.name, learned, scenario.obstacle)


def _ours(frame: Frame) -> _Planned:
    """Our motions, those from the starts of the demonstrations that have one."""
    if frame.blocked:
        return _Planned(note="; ".join(warning.text for warning in frame.blocked[:1]))
    paths = frame.rollouts[: len(frame.rollouts) - frame.num_added]
    if len(paths) < len(frame.task.starts):
        return _Planned(note=f"{NO_WAY} from some starts")
    return _Planned(
        paths, frame.times[: len(paths)], None, scored(paths, frame.task, frame.goal, frame.scenario.obstacle)
    )
