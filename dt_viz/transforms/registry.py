"""The kinds of transforms that can be stacked on the imitation: what the page offers, in this order."""

from __future__ import annotations

from dt_viz.transforms.avoidance import Avoidance
from dt_viz.transforms.base import Transform
from dt_viz.transforms.bias import BiasPoint

KINDS: tuple[type[Transform], ...] = (
    Avoidance,
    BiasPoint,
)
"""All kinds of transforms. A new one is a line here."""
