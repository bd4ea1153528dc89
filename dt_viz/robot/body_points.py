"""Body points: spheres that cover the arm and reduce its distances to those of points (sec. 4.5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from dt_viz.flows.fields import Array, Mask
from dt_viz.kernels.arm import BODY_POINT
from dt_viz.kernels.blocks import clearance
from dt_viz.obstacles.arrays import records
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import NUM_JOINTS, KinematicChain, Robot
from dt_viz.shipped import ASSETS


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Spheres that move with the links and cover them: each triangle of a link's mesh lies in one of them."""

    joint: NDArray[np.int_]
    """(P,) index of each point's joint, not decreasing; −1 for the base, which never moves."""
    offset: Array
    """(P, 3) position in that joint's frame, metres; in the world for the base."""
    radius: Array
    """(P,) radii of the spheres, metres."""

    @property
    def on_moving_links(self) -> BodyPoints:
        """Points that joints can move away from an obstacle: not those of the base and of link 1, which only spins."""
        return self._where(self.joint >= 1)

    @property
    def on_pedestal(self) -> BodyPoints:
        """Points of the base and link 1, which no motion moves away from anything."""
        return self._where(self.joint < 1)

    def with_end_effector(self, robot: Robot, radius: float) -> BodyPoints:
        """The same and the robot's end effector, where the hand holds something, as a sphere of a radius, metres."""
        joint = np.append(self.joint, NUM_JOINTS - 1)
        offset = np.concatenate([self.offset, robot.end_effector_offset[None]])
        return BodyPoints(joint, offset, np.append(self.radius, radius))

    def _where(self, keep: Mask) -> BodyPoints:
        return BodyPoints(self.joint[keep], self.offset[keep], self.radius[keep])

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

    @cached_property
    def records(self) -> NDArray[np.void]:
        """(P,) the points for compiled loops; all are on joints."""
        points = np.zeros(len(self.joint), BODY_POINT)
        points["joint"], points["offset"], points["radius"] = self.joint, self.offset, self.radius
        return points

    def clearance(self, robot: Robot, q: Array, obstacle: Union | Obstacle) -> Array:
        """Compute distances (N,), metres, of the nearest sphere from an obstacle at configurations q (N, 6), rad."""
        shapes, values = records(obstacle.parts if isinstance(obstacle, Union) else (obstacle,))
        return clearance(robot.records, self.records, shapes, values, np.array(q, order="C"))

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
        return BodyPoints(data["joint"], data["offset"], data["radius"])
