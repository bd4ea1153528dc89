"""The hand is pushed aside in the middle of its motion, and goes on to the goal from there.

ψ is a conjugacy, so the motion from any place y is known at once: z₀ = ψ(y), z(t) in closed form, y(t) = ψ⁻¹(z(t)).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dt_viz.arm.retiming import within_velocity_limits
from dt_viz.arm.tracking import track
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Rays, evenly_sampled
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.motion.following import MAX_TRACKING_ERROR, ArmMotion, Follower
from dt_viz.motion.solve import Solved
from dt_viz.scenario.scenario import Scenario

DISTANCES = (0.06, 0.03, 0.015)
"""Distance by which the hand is pushed, metres: less where there is no room for more."""
PUSH_SECONDS = 0.3
"""Duration of a push, if the joints can be as fast."""
NUM_PUSH_SAMPLES, NUM_SAMPLES = 12, 150
"""Samples of the push and of the motion after it."""
NUM_DIRECTIONS = 4
"""Directions that are tried at each distance."""
TABLE_ROOM = 0.03
"""Height above the table that a push leaves to the hand, metres, where the motions themselves leave as much."""
LOWER = 5e-3
"""Tolerance below the lowest motion, metres."""


@dataclass(frozen=True)
class Pushed:
    """Motion of the arm after a push: aside, and on to the goal."""

    scenario: Scenario
    motion: ArmMotion
    """Joints from where the arm was; its `without` are those without the whole arm's avoidance."""
    path: Array
    """(T, 3) the end effector at the times of the motion, metres."""
    begins: int
    """The sample where the push is over and the system's own motion begins."""
    warning: str = ""
    """Why the arm is not where it should be, or its motion not to be trusted, in words."""


def pushed(
    follower: Follower,
    solved: Solved,
    q: Array,
    rng: np.random.Generator,
) -> Pushed:
    """Push the hand aside, in a random direction across its motion, and let it go on.

    Of a few directions the first is taken in which nothing is in the way, or else the one with the most room. Where
    the whole arm avoids, the end effector of the motion below is pushed, and p = ψ_q⁻¹(q) lifts that motion.

    Args:
        follower: lifts paths to the joints.
        solved: the motion that is shown.
        q: (6,) joint angles when the push begins, rad.
        rng: for the directions.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    best, most = None, -np.inf
    for place in _places(follower, solved, q, rng):
        found, room = _motion(follower, solved, q, place)
        if best is None or room > most:
            best, most = found, room
        if most >= 0:
            break
    assert best is not None
    return best


def _places(
    follower: Follower,
    solved: Solved,
    q: Array,
    rng: np.random.Generator,
) -> Iterator[Array]:
    """Places (3,), metres, to push the end effector to, the farthest first."""
    hand = follower.robot.end_effector(below(follower, solved, q))
    directions = _across(solved.stack.system, hand, rng)
    for distance in DISTANCES:
        yield from hand + distance * directions


def _across(system: DiffeomorphicSystem, hand: Array, rng: np.random.Generator) -> Array:
    """Random unit vectors (NUM_DIRECTIONS, 3) at right angles to the motion at `hand` (3,)."""
    velocity = system.velocity(hand[None])[0]
    along = velocity / max(np.linalg.norm(velocity), 1e-9)
    directions = rng.normal(size=(NUM_DIRECTIONS, 3))
    directions -= np.outer(directions @ along, along)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def below(follower: Follower, solved: Solved, q: Array) -> Array:
    """The configuration (6,) of the motion that the whole arm's avoidance is made for, rad."""
    return q if solved.arm is None else solved.arm.transform.forward(follower.whole_arm.limits.inside(q))


def _motion(
    follower: Follower,
    solved: Solved,
    q: Array,
    place: Array,
) -> tuple[Pushed, float]:
    """The motion by way of `place` (3,), and how much room it has, metres; below 0 there is too little."""
    posture = below(follower, solved, q)
    u = np.linspace(0, 1, NUM_PUSH_SAMPLES)
    hand = follower.robot.end_effector(posture)
    aside = hand + (u * u * (3 - 2 * u))[:, None] * (place - hand)
    found, room = onwards(follower, solved, posture, aside, PUSH_SECONDS * u)
    return found, min(room)


class Room(NamedTuple):
    """Room that a motion has, metres; below 0 there is too little."""

    table: float
    """Height above the table."""
    tracking: float
    """Exactness with which the joints follow."""
    obstacle: float
    """Distance of what avoids the obstacle."""


def onwards(
    follower: Follower,
    solved: Solved,
    posture: Array,
    aside: Array,
    seconds: Array,
) -> tuple[Pushed, Room]:
    """The motion along a path and on from its end to the goal, and how much room it has.

    Args:
        follower: lifts paths to the joints.
        solved: the motion that is shown.
        posture: (6,) joints near the beginning of the path, rad, as those of `below`.
        aside: (K, 3) the path, metres, of the end effector of the motion below the whole arm's avoidance.
        seconds: (K,) times on the path.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    robot, scenario, stack, arm = follower.robot, solved.scenario, solved.stack, solved.arm
    rays = Rays(stack.system.transform.forward(aside[-1:]), stack.rays.base)
    bundle = evenly_sampled(lambda i, u: stack.transform.inverse(rays.at(i, u))[:, None], 1, NUM_SAMPLES)
    path = np.concatenate([aside[:-1], bundle.positions])
    times = np.concatenate([seconds[:-1], seconds[-1] + rays.times(bundle.index, bundle.fraction)])

    tracked = track(robot, path, posture, reference=follower.reference(solved.nominal))
    joints = tracked.q
    if arm is not None:
        joints = arm.transform.inverse(follower.whole_arm.limits.inside(joints))
        path = robot.end_effector(joints)
    motion = ArmMotion(within_velocity_limits(times, joints, robot.velocity_limits), joints, tracked.q)

    lowest = min(TABLE_ROOM, float(stack.bundle.positions[:, 2].min())) - LOWER
    if arm is not None:
        clearance = float(follower.whole_arm.clearance(joints, scenario.obstacle).min())
    else:
        clearance = float(scenario.obstacle.signed_distance(path if scenario.avoids else aside).min())
    room = Room(float(path[:, 2].min()) - lowest, MAX_TRACKING_ERROR - float(tracked.error.max()), clearance)
    return Pushed(scenario, motion, path, len(aside) - 1), room
