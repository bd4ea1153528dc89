"""The kinds of transforms that can be stacked on the imitation: what the page offers, in this order."""

from __future__ import annotations

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.transform import Transform

KINDS: tuple[type[Transform], ...] = (
    HandAvoidance,
    ArmAvoidance,
    BiasPoint,
)
"""All kinds of transforms. A new one is a line here."""
