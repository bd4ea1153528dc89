"""Body points: spheres that cover the arm and reduce its distances to those of points (sec. 4.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.arm import BODY_POINT
from dt_viz.kernels.blocks import clearance
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle, records
from dt_viz.obstacles.union import Union
from dt_viz.robot.kinematics import KinematicChain, Kinematics

PROTRUSION = 5e-3
"""Largest distance by which the spheres that cover the JACO's links stick out of these, metres; 3 mm on average. Other
arms have covers of their own (`dt_viz.robot.cover`), 4 mm on average."""


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Points that move with the links, and spheres around them that hold all of the arm.

    In each of these spheres smaller ones cover the collision meshes and hardly stick out of them: what is measured from
    obstacles are these.
    """

    spheres: NDArray[np.void]
    """(N,) all spheres for compiled loops, see `dt_viz.kernels.arm.BODY_POINT`."""

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], prefix: str = "") -> BodyPoints:
        """Make them of arrays that have the names of the fields of `spheres`, behind a prefix."""
        spheres = np.zeros(len(arrays[f"{prefix}joint"]), BODY_POINT)
        for name in BODY_POINT.names or ():
            spheres[name] = arrays[f"{prefix}{name}"]
        return cls(spheres)

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

    def with_end_effector(self, robot: Kinematics) -> BodyPoints:
        """The same and the robot's end effector, a point that keeps clear, too, for what the hand holds."""
        hand = (robot.num_joints - 1, robot.end_effector_offset, 0.0, len(self.spheres) + 1)
        return BodyPoints(np.append(self.spheres, np.array(hand, BODY_POINT)))

    def of_joints(self, first: int, end: float = np.inf) -> BodyPoints:
        """Those of the joints before `end`, from the first one on; −1 is the base."""
        begin, stop = np.searchsorted(self.spheres["joint"], [first, end])
        spheres = self.spheres[begin:stop].copy()
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
        robot: Kinematics,
        q: Array,
        obstacle: Union | Obstacle,
        highest: ArrayLike = np.inf,
        lowest: ArrayLike = -np.inf,
    ) -> Array:
        """Compute distances (N,), metres, of the arm from an obstacle at configurations q (N, n), rad.

        They are too small by `PROTRUSION` at most, and cut off at `lowest` and `highest`, each (N,) or one for all.
        """
        shapes, values = records(obstacle.parts if isinstance(obstacle, Union) else (obstacle,))
        low, high = np.full(len(q), lowest, dtype=float), np.full(len(q), highest, dtype=float)
        return clearance(robot.records, self.spheres, shapes, values, np.array(q, order="C"), low, high)

    @cached_property
    def by_joint(self) -> list[tuple[int, slice]]:
        """Joints that have points, each with the slice of its points."""
        joints, begins = np.unique(self.joint, return_index=True)
        return [(int(j), slice(a, b)) for j, a, b in zip(joints, begins, [*begins[1:], len(self.joint)], strict=True)]

    def positions(self, robot: Kinematics, q: Array) -> Array:
        """Compute the positions (*B, P, 3), metres, at configurations q (*B, n), rad."""
        at = self.of_chain(robot.chain(q.reshape(-1, q.shape[-1]).T))
        return at.transpose(2, 0, 1).reshape(*q.shape[:-1], len(self.joint), 3)
