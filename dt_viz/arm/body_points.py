"""Body points: spheres that cover the arm, so that whole-arm distances are distances of points (sec. 4.5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dt_viz.arm.robot import NUM_JOINTS, KinematicChain, Robot
from dt_viz.flows.fields import Array
from dt_viz.properties import cached_property
from dt_viz.shipped import ASSETS


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Spheres that move with the links and together cover them: each triangle of a link's mesh lies in one of them."""

    joint: NDArray[np.int_]
    """(P,) index of the joint that each point moves with, not decreasing; −1 for the base, which never moves."""
    offset: Array
    """(P, 3) position in that joint's frame, metres; in the world for the base."""
    radius: Array
    """(P,) of the spheres, metres."""

    @property
    def on_moving_links(self) -> BodyPoints:
        """Those that joints can carry away from an obstacle: not the base, nor link 1, which only turns on the spot."""
        keep = self.joint >= 1
        return BodyPoints(self.joint[keep], self.offset[keep], self.radius[keep])

    @property
    def on_pedestal(self) -> BodyPoints:
        """Those of the base and link 1, which no motion carries away from anything."""
        keep = self.joint < 1
        return BodyPoints(self.joint[keep], self.offset[keep], self.radius[keep])

    def of_chain(self, chain: KinematicChain) -> Array:
        """Positions (P, 3, N), metres, of the points at N configurations."""
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
    def by_joint(self) -> list[tuple[int, slice]]:
        """Each joint index that has points, with the points that move with it."""
        bounds = np.searchsorted(self.joint, np.arange(-1, NUM_JOINTS + 1))
        return [(j, slice(a, b)) for j, a, b in zip(range(-1, NUM_JOINTS), bounds, bounds[1:], strict=False) if b > a]

    @cached_property
    def is_beyond(self) -> Array:
        """(6, P) 1 where a joint turns a point, else 0."""
        return (self.joint >= np.arange(NUM_JOINTS)[:, None]).astype(float)

    def positions(self, robot: Robot, q: Array) -> Array:
        """Positions (*B, P, 3), metres, at configurations q (*B, 6), rad."""
        at = self.of_chain(robot.chain(q.reshape(-1, NUM_JOINTS).T))
        return at.transpose(2, 0, 1).reshape(*q.shape[:-1], len(self.joint), 3)


@lru_cache(maxsize=1)
def load_body_points() -> BodyPoints:
    """The JACO's body points, made by ``python -m assets.make_body_points``."""
    with np.load(ASSETS / "body_points.npz", allow_pickle=False) as data:
        return BodyPoints(data["joint"], data["offset"], data["radius"])
