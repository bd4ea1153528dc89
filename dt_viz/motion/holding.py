"""The user holds the hand: the arm follows it by inverse kinematics, and would go on to the goal from where it is.

Where the whole arm avoids, its states are p = ψ_q⁻¹(Q(x)) (see `dt_viz.arm.arm_system`). What is looked for is the
place x of the motion below whose arm has its hand under the pointer: so it goes on from the posture it is held in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dt_viz.arm.robot import NUM_JOINTS
from dt_viz.arm.tracking import track
from dt_viz.arm.whole_arm import ArmSolution
from dt_viz.flows.fields import Array
from dt_viz.motion.following import MAX_TRACKING_ERROR, Follower
from dt_viz.motion.pushing import Pushed, below, onwards
from dt_viz.motion.solve import Solved

ARRIVED = 2e-4
"""Distance from the pointer at which the hand counts as there, metres."""
MAX_STEPS = 8
"""Towards the place below the pointer."""
LONGEST_STEP = 0.05
"""Metres: beyond it the slope of the map from there to the hand means nothing."""
SHORTER = np.array([1.0, 0.5, 0.2, 0.05])
"""Parts of a step that are tried at once."""
DIFFERENCE = 1e-3
"""Distance between the places that the slope is taken from, metres."""
DAMPING = 1e-3
"""Damping of the least-squares step, against the square of the slope, which is 1 far from obstacles."""

Hands = Callable[[Array], Array]
"""Takes places (N, 3) of the motion below to where the hand is then, (N, 3), metres."""


def held(
    follower: Follower,
    solved: Solved,
    q: Array,
    place: Array,
) -> Pushed:
    """The arm with its hand at a place, or as near as it gets, and its motion from there to the goal.

    Args:
        follower: lifts paths to the joints.
        solved: the motion that is shown.
        q: (6,) joint angles now, rad.
        place: (3,) where the hand should be, metres.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    robot, scenario, arm = follower.robot, solved.scenario, solved.arm
    posture, reference = below(follower, solved, q), follower.reference(solved.nominal)
    target = place
    if arm is not None:
        target = _place_below(_hands(follower, arm, posture, reference), robot.end_effector(posture), place)
    tracked = track(robot, target[None], posture, reference=reference)
    posture = tracked.q[0]
    start = robot.end_effector(posture)
    pushed, room = onwards(follower, solved, posture, start[None], np.zeros(1))

    missed, depth = float(np.linalg.norm(pushed.path[0] - place)), -float(scenario.obstacle.signed_distance(place))
    warning = ""
    if depth > 0:
        warning = "inside the obstacle"
    elif missed > MAX_TRACKING_ERROR:
        far = arm is None or track(robot, place[None], posture, reference=reference).error[0] > MAX_TRACKING_ERROR
        warning = "out of the arm's reach" if far else "the arm gives way to the obstacle here"
    elif place[2] < 0:
        warning = "below the table"
    elif scenario.avoids and scenario.warp == 1 and room.obstacle < 0:
        warning = "the motion from here touches the obstacle"
    elif room.tracking < 0:
        warning = "the arm cannot follow the motion from here"
    return replace(pushed, warning=warning)


def _hands(follower: Follower, arm: ArmSolution, posture: Array, reference: Array) -> Hands:
    """Where the hand of the whole arm is when that of the motion below is somewhere near `posture` (6,)."""

    def hands(x: Array) -> Array:
        start = np.broadcast_to(posture, (len(x), NUM_JOINTS))
        q = track(follower.robot, x[:, None], start, reference=np.broadcast_to(reference, start.shape)).q[:, 0]
        return follower.robot.end_effector(arm.transform.inverse(follower.whole_arm.limits.inside(q)))

    return hands


def _place_below(hands: Hands, x: Array, place: Array) -> Array:
    """The place (3,) of the motion below from which the hand is at `place` (3,), or nearest to it, metres.

    By Broyden's method: far from obstacles the map is the identity, so the first step arrives. Where its slope is lost,
    it is taken from differences.
    """
    slope, known = np.eye(3), False
    (hand,) = hands(x[None])
    for _ in range(MAX_STEPS):
        miss = place - hand
        if np.linalg.norm(miss) < ARRIVED:
            break
        step = np.linalg.solve(slope.T @ slope + DAMPING * np.eye(3), slope.T @ miss)
        step *= min(1.0, LONGEST_STEP / max(float(np.linalg.norm(step)), 1e-12)) if known else 1.0
        tried = hands(x + SHORTER[:, None] * step)
        errors = np.linalg.norm(place - tried, axis=1)
        best = int(errors.argmin())
        if errors[best] < 0.7 * np.linalg.norm(miss):
            moved = SHORTER[best] * step
            slope = slope + np.outer(tried[best] - hand - slope @ moved, moved) / (moved @ moved)
            x, hand, known = x + moved, tried[best], False
        elif not known:
            slope, known = (hands(x + DIFFERENCE * np.eye(3)) - hand).T / DIFFERENCE, True
        elif errors[best] < np.linalg.norm(miss):
            x, hand, known = x + SHORTER[best] * step, tried[best], False
        else:
            break
    return x
