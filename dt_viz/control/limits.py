"""Distances that a tick keeps, as rows of slopes and bounds: with bounds of velocities the feasible set of a tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.control.obstacle_motion import Sighting
from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.limits import STEADIEST, barrier
from dt_viz.kernels.proximity import contacts, least_contacts, proximity
from dt_viz.obstacles.shapes import records
from dt_viz.robot.robot import Robot

JOINTS_BETWEEN = 3
"""Number of joints between two parts of the arm from which on they can touch: fewer do not fold them that far."""


@dataclass(frozen=True)
class ObstacleLimit:
    """No part of the arm comes nearer to an obstacle than it can stop: a control barrier for each body point.

    With h the distance of what its sphere holds beyond the clearance, ḣ ≥ −γh (Ames et al., "Control Barrier Functions:
    Theory and Applications", 2019), where ḣ counts the obstacle's own velocity: what approaches moves a robot at rest,
    too.
    """

    arm: WholeArm
    clearance: float
    """Distance that is kept, metres."""
    gain: float
    """γ, 1/s."""
    reach: float
    """Distance from which on a body point has a barrier, metres."""

    def rows(self, q: Array, seen: Sighting, dt: float) -> tuple[Array, Array, float]:
        """Slopes s (K, n) and bounds b (K,) with s·q̇ ≥ b at q (n,), and the distance from the nearest obstacle."""
        if seen.avoidance is None or not seen.avoidance.avoided.parts:
            return np.empty((0, len(q))), np.empty(0), np.inf
        shapes, values = records(seen.avoidance.avoided.parts)
        robot, links = self.arm.robot, self.arm.robot.links
        part, distance, slopes, outward = proximity(robot.records, links.spheres, shapes, values, q, self.reach)
        if not len(distance):
            return slopes, distance, np.inf
        h = distance - min(self.clearance, seen.avoidance.margin / 2)
        near, bounds = barrier(h, slopes, self.gain, dt)
        approach = (outward[near] * seen.velocities[part[near]]).sum(axis=1)
        return slopes[near], approach + bounds, float(distance.min())


@dataclass(frozen=True, eq=False)
class ContactLimit:
    """The arm touches neither the table nor itself: a control barrier for pairs of body points, as of obstacles.

    No pair needs to be farther apart than in the undisturbed motion, which may slide along the table.
    """

    name: str
    """What is not touched."""
    robot: Robot
    pairs: Indices
    """(M, 2) as in `dt_viz.kernels.proximity.contacts`."""
    clearance: float
    """Distance that is kept, metres."""
    gain: float
    """γ, 1/s."""

    @classmethod
    def table(cls, robot: Robot, clearance: float, gain: float) -> ContactLimit:
        """Limit of the links above the table z = 0."""
        links = robot.body.indices[robot.body.joint >= robot.num_fixed]
        return cls("the table", robot, np.stack([np.full(len(links), -1), links], axis=1), clearance, gain)

    @classmethod
    def itself(cls, robot: Robot, clearance: float, gain: float) -> ContactLimit:
        """Limit of the links' distances from each other and the base."""
        return cls("itself", robot, robot.pairs(JOINTS_BETWEEN), clearance, gain)

    def kept(self, q: Array) -> Array:
        """Distances (M,) to keep in a motion whose undisturbed postures are q (N, n), metres."""
        spheres, postures = self.robot.body.spheres, np.array(q, order="C")
        return least_contacts(self.robot.records, spheres, self.pairs, postures, self.clearance)

    def rows(self, q: Array, kept: Array, dt: float) -> tuple[Array, Array]:
        """Slopes s (K, n) and bounds b (K,) with s·q̇ ≥ b at q (n,) where distances (M,) are kept."""
        reach = self.clearance + self.robot.top_speed / min(self.gain, STEADIEST / dt)
        which, apart, slopes = contacts(self.robot.records, self.robot.body.spheres, self.pairs, q, reach)
        near, bounds = barrier(apart - kept[which], slopes, self.gain, dt)
        return slopes[near], bounds
