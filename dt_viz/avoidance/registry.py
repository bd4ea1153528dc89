"""The kinds of transforms that can be stacked on the imitation, and what the page offers of each, in this order."""

from __future__ import annotations

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.bias import MAX_DURATION, BiasPoint
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.page import Choice, FlowIntegration, Number, PageEntry, Surroundings, Switch
from dt_viz.avoidance.transform import Transform
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import as_point

PLACED_BESIDE = 0.08  # distance of a new bias point from the mean path, metres
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


AVOIDANCE = PageEntry(
    "Avoidance",
    "leads motions around the obstacles",
    (
        Choice(
            "generator",
            "Generator",
            {"free-space": "Free space (−∇log(1−p))", "probability": "Probability (∇p, the paper's)"},
            "the vector field whose flow avoids",
        ),
        Number(
            "temperature",
            "Temperature",
            "T",
            low=1.0,
            high=20.0,
            step=0.5,
            initial=6.0,
            hint="the higher, the more gently motions bend, and from farther away",
        ),
        Number(
            "duration",
            "Flow time",
            "t",
            low=0.0,
            high=2.0,
            step=0.01,
            initial=0.5,
            automatic=True,
            of_flow=True,
            hint="auto: the shortest flow that clears the obstacles by the margin",
        ),
        FlowIntegration(),
    ),
    most=1,
)
BIAS = PageEntry(
    "Bias",
    "a point that every motion passes, or ends at",
    (
        Number(
            "radius",
            "Radius",
            "[cm]",
            low=4.0,
            high=40.0,
            step=0.5,
            initial=15.0,
            scale=100.0,
            automatic=True,
            hint="radius of the region in which it acts; auto: from the distance of the motion",
        ),
        Switch("moves_goal", "Moves the goal", "motions end here instead of at the goal"),
        Number("strength", "Strength", "t", 0.0, MAX_DURATION, 0.01, 0.5, automatic=True, of_flow=True),
        FlowIntegration(),
    ),
    flow_time="strength",
    added=bias_beside,
)
KINDS: dict[type[Transform], PageEntry] = {HandAvoidance: AVOIDANCE, ArmAvoidance: AVOIDANCE, BiasPoint: BIAS}
"""All kinds of transforms. A new one is an entry here."""


def entry_of(transform: Transform) -> PageEntry:
    """Return the entry of a transform's kind; of one that is not registered, an entry with its class's name."""
    return KINDS.get(type(transform)) or PageEntry(type(transform).__name__)
