"""Biasing a motion towards a point: the reverse flow of a field of unit vectors away from it (sec. 4.6)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dt_viz.behaviours import Built, Motion
from dt_viz.diffeo import AdaptiveFlow
from dt_viz.fields import Array, GaussianGrid, GridRBF, PlacedField, VectorField
from dt_viz.integrate import integrate_adaptive, rk4

Vector = tuple[float, float, float]

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
SNAPSHOT = 0.1
"""Flow time between two looks at the distance: less than half of what a point at the target takes to halve it."""
TOLERANCE = 1e-5
"""Of the integration up to the duration that is known to be needed, metres a step."""
LARGE, SMALL = 2.5, 1.5
"""Of the distance of the farthest motion: the `auto` radius, and the one down to which it shrinks to leave starts and
goal outside. On a straight path, these turn the motion by up to 30° and 90° on two centimetres."""
MIN_RADIUS = 0.10
"""Metres, of the `auto` radius."""
FINENESS = 0.1
"""Part of the tolerance that a step of the flow may be off by: what contracts on the way there expands on the way back,
and the estimate of a long first step may be small by chance."""
SHOULDER = (0.0, 0.0, 0.28)
"""Of the arm, metres."""
REACH = 0.95
"""Metres from the shoulder, beyond which the hand gets nowhere."""


@dataclass(frozen=True)
class BiasPoint:
    """A place that motions are pulled towards, and how."""

    position: Vector
    """The target, metres."""
    radius: float | None = None
    """Of the region S around it in which the field acts, metres; None is `auto`, by the distance of the motion."""
    strength: float | None = None
    """t of the flow, in which a point far from target and border moves by t radii; None is `auto`, the shortest after
    which every motion passes within a centimetre."""
    plane: tuple[Vector, Vector] | None = None
    """Two orthonormal vectors: the field acts along these only, and alike at every depth. None is in space."""
    moves_goal: bool = False
    """Whether the goal is pulled along, or stays where it is."""

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
        value = np.zeros_like(s)
        k = self.directions.dim
        radius = np.sqrt((s[:, :k] ** 2).sum(axis=1))
        inside = np.flatnonzero(radius < 1)
        if len(inside):
            value[inside, :k] = _window(radius[inside])[0][:, None] * self.directions(s[inside, :k])
        return value

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """V (N, d) and DV (N, d, d) at the points `s` (N, d)."""
        value, DV = np.zeros_like(s), np.zeros((*s.shape, s.shape[1]))
        k = self.directions.dim
        radius = np.sqrt((s[:, :k] ** 2).sum(axis=1))
        inside = np.flatnonzero(radius < 1)
        if len(inside):
            u, r = s[inside, :k], radius[inside]
            window, slope = _window(r)
            fit, D_fit = self.directions.with_jacobian(u)
            gradient = (slope / np.maximum(r, PLATEAU))[:, None] * u
            value[inside, :k] = window[:, None] * fit
            DV[inside, :k, :k] = window[:, None, None] * D_fit + fit[:, :, None] * gradient[:, None, :]
        return value, DV


def _window(radius: Array) -> tuple[Array, Array]:
    """W and its derivative at the radii (N,) below 1."""
    x = np.maximum((radius - PLATEAU) / (1 - PLATEAU), 0)
    return 1 - x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3), -140 * (x * (1 - x)) ** 3 / (1 - PLATEAU)


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
    """Motions are pulled towards a bias point."""

    point: BiasPoint

    def build(self, motion: Motion, tolerance: float, at_least: float) -> Built:
        """See `Behaviour`. With `auto` the duration is the shortest that brings every motion to the target."""
        point = self.point
        nearest = closest_points(point, motion)
        distance = np.linalg.norm(point.offsets(nearest), axis=1)
        radius = self._auto_radius(motion, float(distance.max())) if point.radius is None else point.radius
        field = point.field(radius)
        doubts = [*_misplaced(point, motion)]
        duration = point.strength
        hopeless = False
        if duration is None:
            duration = pulling_duration(field, point, nearest, at_least=at_least)
            hopeless = duration is None
        if duration is None:
            duration = MAX_DURATION
            outside = int((distance >= radius).sum())
            doubts.append(
                f"the bias region of {100 * radius:.0f} cm is too small: "
                f"{outside} of {len(distance)} motions pass it by, up to {100 * distance.max():.0f} cm from the target"
                if outside
                else f"the bias region of {100 * radius:.0f} cm is hardly larger than the distance of the motions, "
                f"{100 * distance.max():.0f} cm: it ends too softly to pull them all the way"
            )
        flow = AdaptiveFlow(field, duration, FINENESS * tolerance)
        goal = flow.inverse(motion.goal) if point.moves_goal else motion.goal
        return Built(flow, duration, goal, hopeless, tuple(doubts))

    def _auto_radius(self, motion: Motion, distance: float) -> float:
        """Large for gentle turns, but such that starts and goal stay outside where that is possible."""
        ends = motion.starts if self.point.moves_goal else np.concatenate([motion.starts, motion.goal[None]])
        room = float(np.linalg.norm(self.point.offsets(ends), axis=1).min())
        return max(MIN_RADIUS, min(LARGE * distance, max(SMALL * distance, room)))

    def satisfied(self, motion: Motion) -> bool:
        """Whether every motion passes close to the target, where that is to be seen to."""
        if self.point.strength is not None:
            return True
        return bool((closest_distances(self.point, motion) <= ACCEPTED).all())


def _misplaced(point: BiasPoint, motion: Motion) -> list[str]:
    """What there is to say of the place of a bias point."""
    doubts = []
    position = np.asarray(point.position)
    if np.linalg.norm(point.offsets(motion.goal)) < ACCEPTED:
        doubts.append("the bias point is on the goal: the motions end there anyway")
    if position[2] < 0:
        doubts.append("the bias point is below the table")
    away = float(np.linalg.norm(position - SHOULDER))
    if away > REACH:
        doubts.append(f"the bias point is {away:.2f} m from the arm's shoulder, which reaches {REACH:.2f} m")
    return doubts


def closest_points(point: BiasPoint, motion: Motion) -> Array:
    """(R, 3) metres: where each rollout, as a polyline, comes closest to the target."""
    offset = point.offsets(motion.positions)
    start, step = offset[:-1], np.diff(offset, axis=0)
    squared = (step * step).sum(axis=1)
    same = np.diff(motion.index) == 0
    along = np.clip(-(start * step).sum(axis=1) / np.maximum(squared, 1e-300), 0, 1) * same
    miss = start + along[:, None] * step
    miss = (miss * miss).sum(axis=1)
    first = np.flatnonzero(np.r_[True, ~same])
    nearest = []
    for low, high in zip(first, [*first[1:], len(offset)], strict=True):
        k = low + int(np.argmin(miss[low : max(high - 1, low + 1)]))
        before, after = motion.positions[k], motion.positions[min(k + 1, high - 1)]
        nearest.append(before + along[min(k, len(along) - 1)] * (after - before))
    return np.stack(nearest)


def closest_distances(point: BiasPoint, motion: Motion) -> Array:
    """(R,) metres: how close each rollout comes to the target, in the plane if the bias acts in one."""
    return np.linalg.norm(point.offsets(closest_points(point, motion)), axis=1)


def pulling_duration(field: VectorField, point: BiasPoint, points: Array, *, at_least: float = 0.0) -> float | None:
    """The shortest duration after which the reverse flow has carried all `points` (N, 3) to the target.

    γ is a one-parameter group, so one integration with snapshots passes every duration on its way. The field is
    nearly radial, so the place where a rollout is closest to the target stays, nearly, where it is closest.

    Returns:
        The duration, or None where some point has not arrived after `MAX_DURATION`.
    """
    duration = at_least
    if duration > 0:
        points, _ = integrate_adaptive(field, points, None, -duration, TOLERANCE)
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
