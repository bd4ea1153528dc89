"""Tasks, placed where an arm can follow them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.numerics import unit
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError, inverse_kinematics
from dt_viz.robot.placement import NUM_SAMPLES, follows, is_jaco, place, resampled
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import Task, TaskEntry

logger = logging.getLogger(__name__)


def in_reach(tasks: Mapping[str, TaskEntry], robot: Robot, *, moves_recorded: bool = False) -> Mapping[str, TaskEntry]:
    """Return tasks made for the JACO, each placed where another arm follows it when it is chosen first.

    One that the arm can follow nowhere stays where it is: a log line says why, and the page what is out of reach.
    Those recorded in space stay where they are, or, if `moves_recorded`, where the arm follows them there.
    """

    def placed(entry: TaskEntry) -> TaskEntry:
        if entry.is_recorded:
            return replace(entry, load=lambda: where_followed(entry(), robot)) if moves_recorded else entry
        return entry if is_jaco(robot) else replace(entry, load=lambda: _placed(entry(), robot))

    return {name: placed(entry) for name, entry in tasks.items()}


def where_followed(task: Task, robot: Robot) -> Task:
    """Return a task where it was recorded if the arm follows it there, or else placed in its reach."""
    paths = np.array([resampled(path, NUM_SAMPLES) for path in task.paths])
    return task if follows(robot, paths) else _placed(task, robot)


def _placed(task: Task, robot: Robot) -> Task:
    reason: UnreachableError | None = None
    for on_table in (True, False) if task.on_table else (False,):
        try:
            placement = place(robot, task.paths, on_table=on_table)
            placed = task.placed(placement.scale, placement.shift)
            return _freed(placed, robot) if task.on_table else placed
        except UnreachableError as error:
            reason = error
    logger.warning("%s: %s", task.title, reason)
    return task


def _freed(task: Task, robot: Robot, room: float = 0.01, step: float = 0.01, most: int = 20) -> Task:
    """Return a task whose first obstacle has room, metres, from the arm at the goal: it is moved away in some steps."""
    goal, place = np.mean([path[-1] for path in task.paths], axis=0), np.array(task.obstacle_position)
    posture, arm = inverse_kinematics(robot, goal), WholeArm(robot)
    for k in range(most):
        there = as_point(place + k * step * unit(place - goal))
        if arm.clearance(posture[None], Union((Sphere(there, task.size * Sphere.diameter),))).min() > room:
            return replace(task, obstacle_position=there)
    return task
