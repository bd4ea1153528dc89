"""The scenes of the paper, each with a line that says what to see."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from dt_viz.bias import Biasing, BiasPoint, Vector
from dt_viz.fields import Array
from dt_viz.obstacles import Box, Cylinder
from dt_viz.scenario import Layer, Scenario
from dt_viz.stacking import aware, plane_of
from dt_viz.tasks import Pot, Task

BOTTLE = (0.07, 0.24)
"""Diameter and height, metres."""
CUBE = 0.10
"""Edge, metres."""
J_OFFSETS = ((0.30, (0.09, 0.0)), (0.70, (0.0, -0.09)))
"""Of the two points beside the J: fraction of its length, and metres to the right and up as seen from the front."""
ABOVE = 0.16
"""Metres over a pot's opening where the object is let go, as the demonstrations do over the centre pot."""


@dataclass(frozen=True)
class PaperScene:
    """A scenario of one of the paper's figures."""

    name: str
    title: str
    line: str
    """What to see."""
    task: str
    """Name of its task."""
    make: Callable[[Task], Scenario]

    def scenario(self, task: Task) -> Scenario:
        """The scenario for its task."""
        return replace(self.make(task), scene=self.name)


def _bottle_in_the_way(task: Task) -> Scenario:
    """Fig. 1 and 7: a standing bottle in the path, given way to by the whole arm."""
    (x, y, _), (diameter, height) = task.obstacle_position, BOTTLE
    return Scenario(task.name, (Cylinder((x, y, height / 2), diameter, height),), space="cspace")


def _cube_in_the_letter(task: Task) -> Scenario:
    """Fig. 3 (a)."""
    return Scenario(task.name, (Box(task.obstacle_position, (CUBE, CUBE, CUBE)),), space="task")


def _two_points(task: Task) -> Scenario:
    """Fig. 4."""
    mean, plane = task.mean_path, plane_of(task)
    places = [mean[round(100 * u)] + task.slice.axes @ offset for u, offset in J_OFFSETS]
    layers = [Layer(Biasing(BiasPoint(_vector(p), plane=plane)), name=f"Bias {k}") for k, p in enumerate(places, 1)]
    return Scenario(task.name, (), layers=aware(layers))


def release(pot: Pot) -> Vector:
    """Where an object that is to fall into this pot is let go, metres."""
    x, y, z = pot.opening
    return x, y, z + ABOVE


def _into_pot(index: int) -> Callable[[Task], Scenario]:
    """Fig. 8."""

    def scenario(task: Task) -> Scenario:
        point = BiasPoint(release(task.pots[index]), moves_goal=True)
        return Scenario(task.name, (), layers=(Layer(Biasing(point), name="Bias 1"),))

    return scenario


def _vector(v: Array) -> Vector:
    x, y, z = (float(c) for c in v)
    return x, y, z


SCENES: Mapping[str, PaperScene] = {
    scene.name: scene
    for scene in (
        PaperScene(
            "lift",
            "Fig. 1, 7: lift, a bottle in the way",
            "The whole arm gives way to the bottle, and still reaches into the box and lifts.",
            "lift_box",
            _bottle_in_the_way,
        ),
        PaperScene(
            "push",
            "Fig. 1, 7: push, a bottle in the way",
            "The whole arm gives way to the bottle, and still ends where the box was pushed to.",
            "push_box",
            _bottle_in_the_way,
        ),
        PaperScene(
            "cube",
            "Fig. 3 (a): a cube in the S",
            "Every stroke leaves the cube, the rest stays. Only the path gives way: avoid with “Both” for the arm.",
            "draw_s",
            _cube_in_the_letter,
        ),
        PaperScene(
            "two_points",
            "Fig. 4: a J biased to two points",
            "Every stroke passes both points within a centimetre: drag them.",
            "draw_j",
            _two_points,
        ),
        PaperScene(
            "left_pot",
            "Fig. 8: into the left pot",
            "All demonstrations end over the centre pot; one bias point takes the goal along to the left one.",
            "drop_pots",
            _into_pot(0),
        ),
        PaperScene(
            "right_pot",
            "Fig. 8: into the right pot",
            "All demonstrations end over the centre pot; one bias point takes the goal along to the right one.",
            "drop_pots",
            _into_pot(2),
        ),
    )
}
"""By name, in the order of the figures."""
