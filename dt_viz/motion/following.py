"""The arm follows the motions of its end effector: which joints, what is out of reach, what is in the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.arm.body_points import load_body_points
from dt_viz.arm.collision import load_collision_model
from dt_viz.arm.robot import NUM_JOINTS, Robot
from dt_viz.arm.tracking import JointPath, UnreachableError, drawn_onto, inverse_kinematics, track
from dt_viz.arm.whole_arm import NUM_CONFIGURATIONS, Lift, WholeArm, joined, lift
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.memo import Memo
from dt_viz.metrics import arc_length
from dt_viz.motion.nominal import Learned, Nominal, Strand
from dt_viz.motion.stack import Solution
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
"""Samples of the motion that the arm shows where it follows a path of the end effector."""
NEWEST = 2 * MAX_STARTS
"""Number of added starts whose joints are kept."""


@dataclass(frozen=True)
class ArmMotion:
    """The joint motion along one rollout."""

    times: Array
    """(T,) seconds, later than the rollout's where the joints' velocity limits ask for it."""
    q: Array
    """(T, 6) joint angles at these times, rad; continuous joints unwrapped."""
    without: Array
    """(T, 6) the same at the same moments of the motion without avoidance."""


@dataclass(frozen=True)
class Admission:
    """Whether and from where the whole arm can move."""

    nominal: Nominal
    """The rollouts that it can begin."""
    blocked: tuple[MotionWarning, ...] = ()
    """Why it cannot move at all; empty where it can."""


class Follower:
    """Lifts motions of the end effector to the joints."""

    def __init__(self, robot: Robot, memo: Memo | None = None) -> None:
        """Take an arm.

        Args:
            robot: the arm.
            memo: what keeps the joints along what a drag leaves unchanged.
        """
        self.robot = robot
        self.body = load_body_points()
        self.whole_arm = WholeArm(robot, self.body)
        self._memo = Memo() if memo is None else memo

    def undisturbed(self, nominal: Nominal) -> Lift:
        """The joints along the motion without any behaviour.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        if nominal is nominal.learned.demonstrated:
            return self._demonstrated(nominal.learned)
        rollouts = range(len(nominal.strands))
        return self._memo(
            "joined",
            nominal,
            lambda: joined([self.undisturbed_along(nominal, rollout) for rollout in rollouts], nominal.num_added),
            newest=4,
        )

    def undisturbed_along(self, nominal: Nominal, rollout: int) -> Lift:
        """The joints along one of the rollouts without any behaviour.

        Raises:
            UnreachableError: the arm cannot get to where the task's motions start.
        """
        number, strand, whole = nominal.numbers[rollout], nominal.strands[rollout], self._demonstrated(nominal.learned)
        if number < nominal.num_demonstrated:
            return whole.only(number)
        # a start that is dragged leaves nothing behind
        return self._memo("added", strand, lambda: _lift_added(self.robot, strand, whole.reference), newest=NEWEST)

    def reference(self, nominal: Nominal) -> Array:
        """The posture (6,), rad, that the arm stays near to.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        return self._demonstrated(nominal.learned).reference

    def behaving(self, nominal: Nominal, solution: Solution, *, exact: bool, before: Lift | None = None) -> Lift:
        """The joints along the motion with the behaviours of the end effector.

        Args:
            nominal: what it begins from.
            solution: that motion.
            exact: whether the end effector is on that motion between the samples, too, and `before` plays no part; else
                it may be off by millimetres where the stack stretches space.
            before: joints along nearby rollouts to begin from.
        """
        fraction = []
        for path, fractions in zip(solution.bundle.paths, solution.bundle.split(solution.bundle.fraction), strict=True):
            length = arc_length(path)
            # where the stack stretches a path, samples by its length alone lie far apart in its fraction
            place = (1 - BY_FRACTION) * length / length[-1] + BY_FRACTION * fractions
            fraction.append(np.interp(np.linspace(0, 1, NUM_CONFIGURATIONS), place, fractions))
        index = np.repeat(np.arange(len(fraction)), NUM_CONFIGURATIONS)
        paths = solution.positions_at(index, np.concatenate(fraction)).reshape(len(fraction), NUM_CONFIGURATIONS, 3)
        reference, initial = self.reference(nominal), None
        if before is not None and not exact and len(before.tracked.q) == len(paths):  # else starts have come or gone
            initial = before.tracked.q
        lifted = replace(lift(self.robot, np.stack(fraction), paths, reference, initial), num_guests=nominal.num_added)
        if not exact:
            return lifted

        def exactly(q: Array, index: Indices, fraction: Array) -> Array:
            return drawn_onto(self.robot, q, solution.positions_at(index, fraction), reference)

        return replace(lifted, exactly=exactly)

    def along(self, nominal: Nominal, path: Array, before: Array | None = None) -> JointPath:
        """The joints along one path (T, 3) of the end effector, metres.

        Args:
            nominal: the motion whose posture the arm stays near to.
            path: where the end effector goes.
            before: (T, 6) joints along a nearby path to begin from, rad.
        """
        return track(self.robot, path, self.reference(nominal), before)

    def admission(self, nominal: Nominal, obstacle: Union) -> Admission:
        """Whether the whole arm can move from the task's starts to the goal, and from which added starts."""

        def admission() -> Admission:
            blocked = self.obstructions(nominal, obstacle)
            return Admission(nominal if blocked else self.admitted(nominal, obstacle), blocked)

        return self._memo("admission", (nominal, obstacle), admission, newest=1)

    def obstructions(self, nominal: Nominal, obstacle: Union) -> tuple[MotionWarning, ...]:
        """Why the whole arm cannot move from the task's starts to the goal; empty where it can."""
        try:
            lifted = self._demonstrated(nominal.learned)
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
        reference = self.reference(nominal)

        def reached(strand: Strand) -> bool:
            tracked = track(self.robot, strand.start[None], reference)
            return bool(tracked.error[0] <= MAX_TRACKING_ERROR)

        reaches = [self._memo("reached", s, lambda s=s: reached(s), newest=NEWEST) for s in added]
        return np.array([False] * num_demonstrated + [not reach for reach in reaches])

    def admitted(self, nominal: Nominal, obstacle: Union) -> Nominal:
        """The rollouts that the whole arm can begin: without those from added starts where it is out of reach or room.

        Raises:
            UnreachableError: the arm cannot get to where the task's motions start.
        """
        num, far = nominal.num_demonstrated, self.out_of_reach(nominal)
        touches = np.zeros_like(far)
        candidates = np.flatnonzero(~far)[num:]
        if len(candidates):
            postures = np.stack([self.undisturbed_along(nominal, k).tracked.q[0, 0] for k in candidates])
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
        """Reasons why the arm cannot rest in the postures `pins` (R + 1, 6): what an obstacle touches of it."""
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

    def _demonstrated(self, learned: Learned) -> Lift:
        """The joints along the rollouts from the task's starts. Raises UnreachableError, also a second time."""
        lifted = self._memo("demonstrated", learned, lambda: _lift_demonstrated(self.robot, learned))
        if isinstance(lifted, UnreachableError):
            raise lifted
        return lifted


def _lift_demonstrated(robot: Robot, learned: Learned) -> Lift | UnreachableError:
    bundle, starts = learned.demonstrated.bundle, learned.task.starts
    num_rollouts = len(starts)
    stride = np.linspace(0, len(bundle.index) // num_rollouts - 1, NUM_CONFIGURATIONS).round().astype(int)
    fractions = bundle.fraction.reshape(num_rollouts, -1)[:, stride]
    paths = bundle.positions.reshape(num_rollouts, -1, 3)[:, stride]
    try:
        return lift(robot, fractions, paths, inverse_kinematics(robot, starts.mean(axis=0)))
    except UnreachableError as error:
        return error


def _lift_added(robot: Robot, strand: Strand, reference: Array) -> Lift:
    path, fraction = strand.positions, strand.fraction
    keep = np.linspace(0, len(fraction) - 1, NUM_CONFIGURATIONS).round().astype(int)
    return lift(robot, fraction[None, keep], path[None, keep], reference)


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
    """Indices (`NUM_ARM_SAMPLES`,) of the samples that the arm follows, of the `num` of a rollout of the hand."""
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
"""Links that no joint can carry away from an obstacle."""
