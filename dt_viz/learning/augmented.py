"""Imitation in an augmented state (y, s): a motion is predicted for its start, and followed by its phase s.

Plain imitation is one field in R^d, in which no two motions cross and none comes back to a place. Here the state is
the place y, the phase s, from s_max at the start to 0 at the goal, and, constant along a motion, its condition a: where
it started, and the index of its pattern. The shear along the motion c(s; a) that this pattern predicts for the start
(see `dt_viz.learning.patterns` and `dt_viz.flows.augmented_systems`) is ψ; the base system runs s down on a clock that
is predicted for a, too. For each a ψ is a diffeomorphism of (y, s); from pattern to pattern it jumps.

A start follows the pattern of the demonstration that begins nearest, or that of its label.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from typing import ClassVar, TypeVar

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.augmented_systems import PhaseCurve, PhasedAttractor, Shear
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rotations import exponential, nearest, turned
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem, asinh_exp, log_sinh
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.initial_guess import groups_of
from dt_viz.learning.interface import AnyImitation, State
from dt_viz.learning.patterns import AugmentedSettings, Pattern, learn_patterns, patterns_of, set_apart, told_by_starts
from dt_viz.learning.preparation import ImitationError, Motions, prepare
from dt_viz.learning.timing import ARRIVED, TimedAttractor
from dt_viz.memo import cached_property
from dt_viz.metrics import arc_length

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmentedImitation(AnyImitation):
    """A learned motion in the augmented state, for any start: what `dt_viz.flows.augmented_systems.Predictions` are.

    Its states have places y, or (`poses`) poses (y, r) of the hand: the place, and the rotation vector at the goal's
    orientation times the length that a radian counts, metres. The shear takes the predicted motion of both away, so
    that what pushes the hand, or turns it, dies away along one stable system.
    """

    state: ClassVar[State] = "augmented"
    top: float  # s_max, metres
    patterns: tuple[Pattern, ...]
    pattern_of: Indices  # (R,) index of the pattern of each start
    numbers: tuple[int, ...]
    """Numbers of the demonstrations, of those that were given, that the starts are of."""
    plain_clock: TimedAttractor
    """Clock of the phase, without the pace that is predicted for a start."""
    radius: float = 0.0  # length that a turn of the hand by one radian counts, metres
    posed: bool = False  # whether the states are those of poses

    @property
    def dim(self) -> int:
        """Dimension of the places, d, or of the poses, d + 3."""
        return len(self.goal) + 3 * self.posed

    @cached_property
    def poses(self) -> AugmentedImitation | None:
        """The motions of the hand's pose, whose places are these; None of motions without orientations."""
        return None if self.goal_orientation is None else replace(self, posed=True)

    @property
    def known_labels(self) -> tuple[float, ...]:
        return tuple(sorted(pattern.label for pattern in self.patterns if pattern.label is not None))

    @property
    def num_conditions(self) -> int:
        """Number of coordinates of a condition: those of the start, and the index of the pattern."""
        return len(self.goal) + 1

    @property
    def base(self) -> PhasedAttractor:
        """The base system of states (y, s, a)."""
        return PhasedAttractor(
            goal=np.zeros(self.dim + 1 + self.num_conditions),
            speed=self.plain_clock.speed,
            smoothing=self.plain_clock.smoothing,
            predictions=self,
            power=self.augmented.power,
        )

    @cached_property
    def system(self) -> DiffeomorphicSystem:
        """The learned dynamical system, of states (y, s, a)."""
        return DiffeomorphicSystem(Shear(self), self.base)

    def system_in(self, origin: Array, axes: Array, scale: float) -> DiffeomorphicSystem:
        return self.placed(origin, axes[:, : len(self.goal)], scale).system

    def states(self, places: Array, label: float | None = None) -> Array:
        """The states (*B, dim + 1 + c) in which motions from places or poses (*B, dim), metres, begin.

        The label is that of the motions; None takes the pattern of the demonstrated start which is nearest to each.

        Raises:
            FormatError: no demonstration has such a label.
        """
        top, starts = np.full((*places.shape[:-1], 1), self.top), places[..., : len(self.goal)]
        if label is None:
            closest = np.linalg.norm(starts[..., None, :] - self.starts, axis=-1).argmin(axis=-1)
            pattern = self.pattern_of[closest][..., None]
        else:
            known = [pattern.label for pattern in self.patterns]
            if label not in known:
                raise unknown_label(label, self.known_labels)
            pattern = np.full_like(top, known.index(label))
        return np.concatenate([places, top, starts, pattern], axis=-1)

    def demonstrated(self, starts: Array) -> Array:
        """The states (R, dim + 1 + c) in which the motions of all demonstrations begin, from their starts (R, dim)."""
        states = self.states(starts)
        states[list(self.numbers), -1] = self.pattern_of
        return states

    def caught(self, state: Array) -> float:
        """The phase, metres, at which a motion goes on that was pushed to a `state` (dim + 1 + c,).

        It is the one, not far from that of the state, at which the predicted motion is nearest: so what it has not
        drawn yet is drawn. A turn of the hand does not change it.
        """
        d, phase, condition = len(self.goal), state[self.dim], state[self.dim + 1 :]
        reach = self.augmented.caught_within * self.top
        first, last = np.clip((phase - reach, phase + reach), self.augmented.caught_above * self.top, self.top)
        phases = np.linspace(first, last, 61)
        away = np.linalg.norm(self.curve(condition).at(phases)[:, :d] - state[:d], axis=1)
        return float(phases[away.argmin()])

    def curve(self, condition: Array) -> PhaseCurve:
        """The motion (dim,), metres, that is predicted for a condition (c,), over the phase."""
        return self._curves(condition.tobytes())

    def sensitivity(self, condition: Array) -> PhaseCurve:
        """Its derivative (dim, c) with respect to the condition; that with respect to the pattern is 0."""
        pattern, start = self.pattern(condition), condition[:-1]
        slopes = pattern.pose_slopes(start) if self.posed else pattern.slopes(start)
        return self.over_phase(np.concatenate([slopes, np.zeros_like(slopes[..., :1])], axis=-1))

    def clock(self, condition: Array) -> TimedAttractor:
        """The clock of the phase that is predicted for a condition (c,)."""
        return self._clocks(condition.tobytes())

    def predicted(self, rest: Array) -> Array:
        """Orientations (N, 4), wxyz, that are predicted for phases and conditions (N, 1 + c), of poses."""
        still = np.zeros((len(rest), self.dim))  # poses in base space: nothing leads off the motion
        return self.orientations(self.system.transform.inverse(np.hstack([still, rest]))[:, self.dim - 3 : self.dim])

    def orientations(self, turns: Array) -> Array:
        """Orientations (*B, 4), wxyz, of the coordinates r (*B, 3) of poses."""
        assert self.goal_orientation is not None
        return exponential(self.goal_orientation, turns / self.radius)

    def turns(self, orientations: Array, near: Array) -> Array:
        """The coordinates r (N, 3) of orientations (N, 4), wxyz, of poses: of all of one, those nearest to `near`."""
        assert self.goal_orientation is not None
        pairs = zip(near / self.radius, orientations, strict=True)
        return self.radius * np.stack([nearest(self.goal_orientation, turned, to) for to, turned in pairs])

    def placed(self, origin: Array, axes: Array, scale: float) -> AugmentedImitation:
        """The same motions in R^D, where a place y becomes origin + scale·axes·y, metres, axes (D, d) orthonormal."""
        return replace(
            self,
            starts=origin + scale * self.starts @ axes.T,
            goal=origin + scale * axes @ self.goal,
            radius=scale * self.radius,
            goal_orientation=None if self.goal_orientation is None else turned(axes, self.goal_orientation),
            top=scale * self.top,
            patterns=tuple(pattern.placed(origin, axes, scale) for pattern in self.patterns),
            plain_clock=replace(
                self.plain_clock, speed=scale * self.plain_clock.speed, smoothing=scale * self.plain_clock.smoothing
            ),
        )

    @cached_property
    def _curves(self) -> Callable[[bytes], PhaseCurve]:
        points = Pattern.poses if self.posed else Pattern.points
        return latest(lambda condition: self.over_phase(points(self.pattern(condition), condition[:-1])))

    @cached_property
    def _clocks(self) -> Callable[[bytes], TimedAttractor]:
        return latest(self._clock)

    def pattern(self, condition: Array) -> Pattern:
        """The pattern of a condition (c,)."""
        return self.patterns[round(condition[-1])]

    def over_phase(self, values: Array) -> PhaseCurve:
        """Values (K, …) at the knots, from the start, over the phase."""
        return PhaseCurve.through(self.top * np.linspace(0.0, 1.0, len(values)), values[::-1])

    def _clock(self, condition: Array) -> TimedAttractor:
        pattern, start, slowest = self.pattern(condition), condition[:-1], self.augmented.min_pace
        length, usual = (float(arc_length(points)[-1]) for points in (pattern.poses(start), pattern.mean_pose))
        length = max(length, self.augmented.min_length * usual)
        duration, *profile = pattern.timing.at(start)
        behind = np.maximum.accumulate(np.clip(pattern.profile + np.array(profile), 0.0, 1.0))
        behind[0], behind[-1] = 0.0, 1.0
        even = np.linspace(0.0, 1.0, len(behind))
        behind = (1 - slowest) * behind + slowest * even
        # as the clock of a phase that falls evenly advances, time passes at these paces
        plain = self.plain_clock
        left = plain.smoothing * asinh_exp(plain.knots * plain.speed / plain.smoothing) / self.top
        total = np.exp(pattern.duration + duration) * np.sqrt(length)
        elapsed = total * np.interp(1 - (left - ARRIVED) / (1 - ARRIVED), behind, even)
        paces = np.maximum(-np.gradient(elapsed, plain.knots), slowest)
        paces *= total / ((paces[1:] + paces[:-1]) / 2 * np.diff(plain.knots)).sum()
        return replace(plain, paces=paces[None])


def fit_augmented(
    demonstrations: Sequence[Demonstration],
    labels: Sequence[float] | None = None,
    settings: AugmentedSettings | None = None,
    reason: str = "",
) -> AugmentedImitation:
    """Learn motions to (about) the same goal in the augmented state, with as few patterns as they show.

    Labels are a number for each demonstration; those with one number are of one pattern. None tells patterns apart, and
    labels them where their starts do not: evenly, 2 apart, around 0, in the order in which they come. For the reason,
    see `AnyImitation`.

    Raises:
        ImitationError: nothing can be learned from these demonstrations, or there are not as many labels.
    """
    began, settings = time.perf_counter(), settings or AugmentedSettings()
    given = None if labels is None else _checked(labels, len(demonstrations))
    motions = prepare(demonstrations, settings.preparation)
    if given is not None:
        known, of = np.unique([given[number] for number in motions.numbers], return_inverse=True)
        imitation = _with_patterns(motions, of, known.tolist(), settings)
        off = _missed(imitation, motions)
    else:
        imitation, off = with_found_patterns(motions, settings)
        if imitation.known_labels:
            of_number = dict(zip(imitation.numbers, imitation.pattern_of, strict=True))
            given = tuple(imitation.patterns[of_number.get(k, 0)].label or 0.0 for k in range(len(demonstrations)))
    warnings = imitation.warnings
    if off > settings.max_missed:
        warnings = (*warnings, f"a motion misses its demonstration by {100 * off:.0f} % of the extent")
    return replace(imitation, labels=given, warnings=warnings, reason=reason, fit_seconds=time.perf_counter() - began)


def latest(compute: Callable[[Array], _T]) -> Callable[[bytes], _T]:
    """A function of a condition's bytes whose latest results are kept."""
    return lru_cache(64)(lambda content: compute(np.frombuffer(content)))


def unknown_label(label: float, known: tuple[float, ...]) -> FormatError:
    """The error about a label that no demonstration has."""
    accepted = ", ".join(f"{value:g}" for value in known) or "none: the demonstrations have none"
    return FormatError("label", f"{label!r}", accepted)


def _checked(labels: Sequence[float], num: int) -> tuple[float, ...]:
    """The labels of `num` demonstrations as numbers. Raises ImitationError where they are not."""
    if len(labels) != num:
        raise ImitationError(f"labels: found {len(labels)}; accepted: {num}, one for each demonstration")
    if not all(isinstance(label, Real) and np.isfinite(float(label)) for label in labels):
        raise ImitationError(f"labels: found {list(labels)}; accepted: finite numbers")
    return tuple(float(label) for label in labels)


def with_found_patterns(motions: Motions, settings: AugmentedSettings) -> tuple[AugmentedImitation, float]:
    """Learn motions with the fewest patterns that draw them, and how far off they are; see `Motions.missed_by`."""
    points = motions.resampled() - motions.goal
    of = groups_of(points / motions.spread)
    imitation = _with_patterns(motions, of, None, settings)
    told = told_by_starts(motions.starts, of, settings.min_apart * motions.extent)
    found = [(_missed(imitation, motions) if told else 1.0, imitation)]
    for num in range(2, min(settings.max_patterns, max(2, len(points) // 2)) + 1):
        if found[-1][0] <= settings.max_missed:
            break
        of = patterns_of(points, num)
        if not set_apart(points, of, settings.apart):
            continue
        labels = [float(2 * index - of.max()) for index in range(of.max() + 1)]
        imitation = _with_patterns(motions, of, labels, settings)
        found.append((_missed(imitation, motions), imitation))
    off, imitation = min(found, key=lambda each: each[0])
    return imitation, off


def _with_patterns(
    motions: Motions, of: Indices, labels: Sequence[float] | None, settings: AugmentedSettings
) -> AugmentedImitation:
    """Learn motions whose patterns are known; see `learn_patterns`."""
    top = settings.phase_length * motions.extent
    duration = float(np.mean([times[-1] for times in motions.times]))
    return AugmentedImitation(
        starts=motions.starts,
        goal=motions.goal,
        fit_seconds=0.0,
        warnings=motions.warnings,
        augmented=settings,
        top=top,
        patterns=learn_patterns(motions, of, labels, settings),
        pattern_of=of,
        numbers=motions.numbers,
        plain_clock=_plain_clock(top, duration, settings.num_paces),
        radius=settings.turn_length * motions.extent,
        goal_orientation=motions.goal_orientation,
    )


def _missed(imitation: AugmentedImitation, motions: Motions) -> float:
    """How far the motions of their own patterns are from demonstrations; see `Motions.missed_by`."""
    states = imitation.states(motions.starts)
    states[:, -1] = imitation.pattern_of
    return motions.missed_by(imitation.system, states)


def _plain_clock(top: float, duration: float, num_knots: int) -> TimedAttractor:
    """The clock on which every pace is 1, for phases up to `top`."""
    plain = Attractor(np.zeros(1), speed=top / duration, smoothing=0.1 * top)
    nearest, farthest = (
        plain.smoothing / plain.speed * float(log_sinh(np.array(part * top / plain.smoothing)))
        for part in (ARRIVED, 1.0)
    )
    return TimedAttractor(
        plain.goal,
        plain.speed,
        plain.smoothing,
        directions=np.ones((1, 1)),
        knots=np.linspace(nearest, farthest, num_knots),
        paces=np.ones((1, num_knots)),
    )


@dataclass(frozen=True, eq=False)
class Style:
    """How a styled motion differs from a plain-handed one of the same action."""

    offsets: Array
    """(K, d) d at the knots of a motion, from its start, in units of s_max; zero at both ends, which stay."""

    @classmethod
    def between(cls, usual: AugmentedImitation, styled: AugmentedImitation) -> Style:
        """What leads from the usual motion of an action to the styled one.

        Raises:
            ImitationError: they do not have as many coordinates, or one shows several patterns: it has no mean motion.
        """
        _check(len(usual.goal), len(styled.goal))
        num = max(len(one.patterns) for one in (usual, styled))
        if num > 1:
            raise ImitationError(f"style: found a hand of {num} patterns; accepted: 1, demonstrations of one figure")
        means = [one.patterns[0].mean / one.top for one in (usual, styled)]
        num_knots = max(len(mean) for mean in means)
        before, after = (_at_knots(mean, num_knots) for mean in means)
        offsets = (after - after[-1]) - (before - before[-1])
        return cls(offsets - np.linspace(1, 0, len(offsets))[:, None] * offsets[0])

    def on(self, imitation: AugmentedImitation, amount: float) -> AugmentedImitation:
        """A motion of any action in this style, of which a part is put on; a negative amount is taken off.

        Raises:
            ImitationError: it has more or fewer coordinates.
        """
        _check(self.offsets.shape[1], len(imitation.goal))
        moved = amount * imitation.top * _at_knots(self.offsets, len(imitation.patterns[0].mean))
        patterns = tuple(replace(pattern, mean=pattern.mean + moved) for pattern in imitation.patterns)
        return replace(imitation, patterns=patterns, reason="a style is put on it")


def _at_knots(values: Array, num: int) -> Array:
    """Values (K, d) at even knots, at `num` of them."""
    return PhaseCurve.through(np.linspace(0, 1, len(values)), values).at(np.linspace(0, 1, num))


def _check(wanted: int, found: int) -> None:
    if found != wanted:
        raise ImitationError(f"style: found a motion of {found} coordinates; accepted: {wanted}, as the style has")
