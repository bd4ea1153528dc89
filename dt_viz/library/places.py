"""Places as callers give them: (x, y) of motions in the plane, (x, y, z) of motions in space, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.transform import Anchored, Planar, Transform
from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Obstacle, Point

PLANE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""The plane of motions with two coordinates."""


def in_space(transform: Transform, dimension: int) -> Transform:
    """A transform for a motion of a dimension: its places have three coordinates, and it acts in the motion's plane.

    Raises:
        FormatError: a place has not as many coordinates as the motion, or one that is not finite.
    """
    changes: dict[str, Any] = {}
    if isinstance(transform, Anchored):
        changes["position"] = _point(transform, dimension)
    elif isinstance(transform, Avoidance):
        parts = transform.obstacles
        points = [_point(part, dimension) for part in parts]
        if points != [part.position for part in parts]:
            changes["obstacles"] = tuple(map(_moved, parts, points))
    if isinstance(transform, Planar) and dimension == 2:
        changes["plane"] = PLANE
    return replace(transform, **changes) if changes else transform


def _moved(obstacle: Obstacle, position: Point) -> Obstacle:
    return obstacle.moved(position, obstacle.wxyz)


def as_place(given: Any, dimension: int, field: str) -> tuple[float, ...]:  # noqa: ANN401 - whatever was given
    """Coordinates that were given, as many as a dimension. Raises FormatError where they are not that."""
    try:
        place = tuple(float(x) for x in given)
    except (TypeError, ValueError):
        place = ()
    if len(place) != dimension or not np.isfinite(place).all():
        accepted = "(x, y), metres: the motion is in the plane" if dimension == 2 else "(x, y, z), metres"
        raise FormatError(field, repr(given)[:80], accepted)
    return place


def as_places(places: Array, dimension: int, field: str) -> Array:
    """Places (N, d) that were given, of a dimension d. Raises FormatError where they are not that."""
    if places.ndim != 2 or places.shape[1] != dimension or not len(places):
        shape = "×".join(str(n) for n in places.shape)
        raise FormatError(field, f"{shape} numbers", f"places of {dimension} coordinates, metres")
    if not np.isfinite(places).all():
        raise FormatError(field, "a number that is not finite", "finite numbers, metres")
    return places


def _point(owner: Anchored | Obstacle, dimension: int) -> Point:
    """The position in space of a transform or an obstacle for a motion of a dimension."""
    position: Any = owner.position
    if dimension == 2 and isinstance(position, Sequence | np.ndarray) and len(position) == 3:
        dimension = 3  # a place before or behind the plane
    x, y, z = (*as_place(position, dimension, f"position of {type(owner).__name__}"), 0.0)[:3]
    return x, y, z
