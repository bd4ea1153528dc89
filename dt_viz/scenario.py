"""Every choice of the user, as one frozen value."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from dt_viz.obstacles import Sphere
from dt_viz.occupancy import Generator

MIN_DIAMETER, MAX_DIAMETER = 0.04, 0.30
"""Metres."""
MAX_MARGIN = 0.05
"""Metres."""
MIN_TEMPERATURE, MAX_TEMPERATURE = 1.0, 20.0
MAX_MANUAL_DURATION = 2.0


@dataclass(frozen=True)
class View:
    """How a result is looked at; changing it computes nothing anew."""

    demonstrations: bool = True
    rollouts: bool = True
    ghost: bool = True
    """The undeformed rollouts."""
    field: bool = True
    """Arrows of the vector field on a slice."""
    arm: bool = True
    table: bool = True
    playing: bool = True
    """Whether the arm moves along its rollout."""
    speed: float = 1.0
    """Of the playback, times real time."""


@dataclass(frozen=True)
class Scenario:
    """All that a picture depends on: the same scenario always gives the same frame."""

    task: str
    obstacle: Sphere
    imitation: bool = True
    """Whether the learned transform is in the stack; without it motions are straight."""
    avoidance: bool = True
    """Whether the obstacle's transform is in the stack."""
    generator: Generator = "free-space"
    temperature: float = 6.0
    """T of the occupancy potential: higher reaches farther and bends more gently."""
    margin: float = 0.01
    """Clearance that `auto` keeps, metres."""
    duration: float | None = None
    """t of the avoidance flow; None is `auto`, the shortest that clears the obstacle by the margin."""
    arm_rollout: int = 0
    """Which rollout the arm follows."""
    view: View = field(default_factory=View)

    def moves_like(self, other: Scenario) -> bool:
        """Whether both give the same motion, however it is looked at."""
        return replace(self, view=other.view) == other
