"""The learned system of a task in the robot's world, as the engine stacks it, for measuring it without the engine."""

from __future__ import annotations

from dt_viz.diffeo import Placed
from dt_viz.imitation import Imitation
from dt_viz.systems import Attractor, DiffeomorphicSystem
from dt_viz.tasks import Task


def learned_system(task: Task, imitation: Imitation) -> DiffeomorphicSystem:
    """The undeformed motion of a task: the placed imitation on the plain attractor, metres and seconds."""
    base = imitation.base
    attractor = Attractor(task.to_world(base.goal), task.scale * base.speed, task.scale * base.smoothing)
    return DiffeomorphicSystem(Placed(imitation.transform, task.origin, task.axes, task.scale), attractor)
