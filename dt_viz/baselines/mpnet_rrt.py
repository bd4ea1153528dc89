"""MPNet with hybrid replanning: what collides is planned again by a classical planner (Qureshi et al. 2021, sec. IV).

The planner is OMPL's RRT-Connect (Kuffner and LaValle, 2000), which is complete in probability: where there is a way,
it finds one if it is given the time. It knows nothing of the demonstrations.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dt_viz.baselines.base import Planner, Problem
from dt_viz.baselines.mpnet import ARCHITECTURE, MPNet, MPNetPlanner, Search
from dt_viz.baselines.postures import Query
from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot

_one_at_a_time = threading.Lock()
"""OMPL's random numbers have one seed for the whole process."""


@dataclass(frozen=True, eq=False)
class _Planner(MPNetPlanner):
    seconds: float

    def way(self, search: Search, query: Query) -> list[Array]:
        """Plan one motion; it collides only where no way was found in time."""
        way = super().way(search, query)
        if search.is_free(way):
            return way
        return search.contracted(search.replanned(way, lambda start, goal: self._connected(search, start, goal)))

    def _connected(self, search: Search, start: Array, goal: Array) -> list[Array]:
        """Find a free way between two postures; the straight line where there is none, or no time is left."""
        if not (search.free(start, start) and search.free(goal, goal)):
            return [start, goal]
        return rrt_connect(search.free, search.surroundings.robot, start, goal, self.seconds) or [start, goal]


class MPNetRRT(MPNet):
    """MPNet whose colliding stretches RRT-Connect plans again."""

    name, title = "mpnet-rrt", "MPNet-RRT"
    promise = (
        "A path planned once, which ends at the goal; the whole arm is clear where RRT-Connect finds a way in time. "
        "That imitates nothing."
    )
    needs = ("ompl",)

    def __init__(self, seconds: float = 10.0) -> None:
        """Choose the time for a stretch, seconds; where none is found in it, the stretch stays in collision."""
        super().__init__()
        self.seconds = seconds

    def fit(self, problem: Problem) -> Planner:
        """Load MPNet's weights; see `Method`."""
        return _Planner(problem, self.model(problem), self.seconds)


def rrt_connect(
    free: Callable[[Array, Array], bool], robot: Robot, start: Array, goal: Array, seconds: float
) -> list[Array]:
    """Find a free way between two postures (n,), rad, seeded; empty if none was found in time.

    Args:
        free: decides whether the straight line between two postures is free.
        robot: the arm.
        start: where it begins.
        goal: where it ends.
        seconds: the time that it may take.
    """
    with _one_at_a_time:
        watch = _Watch(free, time.monotonic() + seconds)
        found = _planned(watch, robot, start, goal)
    if watch.raised is not None:
        raise watch.raised  # not within OMPL's frames, which its traceback would keep
    return found


def _planned(watch: _Watch, robot: Robot, start: Array, goal: Array) -> list[Array]:
    from ompl import base, geometric, util  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - an extra

    class Motions(base.MotionValidator):
        """Checks straight lines at every point of them, not at samples."""

        def checkMotion(self, start: object, end: object) -> bool:
            return watch.is_free(posture(start), posture(end))

    def posture(state: Any) -> Array:  # noqa: ANN401 - OMPL's
        return np.array([state[joint] for joint in range(robot.num_joints)])

    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(ARCHITECTURE.seed + 1)  # 0 would be random
    space = base.RealVectorStateSpace(robot.num_joints)
    space.setBounds(_bounds(base.RealVectorBounds(robot.num_joints), robot, start, goal))
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    motions = Motions(information)  # OMPL does not keep it
    setup.setStateValidityChecker(lambda state: watch.is_free(posture(state), posture(state)))
    information.setMotionValidator(motions)
    setup.setPlanner(geometric.RRTConnect(information))
    ends = space.allocState(), space.allocState()
    for state, q in zip(ends, (start, goal), strict=True):
        for joint, angle in enumerate(q):
            state[joint] = float(angle)  # copyFromReals of ompl 2.0.1 crashes
    setup.setStartAndGoalStates(*ends)
    setup.solve(base.PlannerTerminationCondition(watch.is_over))
    if not setup.haveExactSolutionPath():
        return []
    path = setup.getSolutionPath()  # owns its states
    return [start, *(posture(state) for state in path.getStates()[1:-1]), goal]


def _bounds(bounds: Any, robot: Robot, start: Array, goal: Array) -> Any:  # noqa: ANN401 - OMPL's
    """The joint limits, or half a turn beyond the ends where there are none, in OMPL's bounds."""
    lowest = np.where(np.isinf(robot.lower), np.minimum(start, goal) - np.pi, robot.lower)
    highest = np.where(np.isinf(robot.upper), np.maximum(start, goal) + np.pi, robot.upper)
    for joint, (low, high) in enumerate(zip(lowest, highest, strict=True)):
        bounds.setLow(joint, float(low))
        bounds.setHigh(joint, float(high))
    return bounds


class _Watch:
    """What the planner calls back: exceptions are kept, as they must not pass through OMPL's loops."""

    def __init__(self, free: Callable[[Array, Array], bool], deadline: float) -> None:
        self._free, self._deadline = free, deadline
        self.raised: BaseException | None = None

    def is_over(self) -> bool:
        """Whether to stop."""
        return self.raised is not None or time.monotonic() > self._deadline

    def is_free(self, start: Array, end: Array) -> bool:
        """Whether the straight line between two postures is free; never once an exception was raised."""
        if self.is_over():
            return False
        try:
            return self._free(start, end)
        except BaseException as error:
            self.raised = error
            return False
