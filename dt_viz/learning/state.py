"""Plain or augmented: which state a motion is learned in.

``plain``
    one vector field of places, as in the paper: it needs no memory, and no two of its motions cross;
``augmented``
    it remembers its phase and where it began (see `dt_viz.learning.augmented`): it crosses, comes back and winds, and
    draws the figure from other starts, too;
``auto``
    plain, unless the demonstrations conflict, or a plain fit with the default settings misses one. Other settings do
    not change the state: who chooses fewer layers, or another objective, sees what these make of the plain motion.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.augmented import AugmentedImitation, augmented_from, checked_labels
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, Progress, fit
from dt_viz.learning.initial_guess import groups_of
from dt_viz.learning.preparation import ImitationError, Motions, prepare
from dt_viz.metrics import discrete_frechet, resample_by_arc_length

State = Literal["auto", "plain", "augmented"]
"""State that a motion is learned in."""
STATES: tuple[State, ...] = get_args(State)
AnyImitation = Imitation | AugmentedImitation

MOST_COMPARED = 40
"""Largest number of demonstrations that are compared with each other; of more, as many evenly among them."""
NUM_COMPARED = 120
"""Number of points of a demonstration, evenly by arc length, at which conflicts are looked for."""
NEAR, ANGLE, APART = 0.1, 45.0, 0.1
"""Distance in spreads, angle of directions in degrees, and difference of phases, from which on two passages of a place
are in conflict."""
MOST_CONFLICTING = 0.03
"""Largest share of the way on which demonstrations may conflict for the plain state."""
MOST_MISSED = 0.05
"""Largest Fréchet distance of a plain motion from its demonstration, relative to the extent; with a larger one *auto*
takes the augmented state."""
MOST_UNTOLD = 0.12
"""Largest Fréchet distance of an augmented motion from its demonstration, relative to the extent; with a larger one the
starts do not tell which pattern is followed, and labels are looked for. Handwriting of one pattern stays below 9 %."""
LEAST_TELLING = 0.01
"""Least distance of the starts of different patterns, relative to the extent, that tells these apart; nearer to each
other, what is followed would hang on how a start is rounded."""
MOST_PATTERNS = 8
"""Largest number of patterns that are looked for in demonstrations which their starts do not tell apart."""


@dataclass(frozen=True)
class Conflicts:
    """How much of the demonstrations' way passes a place in different directions, from 0 to 1."""

    phase: float
    """At different phases: what an augmented state resolves."""
    label: float
    """Of two demonstrations at about the same phase: what only a label resolves."""


def learn(
    demonstrations: Sequence[Demonstration],
    settings: ImitationSettings | None = None,
    state: State = "auto",
    labels: Sequence[float] | None = None,
    progress: Progress | None = None,
    plain: Callable[[ImitationSettings | None], Imitation] | None = None,
) -> AnyImitation:
    """Learn a stable motion in the state that is asked for.

    Args:
        demonstrations: at least one, all ending at (about) the same place.
        settings: of the plain fit; None takes the defaults.
        state: see the module.
        labels: a number for each demonstration; only of the augmented state. None looks for some where it misses
            demonstrations without; see `patterns_of`.
        progress: see `dt_viz.learning.imitation.fit`.
        plain: gives the plain fit with these settings; None fits it here.

    Raises:
        ImitationError: nothing can be learned, there is no such state, or the plain state is to have labels.
    """
    if state not in STATES:
        raise ImitationError(f"state: found {state!r}; accepted: {', '.join(STATES)}")
    if state == "plain" and labels is not None:
        raise ImitationError("labels: found some; accepted: none in the plain state")
    plain = plain or (lambda settings: fit(demonstrations, settings, progress))
    if state == "plain":
        return plain(settings)
    began, reason = time.perf_counter(), ""
    motions = prepare(demonstrations)
    if labels is not None:
        given = checked_labels(labels, len(demonstrations))
        imitation = augmented_from(motions, given)
        imitation = _judged(imitation, missed(imitation, motions, [given[number] for number in motions.numbers]))
    else:
        if state == "auto":
            usual, reason = _usual(motions, plain)
            if usual is not None:
                return usual if settings in (None, ImitationSettings()) else plain(settings)
        imitation = _with_patterns(motions, len(demonstrations))
    return replace(imitation, reason=reason, fit_seconds=time.perf_counter() - began)


def _usual(motions: Motions, plain: Callable[[ImitationSettings | None], Imitation]) -> tuple[Imitation | None, str]:
    """The plain fit with the default settings, or why it is not to be taken."""
    share = conflicts(motions).phase
    if share > MOST_CONFLICTING:
        return None, f"on {100 * share:.0f} % of their way the demonstrations pass a place in different directions"
    try:
        imitation = plain(None)
    except ImitationError as error:
        return None, f"the plain state fails: {error}"
    off = missed(imitation, motions)
    if off > MOST_MISSED:
        return None, f"the plain state misses a demonstration by {100 * off:.0f} % of the extent"
    return imitation, ""


def _with_patterns(motions: Motions, num_demonstrations: int) -> AugmentedImitation:
    """The augmented state; with the fewest labels that tell what follows, where starts do not."""
    imitation = augmented_from(motions)
    off = missed(imitation, motions)
    if off > MOST_UNTOLD or not _told_apart(imitation, LEAST_TELLING * motions.extent):
        for num in range(2, min(MOST_PATTERNS, len(motions.positions)) + 1):
            labels = patterns_of(motions, num)
            known = dict(zip(motions.numbers, labels, strict=True))
            labelled = augmented_from(motions, [known.get(k, labels[0]) for k in range(num_demonstrations)])
            off_labelled = missed(labelled, motions, labels)
            if off_labelled <= MOST_UNTOLD:
                return labelled
            if off_labelled < off:
                imitation, off = labelled, off_labelled
    return _judged(imitation, off)


def _judged(imitation: AugmentedImitation, off: float) -> AugmentedImitation:
    """The imitation, with a warning where a motion is `off` its demonstration, relative to the extent, by too much."""
    if off <= MOST_UNTOLD:
        return imitation
    warning = f"a motion misses its demonstration by {100 * off:.0f} % of the extent"
    return replace(imitation, warnings=(*imitation.warnings, warning))


def _told_apart(imitation: AugmentedImitation, least: float) -> bool:
    """Whether each motion begins nearest to one of its own pattern, where it has several, and `least` from others."""
    starts = np.concatenate([pattern.conditions for pattern in imitation.patterns])
    sizes = [len(pattern.conditions) for pattern in imitation.patterns]
    of, num = np.repeat(np.arange(len(sizes)), sizes), np.repeat(sizes, sizes)
    apart = np.linalg.norm(starts[:, None] - starts, axis=-1) + np.diag(np.full(len(starts), np.inf))
    own = (of[apart.argmin(axis=1)] == of)[num > 1]
    return bool(own.all() and apart[of[:, None] != of].min(initial=np.inf) >= least)


def patterns_of(motions: Motions, num: int) -> tuple[float, ...]:
    """Tell motions apart by their shapes, wherever they begin.

    Args:
        motions: R of them.
        num: of the patterns, at least 2.

    Returns:
        A label for each motion: evenly, 2 apart, around 0, in the order in which patterns come first.
    """
    shapes = motions.resampled(NUM_COMPARED)
    fading = np.linspace(1.0, 0.0, NUM_COMPARED)[:, None]
    groups = groups_of(shapes - fading * shapes[:, :1], num)
    first = list(dict.fromkeys(groups))
    return tuple(2.0 * first.index(group) - (len(first) - 1) for group in groups)


def conflicts(motions: Motions) -> Conflicts:
    """Measure how much of the way of motions is in conflict; near the goal, where all meet, nothing is.

    Nor is a place in conflict with itself while a motion stays there: recordings tremble.
    """
    points = motions.resampled(NUM_COMPARED) / motions.spread
    points = points[np.unique(np.linspace(0, len(points) - 1, MOST_COMPARED).round().astype(int))]
    directions = np.gradient(points, axis=1)
    directions /= np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-12)
    goal, phase = motions.goal / motions.spread, np.linspace(0, 1, NUM_COMPARED)
    later, told = [], []
    for k, (path, along) in enumerate(zip(points, directions, strict=True)):
        first, last = _stays(path)
        far = (phase < phase[first, None] - APART) | (phase > phase[last, None] + APART)
        away = (np.linalg.norm(path - goal, axis=1) > 2 * NEAR)[:, None]
        found = np.zeros((2, NUM_COMPARED), dtype=bool)
        for other in range(len(points)):
            close = np.linalg.norm(path[:, None] - points[other], axis=-1) < NEAR
            against = close & away & (along @ directions[other].T < np.cos(np.radians(ANGLE)))
            found[0] |= (against & far).any(axis=1)
            found[1] |= (against & ~far).any(axis=1) & (other != k)
        later.append(found[0])
        told.append(found[1])
    return Conflicts(float(np.mean(later)), float(np.mean(told)))


def _stays(path: Array) -> tuple[Indices, Indices]:
    """For each point of a path (n, d) the first and the last one, in a row with it, that are near it."""
    leaves = np.linalg.norm(path[:, None] - path, axis=-1) >= NEAR
    number, last = np.arange(len(path)), len(path) - 1
    before, behind = leaves & (number < number[:, None]), leaves & (number > number[:, None])
    first = np.where(before.any(axis=1), last - before[:, ::-1].argmax(axis=1) + 1, 0)
    return first, np.where(behind.any(axis=1), behind.argmax(axis=1) - 1, last)


def missed(imitation: AnyImitation, motions: Motions, labels: Sequence[float] | None = None) -> float:
    """Largest discrete Fréchet distance of a learned motion from its demonstration, relative to the extent."""
    of = [None] * len(motions.positions) if labels is None else labels
    drawn = np.stack(
        [_drawn(imitation.system, path[0], label) for path, label in zip(motions.positions, of, strict=True)]
    )
    return float(discrete_frechet(drawn, motions.resampled(NUM_COMPARED)).max()) / motions.extent


def _drawn(system: DiffeomorphicSystem, start: Array, label: float | None) -> Array:
    """Places (n, d) of a learned motion, evenly along it."""
    begun = system.transform.forward(system.base.states(start, label))
    path = system.transform.inverse(system.base.at_fraction(begun, np.linspace(1, 0, NUM_COMPARED)))
    return resample_by_arc_length(path[:, : len(start)], NUM_COMPARED)
