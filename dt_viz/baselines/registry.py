"""The methods by name, and the problems that they are fitted to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dt_viz.baselines import eflow, modulation, mpnet, ours, repulsive
from dt_viz.baselines.base import Method, Problem
from dt_viz.baselines.postures import fit_straight
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned

_IS_STABLE = "Stable: every motion reaches the goal, by construction. It does not avoid."
_WHOLE_ARM = "Stable, and the whole arm keeps clear; where it finds no way it says so."
_MAY_STOP = "No guarantee: it may stop in a local minimum, and a step may end inside the obstacle."
_MAY_COLLIDE = (
    "A path planned once, which ends at the goal, through the obstacle where no free way is found: trained on "
    "demonstrations alone, it has seen no obstacle."
)
_IS_CLEAR = (
    "A path planned once, which ends at the goal; the whole arm is clear where RRT-Connect finds a way in time."
    " That imitates nothing."
)
_IS_STRAIGHT = "A path planned once, straight in the joints to the goal. It neither imitates nor avoids."
_IS_LED_PAST = "The end effector's velocity never leads into a star-shaped obstacle; a motion may stop before one."
_ALONE: Mapping[str, Any] = {"stable": True, "live": True, "avoids": False}
_ALL = (
    Method("ours", "Ours", _WHOLE_ARM, ours.fit, stable=True, whole_arm=True),
    Method("ours-no-avoidance", "Ours, no avoidance", _IS_STABLE, ours.fit_alone, **_ALONE),
    Method("eflow", "EFlow", _IS_STABLE, eflow.fit, weights="eflow", **_ALONE),
    Method("eflow-repulsive", "EFlow (repulsive)", _MAY_STOP, repulsive.fit, weights="eflow", live=True),
    Method("mpnet", "MPNet", _MAY_COLLIDE, mpnet.fit, weights="mpnet", whole_arm=True),
    Method("mpnet-rrt", "MPNet-RRT", _IS_CLEAR, mpnet.fit_rrt, weights="mpnet", whole_arm=True, needs=("ompl",)),
    Method("linear", "Linear", _IS_STRAIGHT, fit_straight, live=True, avoids=False),
    Method("modulation", "Modulation", _IS_LED_PAST, modulation.fit, live=True),
)
METHODS: dict[str, Method] = {method.name: method for method in _ALL}
"""Every method, in the order of the tables."""
OURS = METHODS["ours"]


def others() -> list[Method]:
    """Return the methods that a page can show beside ours, in the order of the tables."""
    return [method for method in METHODS.values() if method is not OURS]


def problem_of(learned: Learned, follower: Follower) -> Problem:
    """The problem of a task: its demonstrations, our imitation of them, and the arm along each demonstration.

    Raises:
        UnreachableError: the arm cannot get to where the task's motions start.
    """
    postures = tuple(follower.along(learned.demonstrated, path).q for path in learned.task.paths)
    return Problem(learned, follower.robot, postures)
