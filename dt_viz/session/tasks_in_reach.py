"""Tasks, placed where an arm can follow them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.numerics import unit
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError, inverse_kinematics
from dt_viz.robot.placement import is_jaco, place
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import Task, TaskEntry

logger = logging.getLogger(__name__)


def in_reach(tasks: Mapping[str, TaskEntry], robot: Robot) -> Mapping[str, TaskEntry]:
    """Return tasks made for the JACO, each placed where another arm follows it when it is chosen first.

    One that the arm can follow nowhere stays where it is: a log line says why, and the page what is out of reach.
    """
    if is_jaco(robot):
        return tasks
    return {
        name: entry if entry.is_fixed else replace(entry, load=partial(_placed, entry, robot))
        for name, entry in tasks.items()
    }


def _placed(entry: TaskEntry, robot: Robot) -> Task:
    task = entry()
    reason: UnreachableError | None = None
    for on_table in (True, False) if task.on_table else (False,):
        try:
            placement = place(robot, task.paths, on_table=on_table)
            placed = task.placed(placement.scale, placement.shift)
            return _freed(placed, robot) if task.on_table else placed
        except UnreachableError as error:
            reason = error
    logger.warning("%s: %s", entry.title, reason)
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
