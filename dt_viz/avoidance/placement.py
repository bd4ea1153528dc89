"""The place at which a new bias point is added on the page."""

from __future__ import annotations

import numpy as np

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.page import Surroundings
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import as_point

PLACED_BESIDE = 0.08
"""Distance of a new bias point from the mean path, metres."""
APART = 0.25
"""Wanted distance of a new bias point from the others, metres: about the size of a region."""
ROOM, LEAST_ROOM = 0.11, 0.04
"""Distances of a new bias point from obstacles, metres: beyond what is displaced by them, and where that is nowhere."""
PLACES = (0.50, 0.30, 0.70, 0.20, 0.80, 0.40, 0.60)
"""Places along the mean path, as fractions of its length, beside which new bias points are placed."""


def bias_beside(surroundings: Surroundings) -> BiasPoint:
    """Make a bias point beside the mean demonstration, in the middle or where other places and obstacles leave room."""
    mean, plane = surroundings.mean_path, surroundings.plane
    normal = np.array([0.0, 0.0, 1.0]) if plane is None else np.cross(*plane)
    places = []
    for u in PLACES:
        k = round((len(mean) - 1) * u)
        tangent = mean[k + 5] - mean[k - 5]
        across = np.cross(tangent, normal)
        if np.linalg.norm(across) < 0.1 * np.linalg.norm(tangent):  # straight up or down
            across = np.array([1.0, 0.0, 0.0])
        sides = [mean[k] + sign * PLACED_BESIDE * across / np.linalg.norm(across) for sign in (-1, 1)]
        # first the side that is farther from the rest of the motion
        places += sorted(sides, key=lambda place: -np.linalg.norm(mean - place, axis=1).min())
    # off other strokes
    free = [place for place in places if np.linalg.norm(mean - place, axis=1).min() > PLACED_BESIDE / 2]
    # two whose regions overlap pull against each other: first where no other one is near, then as far as there is
    taken = np.asarray(surroundings.anchors).reshape(-1, 3)

    def apart(place: Array) -> float:
        return float(np.linalg.norm(place - taken, axis=1).min(initial=np.inf))

    room = free
    for least in (ROOM, LEAST_ROOM):  # where obstacles leave room
        room = [place for place in free if surroundings.obstacle.signed_distance(place) > least]
        far = [place for place in room if apart(place) > APART]
        if far:
            return BiasPoint(as_point(far[0]), plane=plane)
    return BiasPoint(as_point(max(room or free or places, key=apart)), plane=plane)
