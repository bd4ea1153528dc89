"""Sides: on which of them all motions of the end effector pass an obstacle that is dragged through them.

The flow that avoids an obstacle takes each motion out on the side of the obstacle's middle on which it is. So motions
would change sides one by one as the middle is dragged across them. While it is dragged, all keep the side on which they
have been: a flow along it first carries those that are beyond the middle back,

    ẏ = n exp(−‖y − c‖²/2σ²),

until all pass the middle c on the side n. Where they do so already it is the identity. The two legs of a bend around
the middle are left on their own sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erfi

from dt_viz.flows.fields import Array, GaussianGrid, GridRBF
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.ways import Way
from dt_viz.transforms.base import MotionBelow

ROOM = 0.1
"""Distance of all motions from an obstacle's middle on the side on which they pass it, in its radii."""
KEPT = 0.25
"""Distance of the motions beyond the middle up to which they keep their side, in the obstacle's radii."""
ALIKE = 0.5
"""Cosine of the angle between a side and the one on which motions are, up to which they turn to it."""
INNER, CORE = 0.6, 0.9
"""Distances from the middle, in the obstacle's radii, up to which motions are carried all the way to the side, and from
which on they are not carried at all."""
SPREAD = 0.7
"""σ, in the obstacle's radii."""
ENDS = (1.0, 2.0)
"""Distances of the nearest start or goal, in the obstacle's radii, from which on motions are carried a little, and all
the way: what is carried there would have to begin or end elsewhere."""
UPWARDS = 0.01
"""Distance beside the middle, metres, that outweighs passing above it, where motions turn to the opposite side."""
TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Passes:
    """Where motions pass the middle of an obstacle nearer than `CORE`."""

    obstacle: Obstacle
    offsets: Array
    """(K, 3) from the middle to the nearest point of each pass, metres."""
    tangent: Array
    """(3,) mean direction of the passes, a unit vector."""
    share: float = 1.0
    """Part of the way to the side that motions are carried."""

    @classmethod
    def of(cls, motion: MotionBelow, obstacle: Obstacle) -> Passes | None:
        """The only passes of the rollouts that have a demonstration; None where none comes so near just once."""
        motion = motion.demonstrated
        offset = motion.positions - np.asarray(obstacle.position)
        distance = np.linalg.norm(offset, axis=1)
        inside = np.flatnonzero(distance < CORE * obstacle.radius)
        if not len(inside):
            return None
        begins = np.flatnonzero(np.diff(inside, prepend=-2) + np.diff(motion.index[inside], prepend=-1) > 1)
        parts, rollouts = np.split(inside, begins[1:]), motion.index[inside[begins]]
        once = np.bincount(rollouts)[rollouts] == 1
        nearest = np.array([part[distance[part].argmin()] for part, only in zip(parts, once, strict=True) if only])
        if not len(nearest):
            return None
        is_last = np.diff(motion.index, append=-1) != 0
        after = np.where(is_last[nearest], nearest, nearest + 1)
        tangents = offset[after] - offset[after - 1]
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), TINY)
        offsets = offset[nearest]
        offsets = offsets - (offsets * tangents).sum(axis=1, keepdims=True) * tangents
        ends = np.concatenate([motion.starts, motion.goal[None]]) - np.asarray(obstacle.position)
        nearest_end = np.linalg.norm(ends, axis=1).min() / obstacle.radius
        share = float(np.interp(nearest_end, ENDS, (0, 1)))
        return cls(obstacle, offsets, np.linalg.svd(tangents)[2][0], share)

    @property
    def mean(self) -> Array:
        """(3,) mean offset, metres; the nearer ones count more."""
        core = CORE * self.obstacle.radius
        weights = np.maximum(1 - (self.offsets**2).sum(axis=1) / core**2, TINY)
        return weights @ self.offsets / weights.sum()

    def way(self, before: Way | None, *, gradually: bool) -> Way:
        """The way out on the side on which the motions are, or on which they were before while they are near to it.

        Args:
            before: the way out of the obstacle where it was just before; None where there was none.
            gradually: whether it turns there as the obstacle moves on; else it is there at once.
        """
        mean = self.mean
        nearest = self._across(mean)
        if before is None:
            return Way(self.obstacle, nearest, nearest)
        kept = self._across(before.side)
        settled = float((self.offsets @ nearest).min()) >= ROOM * self.obstacle.radius
        gone = -mean @ kept > KEPT * self.obstacle.radius
        side = nearest if gone or (settled and nearest @ kept > ALIKE) else kept
        way = Way(self.obstacle, side, side, kept=True)
        if not gradually:
            return way
        over = np.cross(self.tangent, before.direction)
        return way.turned_from(before, [self._across(over if mean @ over + UPWARDS * over[2] > 0 else -over)])

    def duration(self, direction: Array) -> float:
        """Time, metres, for which the flow along a unit vector (3,) runs until all passes are on that side."""
        radius, sigma = self.obstacle.radius, SPREAD * self.obstacle.radius
        along = self.offsets @ direction
        squared = (self.offsets**2).sum(axis=1)
        aside = np.exp((squared - along**2) / (2 * sigma**2))
        to_side = erfi(ROOM * radius / (np.sqrt(2) * sigma)) - erfi(along / (np.sqrt(2) * sigma))
        carried = np.interp(np.sqrt(squared) / radius, (INNER, CORE), (1, 0))
        return self.share * float((sigma * np.sqrt(np.pi / 2) * aside * to_side * carried).max(initial=0.0))

    def field(self, direction: Array) -> GridRBF:
        """The generator of that flow, (N, 3) of no unit; it is against the direction: motions follow the reverse."""
        position = np.asarray(self.obstacle.position)
        grid = GaussianGrid(tuple(np.array([c]) for c in position), 0.5 / (SPREAD * self.obstacle.radius) ** 2)
        return GridRBF(grid, -direction[None])

    def _across(self, direction: Array) -> Array:
        """A direction (3,) without what is along the passes, a unit vector."""
        across = direction - (direction @ self.tangent) * self.tangent
        size = float(np.linalg.norm(across))
        if size > TINY:
            return across / size
        least = np.eye(3)[np.abs(self.tangent).argmin()]
        return self._across(least)
