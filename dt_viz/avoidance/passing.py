"""Detours of motions, and reference posture of the arm: kept from one scenario to the next in a drag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dt_viz.avoidance.avoidance import StartStatus
from dt_viz.avoidance.detour import Detour, carried_over
from dt_viz.obstacles.shapes import Obstacle

Posture = tuple[float, ...]
"""Posture that the arm stays near to along all rollouts: joint angles, rad."""


@dataclass(frozen=True, eq=False)
class Passing:
    """Detours and reference posture of a motion, which the next one keeps while an obstacle is dragged."""

    hand: Mapping[int, tuple[Detour | None, ...]] = field(default_factory=dict)
    """Detours of the end effector around the obstacles of each layer, by its place in the stack."""
    arm: tuple[Detour | None, ...] = ()  # those of the whole arm
    duration: float = 0.0  # t of the flow by which the whole arm avoids
    cleared: bool = True  # whether that flow clears the obstacles
    posture: Posture | None = None  # reference posture of the arm; None is its usual one
    status: tuple[StartStatus, ...] = ()  # status of each start, in the order of the scenario

    def goes_on(self, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether an obstacle that the whole arm passed is still there, or nearby."""
        return any(carried_over(self.arm, obstacles))

    def follows(self, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether such an obstacle has moved a little."""
        return any(detour is not None and detour.travelled for detour in carried_over(self.arm, obstacles))


ANEW = Passing()  # nothing to keep: detours and reference posture are chosen anew
