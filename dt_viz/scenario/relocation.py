"""A scenario taken along to where its task is placed for another arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.registry import entry_of
from dt_viz.avoidance.transform import Anchored, Planar, Transform
from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array, Mask
from dt_viz.flows.rotations import turned
from dt_viz.obstacles.shapes import Obstacle, Point, Primitive, as_point, as_quaternion
from dt_viz.scenario.scenario import Layer, Scenario, Start
from dt_viz.scenario.tasks import OWN, Task

SIZES = ("diameter", "height", "sizes", "scale")  # fields of obstacles that are lengths
DIGITS = 7
"""Decimal places that lengths are rounded to, metres: there and back is the same to the last bit."""


@dataclass(frozen=True)
class Relocation:
    """The map x ↦ scale·x + shift from where a task was to where it is now."""

    scale: float
    shift: Point  # metres
    first: tuple[Point, Point] | None = None
    """Where the task's first obstacle was and is now, metres: one that nobody has moved stays that."""

    @classmethod
    def between(cls, before: Task, after: Task) -> Relocation:
        """Return the map of the same task's world at two places; they differ in place and scale only."""
        scale = after.scale / before.scale
        shift = as_point(after.origin - scale * before.origin)
        return cls(scale, shift, (before.obstacle_position, after.obstacle_position))

    def point(self, place: Point) -> Point:
        """Map a place, metres."""
        return as_point((self.scale * np.array(place) + self.shift).round(DIGITS))

    def obstacle(self, obstacle: Obstacle) -> Obstacle:
        """Map an obstacle. What comes from a file keeps its size, others theirs within the limits of the page."""
        place = self.point(obstacle.position)
        if self.first is not None and obstacle.position == self.first[0]:
            place = self.first[1]
        moved = obstacle.moved(place, obstacle.wxyz)
        return moved.scaled(self.scale, DIGITS) if isinstance(moved, Primitive) else moved

    def transform(self, transform: Transform) -> Transform:
        """Map the places and lengths of a transform."""
        if isinstance(transform, Avoidance):
            return replace(transform, obstacles=tuple(map(self.obstacle, transform.obstacles)))
        if isinstance(transform, Anchored):
            radius = transform.radius and round(self.scale * transform.radius, DIGITS)
            return replace(transform, position=self.point(transform.position), radius=radius)
        return transform


def in_world(task: Task) -> tuple[Layer, ...]:
    """Return the layers that a task begins with, in the world, named as the page names them.

    Raises:
        FormatError: a transform is of a kind whose places and lengths are not known, and the task lies elsewhere.
    """
    layers: list[Layer] = []
    for layer in task.layers:
        entry = entry_of(layer.transform)
        number = 1 + sum(entry_of(other.transform) is entry for other in layers)
        name = entry.title if entry.most == 1 else f"{entry.title} {number}"
        layers.append(Layer(_in_world(layer.transform, task), layer.on, name))
    return tuple(layers)


def in_its_frame(stack: Sequence[Layer], task: Task) -> tuple[Layer, ...]:
    """Return layers in the frame of a task's demonstrations, whose layers in the world are given: `in_world` undone."""
    axes, scale = task.axes.T, 1 / task.scale
    back = replace(task, origin=-scale * axes @ task.origin, axes=axes, scale=scale)
    return tuple(replace(layer, transform=_in_world(layer.transform, back)) for layer in stack)


def _in_world(transform: Transform, task: Task) -> Transform:
    if task.scale == 1 and not task.origin.any() and np.array_equal(task.axes, np.eye(3)):
        return transform
    place = lambda point: as_point(task.to_world(np.array(point)))  # noqa: E731
    changes: dict[str, Any] = {}
    if isinstance(transform, Planar) and transform.plane is not None:
        u, v = (as_point(task.axes @ np.array(axis)) for axis in transform.plane)
        changes["plane"] = u, v
    if isinstance(transform, Anchored):
        radius = transform.radius and task.scale * transform.radius
        return replace(transform, position=place(transform.position), radius=radius, **changes)
    if isinstance(transform, Avoidance):
        parts = (_resized(part, task.scale) for part in transform.obstacles)
        turns = [as_quaternion(turned(task.axes, np.array(part.wxyz))) for part in transform.obstacles]
        obstacles = tuple(part.moved(place(part.position), turn) for part, turn in zip(parts, turns, strict=True))
        return replace(transform, obstacles=obstacles, margin=task.scale * transform.margin, **changes)
    raise FormatError("transform", type(transform).__name__, "obstacles and bias points on a drawing")


def _resized(obstacle: Obstacle, scale: float) -> Obstacle:
    changed: Any = obstacle
    sizes = {field.name: getattr(obstacle, field.name) for field in fields(changed) if field.name in SIZES}
    return replace(changed, **{name: _scaled(size, scale) for name, size in sizes.items()})


def _scaled(size: float | tuple[float, ...], scale: float) -> float | tuple[float, ...]:
    return tuple(scale * side for side in size) if isinstance(size, tuple) else scale * size


def relocated(
    scenario: Scenario, before: Task, after: Task, reaches: Callable[[Array], Mask]
) -> tuple[Scenario, tuple[str, ...]]:
    """Return a scenario with all that is added to its task where that is for another arm.

    Args:
        scenario: the scenario.
        before: its task where it was.
        after: the same task where it is now.
        reaches: tells which of some places (N, 3), metres, the arm gets to.

    Returns:
        The scenario, and what was left out of it as the arm does not get there, as the page names it.
    """
    to = Relocation.between(before, after)
    starts = [Start(to.point(start.place), start.label) for start in scenario.starts]
    layers = [replace(layer, transform=to.transform(layer.transform)) for layer in scenario.stack]
    view, slice_pose = scenario.view, scenario.view.slice
    if slice_pose is not None:
        view = replace(view, slice=replace(slice_pose, position=to.point(slice_pose.position)))

    def is_there(place: Point) -> bool:
        return place[2] > 0 and bool(reaches(np.array(place)))

    gone = [f"start {k}" for k, start in enumerate(starts, 1) if not is_there(start.place)]
    gone += [layer.name for layer in layers if not _stays(layer, is_there)]
    kept = tuple(start for start in starts if is_there(start.place))
    stack = tuple(layer for layer in layers if _stays(layer, is_there))
    rollout = scenario.arm_rollout if len(kept) == len(starts) else 0
    return replace(scenario, starts=kept, stack=stack, view=view, arm_rollout=rollout), tuple(gone)


def _stays(layer: Layer, is_there: Callable[[Point], bool]) -> bool:
    return not isinstance(layer.transform, Anchored) or is_there(layer.transform.position)


def changes_of_place(arm: str, before: Task, after: Task, gone: Sequence[str]) -> str:
    """Return what a visitor is told of `relocated`, for the arm of a title; empty where there is nothing to say."""
    said = []
    if after.name.startswith(OWN) and (after.scale, *after.origin) != (before.scale, *before.origin):
        said.append(
            f"“{after.title}” is moved to where the {arm} follows it, {after.scale / before.scale:.2g} × as large."
        )
    if gone:
        said.append(f"Out of reach of the {arm}, and left out: {', '.join(gone)}.")
    return " ".join(said)
