"""Patterns of demonstrations: for each shape the motion and the clock of any start.

The motion that a pattern predicts for a start, which is `off` the mean start, is

    c(u s_max) = mean(u) + g(u) off + GP(off)(u),

its mean demonstration, an offset that fades, and a Gaussian process over the starts. How the offset fades, a power of
u, and how much the starts explain is not known: several predictors are tried, each by what it makes of a demonstration
that it has not seen, and their mean is taken, weighted by how likely that makes them. The trivial one, g(u) = u and
nothing explained, is among them, and far from the starts g(u) is u.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dt_viz.flows.augmented_systems import PhaseCurve
from dt_viz.flows.fields import Array, Indices
from dt_viz.learning.initial_guess import groups_of
from dt_viz.learning.preparation import Motions, PreparationSettings
from dt_viz.metrics import arc_length, interpolate, resample_by_arc_length


@dataclass(frozen=True)
class AugmentedSettings:
    """Settings of the augmented state. Lengths are relative to the extent of the demonstrations, or in spreads.

    A spread is the RMS distance of the starts from their mean.
    """

    phase_length: float = 0.5
    """s_max: what the phase counts beside a distance of places."""
    turn_length: float = 0.5
    """Length that a turn of the hand by one radian counts beside a distance of places."""
    power: float = 3.0
    """p of the base system: with a large one, what leads off the motion fades early."""
    min_knots: int = 120
    """Smallest number of knots of a predicted motion."""
    max_knots: int = 480
    """Largest number of knots."""
    knot_error: float = 0.003
    """Mean distance of a demonstration from the curve through its knots up to which these are enough; also the least
    deviation that predictors are told apart by."""
    min_spread: float = 0.04
    """Smallest spread that is reckoned with: starts nearer to each other teach nothing of what they do."""
    width: float = 2.0
    """Width of the kernel over the starts, in spreads."""
    noise: float = 0.6
    """Variance of shapes that the starts do not explain, relative to what they do, where `explained` is 1."""
    explained: tuple[float, ...] = (0.0, 0.4, 1.0)
    """Variances that starts explain, relative to that, which are tried; with 0 they explain nothing."""
    fadings: tuple[float, ...] = (0.5, 0.7, 1.0, 1.4, 2.0)
    """Powers of u by which an offset fades that are tried."""
    reach: float = 4.0
    """Distance from the mean start, in spreads, over which the fading that was learned becomes u."""
    evidence: float = 4.0
    """Number of independent deviations of a demonstration when predictors are weighted: fewer than its knots."""
    time_noise: float = 1.0
    """Variance of clocks that starts do not explain, relative to what they do; of turns if too few can be left out."""
    turn_noises: tuple[float, ...] = (0.2, 0.4, 1.0, 2.5, 6.0)
    """That of the hand's turns: their geometric mean, weighted by how likely turns that are left out make them."""
    time_width: float = 0.1
    """Width of a kernel of that variance, in spreads: a demonstration's own start has its own timing and turns."""
    time_jitter: float = 0.02
    """Part of that variance that remains noise."""
    num_paces: int = 80
    """Number of knots of a clock."""
    num_timed: int = 120
    """Number of samples of a demonstration that its clock is learned from."""
    min_pace: float = 2e-3
    """Smallest speed of the phase, relative to its mean: it never stands still."""
    min_length: float = 0.1
    """Smallest length that a clock is predicted for, relative to the mean's: no length would mean no duration."""
    caught_within: float = 0.15
    """Largest change of the phase of a motion that is pushed, relative to s_max."""
    caught_above: float = 0.05
    """Least phase that such a motion gets, relative to s_max."""
    max_patterns: int = 8
    """Largest number of patterns that are looked for."""
    max_missed: float = 0.12
    """Largest Fréchet distance of a motion from its demonstration before more patterns are looked for."""
    apart: float = 2.0
    """Least distance of demonstrations of different patterns, relative to the largest one within a pattern. There are
    at most half as many patterns as demonstrations, or two."""
    min_apart: float = 0.01
    """Least distance of the starts of different patterns that tells these apart; nearer ones are told by labels."""
    preparation: PreparationSettings = field(default_factory=PreparationSettings)
    """Settings of what is done to the demonstrations before."""


@dataclass(frozen=True, eq=False)
class StartProcess:
    """A Gaussian process over starts: the mean of what it was given, and how it changes with the start."""

    mean: Array  # (d,) mean of the starts
    spread: float  # RMS distance of the starts from their mean, or a larger one
    known: Array  # (R, d) starts, less their mean, in spreads
    coefficients: Array  # (R, …)
    width: float  # width of the kernel, in spreads
    noise: float  # variance of what it does not explain
    narrow: float | None
    """Width of the kernel of that noise, in spreads; None for noise of each start by itself."""

    @classmethod
    def of(
        cls,
        starts: Array,
        values: Array,
        spread: float,
        width: float,
        noise: float,
        narrow: float | None = None,
        jitter: float = 1.0,
    ) -> StartProcess:
        """Learn `values` (R, …) of `starts` (R, d); `jitter` is the part of the noise of each start by itself."""
        mean = starts.mean(axis=0)
        made = cls(mean, spread, (starts - mean) / spread, np.empty(0), width, noise, narrow)
        kernel = made._kernel(made.known) + jitter * noise * np.eye(len(starts))
        flat = np.linalg.solve(kernel, values.reshape(len(starts), -1))
        return replace(made, coefficients=flat.reshape(values.shape))

    def at(self, start: Array) -> Array:
        """The value at a start (d,)."""
        return np.tensordot(self._kernel((start - self.mean)[None] / self.spread)[0], self.coefficients, 1)

    def slope_at(self, start: Array) -> Array:
        """The derivative (…, d) of the value with respect to the start (d,)."""
        offset = (start - self.mean) / self.spread - self.known
        slopes = [
            np.tensordot(-alike[0][:, None] * offset, self.coefficients, (0, 0)) / (width**2 * self.spread)
            for width, alike in self._kernels((start - self.mean)[None] / self.spread)
        ]
        return np.moveaxis(np.sum(slopes, axis=0), 0, -1)

    def placed(self, origin: Array, axes: Array, scale: float, vectors: Array) -> StartProcess:
        """The same in a space of more dimensions, values multiplied by `vectors` (d, D) from the right.

        See `dt_viz.learning.augmented.AugmentedImitation.placed` for the other arguments.
        """
        return replace(
            self,
            mean=origin + scale * axes @ self.mean,
            spread=scale * self.spread,
            known=self.known @ axes.T,
            coefficients=self.coefficients @ vectors,
        )

    def _kernel(self, at: Array) -> Array:
        """What is alike of starts `at` (N, d) and the known ones, (N, R)."""
        return np.sum([alike for _, alike in self._kernels(at)], axis=0)

    def _kernels(self, at: Array) -> Iterator[tuple[float, Array]]:
        """The parts of this, each with its width."""
        squared = ((at[:, None] - self.known) ** 2).sum(axis=-1)
        yield self.width, np.exp(-squared / (2 * self.width**2))
        if self.narrow:
            yield self.narrow, self.noise * np.exp(-squared / (2 * self.narrow**2))


@dataclass(frozen=True, eq=False)
class Pattern:
    """What demonstrations of one shape teach: the motion and the clock of any start."""

    label: float | None
    """Label of the demonstrations; None where their starts tell them from others."""
    mean: Array  # (K, d) mean demonstration at the knots, from the start, metres
    fading: Array
    """(K,) part of an offset of the start that is left at the knots, for starts near the mean one."""
    reach: float  # distance of a start from the mean one over which that part becomes u, metres
    shapes: StartProcess  # (K, d) offsets from the mean and its fading shift
    profile: Array  # (P,) mean part of the length that lies behind at even times
    duration: float  # mean logarithm of the duration of motions a metre long, seconds
    timing: StartProcess  # (1 + P,) offsets from that logarithm, and from the profile
    turn: Array | None = None
    """(K, 3) mean rotation vectors of the hand at the knots, times a radius, metres; None without orientations."""
    turning: StartProcess | None = None  # (K, 3) offsets from them

    def points(self, start: Array) -> Array:
        """The predicted motion from a start (d,) at the knots, (K, d), metres."""
        off, u = start - self.mean[0], _phases(len(self.mean))
        left = u + (self.fading - u) * _near(off, self.reach)
        return self.mean + left[:, None] * off + self.shapes.at(start)

    def slopes(self, start: Array) -> Array:
        """The derivative (K, d, d) of these points with respect to the start (d,)."""
        off, u = start - self.mean[0], _phases(len(self.mean))[:, None, None]
        beside = (self.fading[:, None, None] - u) * _near(off, self.reach)
        eye = np.eye(len(off))
        return self.shapes.slope_at(start) + u * eye + beside * (eye - np.outer(off, off) / self.reach**2)

    def poses(self, start: Array) -> Array:
        """The predicted motion with rotation vectors, (K, d + 3), metres; places (K, d) without orientations."""
        points = self.points(start)
        if self.turn is None or self.turning is None:
            return points
        return np.hstack([points, self.turn + self.turning.at(start)])

    def pose_slopes(self, start: Array) -> Array:
        """The derivative (K, d + 3, d), or (K, d, d), of these with respect to the start (d,)."""
        slopes = self.slopes(start)
        return slopes if self.turning is None else np.concatenate([slopes, self.turning.slope_at(start)], axis=1)

    @property
    def mean_pose(self) -> Array:
        """(K, d + 3) the mean demonstration with rotation vectors; (K, d) without orientations."""
        return self.mean if self.turn is None else np.hstack([self.mean, self.turn])

    def placed(self, origin: Array, axes: Array, scale: float) -> Pattern:
        """The same in a space of more dimensions; see `dt_viz.learning.augmented.AugmentedImitation.placed`."""
        return replace(
            self,
            mean=origin + scale * self.mean @ axes.T,
            reach=scale * self.reach,
            shapes=self.shapes.placed(origin, axes, scale, scale * axes.T),
            duration=self.duration - np.log(scale) / 2,
            timing=self.timing.placed(origin, axes, scale, np.eye(len(self.profile) + 1)),
            turn=None if self.turn is None else scale * self.turn,
            turning=None if self.turning is None else self.turning.placed(origin, axes, scale, scale * np.eye(3)),
        )


def learn_patterns(
    motions: Motions, of: Indices, labels: Sequence[float] | None, settings: AugmentedSettings
) -> tuple[Pattern, ...]:
    """Learn the patterns of R motions, the index (R,) of the pattern of each, and perhaps the label of each pattern."""
    starts, poses = motions.starts, motions.poses(settings.turn_length * motions.extent)
    at_knots = _at_knots(poses, motions.extent, settings)
    points, turns = np.split(at_knots, [starts.shape[1]], axis=2)
    turns = turns - (1 - _phases(turns.shape[1])[:, None]) ** 2 * turns[:, -1:]  # the ends are moved to the goal's
    scatter = float(np.sqrt(((starts - starts.mean(axis=0)) ** 2).sum(axis=1).mean()))
    spread = max(scatter, settings.min_spread * motions.extent)
    profiles = np.stack([_profile(*each, settings.num_timed) for each in zip(motions.times, poses, strict=True)])
    paces = [np.log(t[-1] / np.sqrt(arc_length(path)[-1])) for t, path in zip(motions.times, at_knots, strict=True)]
    timing = np.column_stack([paces, profiles])
    patterns = []
    for index in range(int(of.max()) + 1):
        own = of == index
        usual, turn = timing[own].mean(axis=0), turns[own].mean(axis=0)
        local = settings.time_width, settings.time_jitter
        turn_noise = _turn_noise(starts[own], turns[own], spread, motions.extent, settings)
        patterns.append(
            Pattern(
                None if labels is None else labels[index],
                *_predictor(points[own], spread, settings.knot_error * motions.extent, settings),
                usual[1:],
                float(usual[0]),
                StartProcess.of(starts[own], timing[own] - usual, spread, settings.width, settings.time_noise, *local),
                turn if motions.turns else None,
                StartProcess.of(starts[own], turns[own] - turn, spread, settings.width, turn_noise, *local)
                if motions.turns
                else None,
            )
        )
    return tuple(patterns)


def _turn_noise(starts: Array, turns: Array, spread: float, extent: float, settings: AugmentedSettings) -> float:
    """The variance of turns (R, K, 3) that the starts (R, d) do not explain; see `AugmentedSettings.turn_noises`."""
    if len(starts) < 3 or not turns.size:
        return settings.time_noise
    kernel = (process := StartProcess.of(starts, turns, spread, settings.width, 1.0))._kernel(process.known)
    least, logs = settings.knot_error * extent, []
    for noise in settings.turn_noises:
        _, residual = _kriging(kernel + noise * np.eye(len(starts)))
        logs.append(_log_likelihood(_left_out(residual, np.tensordot(residual, turns, 1)), least, settings))
    likely = np.exp(np.array(logs) - max(logs))
    return float(np.exp(np.average(np.log(settings.turn_noises), weights=likely)))


def _kriging(kernel: Array) -> tuple[Array, Array]:
    """Weights (R,) of R values in their unknown mean, and what (R, R) makes coefficients of values."""
    inverse = np.linalg.inv(kernel)
    weights = inverse.sum(axis=0) / inverse.sum()
    return weights, inverse - np.outer(inverse.sum(axis=0), weights)


def _left_out(residual: Array, coefficients: Array) -> Array:
    """RMS distances (R,) of values (K, d) from what the others make of them, by the coefficients (R, K, d) of all."""
    return np.sqrt((coefficients**2).sum(axis=2).mean(axis=1)) / np.diag(residual)


def _log_likelihood(missed: Array, least: float, settings: AugmentedSettings) -> float:
    """Log likelihood of a predictor that misses values by so much (R,), metres, and by `least` at any rate."""
    return -settings.evidence * len(missed) * float(np.log(missed.mean() + least))


def _predictor(
    points: Array, spread: float, least: float, settings: AugmentedSettings
) -> tuple[Array, Array, float, StartProcess]:
    """Mean, fading, its reach and shapes of a pattern: the mean of all predictors that are tried.

    A predictor is ordinary kriging: what is left of the demonstrations `points` (R, K, d) without their fading offsets
    is an unknown mean plus a Gaussian process over the starts, whose spread is given, metres. What it makes of each
    demonstration from the others is known in closed form, and its likelihood falls with the mean of these errors, of
    which a `least` one, metres, counts as none.
    """
    num, u, reach = len(points), _phases(points.shape[1]), settings.reach * spread
    process = StartProcess.of(points[:, 0], points, spread, settings.width, settings.noise)
    offsets = points[:, 0] - process.mean
    near = _near(offsets, reach)
    if num == 1:  # nothing is known of other starts
        return points[0], u, reach, replace(process, coefficients=np.zeros_like(points))
    found, logs = [], []
    for explained in settings.explained:
        gain = explained / settings.noise
        weights, residual = _kriging(gain * process._kernel(process.known) + np.eye(num))
        for power in settings.fadings:
            fading = u**power
            left = u + (fading - u) * near[:, None]
            shapes = points - left[:, :, None] * offsets[:, None]
            coefficients = np.tensordot(residual, shapes, 1)
            logs.append(_log_likelihood(_left_out(residual, coefficients), least, settings))
            found.append((np.tensordot(weights, shapes, 1), fading, gain * coefficients))
    likely = np.exp(np.array(logs) - max(logs))
    mean, fading, coefficients = (
        np.tensordot(likely / likely.sum(), np.stack(values), 1) for values in zip(*found, strict=True)
    )
    return mean, fading, reach, replace(process, coefficients=coefficients)


def _phases(num: int) -> Array:
    """The part u of the phase that is left at `num` knots of a motion, from its start."""
    return np.linspace(1.0, 0.0, num)


def _near(offsets: Array, reach: float) -> Array:
    """How near starts are that are `offsets` (*B, d) off the mean one, (*B,), from 1 there to 0 far away."""
    return np.exp(-(offsets**2).sum(axis=-1) / (2 * reach**2))


def _at_knots(poses: Sequence[Array], extent: float, settings: AugmentedSettings) -> Array:
    """Poses (T_i, d) of demonstrations at as few knots as they are followed by, (R, K, d)."""
    num = settings.min_knots
    while True:
        points = np.stack([resample_by_arc_length(path, 5 * num) for path in poses])
        even, knots = np.linspace(0.0, 1.0, points.shape[1]), np.linspace(0.0, 1.0, num)
        at_knots = np.stack([interpolate(knots, even, path) for path in points])
        between = PhaseCurve.through(knots, at_knots.swapaxes(0, 1)).at(even).swapaxes(0, 1)
        missed = np.linalg.norm(between - points, axis=-1).mean(axis=1).max()
        if missed <= settings.knot_error * extent or 2 * num > settings.max_knots:
            return at_knots
        num *= 2


def _profile(times: Array, path: Array, num: int) -> Array:
    """The part of a motion's length that lies behind at `num` even times."""
    length = arc_length(path)
    return np.interp(np.linspace(0, times[-1], num), times, length / length[-1])


def patterns_of(points: Array, num: int) -> Indices:
    """Tell motions (R, n, d), evenly sampled along each, apart by their shapes, wherever they begin.

    Returns the index (R,) of the pattern of each, `num` patterns at most, in the order in which they come first.
    """
    groups = groups_of(_without_start(points), num)
    first = list(dict.fromkeys(groups))
    return np.array([first.index(group) for group in groups])


def set_apart(points: Array, of: Indices, least: float) -> bool:
    """Whether motions (R, n, d) of different patterns (R,) differ `least` times as much as those of one pattern do.

    See `AugmentedSettings.apart`. It plays no part where motions begin.
    """
    shapes = _without_start(points)
    apart, same = np.linalg.norm(shapes[:, None] - shapes, axis=-1).mean(axis=-1), of[:, None] == of
    return bool(apart[~same].min(initial=np.inf) >= least * apart[same].max())


def _without_start(points: Array) -> Array:
    """Motions (R, n, d) without an offset of their starts that fades."""
    return points - np.linspace(1.0, 0.0, points.shape[1])[:, None] * points[:, :1]


def told_by_starts(starts: Array, of: Indices, least: float) -> bool:
    """Whether starts (R, d), metres, are nearest to one of their own pattern `of` (R,), if it has several.

    Those of different patterns must be at least a distance `least` apart, metres.
    """
    apart = np.linalg.norm(starts[:, None] - starts, axis=-1) + np.diag(np.full(len(starts), np.inf))
    several = np.bincount(of)[of] > 1
    own = (of[apart.argmin(axis=1)] == of)[several]
    return bool(own.all() and apart[of[:, None] != of].min(initial=np.inf) >= least)
