"""Velocities of the hand where the whole arm avoids: the field on the slice, carried along by the arm.

The joints that hold the hand at x are q = Q(x), and the whole arm's avoidance takes them to p = ψ_q⁻¹(q), whose hand is
at y(x). A motion x(t) below becomes y(x(t)), so the arrow ẋ at x becomes ẏ = Dy·ẋ at y, beside the slice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.arm_field import JointLimits
from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array, Mask
from dt_viz.obstacles.union import Union
from dt_viz.pictures.slice_fields import FieldPicture
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import Robot

STEP = 4e-3
"""Length of the steps that derivatives are taken from, metres at the hand."""
MAX_MISS = 1e-3
"""Distance by which the hand may miss a place that still has an arrow, metres."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Postures that hold the hand at the places where arrows begin: they depend on no motion, and on no obstacle."""

    reached: Mask
    """(M,) which of the places are within the arm's reach."""
    postures: Array
    """(N, n) Q at the reached ones, rad."""
    derivatives: Array
    """(N, n, 3) DQ there, rad/m."""

    @classmethod
    def of(cls, points: Array, robot: Robot, reference: Array) -> Lattice:
        """Find the postures.

        Args:
            points: (M, 3) places of the hand, metres.
            robot: the arm.
            reference: (n,) posture that it stays near to, rad.
        """
        paths = points[:, None] + np.concatenate([np.zeros((1, 3)), STEP * np.eye(3)])
        start = np.broadcast_to(reference, (len(paths), robot.num_joints))
        tracked = track(robot, paths, start, reference=start)
        reached = tracked.error.max(axis=1) <= MAX_MISS
        q = tracked.q[reached]
        return cls(reached, q[:, 0], np.moveaxis(q[:, 1:] - q[:, :1], 1, 2) / STEP)

    def carried(self, velocities: Array, transform: Diffeomorphism, robot: Robot, obstacle: Union) -> FieldPicture:
        """Carry arrows (M, 3), m/s, NaN where there is none, along by the whole arm's avoidance ψ_q.

        That was made for the motions, and may leave arrows far from them in the obstacle: these are left out.
        """
        limits, speed = JointLimits(robot.lower, robot.upper), np.linalg.norm(velocities[self.reached], axis=1)
        moving = speed > 0
        seconds, ahead = STEP / speed[moving], velocities[self.reached][moving]
        q = self.postures[moving]
        step = (self.derivatives[moving] @ (seconds[:, None] * ahead)[..., None])[..., 0]
        p = transform.inverse(limits.inside(np.concatenate([q, q + step])))
        begin, end = robot.end_effector(p).reshape(2, -1, 3)
        free = obstacle.signed_distance(begin) > 0
        return FieldPicture(begin[free], ((end - begin) / seconds[:, None])[free])
