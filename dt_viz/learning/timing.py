"""Timing of a learned motion: an attractor whose speed along its rays is learned from demonstrations.

Multiplying a vector field by a positive function changes no orbit and no stability, only time. So what the transform
has learned of the demonstrations' shape is kept, and their timing is learned afterwards, on the straight rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import make_interp_spline
from scipy.optimize import lsq_linear

from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.systems import Attractor, asinh_exp, log_sinh
from dt_viz.learning.preparation import Motions
from dt_viz.memo import cached_property
from dt_viz.metrics import interpolate

ARRIVED = 3e-4  # distance from the goal, relative to the ray's length, that counts as a demonstration's end


@dataclass(frozen=True)
class TimingSettings:
    """Settings of a learned timing."""

    min_pace: float = 0.15
    """Smallest pace: a motion is at most about seven times as fast as the plain attractor."""
    smoothness: float = 0.03
    """Weight of a pace's second differences against errors in time, relative to the duration."""
    num_knots: int = 48  # number of knots of each pace function
    num_ray: int = 400
    """Number of points of a rollout that a demonstration's points may be matched with."""
    num_samples: int = 120
    """Number of points of a demonstration that are matched, equally spaced in time."""


@dataclass(frozen=True, kw_only=True)
class TimedAttractor(Attractor):
    """An `Attractor` with a learned pace: ż = −v·tanh(r/ρ)·r̂ / m(τ(r), r̂), m > 0.

    τ(r) = ρ/v·log sinh(r/ρ) is the clock of the plain attractor (τ̇ = −1 there; here τ̇ = −1/m). The pace m is
    Σ_i w_i(r̂)·m_i(τ): for each demonstration i a function that is linear between knots and constant beyond them,
    blended by weights w_i that depend on the direction alone, and so stay the same along a ray. Time to go is then
    quadratic between knots, T(τ) = ∫m dτ, and is inverted in closed form.
    """

    directions: Array  # (R, d) unit vectors from the goal to where the demonstrations start
    knots: Array  # (K,) increasing and equally spaced values of τ, seconds
    paces: Array
    """(R, K) m_i at the knots, positive; all equal at the first knot, nearest the goal, so that ż is smooth there."""
    sharpness: float = 0.1
    """Width of the blend between demonstrations, relative to the distance between neighbours."""

    def velocity(self, z: Array) -> Array:
        offset = z - self.goal
        clock = self._clock(np.linalg.norm(offset, axis=-1))
        _, inside, first, second = self._segment(clock[..., None], self._blended(offset))
        return super().velocity(z) / (first + inside / self._spacing * (second - first))

    def flow(self, z0: Array, times: Array) -> Array:
        offset = z0 - self.goal
        r0 = np.linalg.norm(offset, axis=-1, keepdims=True)
        paces = self._blended(offset)
        togo = self._time_to_go(self._clock(r0), paces) - times  # (*B, T)
        r = self.smoothing * asinh_exp(self._clock_at(togo, paces) * self.speed / self.smoothing)
        return self.at_fraction(z0, np.divide(r, r0, out=np.zeros_like(r), where=r0 > 0))

    def times_at(self, z0: Array, distances: Array) -> Array:
        offset = z0 - self.goal
        r0 = np.linalg.norm(offset, axis=-1, keepdims=True)
        clocks = self._clock(np.concatenate([r0, np.minimum(distances, r0)], axis=-1))
        togo = self._time_to_go(clocks, self._blended(offset))
        return togo[..., :1] - togo[..., 1:]

    def placed(self, origin: Array, axes: Array, scale: float) -> TimedAttractor:
        """Return the same attractor in R^D, where a point z becomes origin + scale·axes·z, axes (D, d) orthonormal."""
        return replace(
            self,
            goal=origin + scale * (axes @ self.goal),
            speed=scale * self.speed,
            smoothing=scale * self.smoothing,
            directions=self.directions @ axes.T,
        )

    def _clock(self, r: Array) -> Array:
        """Compute τ(r); at the goal itself a number far below all knots."""
        return self.smoothing / self.speed * log_sinh(np.maximum(r / self.smoothing, 1e-300))

    @property
    def _spacing(self) -> float:
        return float(self.knots[1] - self.knots[0])

    def _segment(self, clock: Array, table: Array) -> tuple[Indices, Array, Array, Array]:
        """Find the knot before τ (*B, N), how far τ is beyond it, and a `table` (*B, K) at that knot and the next.

        What is beyond the knots counts as at the nearest.
        """
        position = np.clip((clock - self.knots[0]) / self._spacing, 0.0, len(self.knots) - 1)
        index = np.minimum(position.astype(int), len(self.knots) - 2)
        first, second = (np.take_along_axis(table, index + k, axis=-1) for k in (0, 1))
        return index, (position - index) * self._spacing, first, second

    def _blended(self, offset: Array) -> Array:
        """Blend the paces m at the knots, (*B, K), for the rays through the points goal + `offset` (*B, d)."""
        radius = np.linalg.norm(offset, axis=-1, keepdims=True)
        direction = offset / np.maximum(radius, 1e-300)
        squared = ((direction[..., None, :] - self.directions) ** 2).sum(axis=-1)
        # Inverse distances to the fourth power give a demonstration's own pace on its ray, the mean of all far away.
        weights = 1.0 / (squared + self._blur**2) ** 2
        return (weights / weights.sum(axis=-1, keepdims=True)) @ self.paces

    @cached_property
    def _blur(self) -> Array:
        """Distances (R,) from the demonstrations' directions within which their own pace holds."""
        distance = np.linalg.norm(self.directions[:, None] - self.directions, axis=-1)
        np.fill_diagonal(distance, 1.0)
        return np.maximum(self.sharpness * distance.min(axis=1), 1e-4)

    def _time_to_go(self, clock: Array, paces: Array) -> Array:
        """Compute T(τ), (*B, N), zero at the first knot, for `clock` (*B, N) on rays with `paces` (*B, K)."""
        index, inside, first, second = self._segment(clock, paces)
        start = np.take_along_axis(self._to_knots(paces), index, axis=-1)
        value = start + inside * (first + (second - first) * inside / (2 * self._spacing))
        beyond = np.maximum(clock - self.knots[-1], 0) * paces[..., -1:]
        return value + beyond + np.minimum(clock - self.knots[0], 0) * paces[..., :1]

    def _to_knots(self, paces: Array) -> Array:
        """Compute T (*B, K) at the knots."""
        return cumulative_trapezoid(paces, dx=self._spacing, initial=0)

    def _clock_at(self, togo: Array, paces: Array) -> Array:
        """Invert `_time_to_go`: compute τ (*B, N) at times to go (*B, N)."""
        at_knots = self._to_knots(paces)
        index = np.clip((togo[..., None] >= at_knots[..., None, :]).sum(axis=-1) - 1, 0, len(self.knots) - 2)
        start, first, second = (
            np.take_along_axis(a, index, axis=-1) for a in (at_knots, paces[..., :-1], paces[..., 1:])
        )
        rest = np.clip(togo, 0, at_knots[..., -1:]) - start
        slope = (second - first) / self._spacing
        inside = 2 * rest / (first + np.sqrt(np.maximum(first**2 + 2 * slope * rest, 0)))
        beyond = np.maximum(togo - at_knots[..., -1:], 0) / paces[..., -1:]
        return self.knots[index] + inside + beyond + np.minimum(togo, 0) / paces[..., :1]


def learn_timing(transform: Diffeomorphism, motions: Motions, settings: TimingSettings) -> TimedAttractor:
    """Learn the attractor whose rollouts under ψ follow the motions in time, as nearly as their paths allow."""
    goal, times, positions = motions.goal, motions.times, motions.positions
    num_knots = settings.num_knots
    end, *images = transform.forward(np.stack([goal, *(path[0] for path in positions)]))
    offsets = np.stack(images) - end
    radii = np.linalg.norm(offsets, axis=1)
    length = float(radii.mean())
    durations = np.array([t[-1] for t in times])
    plain = Attractor(end, speed=length / float(durations.mean()), smoothing=0.1 * length)

    # Rays, denser towards the goal, where the plain attractor's clock runs fast; their last point counts as arrived.
    fractions = np.append(np.linspace(1.0, 0.0, settings.num_ray)[:-1], ARRIVED)
    rays = end + fractions[:, None] * offsets[:, None]
    rollouts = transform.inverse(rays)
    stamps = [np.linspace(0, t[-1], settings.num_samples) for t in times]
    samples = np.stack([interpolate(at, t, path) for at, t, path in zip(stamps, times, positions, strict=True)])
    matched = _monotone_match(samples, rollouts)
    clocks = plain.smoothing / plain.speed * log_sinh(fractions * radii[:, None] / plain.smoothing)
    nearest, farthest = clocks[:, -1].min(), clocks[:, 0].max()
    knots = np.linspace(nearest, farthest + 3 * (farthest - nearest) / (num_knots - 4), num_knots)
    paces = np.stack(
        [
            _fit_pace(knots, clock[match], at, np.linalg.norm(np.gradient(sample, at, axis=0), axis=1), settings)
            for clock, match, at, sample in zip(clocks, matched, stamps, samples, strict=True)
        ]
    )
    paces[:, 0] = paces[:, 0].mean()
    return TimedAttractor(
        end, plain.speed, plain.smoothing, directions=offsets / radii[:, None], knots=knots, paces=paces
    )


def _monotone_match(samples: Array, curves: Array) -> Array:
    """Match samples (R, n, d) with points of their curves (R, N, d), never going back, as near as possible in all.

    Dynamic programming over all pairs; the first sample is held to the first point and the last to the last.
    """
    num, n = samples.shape[:2]
    count = curves.shape[1]
    distance = ((samples[:, :, None] - curves[:, None]) ** 2).sum(axis=-1)
    best = np.full((num, count), np.inf)
    best[:, 0] = 0.0
    came_from = np.empty((n, num, count), dtype=int)
    for k in range(1, n):
        lowest = np.minimum.accumulate(best, axis=1)
        came_from[k] = np.maximum.accumulate(np.where(best <= lowest, np.arange(count), 0), axis=1)
        best = lowest + distance[:, k]
    index = np.full(num, count - 1)
    result = np.empty((num, n), dtype=int)
    for k in reversed(range(n)):
        result[:, k] = index
        if k:
            index = came_from[k, np.arange(num), index]
    return result


def _fit_pace(knots: Array, clock: Array, elapsed: Array, speed: Array, settings: TimingSettings) -> Array:
    """Fit the pace m (K,) at the knots so that ∫m dτ from each `clock` up to the first is `elapsed`.

    The errors are weighted by the speed: an error δ in time is an error speed·δ in space. Second differences are kept
    small, which decides where there are no data.
    """
    spacing = knots[1] - knots[0]
    passed = make_interp_spline(knots, np.eye(len(knots)), k=1).antiderivative()(clock)
    rows = passed[0] - passed
    weight = (speed / speed.mean() + 0.05)[:, None]
    smooth = np.diff(np.eye(len(knots)), n=2, axis=0) * settings.smoothness * elapsed[-1]
    A = np.concatenate([weight * rows, smooth])
    b = np.concatenate([weight[:, 0] * elapsed, np.zeros(len(smooth))])
    pace = lsq_linear(A, b, bounds=(settings.min_pace, np.inf), method="bvls", tol=1e-12).x
    # A demonstration starts from rest. Motions that come from farther away must not be that slow all the way.
    beyond = np.clip(2 * (knots - clock[0]) / spacing - 1.5, 0, 1)
    return (1 - beyond) * pace + beyond * elapsed[-1] / (clock[0] - clock[-1])
