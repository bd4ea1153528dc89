"""The arm follows the motions of its end effector: which joints, what is out of reach, what is in the way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dt_viz.arm.body_points import load_body_points
from dt_viz.arm.collision import load_collision_model
from dt_viz.arm.robot import NUM_JOINTS, Robot
from dt_viz.arm.tracking import JointPath, UnreachableError, drawn_onto, inverse_kinematics, track
from dt_viz.arm.whole_arm import NUM_CONFIGURATIONS, Lift, WholeArm, joined, lift
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.metrics import arc_length
from dt_viz.motion.nominal import Learned, Nominal, Strand
from dt_viz.motion.solve import Solution
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import MAX_STARTS
from dt_viz.scenario.tasks import Task
from dt_viz.transforms.base import start_warnings
from dt_viz.warning import ARM, Kind, MotionWarning

BY_FRACTION = 0.3
"""Part of the even spacing of postures that goes by the fraction of the base ray, not by the length of the path."""
MAX_TRACKING_ERROR = 1e-3
"""Metres by which the hand may miss its path before it is said."""
NUM_ARM_SAMPLES = 200
"""Of the motion that the arm shows where it follows a path of the end effector."""


@dataclass(frozen=True)
class ArmMotion:
    """The joint motion along one rollout."""

    times: Array
    """(T,) seconds, later than the rollout's where the joints' velocity limits ask for it."""
    q: Array
    """(T, 6) joint angles at these times, rad; continuous joints unwrapped."""
    without: Array
    """(T, 6) the same at the same moments of the motion without avoidance."""


class Follower:
    """Lifts the motions of one visitor to the joints, and keeps what a drag leaves unchanged."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.body = load_body_points()
        self.whole_arm = WholeArm(robot, self.body)
        self._lifts: dict[Learned, Lift | UnreachableError] = {}
        self._before: dict[tuple[Learned, int | None], Array] = {}
        newest = lru_cache(maxsize=2 * MAX_STARTS)  # a start that is dragged leaves nothing behind
        self._added, self._reaches = newest(self._lift_added), newest(self._gets_to)
        self._joined = lru_cache(maxsize=4)(self._join)

    def undisturbed(self, nominal: Nominal) -> Lift:
        """The joints along the motion without any behaviour.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        learned = nominal.learned
        if learned not in self._lifts:
            try:
                self._lifts[learned] = self._lift_demonstrated(learned)
            except UnreachableError as error:
                self._lifts[learned] = error
        lifted = self._lifts[learned]
        if isinstance(lifted, UnreachableError):
            raise lifted
        if nominal is learned.demonstrated:
            return lifted
        return self._joined(nominal)

    def reference(self, nominal: Nominal) -> Array:
        """The posture (6,), rad, that the arm stays near to.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        return self.undisturbed(nominal.learned.demonstrated).reference

    def behaving(self, nominal: Nominal, solution: Solution, *, exact: bool) -> Lift:
        """The joints along the motion with the behaviours of the end effector.

        Args:
            nominal: what it begins from.
            solution: that motion.
            exact: whether the end effector is on that motion between the samples, too, whatever was shown before; else
                it may be off by millimetres where the stack stretches space, and begins from what was shown before.
        """
        fraction = []
        for path, fractions in zip(solution.bundle.paths, solution.bundle.split(solution.bundle.fraction), strict=True):
            length = arc_length(path)
            # where the stack stretches a path, samples by its length alone lie far apart in its fraction
            place = (1 - BY_FRACTION) * length / length[-1] + BY_FRACTION * fractions
            fraction.append(np.interp(np.linspace(0, 1, NUM_CONFIGURATIONS), place, fractions))
        index = np.repeat(np.arange(len(fraction)), NUM_CONFIGURATIONS)
        paths = solution.positions_at(index, np.concatenate(fraction)).reshape(len(fraction), NUM_CONFIGURATIONS, 3)
        reference, initial = self.reference(nominal), self._before.get((nominal.learned, None))
        if exact or (initial is not None and len(initial) != len(paths)):
            initial = None  # starts have come or gone
        lifted = replace(lift(self.robot, np.stack(fraction), paths, reference, initial), num_guests=nominal.num_added)
        self._before[nominal.learned, None] = lifted.tracked.q
        if not exact:
            return lifted

        def exactly(q: Array, index: Indices, fraction: Array) -> Array:
            return drawn_onto(self.robot, q, solution.positions_at(index, fraction), reference)

        return replace(lifted, exactly=exactly)

    def along(self, nominal: Nominal, rollout: int, path: Array, *, exact: bool) -> JointPath:
        """The joints along one path (T, 3) of the end effector, metres, T being `NUM_ARM_SAMPLES`.

        They begin from what was shown before, unless `exact`.
        """
        number = nominal.numbers[rollout]
        before = None if exact else self._before.get((nominal.learned, number))
        joints = track(self.robot, path, self.reference(nominal), before)
        self._before[nominal.learned, number] = joints.q
        return joints

    def obstructions(self, nominal: Nominal, obstacle: Union) -> tuple[MotionWarning, ...]:
        """Why the whole arm cannot move from the task's starts to the goal; empty where it can."""
        try:
            lifted = self.undisturbed(nominal.learned.demonstrated)
        except UnreachableError as error:
            return (unreachable(error),)
        missed = lifted.tracked.error[:, [0, -1]] > MAX_TRACKING_ERROR
        reasons = far_starts(np.flatnonzero(missed[:, 0]), len(missed))
        if missed[:, 1].any():
            reasons.append(MotionWarning(Kind.OUT_OF_REACH, "the goal is out of the arm's reach", ARM))
        for part in obstacle.parts:
            reasons += self._touching(lifted.pins, part)
        return tuple(reasons)

    def out_of_reach(self, nominal: Nominal) -> Mask:
        """(R,) bool: which rollouts begin at an added start that the arm cannot get to.

        Raises:
            UnreachableError: the arm cannot get to where the task's motions start.
        """
        num_demonstrated = nominal.num_demonstrated
        added = nominal.strands[num_demonstrated:]
        return np.array([False] * num_demonstrated + [not self._reaches(nominal.learned, strand) for strand in added])

    def admitted(self, nominal: Nominal, obstacle: Union) -> Nominal:
        """The rollouts that the whole arm can begin: without those from added starts where it is out of reach or room.

        Raises:
            UnreachableError: the arm cannot get to where the task's motions start.
        """
        num, far = nominal.num_demonstrated, self.out_of_reach(nominal)
        touches = np.zeros_like(far)
        candidates = np.flatnonzero(~far)[num:]
        if len(candidates):
            postures = self.undisturbed(nominal.only(candidates)).tracked.q[:, 0]
            near = self.whole_arm.clearance(postures, obstacle) < 0
            for rollout, posture in zip(candidates[near], postures[near], strict=True):
                gaps = [load_collision_model().obstacle_distance(posture[None], part)[0][0] for part in obstacle.parts]
                touches[rollout] = min(gaps) < 0
        if not (far | touches).any():
            return nominal
        numbers = np.array(nominal.numbers)
        # of the motions, not of the arm that is shown: these have none
        warnings = far_starts(numbers[far], num, source="") + _touching_starts(numbers[touches], num)
        return nominal.only(np.flatnonzero(~(far | touches)), warnings)

    def _touching(self, pins: Array, obstacle: Obstacle) -> list[MotionWarning]:
        """What an obstacle touches of the arm at rest in the postures `pins` (R + 1, 6)."""
        pedestal = self.body.on_pedestal
        distance = obstacle.signed_distance(pedestal.positions(self.robot, pins[0])) - pedestal.radius
        if (distance >= 0).all() and (self.whole_arm.clearance(pins, obstacle) >= 0).all():
            return []
        # the spheres are larger than the arm: ask the meshes
        model = load_collision_model()
        gaps, links = model.obstacle_distance(pins, obstacle)
        name = model.links[int(links[0])].name
        if gaps[0] < 0 and name in PEDESTAL:
            text = f"the obstacle touches the arm's {name}, which cannot move away"
            return [MotionWarning(Kind.ARM_BLOCKED, text, ARM)]
        reasons = _touching_starts(np.flatnonzero(gaps[:-1] < 0), len(gaps) - 1)
        if gaps[-1] < 0:
            text = "the goal is inside the obstacle: the arm there touches it"
            reasons.append(MotionWarning(Kind.GOAL_COVERED, text, ARM))
        return reasons

    def warnings(self, joints: JointPath, rollout: int) -> tuple[MotionWarning, ...]:
        """Why the joints along a rollout, counted from 0, are not to be trusted."""
        warnings = []
        worst = float(joints.error.max())
        if worst > MAX_TRACKING_ERROR:
            because = ", a joint is at its limit" if joints.limits_hit.any() else ""
            text = f"the arm misses the path of rollout {rollout + 1} by up to {1e3 * worst:.0f} mm{because}"
            warnings.append(MotionWarning(Kind.PATH_MISSED, text, ARM))
        if joints.damped.any():
            text = "the arm is stretched out or folded on the way: its pseudo-inverse is damped there"
            warnings.append(MotionWarning(Kind.DAMPED, text, ARM))
        return tuple(warnings)

    def _lift_demonstrated(self, learned: Learned) -> Lift:
        bundle, starts = learned.demonstrated.bundle, learned.task.starts
        num_rollouts = len(starts)
        stride = np.linspace(0, len(bundle.index) // num_rollouts - 1, NUM_CONFIGURATIONS).round().astype(int)
        fractions = bundle.fraction.reshape(num_rollouts, -1)[:, stride]
        paths = bundle.positions.reshape(num_rollouts, -1, 3)[:, stride]
        reference = inverse_kinematics(self.robot, starts.mean(axis=0))
        return lift(self.robot, fractions, paths, reference)

    def _join(self, nominal: Nominal) -> Lift:
        learned, num_demonstrated = nominal.learned, nominal.num_demonstrated
        whole = self.undisturbed(learned.demonstrated)
        parts = zip(nominal.numbers, nominal.strands, strict=True)
        lifts = [whole.only(n) if n < num_demonstrated else self._added(learned, strand) for n, strand in parts]
        return joined(lifts, nominal.num_added)

    def _lift_added(self, learned: Learned, strand: Strand) -> Lift:
        path, fraction = strand.positions, strand.fraction
        keep = np.linspace(0, len(fraction) - 1, NUM_CONFIGURATIONS).round().astype(int)
        return lift(self.robot, fraction[None, keep], path[None, keep], self.reference(learned.demonstrated))

    def _gets_to(self, learned: Learned, strand: Strand) -> bool:
        reached = track(self.robot, strand.start[None], self.reference(learned.demonstrated))
        return bool(reached.error[0] <= MAX_TRACKING_ERROR)


def unreachable(error: UnreachableError) -> MotionWarning:
    """The warning that the arm cannot get to where the motions start."""
    return MotionWarning(Kind.OUT_OF_REACH, f"the arm cannot reach the starts: {error}", ARM)


def far_starts(which: Indices, num_demonstrated: int, source: str = ARM) -> list[MotionWarning]:
    """Warnings about starts, counted from 0, that are out of the arm's reach."""
    return start_warnings(which, num_demonstrated, Kind.OUT_OF_REACH, "out of the arm's reach", source)


def _touching_starts(which: Indices, num_demonstrated: int) -> list[MotionWarning]:
    how = "inside the obstacle: the arm there touches it"
    return start_warnings(which, num_demonstrated, Kind.START_COVERED, how)


def arm_samples(num: int) -> Indices:
    """Which of the `num` samples of a rollout of the end effector the arm follows, (`NUM_ARM_SAMPLES`,)."""
    return np.linspace(0, num - 1, NUM_ARM_SAMPLES).round().astype(int)


def room_at_rest(robot: Robot, task: Task, obstacle: Union, places: Array) -> Array:
    """Distance (N,), metres, of the arm's covering spheres from the obstacle where the hand rests at `places` (N, 3).

    Raises:
        UnreachableError: the arm cannot get to the task's starts, near whose posture it stays.
    """
    reference = inverse_kinematics(robot, task.starts.mean(axis=0))
    start = np.broadcast_to(reference, (len(places), NUM_JOINTS))
    postures = track(robot, places[:, None], start, reference=start).q[:, 0]
    return WholeArm(robot, load_body_points()).clearance(postures, obstacle)


PEDESTAL = ("base", "link 1")
"""What no joint carries away from an obstacle."""
