"""Places as callers give them: (x, y) of motions in the plane, (x, y, z) of motions in space, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.transform import Anchored, Planar, Transform
from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Bundle, Rays
from dt_viz.flows.rotations import turning
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.demonstrations import checked_orientations
from dt_viz.obstacles.shapes import Obstacle, Point

PLANE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # the plane of motions with two coordinates


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


NOT_LEARNED = "none: no orientations were learned"


def along(
    poses: AugmentedImitation | None, rays: Rays, bundle: Bundle, begin: ArrayLike | None
) -> tuple[Array, ...] | tuple[None, ...]:
    """Orientations (T_i, 4), wxyz, of each of a bundle of motions; None where none were learned.

    They begin with those that are given, (R, 4), or (4,) for all; None begins as they were learned.

    Raises:
        FormatError: `begin` is no orientations, or none were learned.
    """
    if poses is None:
        if begin is not None:
            raise FormatError("orientations", "some", NOT_LEARNED)
        return (None,) * len(rays.z0)
    system, rest = poses.system, rays.z0[:, 3:]
    states = np.hstack([np.zeros((len(rest), poses.dim)), rest])  # on the motions that were learned
    if begin is not None:
        given = np.asarray(begin)
        given = checked_orientations(np.tile(given, (len(rest), 1)) if given.ndim == 1 else given, len(rest))
        start = system.transform.inverse(states)
        start[:, 3:6] = poses.turns(given, start[:, 3:6])
        states = system.transform.forward(start)
    z = system.base.at_fraction(states[bundle.index], (1 - bundle.fraction)[:, None])[:, 0]
    return bundle.split(poses.orientations(system.transform.inverse(z)[:, 3:6]))


def angular_velocity(poses: AugmentedImitation | None, rest: Array, orientation: ArrayLike, dt: float) -> Array:
    """ω (3,), rad/s, in the base frame, that takes a hand, of which the orientation (4,) is given, on with its motion.

    That is to the orientation `dt` seconds later than at a phase and for a condition, `rest` (1 + c,).

    Raises:
        FormatError: the orientation is none, or none were learned.
    """
    if poses is None:
        raise FormatError("orientation", "one", NOT_LEARNED)
    now, system = checked_orientations(np.asarray(orientation)[None], 1), poses.system
    learned = system.transform.inverse(np.concatenate([np.zeros(poses.dim), rest]))
    state = np.concatenate([learned[:3], poses.turns(now, learned[None, 3:6])[0], rest])
    reached = poses.orientations(system.rollout(state, np.array([dt]))[0, 3:6])
    return turning(now[0], reached) / dt
