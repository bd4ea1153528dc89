"""Whether an arm may get around an obstacle at all, by what the avoidance does not use: random postures, a planner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.baselines.mpnet_rrt import rrt_connect
from dt_viz.baselines.postures import PlanningScene
from dt_viz.flows.fields import Array
from dt_viz.motion.following import MAX_TRACKING_ERROR
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union
from dt_viz.robot.choices import Ranges
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import Robot


@dataclass(frozen=True)
class PassableSettings:
    """How much is tried."""

    num_postures: int = 400
    """Number of random postures with the hand at a place, one of which has to keep clear."""
    seconds: float = 10.0
    """Time in which the planner has to find a way from a start."""


def postures_at(
    robot: Robot,
    places: Array,
    avoidance: ArmAvoidance,
    rng: np.random.Generator,
    settings: PassableSettings = PassableSettings(),
) -> Array | None:
    """Find postures with the hand at places, by inverse kinematics from random seeds, that keep clear on the meshes.

    Args:
        robot: the arm.
        places: (R, 3) starts and goal, metres.
        avoidance: the obstacles, and the margin that is kept from them.
        rng: of the seeds.
        settings: how many are tried.

    Returns:
        (R, n), rad; None where one is missing, or an obstacle is at a place or at a link that no joint carries away.
    """
    obstacle, margin = avoidance.avoided, avoidance.margin

    def keeps_clear(solids: CollisionModel, q: Array) -> bool:
        return solids.nearest_to_obstacle(q[None], obstacle).distance >= margin

    def is_sound(q: Array) -> bool:
        near = robot.collision.nearest_to_itself(q[None])
        return (near is None or near.distance > 0) and robot.collision.nearest_to_table(q[None]).distance >= 0

    fixed = CollisionModel(robot, [mesh for mesh in robot.meshes if mesh.joint < robot.num_fixed], robot.num_fixed)
    if obstacle.signed_distance(places).min() < margin or not keeps_clear(fixed, robot.home):
        return None
    found = []
    for place in places:
        seeds = Ranges.of(robot.lower, robot.upper).random(rng, settings.num_postures)
        tracked = track(robot, np.broadcast_to(place, (len(seeds), 1, 3)), seeds)
        q = tracked.q[tracked.error[:, 0] < MAX_TRACKING_ERROR, 0]
        found.append(next((one for one in q if keeps_clear(robot.collision, one) and is_sound(one)), None))
        if found[-1] is None:
            return None
    return np.array(found)


def has_way(
    robot: Robot, ball: Sphere, margin: float, postures: Array, settings: PassableSettings = PassableSettings()
) -> bool | None:
    """Whether a planner finds a way that keeps the margin, metres, from each start to the goal.

    Args:
        robot: the arm.
        ball: the obstacle.
        margin: distance that is kept from it, metres.
        postures: (R + 1, n) of the starts and the goal, rad.
        settings: how long it may take.

    Returns:
        None where there is no planner: it is an extra.
    """
    scene = PlanningScene(robot, Union((Sphere(ball.position, 2 * (ball.radius + margin)),)))
    *starts, goal = postures
    try:
        return all(rrt_connect(scene.is_free, robot, start, goal, settings.seconds) for start in starts)
    except ImportError:
        return None
