"""The arm follows the motions of its end effector: which joints, what is out of reach, what is in the way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.avoidance import ArmAvoidance, StartStatus, start_warnings
from dt_viz.avoidance.lift import NUM_CONFIGURATIONS, Lift, ReferencePostures, lift, reference_postures
from dt_viz.avoidance.passing import Posture
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.flows.rotations import mean_orientation
from dt_viz.memo import Memo
from dt_viz.metrics import arc_length
from dt_viz.motion.nominal import Learned, Nominal, NominalTrajectory
from dt_viz.motion.stack import Solution
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import (
    TrackedPath,
    UnreachableError,
    best_start,
    drawn_onto,
    inverse_kinematics,
    track,
)
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import MAX_STARTS
from dt_viz.scenario.tasks import Task
from dt_viz.warning import ARM, Kind, MotionWarning

BY_FRACTION = 0.3
"""Part of the even spacing of postures that goes by the fraction of the base ray, not by the length of the path."""
MAX_TRACKING_ERROR = 1e-3  # distance from its path beyond which the hand has a warning, metres
MAX_TURNED = 10.0
"""Angle by which the hand may be turned beside its orientation before it is said, degrees."""
NUM_ARM_SAMPLES = 200
"""Samples of the motion that the arm shows where it follows a path of the end effector."""
NUM_ON_PATH = 20  # samples of the mean motion that reference postures are tried on
NUM_POSTURES = 64  # number of reference_postures, over all tasks, whose joints are kept
NEWEST = 2 * MAX_STARTS  # number of added starts whose joints are kept


@dataclass(frozen=True)
class ArmMotion:
    """The joint motion along one rollout."""

    times: Array
    """(T,) seconds, later than the rollout's where the joints' velocity limits ask for it."""
    q: Array  # (T, n) joint angles at these times, rad; continuous joints unwrapped
    without: Array  # (T, n) the same at the same moments of the motion without avoidance
    orientations: Array | None = None
    """(T, 4) orientations that the hand is to have there, wxyz; None where none were learned."""


@dataclass(frozen=True)
class Admission:
    """Whether and from where the whole arm can move."""

    nominal: Nominal  # the rollouts that it can begin
    blocked: tuple[MotionWarning, ...] = ()  # why it cannot move at all; empty where it can


class Follower:
    """Lifts motions of the end effector to the joints."""

    def __init__(self, robot: Robot, memo: Memo | None = None, shared: Memo | None = None) -> None:
        """Take an arm, and what keeps the joints along what a drag leaves unchanged.

        `shared` keeps the reference postures of tasks, for other followers, too.
        """
        self.robot = robot
        self.whole_arm = WholeArm(robot)
        self._memo = Memo() if memo is None else memo
        self._shared = Memo() if shared is None else shared

    def undisturbed(self, nominal: Nominal) -> Lift:
        """The joints along the motion without any behaviour; raises as `reference`."""
        own = self._demonstrated(nominal.learned, nominal.posture)
        if nominal.shaping.all():
            return own

        def joined() -> Lift:
            added = nominal.trajectories[len(own.fractions) :]
            lifts = [own, *(self._added(trajectory, own.reference) for trajectory in added)]
            return Lift.of(lifts, nominal.moving, nominal.shaping)

        return self._memo("undisturbed", nominal, joined, newest=8)

    def _added(self, trajectory: NominalTrajectory, reference: Array) -> Lift:
        """The joints along a rollout from an added start; one that is dragged leaves nothing behind."""

        def lifted() -> Lift:
            path, fraction, turns = trajectory.positions, trajectory.fraction, trajectory.orientations
            wanted = None if turns is None else turns[None]
            return lift(self.robot, fraction[None], path[None], reference, orientations=wanted)

        return self._memo("added", (trajectory, reference.tobytes()), lifted, newest=NEWEST)

    def reference(self, nominal: Nominal) -> Array:
        """The posture (n,), rad, that the arm stays near to.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        return self._demonstrated(nominal.learned, nominal.posture).reference

    def at_ends(self, nominal: Nominal) -> Array:
        """The postures (R + 1, n), rad, at the task's starts and goal; raises as `reference`."""
        return self._demonstrated(nominal.learned, nominal.posture).pins

    def behaving(self, nominal: Nominal, solution: Solution, *, exact: bool) -> Lift:
        """The joints along a solution: the motion with the behaviours of the end effector on the nominal one.

        If `exact`, the end effector is on that motion between the samples, too; else it may be off by millimetres where
        the stack stretches space.
        """
        samples, drawn = np.linspace(0, 1, NUM_CONFIGURATIONS), []
        for path, fractions in zip(solution.bundle.paths, solution.bundle.split(solution.bundle.fraction), strict=True):
            length = arc_length(path)
            # where the stack stretches a path, samples by its length alone lie far apart in its fraction
            place = (1 - BY_FRACTION) * length / length[-1] + BY_FRACTION * fractions
            drawn.append([np.interp(samples, place, values) for values in (fractions, *path.T)])
        fraction, paths = np.array(drawn)[:, 0], np.moveaxis(np.array(drawn)[:, 1:], 1, 2)
        index = np.repeat(np.arange(len(fraction)), NUM_CONFIGURATIONS)
        if exact:
            paths = solution.positions_at(index, fraction.ravel()).reshape(paths.shape)
        wanted = nominal.orientations_at(index, fraction.ravel())
        wanted = None if wanted is None else wanted.reshape(*paths.shape[:2], 4)
        paths[~nominal.moving] = nominal.goal  # what has no motion makes no difference to how the others are followed
        reference = self.reference(nominal)
        initial = None if exact else self.undisturbed(nominal).tracked.q  # near enough to begin from
        lifted = lift(self.robot, fraction, paths, reference, initial, wanted)
        lifted = replace(lifted, moving=nominal.moving, shaping=nominal.shaping)
        if not exact:
            return lifted

        robot = self.robot  # what is kept for all visitors must not keep one of them

        def exactly(q: Array, index: Indices, fraction: Array) -> Array:
            wanted = nominal.orientations_at(index, fraction)
            return drawn_onto(robot, q, solution.positions_at(index, fraction), reference, wanted)

        return replace(lifted, exactly=exactly)

    def along(self, nominal: Nominal, path: Array, orientations: Array | None = None) -> TrackedPath:
        """The joints along one path (T, 3) of the end effector, metres, perhaps with orientations (T, 4), wxyz.

        The arm stays near to the posture of the nominal motion.
        """
        return track(self.robot, path, self.reference(nominal), orientations=orientations)

    def admission(
        self, nominal: Nominal, avoidance: ArmAvoidance, posture: Posture | None = None, *, keeps: bool = False
    ) -> Admission:
        """Whether the whole arm can move around what it avoids, from which starts, and with which reference posture.

        The `posture` that it had where the obstacle was just before, None for the usual one, is kept while no other
        leaves more starts free, or, if it `keeps` it, while that leaves the goal and any start free.
        """
        asked = avoidance.avoided, avoidance.margin, posture, keeps
        return self._memo("admission", (nominal, asked), lambda: self._admission(nominal, *asked), newest=2)

    def alternatives(self, nominal: Nominal, avoidance: ArmAvoidance) -> Iterator[Nominal]:
        """The same motions with other postures that have room at as many starts and at the goal, the best first."""
        ranked = self._ranked(nominal.learned, avoidance.avoided, avoidance.margin, nominal.posture, keeps=False)
        _, free = next(ranked)
        for posture, others in ranked:
            if not (others >= free).all():
                return
            yield replace(nominal, posture=posture)

    def _admission(
        self, nominal: Nominal, obstacle: Union, margin: float, last: Posture | None, keeps: bool
    ) -> Admission:
        blocked = self.unreached(nominal.learned) or self._pedestal_touched(nominal.learned, obstacle)
        if blocked:
            return Admission(nominal, blocked)
        posture, free = next(self._ranked(nominal.learned, obstacle, margin, last, keeps=keeps))
        if not free[-1]:
            text = "the goal is inside the obstacle: the arm there touches it"
            return Admission(nominal, (MotionWarning(Kind.GOAL_COVERED, text, ARM),))
        if not free[:-1].any():
            return Admission(nominal, nominal.without(~nominal.added, StartStatus.IN_COLLISION).warnings)
        standing = replace(nominal, posture=posture)
        touches = self.whole_arm.clearance(self.undisturbed(standing).tracked.q[:, 0], obstacle, 0.0) < 0
        touches[~nominal.added] = ~free[:-1]
        standing = standing.without(self.out_of_reach(standing), StartStatus.OUT_OF_REACH)
        return Admission(standing.without(touches, StartStatus.IN_COLLISION))

    def unreached(self, learned: Learned) -> tuple[MotionWarning, ...]:
        """Warnings about the task's starts and goal that are out of the arm's reach."""
        try:
            lifted = self._demonstrated(learned)
        except UnreachableError as error:
            return (unreachable(error),)
        missed = lifted.tracked.error[:, [0, -1]] > MAX_TRACKING_ERROR
        reasons = [*far_starts(missed[:, 0], np.zeros(len(missed), bool))]
        if missed[:, 1].any():
            reasons.append(MotionWarning(Kind.OUT_OF_REACH, "the goal is out of the arm's reach", ARM))
        return tuple(reasons)

    def _pedestal_touched(self, learned: Learned, obstacle: Union) -> tuple[MotionWarning, ...]:
        """Warnings about what touches the links that no joint carries away."""
        posture, robot = self._demonstrated(learned).pins[:1], self.robot
        for joint, _ in robot.pedestal.by_joint:
            if robot.body.of_joints(joint, joint + 1).clearance(robot, posture, obstacle, 0.0) < 0:
                text = f"the obstacle touches the arm's {robot.link_name(joint)}, which cannot move away"
                return (MotionWarning(Kind.ARM_BLOCKED, text, ARM),)
        return ()

    def _ranked(
        self, learned: Learned, obstacle: Union, margin: float, last: Posture | None, *, keeps: bool
    ) -> Iterator[tuple[Posture | None, Mask]]:
        """The postures with most room at the task's starts and goal, the best first: the usual one where it has enough.

        But the posture `last`, if it is not the usual one, comes before all that leave no more starts free; where it is
        kept, before all, if it leaves the goal and any start free. With each reference posture, None for the usual one,
        comes which of the starts and the goal (R + 1,) it leaves free.
        """
        room = self.whole_arm.clearance(self._demonstrated(learned, last).pins, obstacle, margin)
        is_ample = last is None and bool((room >= margin).all())
        if is_ample or (keeps and room[-1] >= 0 and room[:-1].max() >= 0):
            yield last, room >= 0
        known = self.reference_postures(learned)
        clearance = known.room(obstacle, margin)
        free, ample = clearance >= 0, clearance >= margin
        left = ~known.alike(0) if is_ample else np.ones(len(free), bool)
        # the goal first, then as many starts as possible, then as much room as is asked for
        most = free[:, -1] * free.shape[1] + free.sum(axis=1)
        kept = np.array([_as_posture(posture) == last for posture in known.references])
        for best in np.lexsort((known.cost(obstacle, margin), -ample.sum(axis=1), ~kept, -most)):
            if left[best]:
                left &= ~known.alike(int(best))
                yield None if best == 0 else _as_posture(known.references[best]), free[best]

    def reference_postures(self, learned: Learned) -> ReferencePostures:
        """The reference postures for a task's motions, a second's work the first time; raises as `reference`."""
        usual, paths = self._demonstrated(learned).reference, learned.demonstrated.paths
        return self._shared(
            "reference_postures",
            (self.robot, learned),
            lambda: reference_postures(self.robot, usual, learned.task.starts, _mean(paths), _turns(learned)),
            newest=NUM_POSTURES,
        )

    def out_of_reach(self, nominal: Nominal) -> Mask:
        """(R,) added starts that the arm cannot get to; raises as `reference`."""
        return nominal.added & (self.undisturbed(nominal).tracked.error[:, 0] > MAX_TRACKING_ERROR)

    def warnings(self, joints: TrackedPath, place: int) -> tuple[MotionWarning, ...]:
        """Why the joints along the rollout from the start at this place are not to be trusted."""
        warnings = []
        worst = float(joints.error.max())
        if worst > MAX_TRACKING_ERROR:
            because = ", a joint is at its limit" if joints.limits_hit.any() else ""
            text = f"the arm misses the path of rollout {place + 1} by up to {1e3 * worst:.0f} mm{because}"
            warnings.append(MotionWarning(Kind.PATH_MISSED, text, ARM))
        if (turned := float(np.rad2deg(joints.turned.max()))) > MAX_TURNED:
            text = f"the arm turns the hand up to {turned:.0f}° beside the orientation of rollout {place + 1}"
            warnings.append(MotionWarning(Kind.HAND_TURNED, text, ARM))
        if joints.damped.any():
            text = "the arm is stretched out or folded on the way: its pseudo-inverse is damped there"
            warnings.append(MotionWarning(Kind.DAMPED, text, ARM))
        return tuple(warnings)

    def _demonstrated(self, learned: Learned, posture: Posture | None = None) -> Lift:
        """The joints along the rollouts from the task's starts. Raises UnreachableError, also a second time."""

        def lifted() -> Lift | UnreachableError:
            starts, bundle = learned.task.starts, learned.demonstrated.bundle
            try:
                reference = np.array(posture) if posture is not None else self._usual(learned)
            except UnreachableError as error:
                return error
            stride = np.linspace(0, len(bundle.index) // len(starts) - 1, NUM_CONFIGURATIONS).round().astype(int)
            fractions = bundle.fraction.reshape(len(starts), -1)[:, stride]
            paths, turns = bundle.positions.reshape(len(starts), -1, 3)[:, stride], learned.demonstrated.orientations
            wanted = None if turns is None else np.stack(turns)[:, stride]
            return lift(self.robot, fractions, paths, reference, orientations=wanted)

        found = self._shared("demonstrated", (self.robot, learned, posture), lifted, newest=NUM_POSTURES)
        if isinstance(found, UnreachableError):
            raise found
        return found

    def _usual(self, learned: Learned) -> Array:
        """The usual posture (n,), rad, of the hand at the mean start. Raises UnreachableError."""
        turns, starts = _turns(learned), learned.task.starts
        if turns is None:
            return inverse_kinematics(self.robot, starts.mean(axis=0))
        return best_start(self.robot, _mean(learned.demonstrated.paths), turns[len(starts) :])


def _turns(learned: Learned) -> Array | None:
    """Orientations (R + `NUM_ON_PATH`, 4) of the hand at the starts and along the mean motion; None without any."""
    turns = learned.demonstrated.orientations
    if turns is None:
        return None
    kept = np.linspace(0, len(turns[0]) - 1, NUM_ON_PATH).round().astype(int)
    mean = [mean_orientation(np.stack([turn[k] for turn in turns])) for k in kept]
    return np.concatenate([[turn[0] for turn in turns], mean])


def _mean(paths: Sequence[Array]) -> Array:
    """The mean (`NUM_ON_PATH`, 3) of rollouts with equally many samples, metres."""
    kept = np.linspace(0, len(paths[0]) - 1, NUM_ON_PATH).round().astype(int)
    return np.mean(paths, axis=0)[kept]


def _as_posture(posture: Array) -> Posture:
    return tuple(float(angle) for angle in posture)


def unreachable(error: UnreachableError) -> MotionWarning:
    """The warning that the arm cannot get to where the motions start."""
    return MotionWarning(Kind.OUT_OF_REACH, f"the arm cannot reach the starts: {error}", ARM)


def far_starts(far: Mask, added: Mask) -> Iterator[MotionWarning]:
    """Warnings that the arm cannot get to the starts `far` (R,), some of which are `added` (R,)."""
    why = StartStatus.OUT_OF_REACH
    return start_warnings(far, added, why.kind, why.value, ARM)


def arm_samples(num: int) -> Indices:
    """Indices (`NUM_ARM_SAMPLES`,) of the samples that the arm follows, of the `num` of a rollout of the hand."""
    return np.linspace(0, num - 1, NUM_ARM_SAMPLES).round().astype(int)


def room_at_rest(robot: Robot, task: Task, obstacle: Union, places: Array) -> Array:
    """Distance (N,), metres, of the arm from the obstacle while the hand rests at `places` (N, 3).

    Raises:
        UnreachableError: the arm cannot get to the task's starts.
    """
    reference = inverse_kinematics(robot, task.starts.mean(axis=0))
    start = np.broadcast_to(reference, (len(places), robot.num_joints))
    postures = track(robot, places[:, None], start, reference=start).q[:, 0]
    return WholeArm(robot).clearance(postures, obstacle)
