"""The kinds of transforms that can be stacked on the imitation, and what the page offers of each, in this order."""

from __future__ import annotations

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.bias import MAX_DURATION, BiasPoint
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.page import Choice, FlowIntegration, Number, PageEntry, Switch
from dt_viz.avoidance.placement import bias_beside
from dt_viz.avoidance.transform import Transform

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
