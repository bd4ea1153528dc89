"""On which side motions pass obstacles, and in which stance the arm does: chosen once, kept by scenarios that go on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.ways import Way, remembered, travel

Stance = tuple[float, float, float, float, float, float]
"""Posture that the arm stays near to along all rollouts: six joint angles, rad."""


@dataclass(frozen=True, eq=False)
class Passing:
    """How a scenario's motions pass its obstacles, for the next one to go on with while an obstacle is dragged."""

    hand: Mapping[int, tuple[Way | None, ...]] = field(default_factory=dict)
    """Ways of the end effector out of the obstacles of each layer, by its place in the stack."""
    arm: tuple[Way | None, ...] = ()
    """Ways of the whole arm out of the obstacles."""
    duration: float = 0.0
    """t of the flow by which the whole arm avoids."""
    cleared: bool = True
    """Whether the whole arm finds a way by it."""
    stance: Stance | None = None
    """Stance of the arm; None is its usual one."""
    left_out: tuple[int, ...] = ()
    """Numbers of the starts that have no motion."""

    def goes_on(self, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether the whole arm was passing an obstacle that is hardly anywhere else now."""
        return any(remembered(self.arm, obstacles))

    def follows(self, obstacles: Sequence[Obstacle]) -> bool:
        """Return whether such an obstacle has moved since."""
        known = zip(remembered(self.arm, obstacles), obstacles, strict=True)
        return any(way is not None and travel(way.obstacle, part) > 0 for way, part in known)


ANEW = Passing()
"""Passing of a scenario that goes on from none: sides and stances are chosen anew."""
