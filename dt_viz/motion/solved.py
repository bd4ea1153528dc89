"""What a scenario's motion is, once it is worked out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.arm.whole_arm import ArmSolution, Lift
from dt_viz.flows.fields import Array
from dt_viz.motion.nominal import Ground
from dt_viz.motion.solve import Solution
from dt_viz.scenario.scenario import Scenario


@dataclass(frozen=True)
class Solved:
    """A scenario's motion: the end effector's stack, and how the whole arm avoids on top of it."""

    scenario: Scenario
    """It, or one that moves like it."""
    ground: Ground
    """The undisturbed motion."""
    below: Ground
    """The same, warped as far as the stack is that is built on it."""
    stack: Solution
    """Of the end effector, before the whole arm avoids anything."""
    arm: ArmSolution | None
    """None where only the end effector avoids."""
    lifted: Lift | None
    """The joints along the stack's motion, which the arm's avoidance is made for; None where there is none."""

    @property
    def ends(self) -> Array:
        """(R + 1, 3) where the end effector's motions are to begin, and where all are to end, metres."""
        goal, built = self.ground.goal, self.stack.built
        moved = built[-1].made.goal - goal if built else np.zeros_like(goal)
        return np.concatenate([self.ground.starts, [goal + self.scenario.warp * moved]])
