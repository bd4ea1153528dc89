"""Starts of added motions: places on the slice, one by one or in a grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dt_viz.flows.fields import Array, Mask
from dt_viz.obstacles.shapes import as_point
from dt_viz.scenario.scenario import MAX_STARTS, Scenario, Start
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task

INNER = 0.8  # part of the slice that a grid covers
APART = 0.02  # smallest distance between starts, metres


@dataclass(frozen=True)
class Grid:
    """A grid of starts, and the numbers of places left out."""

    starts: tuple[Start, ...]  # starts of the scenario, the new ones last
    num_blocked: int = 0
    """Number of places at or inside an obstacle, or where the arm that avoids it would touch it."""
    num_far: int = 0
    """Number of places that the hand cannot reach, or less than 2 cm above the table."""


def struck(area: Slice, origin: Array, direction: Array) -> Array | None:
    """Return the place (3,), metres, where a ray meets the slice; None if it misses the rectangle.

    Args:
        area: the slice.
        origin: (3,) origin of the ray, metres.
        direction: (3,) direction of the ray.
    """
    slope = float(direction @ area.normal)
    if abs(slope) < 1e-9:
        return None
    along = float((area.centre - origin) @ area.normal) / slope
    place = origin + along * direction
    return place if along > 0 and (np.abs(area.across(place)) <= area.half_size).all() else None


def with_start(scenario: Scenario, place: Array) -> tuple[Start, ...]:
    """Return the scenario's starts with one more at `place` (3,), metres, if there is room for it."""
    taken = any(np.linalg.norm(place - np.array(start.place)) < APART for start in scenario.starts)
    if taken or len(scenario.starts) >= MAX_STARTS:
        return scenario.starts
    return (*scenario.starts, Start(as_point(place), scenario.view.start_label))


def with_moved_start(scenario: Scenario, index: int, place: Array) -> tuple[Start, ...]:
    """Return the scenario's starts with one of them moved to `place` (3,), metres; unchanged if it was removed."""
    return _changed(scenario, index, place=as_point(place))


def with_grid(
    scenario: Scenario, area: Slice, arm_room: Callable[[Array], Array], reached: Callable[[Array], Mask]
) -> Grid:
    """Return the scenario's starts with a grid over the slice, without places where no motion can begin.

    Args:
        scenario: scenario with obstacles and starts.
        area: the slice.
        arm_room: distance (N,) of the arm from the obstacles with its hand at places (N, 3), metres; asked where the
            whole arm avoids them.
        reached: which (N,) of such places are within the arm's reach.
    """
    u, v = (np.linspace(-INNER * half, INNER * half, num) for half, num in zip(area.half_size, (4, 4), strict=True))
    places = area.at(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2))
    rooms = scenario.obstacle.signed_distance(places)
    if scenario.arm_avoidance is not None:
        rooms = np.minimum(rooms, arm_room(places))
    blocked = rooms < scenario.avoidance.margin
    far = ~blocked & ((places[:, 2] < 0.02) | (~reached(places)))
    for place in places[~blocked & ~far]:
        scenario = replace(scenario, starts=with_start(scenario, place))
    return Grid(scenario.starts, int(blocked.sum()), int(far.sum()))


def followed(scenario: Scenario, task: Task) -> int:
    """Return the place of the start whose rollout the arm follows, counted round: the same when starts are added."""
    return scenario.arm_rollout % (len(task.starts) + len(scenario.starts))


def with_label(scenario: Scenario, task: Task, label: float | None) -> tuple[Start, ...]:
    """Return the scenario's starts with a label on the one that the arm follows; unchanged if that is demonstrated."""
    return _changed(scenario, followed(scenario, task) - len(task.starts), label=label)


def label_of(scenario: Scenario, task: Task) -> float | None:
    """Return the label of the added start that the arm follows, or else that of new starts."""
    index = followed(scenario, task) - len(task.starts)
    return scenario.starts[index].label if index >= 0 else scenario.view.start_label


def _changed(scenario: Scenario, index: int, **changes: Any) -> tuple[Start, ...]:  # noqa: ANN401 - the fields of Start
    return tuple(replace(start, **changes) if k == index else start for k, start in enumerate(scenario.starts))
