"""Places as callers give them: (x, y) of motions in the plane, (x, y, z) of motions in space, metres."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.transform import Anchored, Planar, Transform
from dt_viz.errors import FormatError
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
        changes["position"] = _point(transform, transform.position, dimension)
    elif isinstance(transform, Avoidance):
        parts = transform.obstacles
        points = [_point(part, part.position, dimension) for part in parts]
        if points != [part.position for part in parts]:
            changes["obstacles"] = tuple(map(_moved, parts, points))
    if isinstance(transform, Planar) and dimension == 2:
        changes["plane"] = PLANE
    return replace(transform, **changes) if changes else transform


def _moved(obstacle: Obstacle, position: Point) -> Obstacle:
    return obstacle.moved(position, obstacle.wxyz)


def _point(owner: Transform | Obstacle, position: object, dimension: int) -> Point:
    try:
        given = tuple(float(x) for x in position)  # pyright: ignore[reportGeneralTypeIssues]
    except (TypeError, ValueError):
        given = ()
    if len(given) not in (dimension, 3) or not np.isfinite(given).all():
        accepted = "(x, y), metres: the motion is in the plane" if dimension == 2 else "(x, y, z), metres"
        raise FormatError(f"position of {type(owner).__name__}", repr(position)[:80], accepted)
    x, y, z = (*given, 0.0)[:3]
    return x, y, z
