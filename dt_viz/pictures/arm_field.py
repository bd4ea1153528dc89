"""Velocities of the hand where the whole arm avoids: the field on the slice, carried along by the arm.

The joints that hold the hand at x are q = Q(x), and the whole arm's avoidance takes them to p = ψ_q⁻¹(q), whose hand is
at y(x). A motion x(t) below becomes y(x(t)), so the arrow ẋ at x becomes ẏ = Dy·ẋ at y, beside the slice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dt_viz.arm.cspace import JointLimits
from dt_viz.arm.robot import NUM_JOINTS, Robot
from dt_viz.arm.tracking import track
from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array
from dt_viz.obstacles.union import Union
from dt_viz.pictures.slice_fields import FieldPicture

STEP = 4e-3
"""Length of the step along an arrow that its derivative is taken from, metres."""
MAX_MISS = 1e-3
"""Distance by which the hand may miss a place that still has an arrow, metres."""


@dataclass(frozen=True, eq=False)
class LiftedField:
    """A field of the hand, and the joints that follow its arrows; it does not depend on what the arm avoids."""

    postures: Array
    """(N, 2, 6) with the hand at the beginning of each arrow, and a step along it, rad."""
    seconds: Array
    """(N,) durations of these steps."""

    @classmethod
    def of(cls, field: FieldPicture, robot: Robot, reference: Array) -> LiftedField:
        """Follow the arrows that are within the arm's reach.

        Args:
            field: the field of the motion below the arm's avoidance.
            robot: the arm.
            reference: (6,) posture that it stays near to, rad.
        """
        speed = np.linalg.norm(field.velocities, axis=1)
        moving = speed > 0
        points, velocities, seconds = field.points[moving], field.velocities[moving], STEP / speed[moving]
        paths = np.stack([points, points + seconds[:, None] * velocities], axis=1)
        standing = _standing(robot, points.tobytes(), reference.tobytes())
        tracked = track(robot, paths, standing, np.repeat(standing[:, None], 2, axis=1), reference)
        reached = tracked.error.max(axis=1) <= MAX_MISS
        return cls(tracked.q[reached], seconds[reached])

    def around(self, transform: Diffeomorphism, robot: Robot, obstacle: Union) -> FieldPicture:
        """Carry the arrows along by the whole arm's avoidance.

        Args:
            transform: ψ_q.
            robot: the arm.
            obstacle: what is avoided: ψ_q was made for the motions, and may leave arrows far from them in it.
        """
        limits = JointLimits(robot.lower, robot.upper)
        p = transform.inverse(limits.inside(self.postures.reshape(-1, NUM_JOINTS)))
        begin, end = np.moveaxis(robot.end_effector(p).reshape(-1, 2, 3), 1, 0)
        free = obstacle.signed_distance(begin) > 0
        return FieldPicture(begin[free], ((end - begin) / self.seconds[:, None])[free])


@lru_cache(maxsize=8)
def _standing(robot: Robot, places: bytes, reference: bytes) -> Array:
    """Postures (N, 6), rad, with the hand at places (N, 3), metres: a drag of what bends motions leaves the lattice."""
    paths = np.frombuffer(places).reshape(-1, 1, 3)
    start = np.broadcast_to(np.frombuffer(reference), (len(paths), NUM_JOINTS))
    return track(robot, paths, start, reference=start).q[:, 0]
