"""What methods that plan joints share, and the simplest of them: straight lines to the demonstrated goal posture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.baselines.base import Plan, Planner, Problem
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length, interpolate
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import inverse_kinematics
from dt_viz.robot.joint_trajectory import within_velocity_limits
from dt_viz.robot.robot import Robot

SPACING = 0.01
"""Largest distance, metres, that a point of the arm moves between two postures that are tried for a quick answer."""


@dataclass(frozen=True, eq=False)
class Query:
    """One motion that is asked for."""

    start: Array  # (n,) posture, rad
    goal: Array  # (n,) posture at the end of the demonstration with the nearest start, rad
    duration: float  # duration of that demonstration, seconds

    @classmethod
    def of(cls, problem: Problem, start: Array) -> Query:
        """Find the postures for a start (3,), metres.

        Raises:
            UnreachableError: the arm cannot reach the start.
        """
        nearest = int(np.linalg.norm(problem.task.starts - start, axis=1).argmin())
        along, times = problem.postures[nearest], problem.task.demonstrations[nearest].times
        posture = along[0]
        if np.linalg.norm(problem.robot.end_effector(posture) - start) > problem.robot.tracking.tolerance:
            posture = inverse_kinematics(problem.robot, start, posture)
        return cls(posture, along[-1], float(times[-1] - times[0]))


@dataclass(frozen=True, eq=False)
class PlanningScene:
    """What the arm may hit: an obstacle, the table and itself, by its meshes."""

    robot: Robot
    obstacle: Union

    def is_free(self, start: Array, end: Array) -> bool:
        """Decide whether the arm is free on the straight line between two postures (n,), rad, at every point of it."""
        turn = np.abs(end - start)
        num = 1 + int(np.ceil((self.robot.collision.reach * turn).sum(axis=1).max() / SPACING))
        line = start + np.linspace(0, 1, num + 1)[:, None] * (end - start)
        # spheres that cover the links answer most questions
        if self.obstacle.parts and not self._clears(line):
            return False
        height = self.robot.links.positions(self.robot, line)[..., 2] - self.robot.links.radius
        if height.min() <= SPACING / 2 and self.robot.collision.nearest_to_table(line[[0, -1]]).distance <= 0:
            return False
        itself = self.robot.collision.nearest_to_itself(line[[0, -1]])
        return itself is None or itself.distance > 0

    def _clears(self, line: Array) -> bool:
        """Decide whether the arm clears the obstacle, from samples (N, n), rad."""
        if (self.obstacle.signed_distance(self.robot.end_effector(line)) < 0).any():
            return False
        room = self.robot.links.clearance(self.robot, line, self.obstacle)
        if room.min() > SPACING / 2:
            return True
        deepest = line[np.argsort(room)[:3]]  # tried before the whole line
        if any((self.robot.collision.obstacle_distance(deepest, part)[0] <= 0).any() for part in self.obstacle.parts):
            return False
        return self.robot.collision.nearest_to_obstacle(line[[0, -1]], self.obstacle).distance > 0


def planned(problem: Problem, queries: Sequence[Query], ways: Sequence[Array], warnings: tuple[str, ...] = ()) -> Plan:
    """Make motions of corners (K_i, n), rad: straight between them, even in joint space but for the velocity limits."""
    paths, times, joints = [], [], []
    for query, way in zip(queries, ways, strict=True):
        length = arc_length(way)
        kept = np.concatenate([[True], np.diff(length) > 0])
        at = np.union1d(np.linspace(0, length[-1], 200), length[kept])
        q = interpolate(at, length[kept], way[kept])
        even = query.duration * at / length[-1] if length[-1] else at
        joints.append(q)
        times.append(within_velocity_limits(even, q, problem.robot.velocity_limits))
        paths.append(problem.robot.end_effector(q))
    return Plan(tuple(paths), tuple(times), tuple(joints), warnings)


def fit_straight(problem: Problem) -> Planner:
    """Take the task's postures; joints go straight from that of the start to that of the goal."""

    def plan(obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        queries = [Query.of(problem, start) for start in starts]
        return planned(problem, queries, [np.stack([query.start, query.goal]) for query in queries])

    return plan
