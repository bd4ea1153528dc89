"""Edits of the stack of transforms: pure functions from one stack to another."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance, Space
from dt_viz.avoidance.page import Surroundings
from dt_viz.avoidance.registry import AVOIDANCE, entry_of
from dt_viz.avoidance.transform import Anchored, Transform
from dt_viz.metrics import resample_by_arc_length
from dt_viz.obstacles.shapes import Point, as_point
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.slices import BASE_PANEL, Panel
from dt_viz.scenario.tasks import Task

IMITATION, WHOLE_ARM = "Imitation", "Whole arm"
"""Names of the transforms below and above the stack: the learned one, and the avoidance in configuration space."""

Stack = tuple[Layer, ...]


def avoiding(task: Task, avoidance: Avoidance, *, on: bool = True) -> Scenario:
    """Return the scenario of a task with an avoidance, switched on or off, on its imitation."""
    return Scenario(task.name, (Layer(avoidance, on, AVOIDANCE.title),))


def place_of(scenario: Scenario, name: str) -> int | None:
    """Return the place in the stack of the layer of this name; `WHOLE_ARM` is the layer of the page's obstacles."""
    if name == WHOLE_ARM:
        name = avoidance_layer(scenario).name
    return next((k for k, layer in enumerate(scenario.stack) if layer.name == name), None)


def avoidance_layer(scenario: Scenario) -> Layer:
    """Return the layer that the page's obstacles belong to; without one, an empty layer that is off."""
    none = Layer(scenario.avoidance, on=False, name=AVOIDANCE.title)
    return next((layer for layer in scenario.stack if layer.transform is scenario.avoidance), none)


def transform_of(scenario: Scenario, name: str) -> Transform | None:
    """Return the transform of the layer of this name, see `place_of`; None if there is none."""
    place = place_of(scenario, name)
    return None if place is None else scenario.stack[place].transform


def with_transform(scenario: Scenario, name: str, transform: Transform) -> Stack:
    """The stack with the transform of the layer of this name replaced; unchanged if there is none."""
    return _changed(scenario, name, transform=transform)


def with_avoidance(scenario: Scenario, **changes: Any) -> Stack:  # noqa: ANN401 - the fields of Avoidance
    """Return the stack with fields of the page's avoidance, or its space, replaced; it is added if there is none."""
    layer = avoidance_layer(scenario)
    after = scenario.avoidance.changed(**changes)
    if place_of(scenario, layer.name) is None:
        return (*scenario.stack, Layer(after, name=layer.name))
    return _changed(scenario, layer.name, transform=after)


def avoiding_with(scenario: Scenario, space: Space | None) -> Stack:
    """Return the stack whose page's avoidance acts in a space; None switches it off."""
    changes: dict[str, Any] = {} if space is None else {"space": space}
    stack = with_avoidance(scenario, **changes)
    return _changed(replace(scenario, stack=stack), avoidance_layer(scenario).name, on=space is not None)


def _changed(scenario: Scenario, name: str, **changes: Any) -> Stack:  # noqa: ANN401 - the fields of Layer
    place = place_of(scenario, name)
    return tuple(replace(layer, **changes) if k == place else layer for k, layer in enumerate(scenario.stack))


def with_added(scenario: Scenario, transform: Transform) -> tuple[Stack, str]:
    """Return the stack with one more transform, below those that are the only ones of their kind, and its name."""
    taken, entry = {layer.name for layer in scenario.stack}, entry_of(transform)
    names = (entry.title if entry.most == 1 else f"{entry.title} {k}" for k in range(1, len(taken) + 2))
    name = next(name for name in names if name not in taken)
    place = len(scenario.stack)
    while place and entry_of(scenario.stack[place - 1].transform).most == 1:
        place -= 1
    return (*scenario.stack[:place], Layer(transform, name=name), *scenario.stack[place:]), name


def without(scenario: Scenario, name: str) -> Stack:
    """The stack without the layer of this name."""
    return tuple(layer for layer in scenario.stack if layer.name != name)


def switched(scenario: Scenario, name: str) -> Stack:
    """The stack with the layer of this name switched off, or on; unchanged if there is none."""
    place = place_of(scenario, name)
    return scenario.stack if place is None else _changed(scenario, name, on=not scenario.stack[place].on)


def shifted(scenario: Scenario, name: str, steps: int) -> Stack:
    """Return the stack with a layer moved by `steps` places of those that are listed, outwards if positive."""
    order = list(listed(scenario))
    k = order.index(name)
    order.insert(min(max(k + steps, 0), len(order) - 1), order.pop(k))
    by_name, rest = {layer.name: layer for layer in scenario.stack}, iter(order)
    return tuple(by_name[next(rest)] if layer.transform.acts else layer for layer in scenario.stack)


def as_fresh(scenario: Scenario, fresh: Scenario) -> Stack:
    """Return the stack of a fresh scenario of another task, with this scenario's obstacles and their avoidance."""
    kept = zip(fresh.obstacles, scenario.obstacles, strict=False)
    moved = tuple(had.moved(there.position, had.wxyz) for there, had in kept)
    avoidance, own = avoidance_layer(fresh), avoidance_layer(scenario)
    changes = {"transform": replace(scenario.avoidance, obstacles=moved), "on": own.on}
    return _changed(fresh, avoidance.name, **changes)


def listed(scenario: Scenario) -> tuple[str, ...]:
    """Names of the layers that change the end effector's motion, also of those that are off, from the inside out."""
    return tuple(layer.name for layer in scenario.stack if layer.transform.acts)


def levels(scenario: Scenario) -> tuple[str, ...]:
    """Names of the levels of the end effector's stack that are on, as `Frame.levels` has them."""
    return (IMITATION, *(layer.name for _, layer in scenario.active))


def side_by_side(scenario: Scenario) -> tuple[Panel, ...]:
    """Return panels of the base attractor and of each level below that of the whole stack."""
    below = levels(scenario)[:-1]
    return (BASE_PANEL, *(Panel(level) for level in below if level != IMITATION or scenario.imitation))


def tunable(scenario: Scenario) -> tuple[str, ...]:
    """Names of all transforms, also of those that are off, from the outermost to the imitation."""
    arm = (WHOLE_ARM,) if scenario.avoidance.space == "cspace" and scenario.obstacles else ()
    return (*arm, *reversed(listed(scenario)), IMITATION)


def tuned(scenario: Scenario) -> str:
    """Name of the transform whose settings the page shows: the one chosen, or else the outermost."""
    names = tunable(scenario)
    return scenario.view.tuned if scenario.view.tuned in names else names[0]


def anchored(scenario: Scenario) -> dict[str, Anchored]:
    """The transforms that have a place of their own, also those that are off, by the name of their layer."""
    return {layer.name: layer.transform for layer in scenario.stack if isinstance(layer.transform, Anchored)}


def added(scenario: Scenario) -> dict[str, Transform]:
    """The transforms of which there may be several, also those that are off, by the name of their layer."""
    return {layer.name: layer.transform for layer in scenario.stack if entry_of(layer.transform).most > 1}


def selected(scenario: Scenario) -> str | None:
    """Name of the added transform that the panel changes: the chosen one, or else the newest."""
    names = added(scenario)
    return scenario.view.bias if scenario.view.bias in names else next(reversed(names), None)


def plane_of(task: Task) -> tuple[Point, Point] | None:
    """Return the plane of a drawing, in which it is biased; None for a task in space."""
    if task.demonstrations[0].dimension != 2:
        return None
    u, v = task.slice.axes.T
    return as_point(u), as_point(v)


def surroundings(task: Task, scenario: Scenario) -> Surroundings:
    """Return the surroundings of a transform that is added."""
    mean = np.mean([resample_by_arc_length(path, 201) for path in task.paths], axis=0)
    anchors = tuple(transform.position for transform in anchored(scenario).values())
    return Surroundings(mean, plane_of(task), scenario.obstacle, anchors)
