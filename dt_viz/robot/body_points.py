"""Body points: spheres that cover the arm and reduce its distances to those of points (sec. 4.5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.arm import BODY_POINT
from dt_viz.kernels.blocks import clearance
from dt_viz.kernels.proximity import least_contacts
from dt_viz.obstacles.shapes import Obstacle, records
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import NUM_JOINTS, KinematicChain, Robot
from dt_viz.shipped import ASSETS

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

PROTRUSION = 5e-3
"""Largest distance by which the spheres that cover the links stick out of these, metres; 3 mm on average."""


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Points that move with the links, and spheres around them that hold all of the arm.

    In each of these spheres smaller ones cover the collision meshes and stick out by `PROTRUSION` at most, 3 mm on
    average: what is measured from obstacles are these.
    """

    spheres: NDArray[np.void]
    """(N,) all spheres for compiled loops, see `dt_viz.kernels.arm.BODY_POINT`."""

    @cached_property
    def indices(self) -> Indices:
        """(P,) indices of the points' own spheres, those that no other one holds."""
        ends = self.spheres["end"]
        return np.flatnonzero(np.arange(len(ends)) >= np.maximum.accumulate(np.r_[0, ends[:-1]]))

    @cached_property
    def outermost(self) -> BodyPoints:
        """The points with their own spheres alone."""
        points = self.spheres[self.indices]
        points["end"] = np.arange(len(points)) + 1
        return BodyPoints(points)

    @cached_property
    def joint(self) -> NDArray[np.int_]:
        """(P,) index of each point's joint, not decreasing; −1 for the base, which never moves."""
        return self.spheres["joint"][self.indices]

    @cached_property
    def offset(self) -> Array:
        """(P, 3) position in that joint's frame, metres; in the world for the base."""
        return self.spheres["offset"][self.indices]

    @cached_property
    def radius(self) -> Array:
        """(P,) radii of the spheres around the points, metres."""
        return self.spheres["radius"][self.indices]

    @cached_property
    def on_moving_links(self) -> BodyPoints:
        """Points that joints can move away from an obstacle: not those of the base and of link 1, which only spins."""
        return self.of_joints(1, NUM_JOINTS)

    @cached_property
    def on_pedestal(self) -> BodyPoints:
        """Points of the base and link 1, which no motion moves away from anything."""
        return self.of_joints(-1, 1)

    def with_end_effector(self, robot: Robot) -> BodyPoints:
        """The same and the robot's end effector, a point that keeps clear, too, for what the hand holds."""
        hand = (NUM_JOINTS - 1, robot.end_effector_offset, 0.0, len(self.spheres) + 1)
        return BodyPoints(np.append(self.spheres, np.array(hand, BODY_POINT)))

    def of_joints(self, first: int, end: int) -> BodyPoints:
        """Those of the joints before `end`, from the first one on."""
        begin, end = np.searchsorted(self.spheres["joint"], [first, end])
        spheres = self.spheres[begin:end].copy()
        spheres["end"] -= begin
        return BodyPoints(spheres)

    def of_chain(self, chain: KinematicChain) -> Array:
        """Compute the positions (P, 3, N), metres, of the points at N configurations."""
        num = chain.position.shape[1]
        positions = np.empty((len(self.joint), 3, num), dtype=chain.position.dtype)
        for joint, points in self.by_joint:
            offset = self.offset[points]
            if joint < 0:
                positions[points] = offset[:, :, None]
            else:
                turned = (offset @ chain.axes[joint].reshape(3, 3 * num)).reshape(len(offset), 3, num)
                positions[points] = turned + chain.origins[joint]
        return positions

    def clearance(
        self,
        robot: Robot,
        q: Array,
        obstacle: Union | Obstacle,
        highest: ArrayLike = np.inf,
        lowest: ArrayLike = -np.inf,
    ) -> Array:
        """Compute distances (N,), metres, of the arm from an obstacle at configurations q (N, 6), rad.

        They are too small by `PROTRUSION` at most, and cut off at `lowest` and `highest`, each (N,) or one for all.
        """
        shapes, values = records(obstacle.parts if isinstance(obstacle, Union) else (obstacle,))
        low, high = (np.array(np.broadcast_to(bound, len(q)), dtype=float) for bound in (lowest, highest))
        return clearance(robot.records, self.spheres, shapes, values, np.array(q, order="C"), low, high)

    def self_clearance(self, robot: Robot, q: Array, enough: float) -> float:
        """Compute the smallest distance, metres, of links that no joint connects at configurations q (N, 6), rad.

        It is too small by twice `PROTRUSION` at most, and at most `enough`.
        """
        a, b = np.nonzero(self.joint[:, None] + 1 < self.joint)
        pairs = self.indices[np.stack([a, b], axis=1)]
        return float(least_contacts(robot.records, self.spheres, pairs, np.array(q, order="C"), enough).min())

    @cached_property
    def by_joint(self) -> list[tuple[int, slice]]:
        """Joints that have points, each with the slice of its points."""
        bounds = np.searchsorted(self.joint, np.arange(-1, NUM_JOINTS + 1))
        return [(j, slice(a, b)) for j, a, b in zip(range(-1, NUM_JOINTS), bounds, bounds[1:], strict=False) if b > a]

    @cached_property
    def is_beyond(self) -> Array:
        """Matrix (6, P): 1 where a joint moves a point, else 0."""
        return (self.joint >= np.arange(NUM_JOINTS)[:, None]).astype(float)

    def positions(self, robot: Robot, q: Array) -> Array:
        """Compute the positions (*B, P, 3), metres, at configurations q (*B, 6), rad."""
        at = self.of_chain(robot.chain(q.reshape(-1, NUM_JOINTS).T))
        return at.transpose(2, 0, 1).reshape(*q.shape[:-1], len(self.joint), 3)


@lru_cache(maxsize=1)
def load_body_points() -> BodyPoints:
    """The JACO's body points, made by ``python -m assets.make_body_points``."""
    with np.load(ASSETS / "body_points.npz", allow_pickle=False) as data:
        spheres = np.zeros(len(data["joint"]), BODY_POINT)
        for name in BODY_POINT.names or ():
            spheres[name] = data[name]
    return BodyPoints(spheres)
