"""Dodging: which velocities lead the arm past obstacles that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.control.obstacle_motion import Sighting
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.kernels.dodging import Forecast, LimitedArm, dodge
from dt_viz.obstacles.arrays import records


@dataclass(frozen=True)
class Dodge:
    """The way past obstacles that move, the arm's own acceleration foreseen.

    Each choice of velocities is foreseen for a short time: the joints turn to them as fast as they may and keep them,
    the obstacles go on as `ObstacleMotion` says. How near they come, in deviations of the obstacles from there, is the
    worth of a choice. Choosing anew in each tick, that is model predictive control with one move, by enumeration.
    """

    arm: WholeArm
    settings: ControllerSettings

    def chosen(
        self, q: Array, velocity: Array, wanted: Array, before: Array | None, seen: Sighting, late: float, floor: float
    ) -> Array | None:
        """Choose velocities (6,), rad/s; None where those that are wanted lead past all obstacles that move.

        Args:
            q: (6,) angles, rad.
            velocity: (6,) rad/s.
            wanted: (6,) rad/s.
            before: (6,) chosen in the tick before, rad/s; None is none.
            seen: the obstacles.
            late: time since they were seen, seconds.
            floor: distance from the table that is to be kept, metres.
        """
        settings, robot = self.settings, self.arm.robot
        speeds = np.linalg.norm(seen.velocities, axis=1)
        moving = np.flatnonzero(speeds > settings.slow)
        if seen.avoidance is None or not len(moving):
            return None
        shapes, values = records(tuple(seen.avoidance.obstacle.parts[k] for k in moving))
        times = np.linspace(0, settings.horizon, settings.num_ahead + 1)[1:]
        moved = np.stack([seen.motions[k].ahead(times + late, settings.returning) for k in moving], axis=1)
        deviation = settings.unsure + settings.doubt * times
        clear, velocities = dodge(
            LimitedArm(
                robot.records,
                self.arm.links.spheres,
                robot.lower,
                robot.upper,
                robot.velocity_limits,
                settings.acceleration,
            ),
            Forecast(
                shapes,
                values,
                times,
                moved,
                np.outer(deviation, speeds[moving]),
                settings.clearance,
                floor,
                settings.floor_depth,
            ),
            q,
            velocity,
            wanted,
            wanted if before is None else before,
            settings.staying,
        )
        return None if clear else velocities
