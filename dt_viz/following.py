"""The arm follows the motions of its end effector: which joints, what is out of reach, what is in the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.body import load_body_points
from dt_viz.collision import load_collision_model
from dt_viz.fields import Array, Indices
from dt_viz.metrics import arc_length
from dt_viz.obstacles import Obstacle
from dt_viz.robot import Robot
from dt_viz.several import Several
from dt_viz.solving import Ground, Solution
from dt_viz.tracking import JointPath, UnreachableError, inverse_kinematics, track
from dt_viz.whole_arm import NUM_CONFIGURATIONS, Lift, WholeArm, lift

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
        self._lifts: dict[Ground, Lift | UnreachableError] = {}
        self._before: dict[tuple[Ground, int | None], Array] = {}

    def undisturbed(self, ground: Ground) -> Lift:
        """The joints along the motion without any behaviour.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        if ground not in self._lifts:
            try:
                self._lifts[ground] = self._lift_undisturbed(ground)
            except UnreachableError as error:
                self._lifts[ground] = error
        lifted = self._lifts[ground]
        if isinstance(lifted, UnreachableError):
            raise lifted
        return lifted

    def behaving(self, ground: Ground, solution: Solution) -> Lift:
        """The joints along the motion with the behaviours of the end effector."""
        fraction = []
        for path, fractions in zip(solution.bundle.paths, solution.bundle.split(solution.bundle.fraction), strict=True):
            length = arc_length(path)
            fraction.append(np.interp(np.linspace(0, length[-1], NUM_CONFIGURATIONS), length, fractions))
        index = np.repeat(np.arange(len(fraction)), NUM_CONFIGURATIONS)
        paths = solution.positions_at(index, np.concatenate(fraction)).reshape(len(fraction), NUM_CONFIGURATIONS, 3)
        reference = self.undisturbed(ground).reference
        lifted = lift(self.robot, np.stack(fraction), paths, reference, self._before.get((ground, None)))
        self._before[ground, None] = lifted.tracked.q
        return lifted

    def along(self, ground: Ground, rollout: int, path: Array) -> JointPath:
        """The joints along one path (T, 3) of the end effector, metres, T being `NUM_ARM_SAMPLES`."""
        reference = self.undisturbed(ground).reference
        joints = track(self.robot, path, reference, self._before.get((ground, rollout)))
        self._before[ground, rollout] = joints.q
        return joints

    def obstructions(self, ground: Ground, obstacle: Several) -> tuple[str, ...]:
        """Why the whole arm cannot move from the starts to the goal, in words; empty where nothing is in the way."""
        try:
            lifted = self.undisturbed(ground)
        except UnreachableError as error:
            return (f"the arm cannot reach the starts: {error}",)
        missed = lifted.tracked.error[:, [0, -1]] > MAX_TRACKING_ERROR
        reasons = _named("start", np.flatnonzero(missed[:, 0]), "out of the arm's reach")
        if missed[:, 1].any():
            reasons.append("the goal is out of the arm's reach")
        for part in obstacle.parts:
            reasons += self._touching(lifted.pins, part)
        return tuple(reasons)

    def _touching(self, pins: Array, obstacle: Obstacle) -> list[str]:
        """What an obstacle touches of the arm at rest in the postures `pins` (R + 1, 6), in words."""
        pedestal = self.body.on_pedestal
        distance = obstacle.signed_distance(pedestal.positions(self.robot, pins[0])) - pedestal.radius
        if (distance >= 0).all() and (self.whole_arm.clearance(pins, obstacle) >= 0).all():
            return []
        # the spheres are larger than the arm: ask the meshes
        model = load_collision_model()
        gaps, links = model.obstacle_distance(pins, obstacle)
        name = model.links[int(links[0])].name
        if gaps[0] < 0 and name in PEDESTAL:
            return [f"the obstacle touches the arm's {name}, which cannot move away"]
        reasons = _named("start", np.flatnonzero(gaps[:-1] < 0), "inside the obstacle: the arm there touches it")
        if gaps[-1] < 0:
            reasons.append("the goal is inside the obstacle: the arm there touches it")
        return reasons

    def doubts(self, joints: JointPath, rollout: int) -> tuple[str, ...]:
        """Why the joints along a rollout, counted from 0, are not to be trusted."""
        doubts = []
        worst = float(joints.error.max())
        if worst > MAX_TRACKING_ERROR:
            because = ", a joint is at its limit" if joints.limits_hit.any() else ""
            doubts.append(f"the arm misses the path of rollout {rollout + 1} by up to {1e3 * worst:.0f} mm{because}")
        if joints.damped.any():
            doubts.append("the arm is stretched out or folded on the way: its pseudo-inverse is damped there")
        return tuple(doubts)

    def _lift_undisturbed(self, ground: Ground) -> Lift:
        bundle = ground.bundle
        num_rollouts = len(ground.task.starts)
        stride = np.linspace(0, len(bundle.index) // num_rollouts - 1, NUM_CONFIGURATIONS).round().astype(int)
        fractions = bundle.fraction.reshape(num_rollouts, -1)[:, stride]
        paths = bundle.positions.reshape(num_rollouts, -1, 3)[:, stride]
        reference = inverse_kinematics(self.robot, ground.task.starts.mean(axis=0))
        return lift(self.robot, fractions, paths, reference)


PEDESTAL = ("base", "link 1")
"""What no joint carries away from an obstacle."""


def _named(what: str, which: Indices, how: str) -> list[str]:
    """What there is to say of some things, counted from 0; empty if it is of none."""
    if len(which) == 0:
        return []
    numbers = ", ".join(str(k + 1) for k in which)
    return [f"{what} {numbers} is {how}" if len(which) == 1 else f"{what}s {numbers} are {how}"]
