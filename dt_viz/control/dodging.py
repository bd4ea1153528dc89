"""Dodging: which velocities lead the arm past obstacles that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.arm.whole_arm import OVERSHOOT, WholeArm
from dt_viz.control.obstacle_motion import Sighting
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.kernels.dodging import dodge
from dt_viz.obstacles.arrays import records
from dt_viz.obstacles.shapes import Box

TABLE = Box((0.0, 0.0, -1.0), (10.0, 10.0, 2.0))
"""What is below the table's top."""
TABLE_DEPTH = 0.02
"""Depth in it that counts as much as one deviation of an obstacle, metres."""


@dataclass(frozen=True)
class Dodge:
    """The way past obstacles that move, the arm's own acceleration foreseen.

    Each choice of velocities is foreseen for a short time: the joints turn to them as fast as they may and keep them,
    the obstacles go on as they move. How near they come, less what is needed, is the worth of a choice; what is needed
    grows with the time ahead and with an obstacle's speed, as nobody knows whether it goes on straight. Choosing anew
    in each tick, that is model predictive control with one move, by enumeration.
    """

    arm: WholeArm
    settings: ControllerSettings

    def chosen(
        self, q: Array, velocity: Array, wanted: Array, before: Array | None, seen: Sighting, lowest: float
    ) -> Array | None:
        """Choose velocities (6,), rad/s; None where those that are wanted lead past all obstacles that move.

        Args:
            q: (6,) angles, rad.
            velocity: (6,) rad/s.
            wanted: (6,) rad/s.
            before: (6,) chosen in the tick before, rad/s; None is none.
            seen: the obstacles where they are now.
            lowest: distance from the table that is to be kept, metres.
        """
        settings, robot = self.settings, self.arm.robot
        speeds = np.linalg.norm(seen.velocities, axis=1)
        moving = np.flatnonzero(speeds > settings.slow)
        if seen.avoidance is None or not len(moving):
            return None
        shapes, values = records((*(seen.avoidance.obstacle.parts[k] for k in moving), TABLE))
        motion = np.zeros((len(moving) + 1, 6))
        motion[:, 3] = settings.clearance - OVERSHOOT
        motion[:-1, :3], motion[:-1, 5] = seen.velocities[moving], settings.doubt * speeds[moving]
        motion[:-1, 4] = settings.unsure * speeds[moving]
        motion[-1, 3:5] = lowest - OVERSHOOT - TABLE_DEPTH, TABLE_DEPTH
        clear, velocities = dodge(
            robot.records,
            self.arm.links.records,
            shapes,
            values,
            motion,
            q,
            velocity,
            wanted,
            wanted if before is None else before,
            np.stack([robot.lower, robot.upper, robot.velocity_limits]),
            settings.acceleration,
            np.linspace(0, settings.horizon, settings.num_ahead + 1)[1:],
            settings.staying,
        )
        return None if clear else velocities
