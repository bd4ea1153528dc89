"""Edits of the stack of transforms: pure functions that give the fields of a scenario that change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypedDict

import numpy as np

from dt_viz.metrics import resample_by_arc_length
from dt_viz.obstacles.shapes import Point, as_point
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import Task
from dt_viz.transforms.bias import Biasing, BiasPoint

MAX_BIAS_POINTS = 4
BESIDE = 0.08
"""Metres from the mean path at which a new bias point is placed."""
APART = 0.25
"""Metres that it keeps from other bias points, where that is possible: regions are about that large."""
ROOM = 0.04
"""Metres that it keeps from obstacles."""
PLACES = (0.50, 0.30, 0.70, 0.20, 0.80, 0.40, 0.60)
"""Along the mean path, beside which new bias points are placed, as fractions of its length."""
IMITATION, AVOIDANCE, WHOLE_ARM = "Imitation", "Avoidance", "Whole arm"
"""Names of the transforms that are no layers."""


class Stacked(TypedDict):
    """The fields of a scenario that say what is stacked in which order."""

    layers: tuple[Layer, ...]
    avoidance_level: int | None


def bias_points(layers: Sequence[Layer]) -> dict[str, BiasPoint]:
    """The bias points, also those that are off, by the name of their layer."""
    return {layer.name: layer.behaviour.point for layer in layers if isinstance(layer.behaviour, Biasing)}


def aware(layers: Sequence[Layer]) -> tuple[Layer, ...]:
    """The layers, each bias point told which targets below it are not to be pulled away again."""
    below, told = [], []
    for layer in layers:
        behaviour = layer.behaviour
        if isinstance(behaviour, Biasing):
            layer = replace(layer, behaviour=replace(behaviour, below=tuple(below)))  # noqa: PLW2901
            if layer.on:
                below.append(behaviour.point.position)
        told.append(layer)
    return tuple(told)


def with_bias_point(layers: Sequence[Layer], point: BiasPoint) -> tuple[Layer, ...]:
    """One bias point more, outermost, under the first name that is free."""
    taken = {layer.name for layer in layers}
    name = next(name for k in range(1, len(layers) + 2) if (name := f"Bias {k}") not in taken)
    return aware((*layers, Layer(Biasing(point), name=name)))


def with_changed_point(layers: Sequence[Layer], name: str, point: BiasPoint) -> tuple[Layer, ...]:
    """The bias point of this name replaced."""
    return aware([replace(layer, behaviour=Biasing(point)) if layer.name == name else layer for layer in layers])


def switched(layers: Sequence[Layer], name: str) -> tuple[Layer, ...]:
    """The layer of this name switched off, or on."""
    return aware([replace(layer, on=not layer.on) if layer.name == name else layer for layer in layers])


def names(scenario: Scenario) -> tuple[str, ...]:
    """What is stacked on the imitation, also what is off, from the inside out; the end effector's avoidance is one."""
    stacked = [layer.name for layer in scenario.layers]
    stacked.insert(len(stacked) if scenario.avoidance_level is None else scenario.avoidance_level, AVOIDANCE)
    return tuple(stacked)


def visible_names(scenario: Scenario) -> tuple[str, ...]:
    """The same without the end effector's avoidance where there is nothing for it to do."""
    return tuple(name for name in names(scenario) if name != AVOIDANCE or _hand_avoids(scenario))


def _hand_avoids(scenario: Scenario) -> bool:
    """Whether the end effector's avoidance belongs to the stack, on or off."""
    return scenario.space != "cspace" and bool(scenario.obstacles)


def without(scenario: Scenario, name: str) -> Stacked:
    """The layer of this name taken out."""
    return _in_order(scenario, [other for other in names(scenario) if other != name])


def shifted(scenario: Scenario, name: str, steps: int) -> Stacked:
    """The layer of this name, or the avoidance of the end effector, moved outwards by so many places, or inwards."""
    order = list(visible_names(scenario))
    k = order.index(name)
    order.insert(min(max(k + steps, 0), len(order) - 1), order.pop(k))
    return _in_order(scenario, order)


def _in_order(scenario: Scenario, order: Sequence[str]) -> Stacked:
    by_name = {layer.name: layer for layer in scenario.layers}
    layers = aware([by_name[name] for name in order if name != AVOIDANCE])
    level = order.index(AVOIDANCE) if AVOIDANCE in order else scenario.avoidance_level
    return {"layers": layers, "avoidance_level": None if level == len(layers) else level}


def levels(scenario: Scenario) -> tuple[str, ...]:
    """Names of the levels of the end effector's stack that are on, as `Frame.levels` has them."""
    off = {layer.name for layer in scenario.layers if not layer.on}
    if not scenario.avoidance:
        off.add(AVOIDANCE)
    return (IMITATION, *(name for name in visible_names(scenario) if name not in off))


def plane_of(task: Task) -> tuple[Point, Point] | None:
    """The plane of a drawing, in which it is biased; None of a task in space."""
    if task.demonstrations[0].dimension != 2:
        return None
    u, v = task.slice.axes.T
    return as_point(u), as_point(v)


def place_beside(task: Task, scenario: Scenario) -> BiasPoint:
    """A bias point beside the mean demonstration, in the middle or where bias points and obstacles leave room."""
    mean = np.mean([resample_by_arc_length(path, 201) for path in task.paths], axis=0)
    plane = plane_of(task)
    normal = np.array([0.0, 0.0, 1.0]) if plane is None else np.cross(*plane)
    places = []
    for u in PLACES:
        k = round(200 * u)
        tangent = mean[k + 5] - mean[k - 5]
        aside = np.cross(tangent, normal)
        if np.linalg.norm(aside) < 0.1 * np.linalg.norm(tangent):  # straight up or down
            aside = np.array([1.0, 0.0, 0.0])
        sides = [mean[k] + sign * BESIDE * aside / np.linalg.norm(aside) for sign in (-1, 1)]
        # first the side that is farther from the rest of the motion
        places += sorted(sides, key=lambda place: -np.linalg.norm(mean - place, axis=1).min())
    taken = [np.asarray(other.position) for other in bias_points(scenario.layers).values()]
    free = [place for place in places if np.linalg.norm(mean - place, axis=1).min() > BESIDE / 2]  # of other strokes
    room = [place for place in free if scenario.obstacle.signed_distance(place) > ROOM] or free or places
    # two whose regions overlap pull against each other: first where no other one is near, then as far as there is
    apart = [min((float(np.linalg.norm(place - other)) for other in taken), default=np.inf) for place in room]
    far = [place for place, distance in zip(room, apart, strict=True) if distance > APART]
    return BiasPoint(as_point(far[0] if far else room[int(np.argmax(apart))]), plane=plane)
