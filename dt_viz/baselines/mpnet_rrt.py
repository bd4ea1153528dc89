"""MPNet with hybrid replanning: what collides is planned again by a classical planner (Qureshi et al. 2021, sec. IV).

The planner is OMPL's RRT-Connect (Kuffner and LaValle, 2000), which is complete in probability: where there is a way,
it finds one if it is given the time. It knows nothing of the demonstrations.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from dt_viz.baselines import mpnet
from dt_viz.baselines.base import Planner, Problem
from dt_viz.baselines.mpnet import ARCHITECTURE, Search
from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot

_one_at_a_time = threading.Lock()
"""OMPL's random numbers have one seed for the whole process."""


def fit(problem: Problem, seconds: float = 10.0) -> Planner:
    """Load MPNet's weights; a stretch for which no way is found in these seconds stays in collision."""
    return mpnet.fit(problem, partial(_connected, seconds=seconds))


def _connected(search: Search, start: Array, goal: Array, seconds: float) -> list[Array]:
    """Find a free way between two postures; the straight line where there is none, or no time is left."""
    if not (search.free(start, start) and search.free(goal, goal)):
        return [start, goal]
    return rrt_connect(search.free, search.surroundings.robot, start, goal, seconds) or [start, goal]


def rrt_connect(
    free: Callable[[Array, Array], bool], robot: Robot, start: Array, goal: Array, seconds: float
) -> list[Array]:
    """Find a way between two postures (n,), rad, of lines that are `free`, seeded; empty if there is none in time."""
    deadline, raised = time.monotonic() + seconds, []

    def is_over() -> bool:
        return bool(raised) or time.monotonic() > deadline

    def is_free(start: Array, end: Array) -> bool:
        """Ask `free`, whose exceptions are kept: they must not pass through OMPL's loops."""
        try:
            return not is_over() and free(start, end)
        except BaseException as error:
            raised.append(error)
            return False

    with _one_at_a_time:
        found = _planned(is_free, is_over, robot, start, goal)
    if raised:
        raise raised[0]  # not within OMPL's frames, which its traceback would keep
    return found


def _planned(
    is_free: Callable[[Array, Array], bool], is_over: Callable[[], bool], robot: Robot, start: Array, goal: Array
) -> list[Array]:
    from ompl import base, geometric, util  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - an extra

    class Motions(base.MotionValidator):
        """Checks straight lines at every point of them, not at samples."""

        def checkMotion(self, start: object, end: object) -> bool:
            return is_free(posture(start), posture(end))

    def posture(state: Any) -> Array:  # noqa: ANN401 - OMPL's
        return np.array([state[joint] for joint in range(robot.num_joints)])

    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(ARCHITECTURE.seed + 1)  # 0 would be random
    space, bounds = base.RealVectorStateSpace(robot.num_joints), base.RealVectorBounds(robot.num_joints)
    for joint, ends in enumerate(zip(robot.lower, robot.upper, start, goal, strict=True)):
        low, high, *both = map(float, ends)
        bounds.setLow(joint, low if np.isfinite(low) else min(both) - np.pi)
        bounds.setHigh(joint, high if np.isfinite(high) else max(both) + np.pi)
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    motions = Motions(information)  # OMPL does not keep it
    setup.setStateValidityChecker(lambda state: is_free(posture(state), posture(state)))
    information.setMotionValidator(motions)
    setup.setPlanner(geometric.RRTConnect(information))
    states: Any = space.allocState(), space.allocState()
    for state, q in zip(states, (start, goal), strict=True):
        for joint, angle in enumerate(q):
            state[joint] = float(angle)  # copyFromReals of ompl 2.0.1 crashes
    setup.setStartAndGoalStates(*states)
    setup.solve(base.PlannerTerminationCondition(is_over))
    if not setup.haveExactSolutionPath():
        return []
    path = setup.getSolutionPath()  # owns its states
    return [start, *(posture(state) for state in path.getStates()[1:-1]), goal]
