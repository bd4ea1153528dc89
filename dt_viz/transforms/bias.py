"""Biasing a motion towards a point: the reverse flow of a field of unit vectors away from it (sec. 4.6)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dt_viz.flows.diffeomorphisms import AUTO, Flow, Integration
from dt_viz.flows.fields import Array, GaussianGrid, GridRBF, Mask, PlacedField, Selection, VectorField
from dt_viz.flows.integrators import integrate, rk4
from dt_viz.obstacles.shapes import Point
from dt_viz.transforms.base import Built, Motion

NUM_SAMPLES = 400
"""Unit vectors sampled in one octant of the region, or quadrant of the disc; the others are its mirror images."""
KERNEL_WIDTH = 0.4
"""Of the regression, in radii: the unit vectors are singular at the target, the core where the fit smooths them is
about as wide."""
REGULARISATION = 1e-3
PLATEAU = 0.5
"""Part of the radius from which on the field fades out."""

AIM = 0.009
"""Metres from the target by which `auto` lets the motions pass."""
ACCEPTED = 0.010
"""Metres by which they may pass, between the samples that the duration was chosen for."""
MAX_DURATION = 4.0
"""Longest flow that is tried: what has not arrived after it hardly lies in the region."""
LONG = 1.5
"""Flow after which a motion that has not arrived, and whose start or goal is still its nearest place, never does."""
SNAPSHOT = 0.1
"""Flow time between two looks at the distance: less than half of what a point at the target takes to halve it."""
LARGE, SMALL = 2.5, 1.5
"""Of the distance of the farthest motion: the `auto` radius, and the one down to which it shrinks to leave starts and
goal outside. On a straight path, these turn the motion by up to 30° and 90° on two centimetres."""
MIN_RADIUS = 0.10
"""Metres, of the `auto` radius."""
SMALLER = 1.25
"""Of the distance: where starts or goal do lie in the region, the motion below ends farther away the larger it is, and
the radius may not grow with that."""
OVERSHOOT = 2.0
"""Times the longer duration that another attempt needs."""
STEP = 2.2
"""Flow time of a step of the flow, for each fourth root of a metre of tolerance. The field is mild everywhere, so RK4
with equal steps is quicker here than steps of each point's own length, and there and back it errs less."""
OFF_PLANE = "before or behind the plane"
"""Words of the doubt that a point of a drawing lies there; that motions miss it by so much is not said again."""
SHOULDER = (0.0, 0.0, 0.28)
"""Of the arm, metres."""
REACH = 0.95
"""Metres from the shoulder, beyond which the hand gets nowhere."""


@dataclass(frozen=True)
class BiasPoint:
    """A place that motions are pulled towards, and how."""

    position: Point
    """The target, metres."""
    radius: float | None = None
    """Of the region S around it in which the field acts, metres; None is `auto`, by the distance of the motion."""
    strength: float | None = None
    """t of the flow, in which a point far from target and border moves by t radii; None is `auto`, the shortest after
    which every motion passes within a centimetre."""
    plane: tuple[Point, Point] | None = None
    """Two orthonormal vectors: the field acts along these only, and alike at every depth. None is in space."""
    moves_goal: bool = False
    """Whether the goal is pulled along, or stays where it is."""
    integration: Integration = AUTO
    """Of its flow."""

    def axes(self) -> Array:
        """(3, 3) orthonormal columns, those of the plane first."""
        if self.plane is None:
            return np.eye(3)
        u, v = np.asarray(self.plane)
        return np.stack([u, v, np.cross(u, v)], axis=1)

    def field(self, radius: float) -> PlacedField:
        """The generator whose reverse flow leads to the target, from a regression done once for all targets."""
        unit = unit_field(3 if self.plane is None else 2)
        return PlacedField(unit, np.asarray(self.position), self.axes(), radius)

    def offsets(self, s: Array) -> Array:
        """Offsets (*B, 2 or 3) from the target of the points `s` (*B, 3), metres, along the axes it acts on."""
        return (s - np.asarray(self.position)) @ self.axes()[:, : 3 if self.plane is None else 2]


@dataclass(frozen=True)
class RegionField:
    """A field on the unit ball (or on the cylinder over the unit disc) that fades out smoothly towards its border.

    V(s) = w(‖u‖)·V_fit(u), u the first k coordinates of s; the others are not moved. w falls from 1 at `PLATEAU` to 0
    at the border, three times continuously differentiable.
    """

    directions: GridRBF
    """V_fit, in R^k."""
    dimension: int = 3

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return self.dimension

    def __call__(self, s: Array) -> Array:
        """V at the points `s` (N, d), as (N, d)."""
        value, (inside, u, r) = np.zeros_like(s), self._inside(s)
        if len(u):
            value[inside, : u.shape[1]] = _window(_ramp(r))[:, None] * self.directions(u)
        return value

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and DV (N, d, d) at the points `s` (N, d)."""
        value, DV = np.zeros_like(s), np.zeros((*s.shape, s.shape[1]))
        inside, u, r = self._inside(s)
        if len(u):
            k, x = u.shape[1], _ramp(r)
            bump, window = x * (1 - x), _window(x)[:, None]
            fit, D_fit = self.directions.with_jacobian(u)
            gradient = (_STEEPNESS * bump * bump * bump / np.maximum(r, PLATEAU))[:, None] * u
            value[inside, :k] = window * fit
            DV[inside, :k, :k] = window[:, None] * D_fit + fit[:, :, None] * gradient[:, None]
        return value, DV

    def _inside(self, s: Array) -> tuple[Selection, Array, Array]:
        """Rows of the points `s` (N, d) inside the border, their first k coordinates (M, k) and norms (M,)."""
        u = s[:, : self.directions.dim]
        squared = (u * u).sum(axis=1)
        within = squared < 1
        if within.all():
            return slice(None), u, np.sqrt(squared)
        inside = np.flatnonzero(within)
        return inside, u[inside], np.sqrt(squared[inside])


_STEEPNESS = -140 / (1 - PLATEAU)
"""Factor of w′ = factor·(x·(1 − x))³."""


def _ramp(radius: Array) -> Array:
    """Part x of the way from the plateau to the border, at the radii (N,) below 1."""
    return np.maximum((radius - PLATEAU) / (1 - PLATEAU), 0)


def _window(x: Array) -> Array:
    """Values w (N,) at the parts `x` (N,) of the way from the plateau to the border."""
    squared = x * x
    return 1 - squared * squared * (35 + x * (-84 + x * (70 - 20 * x)))


@lru_cache(maxsize=2)
def unit_field(dim: int) -> RegionField:
    """The field for the unit region, ridge regression of unit vectors away from the centre of the ball of `dim`.

    With every sample come its mirror images, so the centre is at rest and no sampling noise turns the field.
    """
    rng = np.random.default_rng(0)
    octant = np.abs(rng.normal(size=(NUM_SAMPLES, dim)))
    octant *= rng.uniform(size=(NUM_SAMPLES, 1)) ** (1 / dim) / np.linalg.norm(octant, axis=1, keepdims=True)
    samples = np.concatenate([octant * signs for signs in itertools.product((-1, 1), repeat=dim)])
    away = samples / np.linalg.norm(samples, axis=1, keepdims=True)
    grid = GaussianGrid.covering(np.stack([-np.ones(dim), np.ones(dim)]), KERNEL_WIDTH, pad=0)
    features = grid.features(samples)
    gram = features.T @ features / len(samples)
    gram[np.diag_indices_from(gram)] += REGULARISATION
    return RegionField(GridRBF(grid, cho_solve(cho_factor(gram), features.T @ away / len(samples))))


@dataclass(frozen=True)
class Biasing:
    """Motions are pulled towards a bias point.

    With the goal where it is, every motion passes the target on its way. If the goal moves, it does so to the target.
    It is made for the motions that have a demonstration: one that was started elsewhere changes nothing about it.
    """

    point: BiasPoint
    below: tuple[Point, ...] = ()
    """Targets of the bias points below this one in the stack: what passes them is not to be pulled away again."""

    def build(self, motion: Motion, tolerance: float, at_least: float) -> Built:
        """See `Behaviour`. With `auto` the duration is the shortest that brings every motion to the target."""
        point, motion = self.point, motion.demonstrated
        if motion.above is not None:  # what is above must not lead the motion past the target again
            x, y, z = motion.above.forward(np.asarray(point.position))
            point = replace(point, position=(float(x), float(y), float(z)))
        nearest, at_end = closest_points(point, motion)
        if point.moves_goal:
            nearest = motion.goal[None]
        distance = float(np.linalg.norm(point.offsets(nearest), axis=1).max())
        radius = point.radius or self._auto_radius(motion, (SMALL if at_least == 0 else SMALLER) * distance, distance)
        field, duration = point.field(radius), point.strength
        doubts = self._misplaced(motion, nearest, radius)
        if duration is None:
            duration = pulling_duration(field, point, nearest, at_least=at_least)
            if duration is not None and at_least > 0:
                # starts and goal in the region move the motion below the farther, the longer the flow: converge sooner
                duration = min(at_least + OVERSHOOT * (duration - at_least), MAX_DURATION)
        hopeless = duration is None
        if duration is None:
            duration = MAX_DURATION
            doubts.append(_too_small(radius, distance))
        elif point.strength is None and at_least > LONG and at_end.any() and not point.moves_goal:
            hopeless = True  # its ends stay where they are, and no other place of it will be nearer
            doubts.append("a motion has its start or goal nearer to the point than its way: it is not led there")
        steps = max(1, math.ceil(duration / (STEP * tolerance**0.25)))
        flow = Flow(field, duration, steps, sparse=True, tolerance=tolerance)
        flow = point.integration.of(flow)
        goal = flow.inverse(motion.goal) if point.moves_goal else motion.goal
        return Built(flow, duration, goal, hopeless, tuple(doubts), point.integration)

    def satisfied(self, motion: Motion) -> bool:
        """Whether every motion passes close to the target, where that is to be seen to."""
        if self.point.strength is not None:
            return True
        return bool((self.distances(motion) <= ACCEPTED).all())

    def distances(self, motion: Motion) -> Array:
        """(R,) metres from the target: of the motions that have a demonstration, or of their ends if the goal moves."""
        motion = motion.demonstrated
        if motion.top is not None:
            motion = replace(motion, positions=motion.top)
        if self.point.moves_goal:
            last = np.r_[np.flatnonzero(np.diff(motion.index)), len(motion.index) - 1]
            return np.linalg.norm(self.point.offsets(motion.positions[last]), axis=1)
        return closest_distances(self.point, motion)

    def _auto_radius(self, motion: Motion, least: float, distance: float) -> float:
        """Large for gentle turns, but such that what is to stay where it is stays outside, where that is possible."""
        kept = [motion.starts, np.asarray(self.below).reshape(-1, 3)]
        if not self.point.moves_goal:
            kept.append(motion.goal[None])
        room = float(np.linalg.norm(self.point.offsets(np.concatenate(kept)), axis=1).min())
        return max(MIN_RADIUS, min(LARGE * distance, max(least, room)))

    def _misplaced(self, motion: Motion, nearest: Array, radius: float) -> list[str]:
        """What there is to say of the place of the bias point."""
        point, doubts = self.point, []
        position = np.asarray(point.position)
        if np.linalg.norm(point.offsets(motion.goal)) < ACCEPTED:
            doubts.append("the point is on the goal, where the motions end anyway")
        if (np.linalg.norm(point.offsets(motion.starts), axis=1) < ACCEPTED).any():
            doubts.append("the point is on a start, where the motion is anyway")
        if position[2] < 0:
            doubts.append("the point is below the table")
        away = float(np.linalg.norm(position - SHOULDER))
        if away > REACH:
            doubts.append(f"the point is {away:.2f} m from the arm's shoulder, which reaches {REACH:.2f} m")
        depth = float(np.abs((nearest - position) @ point.axes()[:, 2]).max()) if point.plane else 0.0
        if depth > ACCEPTED:
            doubts.append(f"the point lies {100 * depth:.0f} cm {OFF_PLANE}: motions are not led to it")
        if any(np.linalg.norm(point.offsets(np.asarray(other))) < 0.9 * radius for other in self.below):
            doubts.append("the region covers a bias point below it in the stack: motions are pulled away from that")
        return doubts


def _too_small(radius: float, distance: float) -> str:
    """What there is to say of a region from which not all motions arrive."""
    sizes = f"the region of {100 * radius:.0f} cm is too small: a motion is {100 * distance:.0f} cm from the target"
    return sizes if distance >= radius else f"{sizes}, near the border, where the pull fades out"


def closest_points(point: BiasPoint, motion: Motion) -> tuple[Array, Mask]:
    """Where each rollout, as a polyline, comes closest to the target.

    Returns:
        (R, 3) these places, metres, and (R,) whether they are the rollout's start or goal.
    """
    offset = point.offsets(motion.positions)
    start, step = offset[:-1], np.diff(offset, axis=0)
    squared = (step * step).sum(axis=1)
    same = np.diff(motion.index) == 0
    along = np.clip(-(start * step).sum(axis=1) / np.maximum(squared, 1e-300), 0, 1) * same
    miss = start + along[:, None] * step
    miss = np.where(same, (miss * miss).sum(axis=1), np.inf)
    first = np.flatnonzero(np.r_[True, ~same])
    last = np.r_[first[1:], len(offset)] - 1
    k = np.array([low + np.argmin(miss[low:high]) for low, high in zip(first, last, strict=True)])
    nearest = motion.positions[k] + along[k, None] * (motion.positions[k + 1] - motion.positions[k])
    return nearest, ((k == first) & (along[k] == 0)) | ((k + 1 == last) & (along[k] == 1))


def closest_distances(point: BiasPoint, motion: Motion) -> Array:
    """(R,) metres: how close each rollout comes to the target, in the plane if the bias acts in one."""
    return np.linalg.norm(point.offsets(closest_points(point, motion)[0]), axis=1)


def pulling_duration(field: VectorField, point: BiasPoint, points: Array, *, at_least: float = 0.0) -> float | None:
    """The shortest duration after which the reverse flow has carried all `points` (N, 3) to the target.

    γ is a one-parameter group, so one integration with snapshots passes every duration on its way. The field is
    nearly radial, so the place where a rollout is closest to the target stays, nearly, where it is closest.

    Returns:
        The duration, or None where some point has not arrived after `MAX_DURATION`.
    """
    duration = at_least
    if duration > 0:
        points, _ = integrate(rk4, field, points, None, -duration, math.ceil(duration / SNAPSHOT))
    distance = np.linalg.norm(point.offsets(points), axis=1)
    away = distance > AIM
    points, distance = points[away], distance[away]
    while len(points):
        if duration >= MAX_DURATION:
            return None
        points, _ = rk4(field, points, None, -SNAPSHOT)
        before, distance = distance, np.linalg.norm(point.offsets(points), axis=1)
        away = distance > AIM
        if not away.any():
            # the approach is exponential where it ends
            fraction = np.log(before / AIM) / np.log(before / distance)
            return duration + SNAPSHOT * float(np.clip(fraction, 0, 1).max())
        points, distance, duration = points[away], distance[away], duration + SNAPSHOT
    return duration
