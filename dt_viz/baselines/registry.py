"""The methods by name, and the problems that they are fitted to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from dt_viz.baselines import eflow, mpnet
from dt_viz.baselines.base import Method, Problem
from dt_viz.baselines.eflow import EFlow
from dt_viz.baselines.linear import Linear
from dt_viz.baselines.modulation import Modulation
from dt_viz.baselines.mpnet import MPNet
from dt_viz.baselines.mpnet_rrt import MPNetRRT
from dt_viz.baselines.ours import Ours, OursAlone
from dt_viz.baselines.repulsive import EFlowRepulsive
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned

METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Ours(),
        OursAlone(),
        EFlow(),
        EFlowRepulsive(),
        MPNet(),
        MPNetRRT(),
        Linear(),
        Modulation(),
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
    from_folder: Callable[[Path], Method]
    """The method with the weights of a folder."""


TRAINED: Mapping[str, Trained] = {
    "eflow": Trained(eflow.VERSION, "dt_viz.baselines.eflow_training", 2000, lambda folder: EFlow(folder=folder)),
    "mpnet": Trained(mpnet.VERSION, "dt_viz.baselines.mpnet_training", 1500, MPNet),
}
"""Methods that are trained in advance, by name."""


def problem_of(learned: Learned, follower: Follower) -> Problem:
    """The problem of a task: its demonstrations, our imitation of them, and the arm along each demonstration.

    Args:
        learned: the task, learned.
        follower: the arm; that of an engine knows the task's postures already.

    Raises:
        UnreachableError: the arm cannot get to where the task's motions start.
    """
    postures = tuple(follower.along(learned.demonstrated, path).q for path in learned.task.paths)
    return Problem(learned, follower.robot, postures)
