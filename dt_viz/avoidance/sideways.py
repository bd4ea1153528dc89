"""Sideways: the flow that carries all motions of the end effector to one side of an obstacle.

The flow out of an occupied region takes each sample out where it is nearest: a motion through the middle is pushed back
along its own way and then turns sharply, and its neighbours leave on other sides. So all motions together are carried
to one side n before, as far as they need to be clear, by a flow along it,

    ẏ = n g exp(−½ ‖A(y − c)‖²) Π_e (1 − exp(−‖y − e‖²/2ρ_e²)),

which is broad along the motions and leaves their free starts and goal e where they are. The side is the one with the
least detour, see `dt_viz.avoidance.detour`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.detour import Detour, DetourSettings, escape_directions
from dt_viz.avoidance.transform import MotionBelow
from dt_viz.flows.diffeomorphisms import Diffeomorphism, Flow
from dt_viz.flows.fields import Array, Mask, PointField
from dt_viz.kernels.fields import ASIDE, TERM, Terms
from dt_viz.numerics import unit
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union, escape_lengths

MAX_SAMPLES = 96  # largest number of samples that sides are compared by
BREADTH = 0.7
"""Smallest half size of A⁻¹, relative to the largest displacement; else it is the obstacle's plus the margin."""
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
"""Longest flow time: beside covered starts a longer one would squeeze space to nothing."""
SIMPSON = np.array([1, *[4, 2] * 7, 4, 1]) / 48
"""Weights of Simpson's rule, along the displacement of a sample."""


@dataclass(frozen=True, eq=False)
class Sideways(PointField):
    """The generator of the flow to a side; it is against n, since motions follow the reverse."""

    centre: Array  # c, (3,), metres
    inverse: Array  # a, (3, 3), 1/metre
    velocity: Array  # n g, (3,), metres per unit of time
    ends: Array  # e, (E, 3), metres
    radii: Array  # ρ_e, (E,), metres

    def _terms(self) -> Terms:
        term, ends = np.zeros(1, TERM), np.column_stack([self.ends, self.radii])
        values = np.concatenate([self.centre, self.inverse.ravel(), ends.ravel()]).astype(np.float64)
        term["kind"], term["size"], term["inward"] = ASIDE, len(values), np.eye(3)
        term["outward"][0, :, 0] = -self.velocity
        return Terms(term, values)


def fixing_ends(flow: Flow, outer: Diffeomorphism) -> Flow:
    """The flow to a side, zero not at its ends but at their images under `outer`, which is stacked on it.

    So `outer` alone moves the ends. Where it brought them into the field, that would carry them far into the obstacle.
    """
    assert isinstance(flow.field, Sideways)
    return replace(flow, field=replace(flow.field, ends=outer.forward(flow.field.ends)))


@dataclass(frozen=True, eq=False)
class Encounter:
    """Where the motions that have a demonstration come nearer to an obstacle than a margin."""

    obstacle: Obstacle
    margin: float  # metres
    points: Array  # (K, 3) samples of the motions there, metres
    tangents: Array  # (K, 3) unit vectors along the motions
    ends: Array  # (E, 3) starts and goal outside the obstacle, metres
    others: tuple[Obstacle, ...] = ()
    """Obstacles whose sides have been chosen: the escape from this one does not end in them."""
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
    ) -> Encounter | None:
        """Find it for a motion, of whose samples only those `avoidable` (N,) count; None where none comes so near."""
        inside = np.flatnonzero(avoidable & (obstacle.signed_distance(motion.positions) < margin))
        if not len(inside):
            return None
        inside = inside[:: -(-len(inside) // MAX_SAMPLES)]
        of_next = motion.index[np.minimum(inside + 1, len(motion.index) - 1)] == motion.index[inside]
        of_last = motion.index[np.maximum(inside - 1, 0)] == motion.index[inside]
        after, before = (np.clip(inside + by, 0, len(motion.index) - 1) for by in (of_next, -1 * of_last))
        tangents = unit(motion.positions[after] - motion.positions[before])
        ends = np.concatenate([motion.starts, motion.goal[None]])
        ends = ends[obstacle.signed_distance(ends) >= 0]
        return cls(obstacle, margin, motion.positions[inside], tangents, ends, tuple(others), plane)

    def detour(self, previous: Detour | None, settings: DetourSettings) -> Detour:
        """Choose the side with the least detour, or the previous one, carried over, while that costs little more.

        Where turning there at a limited rate would move the motions farther than going there at once, it is there at
        once: what has just come near may make the detours in between long.
        """
        found = escape_directions(
            self.points.T[None],
            np.zeros(1),
            self.tangents,
            self._around,
            self.margin,
            num=1,
            previous=None if previous is None else previous.side,
            plane=self.plane,
            settings=settings,
        )
        arrived = self._measured(Detour(self.obstacle, found[0], found[0], kept=previous is not None))
        if previous is None or previous.travelled is None:
            return arrived
        both = arrived, self._measured(arrived.turned_from(previous, found, settings.turning))
        return min(both, key=lambda detour: float(np.linalg.norm(detour.offset - previous.offset)))

    def _measured(self, detour: Detour) -> Detour:
        return replace(detour, length=float(self._lengths(detour.direction).max()))

    def flow(self, direction: Array, tolerance: float) -> Flow:
        """The flow whose inverse carries all samples along a unit vector (3,) until they keep the margin."""
        length = self._lengths(direction)
        ellipsoid = self.obstacle.field("free-space", 1.0)  # with half axes as columns, metres, about as large
        centre, axes = ellipsoid.origin, ellipsoid.axes
        half = np.linalg.norm(axes, axis=0)
        inverse = np.linalg.inv(axes * (np.maximum(half + self.margin, BREADTH * length.max()) / half))
        ends = self.ends[np.linalg.norm((self.ends - centre) @ inverse.T, axis=1) < ASLEEP]
        distance = np.linalg.norm(self.points[:, None] - ends, axis=2).min(axis=0)
        gain = GAIN * float(half.mean())
        field = Sideways(centre, inverse, gain * direction, ends, np.maximum(END_RADIUS * distance, LEAST_END_RADIUS))
        passed = self.points + (np.linspace(0, 1, len(SIMPSON))[:, None] * length)[:, :, None] * direction
        speed = -(field(passed.reshape(-1, 3)) @ direction).reshape(len(SIMPSON), -1)
        duration = length * (SIMPSON @ (1 / np.maximum(speed, SLOWEST * gain)))
        return Flow.adaptive(field, min(float(duration.max()), LONGEST), tolerance)

    def _lengths(self, direction: Array) -> Array:
        """Lengths (K,), metres, by which the samples are displaced along a unit vector (3,) to keep the margin."""
        return escape_lengths(self._around, self.points, direction, self.margin)

    @property
    def _around(self) -> Union:
        """The obstacle, and those that the escape does not end in."""
        return Union((self.obstacle, *self.others))
