"""Sides: on which of them all motions of the end effector pass an obstacle.

The flow out of an occupied region takes each sample out where it is nearest: a motion through the middle is pushed back
along its own way and then turns sharply, and its neighbours leave on other sides. So all motions together are carried
to one side n before, as far as they need to be clear, by a flow along it,

    ẏ = n g exp(−½ ‖A(y − c)‖²) Π_e (1 − exp(−‖y − e‖²/2ρ_e²)),

which is broad along the motions and leaves their free starts and goal e where they are. The side is the one with the
least detour; while an obstacle is dragged, it is kept until another one costs much less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.transform import Aside, MotionBelow
from dt_viz.avoidance.ways import Way
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Diffeomorphism
from dt_viz.flows.fields import Array, Mask, PointField
from dt_viz.kernels.fields import ASIDE, TERM, Terms
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.surfaces import golden_spiral
from dt_viz.obstacles.union import Union

NUM_DIRECTIONS, MAX_SAMPLES = 128, 96
"""Number of sides that are compared, and largest number of samples that they are compared by."""
SIDEWAYS = 1.0
"""Relative extra cost of a side along the motions against one across them: it would bend them sharply."""
SELECTIVITY = 0.05
"""Relative difference in cost over which a direction's share in a side falls by a factor e, for smooth drags."""
ALIKE = 0.77
"""Cosine of the largest angle between two directions of one side."""
STAYING = 1.5
"""Cost of the side that was chosen before, relative to the least one, up to which it is kept."""
ROUNDNESS = 1.1
"""Size of the ellipsoid that sides are compared by, relative to the obstacle's half sizes."""
BREADTH = 0.7
"""Smallest half size of A⁻¹, relative to the longest way to the side; else it is the obstacle's plus the margin."""
GAIN = 2.0
"""g in mean half sizes of the obstacle, so that a motion through its middle takes somewhat less than a unit of time."""
ASLEEP = 3.0
"""‖A(y − c)‖ from which on an end hardly moves, so that the field needs no factor for it."""
END_RADIUS, LEAST_END_RADIUS = 0.5, 2e-3
"""ρ_e relative to the distance of the end from the motions in the obstacle, and at least, metres: an end may lack the
margin itself, and the field is not to jump there."""
SLOWEST = 0.3
"""Smallest speed, in g, that the duration allows for: samples beside an end are hardly carried."""
LONGEST = 2.0
"""Longest time of the flow, in the same unit: beside covered starts a longer one would squeeze space to nothing."""
NUM_STEPS, SHORTEST, REACHED = 16, 1e-3, 2e-4
"""Largest number of steps to a surface, the smallest step and the margin's part that may be missing, metres."""
SIMPSON = np.array([1, *[4, 2] * 7, 4, 1]) / 48
"""Weights of Simpson's rule, along the way of a sample to the side."""
UPWARDS = 0.01
"""Length of a detour, metres, that passing above an obstacle outweighs, where motions turn to the opposite side."""
TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Sideways(PointField):
    """The generator of the flow to a side; it is against n, since motions follow the reverse."""

    centre: Array
    """c, (3,), metres."""
    inverse: Array
    """A, (3, 3), 1/metre."""
    velocity: Array
    """n g, (3,), metres per unit of time."""
    ends: Array
    """e, (E, 3), metres."""
    radii: Array
    """ρ_e, (E,), metres."""

    @property
    def dim(self) -> int:
        """Dimension of the space."""
        return 3

    def _terms(self) -> Terms:
        term, ends = np.zeros(1, TERM), np.column_stack([self.ends, self.radii])
        values = np.concatenate([self.centre, self.inverse.ravel(), ends.ravel()]).astype(np.float64)
        term["kind"], term["size"], term["inward"] = ASIDE, len(values), np.eye(3)
        term["outward"][0, :, 0] = -self.velocity
        return Terms(term, values)


def held(aside: Aside, outer: Diffeomorphism) -> Aside:
    """The flow `aside` to a side, zero not at its ends but at their images under `outer`, which is stacked on it.

    So `outer` alone moves the ends. Where it brought them into the field, that would carry them far into the obstacle.
    """
    assert isinstance(aside.field, Sideways)
    return replace(aside, field=replace(aside.field, ends=outer.forward(aside.field.ends)))


@dataclass(frozen=True, eq=False)
class Passes:
    """Where the motions that have a demonstration come nearer to an obstacle than a margin."""

    obstacle: Obstacle
    margin: float
    """Metres."""
    points: Array
    """(K, 3) samples of the motions there, metres."""
    tangents: Array
    """(K, 3) unit vectors along the motions."""
    ends: Array
    """(E, 3) starts and goal outside the obstacle, metres."""
    others: tuple[Obstacle, ...] = ()
    """Obstacles whose sides have been chosen: the way out of this one does not end in them."""
    plane: Array | None = None
    """(3, 2) orthonormal columns: sides are in this plane; None is in space."""

    @classmethod
    def of(
        cls,
        motion: MotionBelow,
        avoidable: Mask,
        obstacle: Obstacle,
        margin: float,
        others: Sequence[Obstacle] = (),
        plane: Array | None = None,
    ) -> Passes | None:
        """The passes of a motion, of whose samples only those `avoidable` (N,) count; None where none comes so near."""
        inside = np.flatnonzero(avoidable & (obstacle.signed_distance(motion.positions) < margin))
        if not len(inside):
            return None
        inside = inside[:: -(-len(inside) // MAX_SAMPLES)]
        of_next = motion.index[np.minimum(inside + 1, len(motion.index) - 1)] == motion.index[inside]
        of_last = motion.index[np.maximum(inside - 1, 0)] == motion.index[inside]
        after, before = (np.clip(inside + by, 0, len(motion.index) - 1) for by in (of_next, -1 * of_last))
        tangents = motion.positions[after] - motion.positions[before]
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), TINY)
        ends = np.concatenate([motion.starts, motion.goal[None]])
        ends = ends[obstacle.signed_distance(ends) >= 0]
        return cls(obstacle, margin, motion.positions[inside], tangents, ends, tuple(others), plane)

    def way(self, before: Way | None, *, gradually: bool) -> Way:
        """The way out on the side with the least detour, or on the side of before while that costs little more.

        Where turning there gradually would move the motions farther than going there at once, it is there at once: what
        has just come near may make the way long in between.

        Args:
            before: the way out of the obstacle where it was just before; None where there was none.
            gradually: whether it turns there as the obstacle moves on; else it is there at once.
        """
        directions = self._directions
        cost = self.costs(directions)
        alike = directions @ directions[cost.argmin()] > ALIKE
        share = np.where(alike, np.exp((cost.min() - cost) / (SELECTIVITY * cost.min())), 0)
        best = _unit(share @ directions)
        if before is None:
            return self._way(best, best, kept=False)
        keeps = best @ before.side < ALIKE and self.costs(before.side[None])[0] < STAYING * cost.min()
        side = before.side if keeps else best
        way = self._way(side, side)
        if not gradually:
            return way
        over = _unit(np.cross(np.linalg.svd(self.tangents, full_matrices=False)[2][0], before.direction))
        above, below = self.costs(np.stack([over, -over]))
        turned = way.turned_from(before, [over if above - below < UPWARDS * over[2] else -over])
        ways = way, self._way(side, turned.direction)
        return min(ways, key=lambda way: float(np.linalg.norm(way.offset - before.offset)))

    def _way(self, side: Array, direction: Array, *, kept: bool = True) -> Way:
        return Way(self.obstacle, side, direction, kept, float(self._lengths(direction).max()))

    def costs(self, directions: Array) -> Array:
        """Longest way (D,), metres, of a sample along unit vectors (D, 3) out of ellipsoids around the obstacles.

        It is longer by up to `SIDEWAYS` times itself for a direction along the motions.
        """
        first, *others = (self._crossed(obstacle, directions) for obstacle in (self.obstacle, *self.others))
        way = first[1]
        for _ in others:
            for begins, ends in others:
                way = np.where((begins < way) & (way < ends), ends, way)
        parallel = np.abs(directions @ self.tangents.T).mean(axis=1)
        return way.max(axis=1) * (1 + SIDEWAYS * parallel) + TINY

    def _crossed(self, obstacle: Obstacle, directions: Array) -> tuple[Array, Array]:
        """Where rays from the samples along unit vectors (D, 3) enter and leave an ellipsoid, both (D, K), metres."""
        centre, axes = _ellipsoid(obstacle)
        inverse = np.linalg.inv(axes * (ROUNDNESS + self.margin / np.linalg.norm(axes, axis=0)))
        u, v = (self.points - centre) @ inverse.T, directions @ inverse.T
        size, along, squared = (v * v).sum(axis=1)[:, None], v @ u.T, (u * u).sum(axis=1)
        # it holds all samples in the obstacle: corners of a box stick out
        surface = max(1.0, float(squared.max())) if obstacle is self.obstacle else 1.0
        half = np.sqrt(np.maximum(along**2 + size * (surface - squared), 0))
        return (-half - along) / size, (half - along) / size

    def flow(self, direction: Array, tolerance: float) -> AdaptiveFlow:
        """The flow whose inverse carries all samples along a unit vector (3,) until they keep the margin."""
        way = self._lengths(direction)
        centre, axes = _ellipsoid(self.obstacle)
        half = np.linalg.norm(axes, axis=0)
        inverse = np.linalg.inv(axes * (np.maximum(half + self.margin, BREADTH * way.max()) / half))
        ends = self.ends[np.linalg.norm((self.ends - centre) @ inverse.T, axis=1) < ASLEEP]
        distance = np.linalg.norm(self.points[:, None] - ends, axis=2).min(axis=0)
        gain = GAIN * float(half.mean())
        field = Sideways(centre, inverse, gain * direction, ends, np.maximum(END_RADIUS * distance, LEAST_END_RADIUS))
        on_the_way = self.points + (np.linspace(0, 1, len(SIMPSON))[:, None] * way)[:, :, None] * direction
        speed = -(field(on_the_way.reshape(-1, 3)) @ direction).reshape(len(SIMPSON), -1)
        duration = way * (SIMPSON @ (1 / np.maximum(speed, SLOWEST * gain)))
        return AdaptiveFlow(field, min(float(duration.max()), LONGEST), tolerance)

    def _lengths(self, direction: Array) -> Array:
        """How far (K,), metres, the samples have to go along a unit vector (3,) to keep the margin."""
        length, around = np.zeros(len(self.points)), Union((self.obstacle, *self.others))
        for _ in range(NUM_STEPS):
            lacking = self.margin - around.signed_distance(self.points + length[:, None] * direction)
            if lacking.max() <= REACHED:
                break
            length += np.where(lacking > REACHED, np.maximum(lacking, SHORTEST), 0)
        return length

    @property
    def _directions(self) -> Array:
        """(D, 3) unit vectors all around."""
        if self.plane is None:
            return golden_spiral(NUM_DIRECTIONS, 0.5)
        turn = np.linspace(0, 2 * np.pi, NUM_DIRECTIONS, endpoint=False)
        return np.stack([np.cos(turn), np.sin(turn)], axis=1) @ self.plane.T


def _ellipsoid(obstacle: Obstacle) -> tuple[Array, Array]:
    """Centre (3,) and half axes (3, 3), as columns, metres, of an ellipsoid about as large as an obstacle."""
    placed = obstacle.field("free-space", 1.0)
    return placed.origin, placed.axes


def _unit(direction: Array) -> Array:
    return direction / max(float(np.linalg.norm(direction)), TINY)
