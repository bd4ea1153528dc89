"""A generator on the signed distance: flow along its barrier-weighted gradient (after Simmoteit et al., RSS 2025).

Nothing is learned of the obstacle: the field is −v·w(d)·∇d, with d the signed distance of its true shape and w a
barrier, 1 inside and fading to 0 at a range. All else, flow time and sides included, is our avoidance of the end
effector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.transform import axes_of
from dt_viz.baselines.base import Method, Plan, Planner, Problem
from dt_viz.baselines.ours import from_starts
from dt_viz.baselines.surface import distance_and_normal
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array, VectorField
from dt_viz.motion.nominal import Learned
from dt_viz.motion.stack import LIVE, Precision, build_stack
from dt_viz.obstacles.shapes import Point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import Layer

RANGE = 0.10
"""Distance from the surface at which the field ends, metres."""
SPEED = 0.3
"""v inside the obstacle, metres for each unit of flow time."""
STEP = 1e-5
"""Step of the differences that the field's derivative is made of, metres."""


@dataclass(frozen=True)
class SignedDistanceField:
    """V(s) = −v·w(d(s))·∇d(s), w(d) = (1 − (d/R)²)² between the surface and the range R, 1 inside, 0 beyond."""

    obstacle: Union
    plane: tuple[Point, Point] | None = None
    """Two orthonormal vectors, along which the field acts only; None is in space."""

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return 3

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, 3), as (N, 3)."""
        distance, normal = distance_and_normal(self.obstacle, s)
        barrier = (1 - np.clip(distance / RANGE, 0, 1) ** 2) ** 2
        along = np.eye(3) if self.plane is None else axes_of(self.plane)[:, :2]
        return -SPEED * barrier[:, None] * (normal @ along @ along.T)

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, 3) and DV (N, 3, 3) at the points `s` (N, 3), by central differences."""
        columns = [(self(s + step) - self(s - step)) / (2 * STEP) for step in STEP * np.eye(3)]
        return self(s), np.stack(columns, axis=-1)


@dataclass(frozen=True, init=False)
class SignedDistanceAvoidance(HandAvoidance):
    """Avoidance of the end effector whose generator is `SignedDistanceField`."""

    def _field(self) -> VectorField:
        return SignedDistanceField(self.avoided, self.plane)


@dataclass(frozen=True, eq=False)
class _Planner:
    learned: Learned
    precision: Precision

    def plan(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan motions of the end effector; see `Planner`."""
        nominal, numbers = from_starts(self.learned, starts)
        avoidance = SignedDistanceAvoidance(obstacle.parts)
        layers = [(0, Layer(avoidance, name=avoidance.title))] if avoidance.acts else []
        solution = build_stack(nominal, layers, self.precision)
        bundle = solution.bundle
        times = bundle.split(solution.rays.times(bundle.index, bundle.fraction))
        return Plan(tuple(bundle.paths[k] for k in numbers), tuple(times[k] for k in numbers))


class SignedDistance(Method):
    """Our imitation, its motions led out of the obstacles by the flow of a field on the signed distance."""

    name, title = "signed-distance", "Signed distance"
    promise = "Stable: a diffeomorphism of the imitation. The end effector avoids, not the whole arm."
    stable, whole_arm, live = True, False, True

    def __init__(self, precision: Precision = LIVE) -> None:
        """Choose how exactly the motion is worked out."""
        self.precision = precision

    def fit(self, problem: Problem) -> Planner:
        """Take what is learned already; see `Method`."""
        return _Planner(problem.learned, self.precision)
