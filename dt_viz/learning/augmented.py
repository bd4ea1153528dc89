"""Imitation in an augmented state (y, s): a motion is predicted for its start, and followed by its phase s.

Plain imitation is one field in R^d, in which no two motions cross and none comes back to a place. Here the state is
the place y, the phase s, from s_max at the start to 0 at the goal, and, constant along a motion, its condition a: where
it started, and a label if there is one. The motion c(s; a) predicted for a is

    c(u s_max; a) = mean(u) + u (start − mean(1)) + GP(a)(u),

the mean demonstration, an offset that fades, and a Gaussian process over the starts. The shear along it
(see `flows.augmented_systems`) is ψ; the base system runs s down on a clock that is predicted for a, too. Where
demonstrations fall into groups of different shapes, each has a mean and a process of its own, and a start follows the
group that begins nearest: for each a ψ is a diffeomorphism of (y, s), but from group to group it jumps with a.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from numbers import Real
from typing import TypeVar

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.augmented_systems import PhaseCurve, PhasedAttractor, Shear
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem, asinh_exp, log_sinh
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.initial_guess import groups_of
from dt_viz.learning.preparation import ImitationError, Motions, prepare
from dt_viz.learning.timing import ARRIVED, TimedAttractor
from dt_viz.metrics import arc_length, interpolate

FEWEST_KNOTS, MOST_KNOTS, POINTS_PER_KNOT = 30, 240, 5
"""Smallest and largest number of knots of a predicted motion, and number of points of a demonstration for each."""
KNOT_ERROR = 0.003
"""Mean distance of a demonstration from the curve through its knots, relative to the extent, up to which these are
enough; handwriting stays below 0.1 % with the fewest."""
TOP = 0.5
"""s_max relative to the extent of the demonstrations."""
SMALLEST_SPREAD = 0.04
"""Smallest spread of the starts, relative to the extent: starts nearer to each other teach nothing of what they do."""
WIDTH, NOISE = 2.0, 0.6
"""Width of the kernel over the starts, in their spreads, and variance of what it does not explain, relative to it."""
LABEL_SPREAD, LABEL_VARIANCE = 3.0, 100.0
"""Distance of labels that differ by 1, in spreads of the starts, and variance of what the label alone explains wherever
a motion begins, relative to that of what the starts explain."""
TIME_NOISE, TIME_WIDTH, JITTER = 1.0, 0.1, 0.02
"""Variance of the clocks that the starts do not explain, width of the kernel that it has instead of being noise, so
that a demonstration's own start has its own timing, in spreads, and the part of it that remains noise."""
NUM_PACES, NUM_TIMED = 80, 120
"""Number of knots of a clock, and number of samples of a demonstration that it is learned from."""
CAUGHT_WITHIN, LEAST_PHASE, NUM_CAUGHT = 0.15, 0.05, 61
"""Largest change of the phase of a motion that is pushed, and the least phase that it gets, relative to s_max, and
number of phases that are compared."""
AWAY, LEAST_EXPECTED = 1.2, 0.03
"""Distance of the starts for which motions are predicted from the mean one, in standard deviations along a principal
axis, and the least such deviation, relative to the extent."""
SHORTEST = 0.1
"""Least length of a motion that its clock is predicted for, relative to that of the mean: from the goal to the goal a
motion still takes some time."""
SLOWEST = 2e-3
"""Smallest speed of the phase, relative to the mean: it never stands still."""
NUM_KEPT = 64
"""Number of conditions whose curves and clocks are kept."""
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class OverStarts:
    """A Gaussian process over conditions: the mean of what it was given, and how it changes with the condition."""

    mean: Array
    """(k,) mean of the conditions."""
    spread: float
    """RMS distance of the conditions from their mean, or a larger one."""
    known: Array
    """(R, k) conditions, less their mean, in spreads."""
    coefficients: Array
    """(R, …)."""
    noise: float
    narrow: float | None
    """Width of the kernel of the noise, in spreads; None for noise of each condition by itself."""
    dim: int
    """Number of the first coordinates of a condition, those of a place; what follows is a label."""

    @classmethod
    def of(
        cls, conditions: Array, values: Array, *, dim: int, spread: float, noise: float, narrow: float | None = None
    ) -> OverStarts:
        """Learn `values` (R, …) of `conditions` (R, k)."""
        mean = conditions.mean(axis=0)
        known = (conditions - mean) / spread
        own = JITTER if narrow else 1.0
        made = cls(mean, spread, known, np.empty(0), noise, narrow, dim)
        kernel = made._kernel(known) + own * noise * np.eye(len(known))
        flat = np.linalg.solve(kernel, values.reshape(len(known), -1))
        return replace(made, coefficients=flat.reshape(values.shape))

    def at(self, condition: Array) -> Array:
        """The value at a condition (k,)."""
        return np.tensordot(self._kernel((condition - self.mean)[None] / self.spread)[0], self.coefficients, 1)

    def slope_at(self, condition: Array) -> Array:
        """The derivative (…, k) of the value with respect to the condition (k,); of values without a narrow kernel."""
        offset = (condition - self.mean) / self.spread - self.known
        of_place, of_label = (kernel[0] for kernel in self._kernels((condition - self.mean)[None] / self.spread))
        own = np.where(np.arange(offset.shape[1]) < self.dim, of_place[:, None], (of_place + of_label)[:, None])
        weights = -own * offset
        return np.moveaxis(np.tensordot(weights, self.coefficients, (0, 0)), 0, -1) / (WIDTH**2 * self.spread)

    def placed(self, origin: Array, axes: Array, scale: float, vectors: Array) -> OverStarts:
        """The same over conditions in a space of more dimensions, values multiplied by `vectors` (d, D) from the right.

        See `AugmentedImitation.placed` for the other arguments.
        """
        return replace(
            self,
            mean=_placed_conditions(self.mean[None], origin, axes, scale)[0],
            spread=scale * self.spread,
            known=_placed_conditions(self.known, np.zeros(len(origin)), axes, 1.0),
            dim=len(origin),
            coefficients=self.coefficients @ vectors,
        )

    def _kernel(self, at: Array) -> Array:
        of_place, of_label = self._kernels(at)
        if not self.narrow:
            return of_place + of_label
        squared = ((at[:, None] - self.known) ** 2).sum(axis=-1)
        return of_place + of_label + self.noise * np.exp(-squared / (2 * self.narrow**2))

    def _kernels(self, at: Array) -> tuple[Array, Array]:
        """What is alike of conditions `at` (N, k) and the known ones, (N, R): by place and label, and by the label."""
        squared = (at[:, None] - self.known) ** 2 / (2 * WIDTH**2)
        alike = np.exp(-squared[..., self.dim :].sum(axis=-1))
        by_label = LABEL_VARIANCE * alike if squared.shape[-1] > self.dim else np.zeros_like(alike)
        return alike * np.exp(-squared[..., : self.dim].sum(axis=-1)), by_label


@dataclass(frozen=True, eq=False)
class Pattern:
    """What demonstrations of one shape teach: the motion and the clock of any start."""

    conditions: Array
    """(R, k) of the demonstrations."""
    mean: Array
    """(K, d) mean demonstration at the knots, from the start, metres."""
    shapes: OverStarts
    """(K, d) offsets from the mean and its fading shift."""
    profile: Array
    """(P,) mean part of the length that lies behind at even times."""
    duration: float
    """Mean logarithm of the duration of motions a metre long, seconds."""
    timing: OverStarts
    """(1 + P,) offsets from that logarithm, and from the profile."""

    def placed(self, origin: Array, axes: Array, scale: float) -> Pattern:
        """See `AugmentedImitation.placed`."""
        return replace(
            self,
            conditions=_placed_conditions(self.conditions, origin, axes, scale),
            mean=origin + scale * self.mean @ axes.T,
            shapes=self.shapes.placed(origin, axes, scale, scale * axes.T),
            duration=self.duration - np.log(scale) / 2,
            timing=self.timing.placed(origin, axes, scale, np.eye(len(self.profile) + 1)),
        )


@dataclass(frozen=True, eq=False)
class AugmentedImitation:
    """A learned motion in the augmented state, for any start: what `dt_viz.flows.augmented_systems.Predictions` are."""

    starts: Array
    """(R, d) of the demonstrations, metres."""
    goal: Array
    """(d,) common end of the demonstrations, metres."""
    labels: tuple[float, ...] | None
    """One for each demonstration that was given; None without labels."""
    top: float
    """s_max, metres."""
    power: float
    """p of the base system."""
    patterns: tuple[Pattern, ...]
    plain_clock: TimedAttractor
    """Clock of the phase, without the pace that is predicted for a start."""
    fit_seconds: float
    warnings: tuple[str, ...] = ()
    reason: str = ""
    """Why it was learned in this state, where that was not asked for; see `dt_viz.learning.state`."""
    _of_starts: Array | None = field(default=None, repr=False)
    """(R,) labels of the starts."""
    _label_unit: float = field(default=1.0, repr=False)
    """Distance of labels that differ by 1, metres."""

    @property
    def dim(self) -> int:
        """Dimension d of the places."""
        return len(self.goal)

    @property
    def known_labels(self) -> tuple[float, ...]:
        """The different labels, increasing; none without labels."""
        return () if self._of_starts is None else tuple(float(label) for label in np.unique(self._of_starts))

    @property
    def num_conditions(self) -> int:
        """Number of coordinates of a condition: those of the start, and the label if there is one."""
        return self.dim + (self._of_starts is not None)

    @cached_property
    def system(self) -> DiffeomorphicSystem:
        """The learned dynamical system, of states (y, s, a)."""
        base = PhasedAttractor(
            goal=np.zeros(self.dim + 1 + self.num_conditions),
            speed=self.plain_clock.speed,
            smoothing=self.plain_clock.smoothing,
            predictions=self,
            power=self.power,
        )
        return DiffeomorphicSystem(Shear(self), base)

    def states(self, places: Array, label: float | None = None) -> Array:
        """The states (*B, d + 1 + c) in which motions from places (*B, d), metres, begin.

        Args:
            places: metres.
            label: of the motions; None takes that of the demonstrated start which is nearest to each.

        Raises:
            FormatError: no demonstration has such a label.
        """
        top = np.full((*places.shape[:-1], 1), self.top)
        parts = [places, top, places]
        if label is not None and label not in self.known_labels:
            raise unknown_label(label, self.known_labels)
        if self._of_starts is not None:
            nearest = np.linalg.norm(places[..., None, :] - self.starts, axis=-1).argmin(axis=-1)
            labels = self._of_starts[nearest][..., None] if label is None else np.full_like(top, label)
            parts.append(self._label_unit * labels)
        return np.concatenate(parts, axis=-1)

    def demonstrated(self, starts: Array) -> Array:
        """The states (R, d + 1 + c) in which the motions of all demonstrations begin, from their starts (R, d)."""
        if self.labels is None:
            return self.states(starts)
        known = self.known_labels
        labels = [label if label in known else None for label in self.labels]
        return np.stack([self.states(start, label) for start, label in zip(starts, labels, strict=True)])

    def caught(self, state: Array) -> float:
        """The phase, metres, at which a motion goes on that was pushed to a `state` (d + 1 + c,).

        It is the one, not far from that of the state, at which the predicted motion is nearest: so what it has not
        drawn yet is drawn.
        """
        place, phase, condition = state[: self.dim], state[self.dim], state[self.dim + 1 :]
        reach = CAUGHT_WITHIN * self.top
        first, last = np.clip((phase - reach, phase + reach), LEAST_PHASE * self.top, self.top)
        phases = np.linspace(first, last, NUM_CAUGHT)
        away = np.linalg.norm(self.curve(condition).at(phases) - place, axis=1)
        return float(phases[away.argmin()])

    def curve(self, condition: Array) -> PhaseCurve:
        """The motion (d,), metres, that is predicted for a condition (c,), over the phase."""
        return self._curves(condition.tobytes())

    def sensitivity(self, condition: Array) -> PhaseCurve:
        """Its derivative (d, c) with respect to the condition."""
        pattern = self._pattern(condition)
        slopes = pattern.shapes.slope_at(condition)
        slopes[..., : self.dim] += self._phases(pattern)[:, None, None] * np.eye(self.dim)
        return PhaseCurve.through(self.top * self._phases(pattern)[::-1], slopes[::-1])

    def clock(self, condition: Array) -> TimedAttractor:
        """The clock of the phase that is predicted for a condition (c,)."""
        return self._clocks(condition.tobytes())

    def placed(self, origin: Array, axes: Array, scale: float) -> AugmentedImitation:
        """The same motions in a space of more dimensions: a place y becomes origin + scale·axes·y.

        Args:
            origin: (D,), metres.
            axes: (D, d) orthonormal columns.
            scale: metres for one unit of y.
        """
        return replace(
            self,
            starts=origin + scale * self.starts @ axes.T,
            goal=origin + scale * axes @ self.goal,
            top=scale * self.top,
            patterns=tuple(pattern.placed(origin, axes, scale) for pattern in self.patterns),
            plain_clock=replace(
                self.plain_clock, speed=scale * self.plain_clock.speed, smoothing=scale * self.plain_clock.smoothing
            ),
            _label_unit=scale * self._label_unit,
        )

    @cached_property
    def _curves(self) -> Callable[[bytes], PhaseCurve]:
        return _kept(self._curve)

    @cached_property
    def _clocks(self) -> Callable[[bytes], TimedAttractor]:
        return _kept(self._clock)

    def _pattern(self, condition: Array) -> Pattern:
        """That of the demonstration with the nearest condition."""
        nearest = [np.linalg.norm(condition - pattern.conditions, axis=1).min() for pattern in self.patterns]
        return self.patterns[int(np.argmin(nearest))]

    def _phases(self, pattern: Pattern) -> Array:
        return np.linspace(1.0, 0.0, len(pattern.mean))

    def _points(self, condition: Array) -> Array:
        """The predicted motion at the knots, from its start, (K, d)."""
        pattern = self._pattern(condition)
        offset = condition[: self.dim] - pattern.mean[0]
        return pattern.mean + self._phases(pattern)[:, None] * offset + pattern.shapes.at(condition)

    def _curve(self, condition: Array) -> PhaseCurve:
        points = self._points(condition)
        return PhaseCurve.through(self.top * np.linspace(0.0, 1.0, len(points)), points[::-1])

    def _clock(self, condition: Array) -> TimedAttractor:
        pattern = self._pattern(condition)
        length, usual = (float(arc_length(points)[-1]) for points in (self._points(condition), pattern.mean))
        return self._timed(pattern, condition, max(length, SHORTEST * usual))

    def _timed(self, pattern: Pattern, condition: Array, length: float) -> TimedAttractor:
        """The clock of a motion of a length, metres."""
        duration, *profile = pattern.timing.at(condition)
        behind = np.maximum.accumulate(np.clip(pattern.profile + np.array(profile), 0.0, 1.0))
        behind[0], behind[-1] = 0.0, 1.0
        even = np.linspace(0.0, 1.0, len(behind))
        behind = (1 - SLOWEST) * behind + SLOWEST * even
        # as the clock of a phase that falls evenly advances, time passes at these paces
        plain = self.plain_clock
        left = plain.smoothing * asinh_exp(plain.knots * plain.speed / plain.smoothing) / self.top
        total = np.exp(pattern.duration + duration) * np.sqrt(length)
        elapsed = total * np.interp(1 - (left - ARRIVED) / (1 - ARRIVED), behind, even)
        paces = np.maximum(-np.gradient(elapsed, plain.knots), SLOWEST)
        paces *= total / ((paces[1:] + paces[:-1]) / 2 * np.diff(plain.knots)).sum()
        return replace(plain, paces=paces[None])


def fit_augmented(
    demonstrations: Sequence[Demonstration], labels: Sequence[float] | None = None, *, power: float = 3.0
) -> AugmentedImitation:
    """Learn motions in the augmented state.

    Args:
        demonstrations: at least one, all ending at (about) the same place.
        labels: a number for each demonstration, where they differ although they begin at one place; usually from −1
            to 1.
        power: p of the base system.

    Raises:
        ImitationError: nothing can be learned from these demonstrations, or there are not as many labels.
    """
    given = None if labels is None else checked_labels(labels, len(demonstrations))
    return augmented_from(prepare(demonstrations), given, power=power)


def unknown_label(label: float, known: tuple[float, ...]) -> FormatError:
    """The error about a label that no demonstration has."""
    accepted = ", ".join(f"{value:g}" for value in known) or "none: the demonstrations have none"
    return FormatError("label", f"{label!r}", accepted)


def checked_labels(labels: Sequence[float], num: int) -> tuple[float, ...]:
    """The labels of `num` demonstrations as numbers.

    Raises:
        ImitationError: there are more or fewer, or one is no finite number.
    """
    if len(labels) != num:
        raise ImitationError(f"labels: found {len(labels)}; accepted: {num}, one for each demonstration")
    if not all(isinstance(label, Real) and np.isfinite(float(label)) for label in labels):
        raise ImitationError(f"labels: found {list(labels)}; accepted: finite numbers")
    return tuple(float(label) for label in labels)


def augmented_from(
    motions: Motions, labels: Sequence[float] | None = None, *, power: float = 3.0
) -> AugmentedImitation:
    """Learn prepared motions in the augmented state; `labels` are those of all demonstrations, also of those left out.

    See `fit_augmented`.
    """
    began = time.perf_counter()
    starts = np.stack([path[0] for path in motions.positions])
    scatter = float(np.sqrt(((starts - starts.mean(axis=0)) ** 2).sum(axis=1).mean()))
    spread = max(scatter, SMALLEST_SPREAD * motions.extent)
    unit, top, kept = LABEL_SPREAD * spread, TOP * motions.extent, None
    conditions, (points, at_knots) = starts, _at_knots(motions)
    if labels is None:
        group = groups_of((points - points.mean(axis=(0, 1))) / motions.spread)
    else:
        kept = np.array([labels[number] for number in motions.numbers], dtype=float)
        conditions, group = np.column_stack([starts, unit * kept]), np.zeros(len(starts), dtype=int)
    durations = np.array([t[-1] for t in motions.times])
    clock = _plain_clock(top, float(durations.mean()))
    profiles = np.stack([_profile(*motion) for motion in zip(motions.times, motions.positions, strict=True)])
    lengths = np.array([arc_length(path)[-1] for path in at_knots])
    patterns = []
    for number in range(int(group.max()) + 1):
        of = group == number
        patterns.append(
            _pattern(conditions[of], at_knots[of], np.log(durations[of] / np.sqrt(lengths[of])), profiles[of], spread)
        )
    seconds = time.perf_counter() - began
    return AugmentedImitation(
        starts,
        motions.goal,
        None if labels is None else tuple(labels),
        top,
        power,
        tuple(patterns),
        clock,
        seconds,
        motions.warnings,
        _of_starts=kept,
        _label_unit=unit,
    )


def expected_motions(motions: Motions) -> list[Array]:
    """Motions (n, d), metres, that are predicted for starts on both sides of the mean one, along each principal axis.

    They tell a fit that knows places alone what to do between demonstrations and beside them.
    """
    imitation, found = augmented_from(motions), []
    for pattern in imitation.patterns:
        starts = pattern.conditions
        axes = motions.principal_axes(starts, starts.mean(axis=0) - motions.goal)
        widths = np.maximum((starts @ axes).std(axis=0), LEAST_EXPECTED * motions.extent)
        for offset in (AWAY * widths * axes).T:
            for start in (starts.mean(axis=0) + offset, starts.mean(axis=0) - offset):
                curve = imitation.curve(start)
                found.append(curve.at(np.linspace(imitation.top, 0, POINTS_PER_KNOT * len(curve.spline.x))))
    return found


def _pattern(conditions: Array, points: Array, durations: Array, profiles: Array, spread: float) -> Pattern:
    dim = points.shape[-1]
    fading = np.linspace(1.0, 0.0, points.shape[1])[:, None]
    mean = points.mean(axis=0)
    rest = points - mean - fading * (points[:, :1] - mean[0])
    timing = np.column_stack([durations - durations.mean(), profiles - profiles.mean(axis=0)])
    return Pattern(
        conditions,
        mean,
        OverStarts.of(conditions, rest, dim=dim, spread=spread, noise=NOISE),
        profiles.mean(axis=0),
        float(durations.mean()),
        OverStarts.of(conditions, timing, dim=dim, spread=spread, noise=TIME_NOISE, narrow=TIME_WIDTH),
    )


def _at_knots(motions: Motions) -> tuple[Array, Array]:
    """Demonstrations at even points along each (R, n, d), and at as few knots as they are followed by (R, K, d)."""
    num = FEWEST_KNOTS
    while True:
        points = motions.resampled(POINTS_PER_KNOT * num)
        even, knots = np.linspace(0.0, 1.0, points.shape[1]), np.linspace(0.0, 1.0, num)
        at_knots = np.stack([interpolate(knots, even, path) for path in points])
        between = PhaseCurve.through(knots, at_knots.swapaxes(0, 1)).at(even).swapaxes(0, 1)
        missed = np.linalg.norm(between - points, axis=-1).mean(axis=1).max()
        if missed <= KNOT_ERROR * motions.extent or 2 * num > MOST_KNOTS:
            return points, at_knots
        num *= 2


def _plain_clock(top: float, duration: float) -> TimedAttractor:
    """The clock on which every pace is 1, for phases up to `top`."""
    plain = Attractor(np.zeros(1), speed=top / duration, smoothing=0.1 * top)
    nearest, farthest = (
        plain.smoothing / plain.speed * float(log_sinh(np.array(part * top / plain.smoothing)))
        for part in (ARRIVED, 1.0)
    )
    knots = np.linspace(nearest, farthest, NUM_PACES)
    return TimedAttractor(
        plain.goal,
        plain.speed,
        plain.smoothing,
        directions=np.ones((1, 1)),
        knots=knots,
        paces=np.ones((1, NUM_PACES)),
    )


def _profile(times: Array, path: Array) -> Array:
    """The part of a motion's length that lies behind at even times, (P,)."""
    length = arc_length(path)
    return np.interp(np.linspace(0, times[-1], NUM_TIMED), times, length / length[-1])


def _placed_conditions(conditions: Array, origin: Array, axes: Array, scale: float) -> Array:
    """Conditions (R, c) whose first coordinates are a place, in a space of more dimensions; see `placed`."""
    dim = axes.shape[1]
    return np.column_stack([origin + scale * conditions[:, :dim] @ axes.T, scale * conditions[:, dim:]])


def _kept(compute: Callable[[Array], _T]) -> Callable[[bytes], _T]:
    """A function of a condition's bytes whose latest results are kept."""
    return lru_cache(NUM_KEPT)(lambda content: compute(np.frombuffer(content)))
