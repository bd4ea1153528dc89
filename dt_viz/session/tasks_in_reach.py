"""Tasks, placed where an arm can follow them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from dt_viz.robot.inverse_kinematics import UnreachableError
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
            return task.placed(placement.scale, placement.shift)
        except UnreachableError as error:
            reason = error
    logger.warning("%s: %s", entry.title, reason)
    return task
