"""The methods by name, and the problems that they are fitted to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dt_viz.baselines import eflow, linear, modulation, mpnet, mpnet_rrt, ours, repulsive
from dt_viz.baselines.base import Method, Planner, Problem
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned

METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method(
            "ours",
            "Ours",
            "Stable, and the whole arm keeps clear; where it finds no way it says so.",
            ours.fit,
            stable=True,
            whole_arm=True,
        ),
        Method(
            "ours-no-avoidance",
            "Ours, no avoidance",
            "Stable: every motion reaches the goal, by construction. It does not avoid.",
            ours.fit_alone,
            stable=True,
            live=True,
            avoids=False,
        ),
        Method(
            "eflow",
            "EFlow",
            "Stable: every motion reaches the goal, by construction. It does not avoid.",
            eflow.fit,
            stable=True,
            live=True,
            avoids=False,
        ),
        Method(
            "eflow-repulsive",
            "EFlow (repulsive)",
            "No guarantee: it may stop in a local minimum, and a step may end inside the obstacle.",
            repulsive.fit,
            live=True,
        ),
        Method(
            "mpnet",
            "MPNet",
            "A path planned once, which ends at the goal, through the obstacle where no free way is found: trained on "
            "demonstrations alone, it has seen no obstacle.",
            mpnet.fit,
            whole_arm=True,
        ),
        Method(
            "mpnet-rrt",
            "MPNet-RRT",
            "A path planned once, which ends at the goal; the whole arm is clear where RRT-Connect finds a way in time."
            " That imitates nothing.",
            mpnet_rrt.fit,
            whole_arm=True,
            needs=("ompl",),
        ),
        Method(
            "linear",
            "Linear",
            "A path planned once, straight in the joints to the goal. It neither imitates nor avoids.",
            linear.fit,
            live=True,
            avoids=False,
        ),
        Method(
            "modulation",
            "Modulation",
            "The end effector's velocity never leads into a star-shaped obstacle; a motion may stop before one.",
            modulation.fit,
            live=True,
        ),
    )
}
"""Every method, in the order of the tables."""


@dataclass(frozen=True)
class Trained:
    """A method whose weights are made in advance."""

    version: int
    """Version of its weights."""
    training: str
    """Module with `train(problem, num_epochs, report, seed)`, which gives the arrays of the weights; it may need
    more than DT-Viz itself."""
    num_epochs: int
    """Default number of epochs."""
    fit: Callable[..., Planner]
    """Fits the method by the weights of a `folder`."""


TRAINED: Mapping[str, Trained] = {
    "eflow": Trained(eflow.VERSION, "dt_viz.baselines.eflow_training", 2000, eflow.fit),
    "mpnet": Trained(mpnet.VERSION, "dt_viz.baselines.mpnet_training", 1500, mpnet.fit),
}
"""Methods that are trained in advance, by name."""


def problem_of(learned: Learned, follower: Follower) -> Problem:
    """The problem of a task: its demonstrations, our imitation of them, and the arm along each demonstration.

    Raises:
        UnreachableError: the arm cannot get to where the task's motions start.
    """
    postures = tuple(follower.along(learned.demonstrated, path).q for path in learned.task.paths)
    return Problem(learned, follower.robot, postures)
